"""What cameras have in common, and what many views know of that.

The Jacobian of views with a camera each is an arrow: each view has columns of its own and all have
the shared ones. A view's own unknowns are eliminated, and what is left of the others is what they
know of the shared ones, to this view.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from .._camera.camera import Camera
from .._camera.distortion import COEFFICIENTS
from .._camera.lens import Lens
from .._solver.looks import View
from .._solver.parameters import PARAMETERS, as_names, check_free, in_one

#: What views may share.
SHARED = tuple(name for name, row in PARAMETERS.items() if row.shared)


def shared_and_free(
    shared: str | Sequence[str],
    free: str | Sequence[str],
    camera: Camera | None,
    lens: Lens | None = None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return all names in a fixed order, and those that are shared, or raise ValueError; without a
    camera those of a lens."""
    free = as_names(free)
    common = check_shared(as_names(shared, "shared"), camera, lens)
    own = [n for n in check_free(free, camera, lens) if n not in common] if free else []
    return in_one(check_free([*common, *own], camera, lens)), common


def groups_of(shared: Any, cameras: Mapping[str, Camera]) -> dict[str, list[tuple[str, ...]]]:
    """Return for each parameter that is shared the groups of cameras that have one in common, or
    raise ValueError; `shared` are names (of all cameras), or such groups by names."""
    given: Any = shared
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


def check_shared(
    shared: tuple[str, ...], camera: Camera | None, lens: Lens | None = None
) -> tuple[str, ...]:
    """Return the names in a fixed order, or raise ValueError for what cannot be shared."""
    common = check_free(shared, camera, lens) if shared else ()
    if not {*common} <= {*SHARED}:
        known = ", ".join([*SHARED, "distortion"])
        raise ValueError(f"`shared`: expected names among {known}, got {', '.join(common)}")
    return common


def alike_in_groups(
    cameras: Mapping[str, Camera], groups: Mapping[str, list[tuple[str, ...]]]
) -> dict[str, Camera]:
    """Return the cameras with the mean of what each group shares."""
    result = dict(cameras)
    for row, some in groups.items():
        for group in some:
            same = alike([result[name] for name in group], (row,))
            result.update(zip(group, same, strict=True))
    return result


def alike(cameras: Sequence[Camera], common: tuple[str, ...]) -> list[Camera]:
    """Return the cameras with the mean of what they share."""
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


class Reduced(NamedTuple):
    """A view's least squares with its own unknowns eliminated, and what they leave of the shared
    ones: across (m, k), along (m,); rest (., k), left (.,). Shared columns per unit."""

    across: np.ndarray
    along: np.ndarray
    rest: np.ndarray
    left: np.ndarray

    @property
    def slope(self) -> np.ndarray:
        """Return half the squares' derivative (k,) by the shared unknowns."""
        return self.across.T @ self.along + self.rest.T @ self.left


def reduced(view: Any, own: np.ndarray) -> Reduced:
    """Return a view's least squares with its own unknowns eliminated; as of `View`s it takes what
    has a `triangle`, `along` and `scale`."""
    columns = np.asarray(view.triangle, float) / np.where(own, 1, np.asarray(view.scale, float))
    m, k = int(own.sum()), int((~own).sum())
    along = np.asarray(view.along, float)
    r: Any = np.linalg.qr(np.column_stack([columns[:, own], columns[:, ~own], along]), mode="r")
    return Reduced(r[:m, m : m + k], r[:m, -1], r[m:, m : m + k], r[m:, -1])


def others(rests: list[np.ndarray]) -> list[np.ndarray]:
    """Return for each view what all others together know of the shared unknowns, as a triangle."""

    def running(items: Any) -> list[np.ndarray]:
        result: list[Any] = [np.zeros((0, rests[0].shape[1]))]
        for rest in items:
            result.append(np.linalg.qr(np.concatenate([result[-1], rest]), mode="r"))
        return result

    before, after = running(rests[:-1]), running(rests[:0:-1])[::-1]
    return [np.concatenate(pair) for pair in zip(before, after, strict=True)]


def joint(view: Any, others: np.ndarray, slope: np.ndarray, own: np.ndarray) -> Any:
    """Return the view with what the others know of the shared unknowns, and with the `slope` of
    all together by these."""
    scale = np.asarray(view.scale, float)[~own]
    more = np.zeros((len(others), len(own)))
    more[:, ~own] = others * scale
    triangle: Any = np.linalg.qr(np.concatenate([np.asarray(view.triangle, float), more]), mode="r")
    gradient = np.asarray(view.triangle, float).T @ np.asarray(view.along, float)
    gradient[~own] = slope * scale
    along = np.linalg.lstsq(triangle.T, gradient, rcond=None)[0]
    # (As NumPy's: within `grad` JAX's would be traced, and no report could look at them.)
    return view._replace(triangle=triangle, along=along)


def in_few(view: View, rows: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals `rows y` of a view's moves, and half their squares' derivative (n,), as not
    more than there are moves: rows (n, n) and their values (n,).

    No row counts more than what the view itself sees best: it is that to which it compares what it
    hardly sees, and with many others it would hardly see anything.
    """
    most = np.linalg.norm(np.asarray(view.triangle, float), 2)
    seen = np.any(rows != 0, axis=0)
    _, values, directions = np.linalg.svd(rows[:, seen], full_matrices=False)
    n, k = rows.shape[1], len(values)
    few, left = np.zeros((n, n)), np.zeros(n)
    few[:k, seen] = np.minimum(values, most)[:, None] * directions
    left[:k] = np.linalg.lstsq(few[:k].T, slope, rcond=None)[0]
    return few, left


def with_rows(view: View, rows: np.ndarray, left: np.ndarray) -> View:
    """Return the view with more residuals: their derivatives (., n) and values."""
    seen = np.column_stack([np.asarray(view.triangle, float), np.asarray(view.along, float)])
    table: Any = np.linalg.qr(np.concatenate([seen, np.column_stack([rows, left])]), mode="r")
    n = rows.shape[1]
    prior = float(view.prior) + float(left @ left)
    return view._replace(triangle=table[:n, :n], along=table[:n, n], prior=prior)
