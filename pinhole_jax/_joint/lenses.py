"""Parameters that cameras have in common: which these are, and where they begin."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from .._camera.camera import Camera
from .._camera.distortion import COEFFICIENTS
from .._solver.least_squares import Rows, Solved
from .._solver.parameters import PARAMETERS, as_names, check_free, in_one

#: What views may share.
SHARED = tuple(name for name, row in PARAMETERS.items() if row.shared)
#: A smaller share of the information on what is shared is rounding.
CLEAR = 1e-11


def shared_and_free(
    shared: str | Sequence[str], free: str | Sequence[str], camera: Camera
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """All names in a fixed order, and those that are shared.

    Raises ValueError for names of no parameter, or of one that cannot be shared.
    """
    common = check_shared(as_names(shared, "shared"), camera)
    return in_one(check_free([*common, *as_names(free)], camera)), common


def groups_of(shared: Any, cameras: Mapping[str, Camera]) -> dict[str, list[tuple[str, ...]]]:
    """Groups of cameras that have a parameter in common, by its name.

    `shared` are names (of all cameras), or such groups by names. Raises ValueError for others.
    """
    given = shared
    if not isinstance(shared, Mapping):
        given = {name: [tuple(cameras)] for name in as_names(shared, "shared")}
    first, result = next(iter(cameras.values())), {}
    for name, groups in given.items():
        for row in check_shared((name,), first):
            result[row] = [(group,) if isinstance(group, str) else tuple(group) for group in groups]
            named = [n for group in result[row] for n in group]
            if unknown := [n for n in named if n not in cameras]:
                words = f"expected groups of cameras among {', '.join(cameras)}, got {unknown[0]!r}"
                raise ValueError(f"`shared`: {words}")
            if len({*named}) < len(named):
                raise ValueError(f"`shared`: expected each camera in one group of {row}, got more")
    return result


def check_shared(shared: tuple[str, ...], camera: Camera) -> tuple[str, ...]:
    """The names in a fixed order. Raises ValueError for those that cannot be shared."""
    common = check_free(shared, camera) if shared else ()
    if not {*common} <= {*SHARED}:
        known = ", ".join([*SHARED, "distortion"])
        raise ValueError(f"`shared`: expected names among {known}, got {', '.join(common)}")
    return common


def alike_in_groups(
    cameras: Mapping[str, Camera], groups: Mapping[str, list[tuple[str, ...]]]
) -> dict[str, Camera]:
    """The cameras with the mean of each group's shared parameters."""
    result = dict(cameras)
    for row, members in groups.items():
        for group in members:
            same = alike([result[name] for name in group], (row,))
            result.update(zip(group, same, strict=True))
    return result


def alike(cameras: Sequence[Camera], common: tuple[str, ...]) -> list[Camera]:
    """The cameras with the mean of shared parameters."""
    kinds = {type(c.lens and c.lens.distortion) for c in cameras}
    if len(kinds) > 1 and not {*COEFFICIENTS}.isdisjoint(common):
        words = " and ".join(sorted(k.__name__ for k in kinds))
        raise ValueError(f"`cameras`: expected distortions of one kind to share, got {words}")
    result = list(cameras)
    for leaf in (leaf for name in common for leaf in PARAMETERS[name].leaves):
        values = [leaf.of(c) for c in cameras]
        mean: Any = sum(values[1:], values[0]) / len(values)
        result = [eqx.tree_at(leaf.of, c, mean.astype(c.e.dtype)) for c in result]
    return result


def known_by_others(solved: Solved, part: Rows, shared: np.ndarray) -> np.ndarray:
    """Residuals (s, s) of all other parts by the unknowns that a part shares with them (which of
    its columns): their information is that of all, less the part's, its own unknowns eliminated."""
    own, m = part.rows[:, ~shared], int(np.sum(~shared))
    r: Any = np.linalg.qr(np.column_stack([own, part.rows[:, shared]]), mode="r")
    columns = part.columns[shared]
    inverse = solved.inverse(columns, columns)
    spread = np.sqrt(np.diag(inverse))
    unit = np.where(spread > 0, 1 / np.where(spread > 0, spread, 1), 0)
    total = np.linalg.pinv(inverse * np.outer(unit, unit), CLEAR, hermitian=True)
    rest = r[m:, m:] * spread
    values, vectors = np.linalg.eigh(total - rest.T @ rest)
    values = np.where(values > CLEAR * np.max(np.abs(total), initial=0), values, 0)
    return np.sqrt(values)[:, None] * vectors.T * unit
