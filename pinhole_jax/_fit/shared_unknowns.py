"""Many views that share unknowns, as one least-squares problem.

The Jacobian is an arrow: each view has columns of its own and all have the shared ones. Each view
is reduced to a small triangle by QR, its own unknowns are eliminated, and what is left of all views
determines the shared ones. So the cost is linear in the views, and no matrix over all of them is
ever made (nor normal equations, which would lose half of the digits).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._camera.camera import Camera
from .._camera.distortion import COEFFICIENTS
from .._camera.lens import Lens
from .parameters import PARAMETERS, as_names, check_free, in_one
from .problem import COARSE_PX, COSINE, FINE_PX, UNIT_PX

#: One view's residuals about where it is: `triangle` (R of J = QR), `along` (Q^T r), the unknowns'
#: `unit`s and `squares` (|r|^2). `problem.View` is one.
Linearised = Any
#: One view: `look(depth)` gives it linearised on a level, `stepped(depth, y)` after a step.
One = Any


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
    """A view's least squares with its own unknowns first, and what they leave of the shared ones:
    own (m, m), across (m, k), known (m,); rest (., k), left (.,). Shared columns per unit.
    """

    own: np.ndarray
    across: np.ndarray
    known: np.ndarray
    rest: np.ndarray
    left: np.ndarray


def reduced(view: Linearised, own: np.ndarray, damping: float) -> Reduced:
    """Return a view's least squares with its own unknowns, damped, eliminated."""
    columns = np.asarray(view.triangle, float).copy()
    columns[:, ~own] /= np.asarray(view.unit, float)[~own]
    m, k = int(own.sum()), int((~own).sum())
    table = np.concatenate(
        [columns[:, own], columns[:, ~own], np.asarray(view.along, float)[:, None]], axis=1
    )
    damped = np.concatenate([damping**0.5 * np.eye(m), np.zeros((m, k + 1))], axis=1)
    r: Any = np.linalg.qr(np.concatenate([table, damped]), mode="r")
    return Reduced(r[:m, :m], r[:m, m : m + k], r[:m, -1], r[m:, m : m + k], r[m:, -1])


def solved(views: list[Any], own: np.ndarray, damping: float) -> list[np.ndarray]:
    """Return each view's damped Gauss-Newton step in its own units."""
    parts = [reduced(v, own, damping) for v in views]
    unit = np.mean([np.asarray(v.unit, float)[~own] for v in views], axis=0)
    rest = np.concatenate([*(p.rest for p in parts), damping**0.5 * np.diag(1 / unit)])
    left = np.concatenate([*(p.left for p in parts), np.zeros(len(unit))])
    together = np.linalg.lstsq(rest * unit, -left, rcond=None)[0] * unit
    result = []
    for view, part in zip(views, parts, strict=True):
        y = np.empty(len(own))
        y[own] = np.linalg.lstsq(part.own, -part.known - part.across @ together, rcond=None)[0]
        y[~own] = together / np.asarray(view.unit, float)[~own]
        result.append(y)
    return result


class Descent(NamedTuple):
    """The views after a descent, what each is there, linearised, and the number of steps."""

    views: list[One]
    seen: list[Linearised]
    steps: int


def descend(
    views: list[One], depth: int, own: np.ndarray, max_steps: int, dtype: np.dtype
) -> Descent:
    """Return the views after Levenberg-Marquardt on one level."""
    tolerance = (FINE_PX[dtype] if depth <= 2 else COARSE_PX) / UNIT_PX
    seen, damping = [v.look(depth) for v in views], 1.0
    for n in range(1, max_steps + 1):
        ys = solved(seen, own, damping)
        trial = [v.stepped(depth, y) for v, y in zip(views, ys, strict=True)]
        there = [v.look(depth) for v in trial]
        before, after = (sum(v.squares for v in s) for s in (seen, there))
        change = sum(
            float(np.sum((np.asarray(v.triangle, float) @ y) ** 2))
            for v, y in zip(seen, ys, strict=True)
        )
        if after <= before:
            views, seen, damping = trial, there, damping / 10
        else:
            damping = max(10 * damping, 1e-6)
        small = max(float(np.max(np.abs(y))) for y in ys) < tolerance
        if small or change <= COSINE[dtype] ** 2 * before:
            return Descent(views, seen, n)
    return Descent(views, seen, max_steps)


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
    """Return the view with what the others know of the shared unknowns."""
    unit = np.asarray(view.unit, float)[~own]
    more = np.zeros((len(others), len(own)))
    more[:, ~own] = others * unit
    triangle: Any = np.linalg.qr(np.concatenate([np.asarray(view.triangle, float), more]), mode="r")
    gradient = np.asarray(view.triangle, float).T @ np.asarray(view.along, float)
    gradient[~own] = slope * unit
    along = np.linalg.lstsq(triangle.T, gradient, rcond=None)[0]
    return view._replace(triangle=jnp.asarray(triangle), along=jnp.asarray(along))


def beside(
    view: Any, rest: np.ndarray, slope: np.ndarray, own: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return what the others know of the shared unknowns as residuals of the view, in its units:
    rows (n, n) and their values (n,), from the others' triangle and slope.

    No row counts more than what the view itself sees best: it is that to which it compares what it
    hardly sees, and with many others it would hardly see anything.
    """
    unit = np.asarray(view.unit, float)[~own]
    most = np.linalg.norm(np.asarray(view.triangle, float), 2)
    _, values, directions = np.linalg.svd(rest * unit, full_matrices=False)
    k = len(values)
    rows, left = np.zeros((len(own), len(own))), np.zeros(len(own))
    rows[:k, ~own] = np.minimum(values, most)[:, None] * directions
    left[:k] = np.linalg.lstsq(rows[:k, ~own].T, slope * unit, rcond=None)[0]
    return rows, left


def with_rows(view: Any, rows: np.ndarray, left: np.ndarray) -> Any:
    """Return the view with more residuals: their derivatives (., n) and values."""
    seen = np.column_stack([np.asarray(view.triangle, float), np.asarray(view.along, float)])
    table: Any = np.linalg.qr(np.concatenate([seen, np.column_stack([rows, left])]), mode="r")
    n = rows.shape[1]
    prior = float(view.prior) + float(left @ left)
    return view._replace(triangle=table[:n, :n], along=table[:n, n], prior=prior)
