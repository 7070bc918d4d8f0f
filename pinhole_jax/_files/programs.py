"""Programs that are kept as they were traced, so that a later process need not trace them again.

JAX keeps what it compiled, but to find that it has to trace and lower the program first: two of the
three seconds that a first fit waits for where all is kept.
"""

import functools
import hashlib
import importlib
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .paths import replace_file

#: What a traced program depends on beside its own code: other people's code, and JAX's switches.
PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
SWITCHES = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_legacy_prng_key",
)
#: Switches with which each call wants to be looked at, and those that say where it runs.
WATCHED = ("jax_debug_nans", "jax_debug_infs", "jax_disable_jit", "jax_default_device")

_folder: Path | None = None
_programs: dict[Any, Callable[..., Any] | None] = {}


def keep_in(folder: Path | None) -> None:
    """Keep traced programs in a folder from now on (None: nowhere)."""
    global _folder
    _folder = folder
    _programs.clear()


def call(where: str, arguments: tuple[Any, ...], answer: Callable[[], Any]) -> Any:
    """Return what a function of `equinox.filter_jit`'s returns, traced by an earlier process where
    that can be.

    `where` names it, as "module:name": its module is not imported where it need not be traced.
    `answer` returns something of the same structure as what the function returns.
    """
    if _folder is None:
        return _function(where)(*arguments)
    leaves, tree = jax.tree.flatten(arguments)
    key = where, tree, tuple(map(_described, leaves)), _settings(SWITCHES), _settings(WATCHED)
    if key not in _programs:
        _programs[key] = _program(key, arguments, answer)
    program = _programs[key]
    if program is None:
        return _function(where)(*arguments)
    return program(*filter(_is_array, leaves))


def like(kind: Any) -> Any:
    """Return a named tuple of a kind, of numbers."""
    return kind(*[0.0] * len(kind._fields))


def _program(
    key: Any, arguments: tuple[Any, ...], answer: Callable[[], Any]
) -> Callable[..., Any] | None:
    """Return a function of the arrays among some arguments, read or traced; None for a program that
    cannot be kept."""
    where, tree, described, switches, watched = key
    text = repr((where, str(tree), described, switches, _versions(), _source()))
    plain = jax.default_backend() == "cpu" and jax.device_count() == 1 and not any(watched)
    if _folder is None or not plain or " at 0x" in text:  # (an address: another one next time)
        return None
    path = _folder / f"{hashlib.sha256(text.encode()).hexdigest()}.stablehlo"
    structure = jax.tree.structure(answer())
    exported = _read(path)
    if exported is None:
        exported = _traced(where, arguments, structure)
        if exported is None:
            return None
        data = exported.serialize()
        with suppress(OSError, ValueError):  # a folder that cannot be written to keeps nothing
            replace_file(path, hashlib.sha256(data).digest() + bytes(data))
    # (Compiled here: a jit would compile once more for arrays that are results of its own.)
    run = jax.jit(exported.call).lower(*filter(_is_array, jax.tree.leaves(arguments))).compile()
    return lambda *arrays: jax.tree.unflatten(structure, run(*arrays))


def _read(path: Path) -> Any:
    """Return the program in a file, None where there is none, or not whole."""
    from jax import export

    with suppress(OSError, ValueError):
        content = path.read_bytes()
        digest, data = content[:32], content[32:]
        if hashlib.sha256(data).digest() == digest:
            return export.deserialize(bytearray(data))
    return None


def _traced(where: str, arguments: tuple[Any, ...], structure: Any) -> Any:
    """Return a program of the arrays among some arguments, None where it cannot be kept."""
    from jax import export

    leaves, tree = jax.tree.flatten(arguments)

    def flat(*arrays: Any) -> list[Any]:
        rest = iter(arrays)
        own = [next(rest) if _is_array(leaf) else leaf for leaf in leaves]
        result, found = jax.tree.flatten(_function(where)(*jax.tree.unflatten(tree, own)))
        if found != structure:
            raise AssertionError(f"a result of structure {found}, expected {structure}")
        return result

    with suppress(NotImplementedError, ValueError):
        return export.export(jax.jit(flat))(*filter(_is_array, leaves))
    return None


def _function(where: str) -> Callable[..., Any]:
    module, name = where.split(":")
    return getattr(importlib.import_module(module), name)


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, np.ndarray | np.generic | jax.Array)


def _described(leaf: Any) -> Any:
    """Return what a program depends on of an argument's leaf."""
    if _is_array(leaf):
        return leaf.shape, str(leaf.dtype), getattr(leaf, "weak_type", False)
    return type(leaf).__name__, leaf


def _settings(names: tuple[str, ...]) -> tuple[Any, ...]:
    return tuple(getattr(jax.config, name, None) for name in names)


@functools.cache
def _versions() -> tuple[str, ...]:
    return tuple(map(version, PACKAGES))


@functools.cache
def _source() -> str:
    """Return a digest of this package's code."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
    return digest.hexdigest()
