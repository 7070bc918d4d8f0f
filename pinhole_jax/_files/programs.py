"""Programs that are kept as they were traced, so that a later process need not trace them again.

JAX keeps what it compiled, but to find that it has to trace and lower the program first: two of the
three seconds that a first fit waits for where all is kept.

A program is found by all that it was traced from: the package's code, the versions of what that
uses, the arguments' structure, shapes and static values, and JAX's switches. Where one of these
cannot be told, nothing is kept.
"""

import hashlib
import importlib
import sys
import threading
from collections.abc import Callable, Hashable, Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import export

from .._numerics.jitted import options
from .native_library import HANDLERS, is_switched_off, library_path
from .paths import read_bytes, replace_file

#: What a traced program depends on beside its own code: other people's code, and JAX's switches.
PACKAGES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")
SWITCHES = (
    "jax_enable_x64",
    "jax_explicit_x64_dtypes",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_legacy_prng_key",
    "jax_softmax_custom_jvp",
    "jax_error_checking_behavior_nan",
    "jax_error_checking_behavior_divide",
    "jax_error_checking_behavior_oob",
)
#: Switches with which JAX has to look at each call, and one that says where it runs.
WATCHED = ("jax_debug_nans", "jax_debug_infs", "jax_disable_jit", "jax_default_device")
#: At most this many programs are held.
HELD = 64
#: XLA's older way to write kernels for a CPU: a mask takes a fifth less time to compile, and what
#: it makes runs 1.3 to 1.6 times as long. From jaxlib 0.12 on XLA no longer has it, and refuses it.
QUICK = {"xla_cpu_use_fusion_emitters": False}

_folder: Path | None = None
_code: str | None = None
_quick = False
_programs: dict[Any, Callable[..., Any] | None] = {}
_making = threading.RLock()


def keep_in(folder: Path | None, quick: bool = False) -> None:
    """Keep traced programs in a folder from now on (None: nowhere).

    `quick` ones are compiled in less time and run for longer: for a process that runs them a few
    times, as a command does.
    """
    global _folder, _code, _quick
    if (folder, quick) != (_folder, _quick):
        _folder, _code, _quick = folder, folder and _source(), quick
        _programs.clear()


def call(where: str, arguments: tuple[Any, ...], answer: Callable[[], Any]) -> Any:
    """Return what a jitted function returns, traced by an earlier process where that can be.

    `where` names a `jitted` function, as "module:name": its module is not
    imported where it need not be traced. `answer` returns something of its result's structure.
    """
    if _folder is None:
        return _function(where)(*arguments)
    given = name_of(where, arguments)
    key = given, _imported(where)
    with _making:
        if key not in _programs:
            if len(_programs) >= HELD:
                _programs.clear()
            program = _program(where, arguments, answer)
            # (To trace it imports its module.)
            _programs[key] = _programs[given, _imported(where)] = program
        program = _programs[key]
    if program is None:
        return _function(where)(*arguments)
    return program(*filter(_is_array, jax.tree.leaves(arguments)))


def name_of(where: str, arguments: tuple[Any, ...]) -> Hashable:
    """Return what tells the program from all others of this process that `call` calls with such
    arguments."""
    leaves, tree = jax.tree.flatten(arguments)
    return where, tree, tuple(map(_described, leaves)), _settings(SWITCHES), _settings(WATCHED)


def like(kind: Any) -> Any:
    """Return a named tuple of that kind, with a number in each field."""
    return kind(*[0.0] * len(kind._fields))


def _program(
    where: str, arguments: tuple[Any, ...], answer: Callable[[], Any]
) -> Callable[..., Any] | None:
    """Return a function of the arrays among some arguments, read or traced; None for a program that
    cannot be kept."""
    path = _path(where, arguments)
    if path is None:
        return None
    structure = jax.tree.structure(answer())
    exported = _read(path)
    if exported is None:
        exported = _traced(where, arguments, structure)
        if exported is None:
            return None
        data = exported.serialize()
        exported = export.deserialize(bytearray(data))  # as later processes have it: compiled once
        if _source() == _code:  # else it was traced from code that is no longer there
            with suppress(OSError, ValueError):  # a folder that cannot be written to keeps nothing
                replace_file(path, hashlib.sha256(data).digest() + bytes(data))
    _set_lapack_up()
    # (Compiled here: a jit would compile once more for arrays that are results of its own.)
    arrays = filter(_is_array, jax.tree.leaves(arguments))
    run = _compiled(jax.jit(exported.call).lower(*arrays))
    return lambda *arrays: jax.tree.unflatten(structure, run(*arrays))


def _compiled(lowered: Any) -> Any:
    if _quick:
        with suppress(RuntimeError):  # an XLA that does not know the way
            return lowered.compile(compiler_options={**options(), **QUICK})
    return lowered.compile(compiler_options=options())


def _set_lapack_up() -> None:
    """Let XLA know where LAPACK is. JAX does so where it lowers a call of it: not where it reads a
    program, which jaxlib 0.7 then ends the process for."""
    with suppress(ImportError, AttributeError):
        importlib.import_module("jaxlib.lapack")._lapack.initialize()


def _path(where: str, arguments: tuple[Any, ...]) -> Path | None:
    """Return the file of a program, None where it cannot be told from all others."""
    plain = jax.default_backend() == "cpu" and jax.device_count() == 1
    plain &= all(_settings(("jax_enable_compilation_cache",))) and not any(_settings(WATCHED))
    leaves, tree = jax.tree.flatten(arguments)
    classes = list(_classes(tree))
    ours = all(c.__module__.split(".")[0] in ("pinhole_jax", "builtins") for c in classes)
    if _folder is None or _code is None or not plain or not ours:
        return None
    names = [f"{c.__module__}.{c.__qualname__}" for c in classes]
    described = tuple(map(_described, leaves))
    with suppress(PackageNotFoundError):
        versions = tuple(map(version, PACKAGES))
        library = library_path() is not None and not is_switched_off()
        facts = (names, described, _settings(SWITCHES), versions, _code, library)
        text = repr((where, str(tree), *facts))
        if " at 0x" not in text:  # an address is another one in the next process
            return _folder / f"{hashlib.sha256(text.encode()).hexdigest()}.stablehlo"
    return None


def _classes(tree: Any) -> Iterator[type]:
    """Yield the classes of a structure's nodes."""
    node = tree.node_data()
    if node is not None:
        yield node[0]
    for child in tree.children():
        yield from _classes(child)


def _read(path: Path) -> Any:
    """Return the program in a file, None where there is none, or not whole."""
    with suppress(OSError, ValueError):
        content = read_bytes(path, "a traced program")
        digest, data = content[:32], content[32:]
        if hashlib.sha256(data).digest() == digest:
            return export.deserialize(bytearray(data))
    return None


def _traced(where: str, arguments: tuple[Any, ...], structure: Any) -> Any:
    """Return a program of the arrays among some arguments, None where it cannot be kept."""
    leaves, tree = jax.tree.flatten(arguments)

    def flat(*arrays: Any) -> list[Any]:
        rest = iter(arrays)
        own = [next(rest) if _is_array(leaf) else leaf for leaf in leaves]
        result, found = jax.tree.flatten(_function(where)(*jax.tree.unflatten(tree, own)))
        if found != structure:
            raise ValueError(f"expected a result of structure {structure}, got {found}")
        return result

    with suppress(NotImplementedError, ValueError):
        # (What the library promises from one process to the next is in the file's name.)
        ours = [export.DisabledSafetyCheck.custom_call(name) for name in HANDLERS]
        program = export.export(jax.jit(flat), disabled_checks=ours)
        return program(*filter(_is_array, leaves))
    return None


def _function(where: str) -> Callable[..., Any]:
    module, name = where.split(":")
    return getattr(importlib.import_module(module), name)


def _imported(where: str) -> int | None:
    """Return which function a name stands for now, None before its module is imported."""
    module, name = where.split(":")
    return id(getattr(sys.modules[module], name)) if module in sys.modules else None


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, np.ndarray | np.generic | jax.Array)


def _described(leaf: Any) -> Any:
    """Return what a program depends on of an argument's leaf."""
    if _is_array(leaf):
        return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)
    return type(leaf).__name__, repr(leaf)


def _settings(names: tuple[str, ...]) -> tuple[Any, ...]:
    return tuple(getattr(jax.config, name, None) for name in names)


def _source() -> str | None:
    """Return a digest of this package's code, None where it is not there to be read."""
    digest, root = hashlib.sha256(), Path(__file__).parents[1]
    paths = sorted(root.rglob("*.py"))
    with suppress(OSError):
        for path in paths:
            digest.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
        return digest.hexdigest() if paths else None
    return None
