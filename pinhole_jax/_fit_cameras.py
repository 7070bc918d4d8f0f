"""`fit_cameras`: many views of one scene with shared intrinsics, in one least-squares problem.

The Jacobian is an arrow: each view has columns of its own and all have the shared ones. Each view
is reduced to a small triangle by QR, its own unknowns are eliminated, and what is left of all views
determines the shared ones. So the cost is linear in the views, and no matrix over all of them is
ever made (nor normal equations, which would lose half of the digits).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ._arrays import Numbers
from ._camera import Camera
from ._exact import completed, worthwhile
from ._fit import Fit, fit_camera, report
from ._parameters import as_names, canonical, check_free, components
from ._residuals import Capacity
from ._scene import Scene, check_scene
from ._search import Mask
from ._solver import COARSE_PX, COSINE, FINE_PX, UNIT_PX, Found, Solver, View
from ._target import check_target

#: What views may share.
SHARED = ("phi", "d", "principal_point", "aspect")


def fit_cameras(
    scene: Scene,
    targets: Sequence[Numbers],
    cameras: Sequence[Camera] | None,
    shared: str | Sequence[str] = ("phi",),
    free: str | Sequence[str] = ("pose",),
    *,
    phi: Numbers = None,
    weights: Sequence[Numbers] | None = None,
    max_steps: int = 64,
) -> tuple[Fit, ...]:
    """Return a `Fit` for each mask; what is `free` is each view's own, what is `shared` is one.

    - `targets`: masks, each as in `fit_camera`; their sizes may differ.
    - `cameras`: where to start, one for each mask; what is shared begins at their mean. None: each
      is searched for, with `phi` as in `fit_camera`.
    - `weights`: for each mask, or None.
    - `max_steps`: a limit for each level.

    The covariance of each fit is that of the joint problem: knowledge of all views is in it. The
    cost of a step grows linearly with the number of views.

    Raises ValueError for arguments that make no fit; what the solver met is in each `Fit.status`.
    """
    check_scene(scene)
    names = check_free(as_names(shared) + as_names(free))
    common = tuple(n for n in names if n in as_names(shared))
    unknown = [n for n in common if n not in SHARED]
    if unknown or not common:
        raise ValueError(f"`shared`: expected names among {', '.join(SHARED)}, got {shared!r}")
    count = len(targets)
    if count == 0:
        raise ValueError("`targets`: expected at least one mask, got none")
    weights = [None] * count if weights is None else weights
    for name, given in (("cameras", cameras), ("weights", weights)):
        if given is not None and len(given) != count:
            raise ValueError(f"`{name}`: expected one for each of {count} masks, got {len(given)}")
    if cameras is None:
        pairs = zip(targets, weights, strict=True)
        alone = (fit_camera(scene, t, None, names, phi=phi, weight=w) for t, w in pairs)
        cameras = [fit.camera for fit in alone]
    if not all(isinstance(c, Camera) for c in cameras):
        raise ValueError(f"`cameras`: expected Cameras, got {cameras!r}")

    views = []
    for camera, target, weight in zip(_alike(cameras, common), targets, weights, strict=True):
        image, w = check_target(target, weight, camera.W, camera.H)
        solver = Solver(scene, image, w, camera.e.dtype, names, max_steps)
        views.append(_One(Mask(image, w, camera), solver, canonical(camera)))
    largest = Capacity(*np.max([v.solver.capacity for v in views], axis=0).tolist())
    for one in views:
        one.solver.capacity = largest
    own = np.array([name not in common for name in names for _ in components((name,))])
    steps: list[int] = []
    for depth in range(max(len(v.solver.levels) for v in views), 0, -1):
        views, n = _descend(views, depth, own, max_steps)
        steps.append(n)
    return _reports(views, names, own, tuple(steps))


class _One(NamedTuple):
    """One view: its mask (with the camera as given), the mask's solver, and the camera so far."""

    mask: Mask
    solver: Solver
    unit: Camera

    def level(self, depth: int) -> int:
        """Return the number of the level this far from the last, or of the first."""
        return max(len(self.solver.levels) - depth, 0)

    def look(self, depth: int) -> View:
        """Return the view on a level; 0 is the last one with every pixel, overlaps resolved."""
        if depth == 0:
            return completed(self.solver, self.mask, self.unit)
        return self.solver.look(self.unit, self.level(depth))


def _alike(cameras: Sequence[Camera], common: tuple[str, ...]) -> list[Camera]:
    """Return the cameras with the mean of what they share."""
    leaves = {
        "phi": [lambda c: c.phi],
        "d": [lambda c: c.d, lambda c: c.phi],
        "principal_point": [lambda c: c.lens and c.lens.principal_point],
        "aspect": [lambda c: c.lens and c.lens.aspect],
    }
    result = list(cameras)
    for leaf in (leaf for name in common for leaf in leaves[name]):
        values = [leaf(c) for c in cameras]
        if all(v is not None for v in values):
            mean = sum(values[1:], values[0]) / len(values)
            result = [eqx.tree_at(leaf, c, mean.astype(c.e.dtype)) for c in result]
    return result


class _Reduced(NamedTuple):
    """A view's least squares with its own unknowns first, and what they leave of the shared ones:
    own (m, m), across (m, k), known (m,); rest (., k), left (.,). Shared columns per unit.
    """

    own: np.ndarray
    across: np.ndarray
    known: np.ndarray
    rest: np.ndarray
    left: np.ndarray


def _reduced(view: View, own: np.ndarray, damping: float) -> _Reduced:
    columns = np.asarray(view.triangle, float).copy()
    columns[:, ~own] /= np.asarray(view.unit, float)[~own]
    m, k = int(own.sum()), int((~own).sum())
    table = np.concatenate(
        [columns[:, own], columns[:, ~own], np.asarray(view.along, float)[:, None]], axis=1
    )
    damped = np.concatenate([damping**0.5 * np.eye(m), np.zeros((m, k + 1))], axis=1)
    r: Any = np.linalg.qr(np.concatenate([table, damped]), mode="r")
    return _Reduced(r[:m, :m], r[:m, m : m + k], r[:m, -1], r[m:, m : m + k], r[m:, -1])


def _solved(views: list[View], own: np.ndarray, damping: float) -> list[np.ndarray]:
    """Return each view's damped Gauss-Newton step in its own units."""
    parts = [_reduced(v, own, damping) for v in views]
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


def _descend(
    views: list[_One], depth: int, own: np.ndarray, max_steps: int
) -> tuple[list[_One], int]:
    """Return the views after Levenberg-Marquardt on one level, and its number of steps."""
    dtype = views[0].solver.dtype
    tolerance = (FINE_PX[dtype] if depth <= 2 else COARSE_PX) / UNIT_PX
    seen, damping = [v.look(depth) for v in views], 1.0
    for n in range(1, max_steps + 1):
        ys = _solved(seen, own, damping)
        trial = [
            v._replace(unit=v.solver.step(v.unit, v.level(depth), y))
            for v, y in zip(views, ys, strict=True)
        ]
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
            return views, n
    return views, max_steps


def _with_overlaps(views: list[_One], own: np.ndarray) -> tuple[list[_One], list[View]]:
    """Return the cameras, and views, after Gauss-Newton steps in which every pixel counts."""
    before, last = np.inf, [v.look(1) for v in views]
    whole = [0 if worthwhile(v.solver, view) else 1 for v, view in zip(views, last, strict=True)]
    while not all(whole):
        last = [v.look(depth) for v, depth in zip(views, whole, strict=True)]
        ys = _solved(last, own, 0.0)
        size = max(float(np.max(np.abs(y))) for y in ys) * UNIT_PX
        if not FINE_PX[views[0].solver.dtype] < size < before:
            break
        before = size
        views = [
            v._replace(unit=v.solver.step(v.unit, v.solver.finest, y))
            for v, y in zip(views, ys, strict=True)
        ]
    return views, last


def _reports(
    views: list[_One], names: tuple[str, ...], own: np.ndarray, steps: tuple[int, ...]
) -> tuple[Fit, ...]:
    views, seen = _with_overlaps(views, own)
    parts = [_reduced(v, own, 0.0) for v in seen]
    squares, touched = (
        sum(float(x) for x in xs)
        for xs in zip(*((v.sums.touched_squares, v.sums.touched) for v in seen), strict=True)
    )
    unknowns = len(views) * int(own.sum()) + int((~own).sum())
    variance = squares / max(touched - unknowns, 1)
    slope: Any = sum(p.rest.T @ p.left + p.across.T @ p.known for p in parts)
    return tuple(
        report(
            one.mask.camera,
            Found(one.unit, _joint(view, others, slope, own), steps),
            view.sums,
            names,
            variance,
        )
        for one, view, others in zip(views, seen, _others([p.rest for p in parts]), strict=True)
    )


def _others(rests: list[np.ndarray]) -> list[np.ndarray]:
    """Return for each view what all others together know of the shared unknowns, as a triangle."""

    def running(items: Any) -> list[np.ndarray]:
        result: list[Any] = [np.zeros((0, rests[0].shape[1]))]
        for rest in items:
            result.append(np.linalg.qr(np.concatenate([result[-1], rest]), mode="r"))
        return result

    before, after = running(rests[:-1]), running(rests[:0:-1])[::-1]
    return [np.concatenate(pair) for pair in zip(before, after, strict=True)]


def _joint(view: View, others: np.ndarray, slope: np.ndarray, own: np.ndarray) -> View:
    """Return the view with what the others know of the shared unknowns."""
    unit = np.asarray(view.unit, float)[~own]
    more = np.zeros((len(others), len(own)))
    more[:, ~own] = others * unit
    triangle: Any = np.linalg.qr(np.concatenate([np.asarray(view.triangle, float), more]), mode="r")
    gradient = np.asarray(view.triangle, float).T @ np.asarray(view.along, float)
    gradient[~own] = slope * unit
    along = np.linalg.lstsq(triangle.T, gradient, rcond=None)[0]
    return view._replace(triangle=jnp.asarray(triangle), along=jnp.asarray(along))
