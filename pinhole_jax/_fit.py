"""`fit_camera`: the camera from a mask, by Levenberg-Marquardt on exact coverage."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ._arrays import Numbers
from ._camera import Camera, camera_basis
from ._parameters import (
    COMPONENTS,
    REPORTED,
    Move,
    canonical,
    check_free,
    moved,
    on_film,
    reported,
    units,
)
from ._residuals import Capacity, Load, Sums, residuals
from ._scene import Scene, astype, bounding_sphere, padded
from ._target import Level, Pyramid, check_target, pyramid
from ._uncertainty import BLIND, covariance, weak_directions

#: What `Fit.status` may be.
STATUSES = (
    "converged",  # the gradient vanishes, the masks overlap, every direction is determined
    "rank_deficient",  # converged, but some direction changes no pixel: `Fit.weak` names it
    "max_steps",  # stopped while still moving
    "no_overlap",  # object and mask hardly overlap: their IoU is below `LEAST_IOU`
    "saturated",  # the object covers the whole film: there is no outline to follow
    "non_finite",  # NaN or infinity turned up
)

#: Below this intersection over union a fit has found something else than the object.
LEAST_IOU = 0.5
#: One unit of the solver in pixels. Its damping begins at 1 in its own units, whatever they are:
#: larger units make bolder first steps.
UNIT_PX = 30.0
#: A step is negligible below this many pixels; on coarse levels, and on the finest.
COARSE_PX = 0.02
FINE_PX = {np.dtype(np.float32): 3e-4, np.dtype(np.float64): 1e-7}
#: ... or where it would change the residuals by less than this share of their norm: MINPACK's
#: cosine between residual and Jacobian, some thousandths of the error that noise leaves anyway.
COSINE = {np.dtype(np.float32): 1e-4, np.dtype(np.float64): 1e-5}
#: A mask with a smaller residual (root mean square over the pixels that the outline touches) is
#: fitted once more without the pixels where contours overlap.
EXACT = 0.1


class Fit(NamedTuple):
    """The result of `fit_camera`.

    - `camera`: the fitted camera; it has the start's gauge (`|p-e|`, `|u|`, `u.v`).
    - `status`: one of `STATUSES`; trust the camera only where it is "converged".
    - `names`: the fitted parameters, in the order of `covariance` (n, n) and `std` (n,):
      small rotations of the camera about its own axes b1, b2, v (rad), the eye (world units), phi
      (rad), d (world units), the principal point (px).
    - `covariance` assumes independent pixel noise of one size, estimated from the residuals of the
      pixels that the outline touches; infinite where the mask does not determine a parameter.
    - `rms`: root mean square of coverage minus target over all pixels that count, but for the few
      where contours overlap; `iou` their intersection over union.
    - `steps`: Levenberg-Marquardt steps on each level, coarse to fine; more than one round of
      levels where the view outgrew its buffers on the way.
    - `weak`: directions that the mask determines badly or not at all, in words.
    """

    camera: Camera
    status: str
    names: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]
    std: Float[np.ndarray, "n"]
    rms: float
    iou: float
    steps: tuple[int, ...]
    weak: tuple[str, ...]


def fit_camera(
    scene: Scene,
    target: Numbers,
    camera: Camera | None,
    free: str | Sequence[str] = ("pose",),
    *,
    weight: Numbers = None,
    max_steps: int = 64,
    progress: Callable[[str], None] | None = None,
) -> Fit:
    """Return the camera whose silhouette of the scene is closest to a mask, with error bars.

    - `target`: mask (H, W), row 0 on top: bool, uint8 (0..255) or float (0..1, soft edges welcome).
    - `camera`: where to start; also all that is not free. Starts some 20 degrees off are pulled in.
    - `free`: any of pose (or position, orientation), phi, d, principal_point, aspect.
    - `weight`: (H, W), at least 0: how much each pixel counts.
    - `max_steps`: a limit for each level. `progress` is called with a line after each level.

    Levenberg-Marquardt (optimistix) minimises the weighted squared difference of exact coverage and
    target over the camera's pose and log focal length, on images from about 16 pixels across the
    object up to the full size. Pixels in which contours overlap count as the clamped sum of layers;
    if the mask turns out to be exact to a tenth, they are left out at the end. Works in the float
    type of `camera`; runs on concrete arrays, not inside `jit`. The first call compiles (seconds);
    later ones with scenes and images of similar size do not.

    Raises ValueError for arguments that make no fit; what the solver met is in `Fit.status`.
    """
    if not isinstance(camera, Camera):
        raise ValueError(f"`camera`: expected a Camera to start from, got {camera!r}")
    if not isinstance(scene, Scene) or (scene.mesh is None and scene.spheres is None):
        raise ValueError("`scene`: expected a Scene with a mesh or spheres, got an empty one")
    if max_steps < 1:
        raise ValueError(f"`max_steps`: expected at least 1, got {max_steps}")
    names = check_free(free)
    image, weights = check_target(target, weight, camera.W, camera.H)
    dtype = camera.e.dtype
    levels_data, levels = pyramid(image, weights, dtype)
    problem = _Problem(padded(astype(scene, dtype)), levels_data, *bounding_sphere(scene))
    start = canonical(camera)

    before, capacity = _look(start, problem, levels[-1], names, _first_capacity(scene, image))
    unit, after, steps, enough = start, before, [], None
    while enough != capacity:  # a view that outgrew its buffers: go on from there with larger ones
        capacity = enough or capacity
        for level in levels:
            tolerance = FINE_PX[dtype] if level is levels[-1] else COARSE_PX
            tolerance = jnp.asarray(tolerance, dtype)
            unit, n = _solve(unit, problem, level, tolerance, names, capacity, max_steps)
            steps.append(int(n))
            if progress is not None:
                progress(f"{int(level.W)} x {int(level.H)} pixels: {n} steps")
        after, enough = _look(unit, problem, levels[-1], names, capacity)
    if not float(after.sums.squares) <= float(before.sums.squares):
        unit, after = start, before  # never worse than the start
    if float(after.sums.touched_squares) < EXACT**2 * float(after.sums.touched):
        # The mask is so exact that clamped overlaps would show: once more without them.
        strict = levels[-1]._replace(strict=jnp.bool_(True))
        tolerance = jnp.asarray(FINE_PX[dtype], dtype)
        exact, n = _solve(unit, problem, strict, tolerance, names, capacity, max_steps)
        ends = [exact, unit, start] if int(n) < max_steps else [unit, start]
        views = [(x, *_look(x, problem, strict, names, capacity)) for x in ends]
        views = [v for v in views if v[2] == capacity and np.isfinite(float(v[1].sums.squares))]
        unit, after, _ = min(views, key=lambda v: float(v[1].sums.squares))
        steps[-1] += int(n)
    return _report(camera, unit, after, names, tuple(steps), max_steps)


class _Problem(eqx.Module):
    scene: Scene
    pyramid: Pyramid
    pivot: Float[Array, "3"]
    radius: Float[Array, ""]

    def __init__(self, scene: Scene, pyramid: Pyramid, pivot: Array, radius: Array):
        dtype = pyramid.target.dtype
        self.scene, self.pyramid = scene, pyramid
        self.pivot, self.radius = pivot.astype(dtype), radius.astype(dtype)


class _View(NamedTuple):
    """What is known at one camera: R of J = QR, Q^T r, sums, reported parameters' derivative."""

    triangle: Float[Array, "n n"]
    along: Float[Array, "n"]
    sums: Sums
    load: Load
    to_reported: Float[Array, "n n"]


class _LevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix's Levenberg-Marquardt, which also stops when the next step is negligible.

    Its own test compares residuals entry by entry, which change places here from step to step, and
    never stops while steps are rejected (in float32, at the rounding floor, until `max_steps`).
    """

    rtol: float
    atol: Any
    norm: Callable
    descent: optx.AbstractDescent
    search: optx.AbstractSearch
    verbose: Callable

    def __init__(self, atol: Any):
        self.rtol, self.atol, self.norm = 0.0, atol, optx.max_norm
        self.descent = optx.DampedNewtonDescent(linear_solver=lx.QR())
        self.search = _TrustRegion()
        self.verbose = _silent

    def terminate(self, fn, y, args, options, state, tags):
        del fn, args, options, tags
        step = state.y_eval - y
        change = state.f_info.jac.mv(step)
        cosine = COSINE[np.dtype(step.dtype)]
        flat = _sum_squares(change) <= cosine**2 * _sum_squares(state.f_info.residual)
        small = jnp.max(jnp.abs(step)) < self.atol
        return ~state.first_step & (small | flat), state.result


class _TrustRegion(optx.ClassicalTrustRegion):
    """optimistix's, with its step size in the problem's float type, not the configuration's."""

    def init(self, y, f_info_struct):
        state = super().init(y, f_info_struct)
        return eqx.tree_at(lambda s: s.step_size, state, state.step_size.astype(y.dtype))


def _sum_squares(parts: Any) -> Any:
    return sum((jnp.sum(x * x) for x in parts), jnp.zeros((), parts[0].dtype))


def _silent(**kwargs: Any) -> None:
    del kwargs


def _residual(y: Float[Array, "n"], args: Any):
    """The function that optimistix sees: module level and all data in `args`, to compile once."""
    move, problem, level, names, capacity = args
    camera = moved(move, y, names.value)
    return residuals(camera, problem.scene, problem.pyramid, level, Capacity(*capacity.value))[0]


class _Static(eqx.Module):
    """A static value inside a pytree of arguments."""

    value: tuple = eqx.field(static=True)


def _move(unit: Camera, problem: _Problem, level: Level, names: tuple[str, ...]) -> Move:
    one_px = units(unit, problem.pivot, problem.radius, level.scale, names)
    return Move(unit, problem.pivot, UNIT_PX * one_px)


@eqx.filter_jit
def _solve(unit: Camera, problem: _Problem, level: Level, tolerance, names, capacity, max_steps):
    move = _move(unit, problem, level, names)
    args = (move, problem, level, _Static(names), _Static(tuple(capacity)))
    solution = optx.least_squares(
        _residual,
        _LevenbergMarquardt(tolerance / UNIT_PX),
        jnp.zeros_like(move.unit),
        args,
        max_steps=max_steps,
        throw=False,
    )
    return moved(move, solution.value, names), solution.stats["num_steps"]


@eqx.filter_jit
def _view(unit: Camera, problem: _Problem, level: Level, names, capacity) -> _View:
    move = _move(unit, problem, level, names)
    zero = jnp.zeros_like(move.unit)

    def at(y):
        camera = moved(move, y, names)
        (r, _), *rest = residuals(camera, problem.scene, problem.pyramid, level, capacity)
        return r, (r, *rest)

    jacobian, (r, sums, load) = jax.jacfwd(at, has_aux=True)(zero)
    q, triangle = jnp.linalg.qr(jacobian)
    to_reported = jax.jacfwd(lambda y: reported(unit, moved(move, y, names), names))(zero)
    return _View(triangle, r @ q, sums, load, to_reported)


def _look(
    unit: Camera, problem: _Problem, level: Level, names: tuple[str, ...], capacity: Capacity
) -> tuple[_View, Capacity]:
    """Return the view at a camera, and capacities with half as much room again as it takes."""
    while True:
        view = _view(unit, problem, level, names, capacity)
        needs = zip(capacity, view.load, strict=True)
        room = Capacity(*(_room(have, int(need)) for have, need in needs))
        if room == capacity:
            return view, capacity
        capacity = room


def _first_capacity(scene: Scene, image: np.ndarray) -> Capacity:
    """Return a guess: some contour edges per root of faces, some pieces per pixel of outline."""
    faces = 0 if scene.mesh is None else scene.mesh.faces.shape[0]
    spheres = 0 if scene.spheres is None else scene.spheres.radii.shape[0]
    inside = image > 0.5
    outline = sum(int(np.sum(np.diff(inside, axis=k))) for k in (0, 1))
    return Capacity(
        edges=_room(1, int(3 * faces**0.5)) if faces else 1,
        pieces=_room(1, outline + int(3 * faces**0.5)) if faces else 1,
        arc_pieces=_room(1, outline + 8 * spheres) if spheres else 1,
    )


def _room(have: int, need: int) -> int:
    """Return `have` if it is 3/2 of `need`, else the next of a few sizes (each is compiled)."""
    while 2 * have < 3 * need:
        have = max(4 * have, 1024)
    return have


def _report(
    camera: Camera, unit: Camera, view: _View, names: tuple[str, ...], steps, max_steps: int
) -> Fit:
    fitted = on_film(unit, camera, names)
    triangle, along = np.asarray(view.triangle, float), np.asarray(view.along, float)
    sums: Any = jax.tree.map(float, view.sums)
    # Film coordinates are in film heights inside the fit: the principal point's come back in px.
    to_reported = np.array(view.to_reported, float)
    labels = tuple(r for name in names for r in REPORTED[name])
    in_px = [label.startswith("principal") for label in labels]
    to_reported[in_px] *= camera.H
    dtype = np.dtype(camera.e.dtype)
    finite = np.all(np.isfinite(triangle)) and np.isfinite(sums.squares)
    n = len(labels)
    if not finite:
        empty = np.full((n, n), np.nan)
        nan = float("nan")
        return Fit(fitted, "non_finite", labels, empty, np.diag(empty), nan, nan, steps, ())
    variance = sums.touched_squares / max(sums.touched - n, 1)
    cov = covariance(triangle, to_reported, variance, BLIND[dtype])
    axes = np.asarray(jnp.stack(camera_basis(unit)), float)
    components = [c for name in names for c in COMPONENTS[name]]
    blind, weak = weak_directions(triangle, components, axes, BLIND[dtype])
    return Fit(
        camera=fitted,
        status=_status(triangle, along, sums, blind, dtype),
        names=labels,
        covariance=cov,
        std=np.sqrt(np.diag(cov)),
        rms=float(np.sqrt(sums.squares / sums.weight)),
        iou=sums.overlap / sums.union if sums.union > 0 else 0.0,
        steps=steps,
        weak=weak,
    )


def _status(triangle, along, sums: Any, blind: bool, dtype) -> str:
    if not np.any(triangle):
        return "saturated" if sums.overlap > 0 else "no_overlap"
    if sums.overlap < LEAST_IOU * sums.union:
        return "no_overlap"
    # MINPACK's test: the residual is orthogonal to every column of the Jacobian. At the rounding
    # floor the residual has no direction; there the Newton step must be negligible.
    columns = np.linalg.norm(triangle, axis=0)
    slope = np.abs(triangle.T @ along)
    cosine = np.max(slope / np.maximum(columns * np.sqrt(sums.squares), 1e-300))
    newton = np.linalg.pinv(triangle, rcond=BLIND[dtype]) @ along
    if cosine > 100 * COSINE[dtype] and UNIT_PX * np.max(np.abs(newton)) > 10 * FINE_PX[dtype]:
        return "max_steps"
    return "rank_deficient" if blind else "converged"
