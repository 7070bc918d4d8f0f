"""Parameters that cameras have in common: which these are, and where they begin."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import numpy as np

from .._camera.camera import Camera
from .._camera.distortion import COEFFICIENTS
from .._solver.least_squares import LinearSolution, Rows
from .._solver.parameters import PARAMETERS, as_names, check_free, in_one, with_lens

#: What views may share.
SHARED = tuple(name for name, row in PARAMETERS.items() if row.shared)
#: A smaller share of the information on what is shared is rounding.
CLEAR = 1e-11


def with_shared(
    cameras: Mapping[str, Camera], free: Any, shared: Any
) -> tuple[tuple[str, ...], dict[str, list[tuple[str, ...]]], dict[str, Camera]]:
    """All free parameters, in a fixed order; groups of cameras that have a parameter in
    common; and the cameras, alike in these, with a lens that has what is free.

    Raises ValueError for names of no parameter, or of one that cannot be shared.
    """
    groups = groups_of(shared, cameras)
    names = (*groups, *as_names(free))
    freed = in_one(check_free(names, next(iter(cameras.values())))) if names else ()
    having = {name: with_lens(camera, freed) for name, camera in cameras.items()}
    return freed, groups, share_means(having, groups)


def groups_of(shared: Any, cameras: Mapping[str, Camera]) -> dict[str, list[tuple[str, ...]]]:
    """Groups of cameras that have a parameter in common, by its name.

    `shared` are names (of all cameras), or such groups by names. Raises ValueError for others.
    """
    given = shared
    if not isinstance(shared, Mapping):
        given = {name: [tuple(cameras)] for name in as_names(shared, "shared")}
    first, result = next(iter(cameras.values())), {}
    for name, groups in given.items():
        for row in check_free((name,), first):
            if row not in SHARED:
                known = ", ".join([*SHARED, "distortion"])
                raise ValueError(f"`shared`: expected names among {known}, got {row}")
            result[row] = [(group,) if isinstance(group, str) else tuple(group) for group in groups]
            named = [n for group in result[row] for n in group]
            if unknown := [n for n in named if n not in cameras]:
                words = f"expected groups of cameras among {', '.join(cameras)}, got {unknown[0]!r}"
                raise ValueError(f"`shared`: {words}")
            if len({*named}) < len(named):
                raise ValueError(f"`shared`: expected each camera in one group of {row}, got more")
    return result


def share_means(
    cameras: Mapping[str, Camera], groups: Mapping[str, list[tuple[str, ...]]]
) -> dict[str, Camera]:
    """The cameras with the mean of each group's shared parameters.

    Raises ValueError for coefficients of different distortions.
    """
    result = dict(cameras)
    for row, group in ((row, group) for row, members in groups.items() for group in members):
        kinds = {type(result[name].distortion).__name__ for name in group}
        if len(kinds) > 1 and row in COEFFICIENTS:
            words = f"expected distortions of one kind to share, got {' and '.join(sorted(kinds))}"
            raise ValueError(f"`cameras`: {words}")
        for leaf in PARAMETERS[row].leaves:
            values = [leaf.of(result[name]) for name in group]
            mean: Any = sum(values[1:], values[0]) / len(values)
            for name in group:
                mean = mean.astype(result[name].e.dtype)
                result[name] = eqx.tree_at(leaf.of, result[name], mean)
    return result


def known_by_others(solved: LinearSolution, part: Rows, shared: np.ndarray) -> np.ndarray:
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
