"""`fit_points`: cameras from points whose places in the world are known (calibration, pose)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from .._camera.axes import axes_of
from .._camera.camera import Camera, check_camera
from .._files.progress import say, shown
from .._fit.fit_camera import check_reach, check_steps
from .._fit.implicit import check_plain, steps_of, through
from .._fit.result import (
    CameraResult,
    Progress,
    at_rest,
    to_units,
    uncertain_rotation,
    with_modes,
    without_ended,
)
from .._joint.lenses import known_by_others, with_shared
from .._numerics.arrays import ArrayLike, Input, checked, is_concrete
from .._rules import RULES
from .._solver.least_squares import solve
from .._solver.moves import on_film
from .._solver.parameters import check_free, components, labels_of
from .._solver.priors import Pair, bounds_of, prior_of
from .._solver.uncertainty import BLIND, covariance, weak_directions
from .descent import PointDescent, descend
from .noise import FEW, Noise, beyond_noise, coordinates
from .reprojection import PointArrays, PointProblem, PointRows, PointView
from .starts import begin

#: What several views share by default: the intrinsics of one physical camera.
INTRINSICS = ("phi", "principal_point", "distortion")
#: Where standard errors may be this many times as large by chance, as 1 to 4 coordinates alone show
#: how points err, a rotation is open that is uncertain by this much (rad). (By Student's t four of
#: them are passed by 1 fit in 40 to 200 there, of 9 coordinates by 1 in 1000.)
FOUR_SIGMA, UNCERTAIN_OF_FEW = 4.0, np.deg2rad(1)
WRONG = "are they the same points, in the right order, units and focal length?"


class PointFit(CameraResult):
    """The result of `fit_points` for one view.

    - `camera`: the fitted camera.
    - `status`: "converged" (trust the camera only then), "ambiguous" (the cameras of `modes` see
      the points as well), "unchecked" (no more coordinates than unknowns: the camera meets the
      points however far these err), "uncertain" (the points' errors may leave a rotation of several
      degrees open), "misfit" (points lie far from where they are seen), "rank_deficient" (some
      direction moves no point: `weak` names it), "max_steps", "behind" (a point would lie behind
      the eye) or "non_finite".
    - `names`: the fitted parameters, in the order of `covariance` (n, n) and `std` (n,), as in
      `Fit`. The covariance is that of the joint problem and assumes that all coordinates err
      independently and alike (those of points with weights, with variances in inverse proportion
      to these), by `noise_px`, or by as much as the residuals say. Where these say that errors are
      alike within each view, as a bent board's, it is widened by as much as views disagree. Few
      coordinates say it badly: where up to 30 more than unknowns do, it is widened so that 95 %
      intervals hold the truth (Student's t), and where none does it is infinite. Points that are
      repeated count once.
    - `rms_px`: root mean square distance of the view's points from where they are seen, each as it
      counts.
    - `steps`: Levenberg-Marquardt steps.
    - `weak`: directions that the points determine badly or not at all, and how many points do not
      count, as sentences.
    - `modes`: other cameras that see the view's points as well; if these see them equally well, in
      the order of their rotation away from the start, else the best first.
    - `history`: the way to `camera`: the start of the descents (0 steps), and where each of them
      ended; with `outlier_px` there are several.

    ```python
    found.status, found.rms_px
    ```
    """

    rms_px: float
    _: KW_ONLY
    modes: tuple["PointFit", ...] = ()

    data: ClassVar[str] = "the points"

    @property
    def steps(self) -> int:
        """The number of Levenberg-Marquardt steps."""
        return sum(stop.steps for stop in self.history)

    @property
    def _agreement(self) -> tuple[str, str, str]:
        return "rms", f"{self.rms_px:.3g} px", ""


def fit_points(
    points3d: Input[ArrayLike, "*V N 3"],
    points2d: Input[ArrayLike, "*V N 2"],
    camera: Input[Camera | Sequence[Camera], "one, or one a view"],
    free: str | Sequence[str] = ("pose",),
    shared: str | Sequence[str] | None = None,
    *,
    weights: Input[ArrayLike | None, "*V N"] = None,
    outlier_px: float | None = None,
    noise_px: float | None = None,
    prior: Input[Mapping[str, Pair] | None, "mean, sigma"] = None,
    bounds: Input[Mapping[str, Pair] | None, "low, high"] = None,
    max_steps: int = 100,
    progress: bool | Callable[[str], None] | None = None,
) -> PointFit | tuple[PointFit, ...]:
    """The camera whose projections of points match their images: a `PointFit`, or one a view.

    - `points3d`: (N, 3), world units; or (V, N, 3) if each of V views has its own.
    - `points2d`: (N, 2), or (V, N, 2) for V views: film coordinates (px, origin at the film's
      bottom-left corner, y up; of OpenCV's (u, v) they are (u + 1/2, H - v - 1/2)). NaN: not seen.
    - `camera`: resolution and start, one for all views or one for each. The start's pose is used
      only if it is better than direct solutions: a homography (4 points of a plane), a direct
      linear transformation (6 points), or three of few points. Among equals the nearest to it comes
      first. Its focal length may be off by some tens of percent.
    - `free`: parameters of each view; `shared`: parameters that all views share. Names are those of
      `fit_camera`. None: with several views phi, principal_point and distortion, else nothing.
    - `weights`: (N,) or (V, N), 0 or more: 1 / variance of each point, up to a factor.
    - `outlier_px`: points whose residual ends above this do not count, as long as half of a view's
      points do; some five times the others' error is right. None: all count.
    - `noise_px`: the standard error of a coordinate, or of one whose weight is 1. None: the
      residuals show it.
    - `prior`, `bounds`: as in `fit_camera`; once for shared parameters, else for each view.
    - `max_steps`: a limit for each descent. `progress`: as in `fit_camera`, a function is
      called with words after each.

    Points of a plane are seen almost as well with their depths reversed, the farther away the
    better, and three points have up to four exact poses: each view of a plane, and of up to 8
    points, is asked whether its points tell such cameras apart (`PointFit.modes`).

    Returns a `PointFit` for points2d (N, 2), a tuple of them for (V, N, 2). Levenberg-Marquardt as
    in `fit_cameras`: a step's cost is linear in the views. Works in the float type of `camera`.
    Steps that would make the lens fold within the film are not taken.

    Runs outside `jit` and `vmap`. Cameras of the result are differentiable (once, forward and
    reverse) with respect to points3d, points2d and weights, by the implicit function theorem, as
    points count in the end; where nothing is known beforehand.

    Raises ValueError for arguments that make no fit; what the solver met is in each `status`.

    ```python
    points = scene.mesh.vertices[::50]
    seen_at = pj.project(truth, points)
    found = pj.fit_points(points, seen_at, start)  # no pose is needed to start from
    found = pj.fit_points(points, seen_at, start, outlier_px=1.0)  # some may be wrong
    ```
    """
    check_steps(max_steps)
    check_reach(outlier_px)
    if noise_px is not None and not 0 < noise_px < np.inf:
        raise ValueError(f"`noise_px`: expected a positive number of px, got {noise_px}")

    def run(inputs: Any) -> tuple[tuple[PointFit, ...], PointDescent]:
        given = _checked(*inputs)
        cameras = {str(k): c for k, c in enumerate(_cameras(camera, len(given)))}
        several = INTRINSICS if len(given) > 1 else ()
        shared_names = several if shared is None else shared
        freed, common, cameras = with_shared(cameras, free, shared_names)
        check_free(freed, cameras["0"])
        views, scale = [], _scale(given)
        for one, c in zip(given, cameras.values(), strict=True):
            view = PointView.from_points(c, one._replace(weight=one.weight / scale), freed)
            known = prior_of(prior, c, freed, tuple(common), len(given))
            view = view._replace(bounds=bounds_of(bounds, c, freed), prior=known)
            views.append(begin(view, outlier_px is not None))
        variance = None if noise_px is None else noise_px**2 / scale
        alone = tuple(name for name in freed if name not in common)
        problem = PointProblem.from_views(views, alone)
        with shown(progress, "fitting points") as tell:
            found = descend(problem, views, outlier_px, variance, max_steps, tell or say)
        return _reports(found, given), found

    inputs = points3d, points2d, weights
    if is_concrete(*inputs):
        fits = run(inputs)[0]
    else:
        check_plain(prior=prior, bounds=bounds)
        named = "`points3d`, `points2d`, `weights`"
        answer = lambda fits: tuple(fit.camera for fit in fits)
        fits = through(run, inputs, answer, _velocity, named)
    return fits if np.ndim(points2d) == 3 else fits[0]


def _velocity(
    fits: tuple[PointFit, ...], found: PointDescent, inputs: Any, velocity: Any
) -> tuple[Camera, ...]:
    """The cameras' rates of change with the inputs."""
    given, dtype = _checked(*inputs), fits[0].camera.e.dtype

    def in_each(change: Any, array: np.ndarray, scale: float) -> Sequence[Any]:
        if change is None:
            return [None] * len(given)
        shape = len(given), *array.shape
        return list(jnp.broadcast_to(jnp.asarray(change, dtype) / scale, shape))

    units = 1.0, 1.0, _scale(given)
    each = zip(*map(in_each, velocity, given[0], units), strict=True)
    pairs = enumerate(zip(found.views, each, strict=True))
    slopes = [
        view.slope(PointArrays(*moving), found.problem.columns(k)) for k, (view, moving) in pairs
    ]
    steps = zip(found.views, steps_of(slopes), strict=True)
    return tuple(view.camera_velocity(step) for view, step in steps)


def _scale(given: list[PointArrays]) -> float:
    """The mean of all weights that count: what weights are times is nothing."""
    weights = np.concatenate([one.weight for one in given])
    return float(np.mean(weights[weights > 0]))


def _cameras(camera: Any, count: int) -> list[Camera]:
    """A camera for each of this many views, or raise ValueError."""
    cameras = [camera] * count if isinstance(camera, Camera) else camera
    if not isinstance(cameras, Sequence):
        kind = type(camera).__name__
        raise ValueError(f"`camera`: expected a Camera, or one for each view, got {kind}")
    for one in cameras:
        check_camera(one)
    if len(cameras) != count:
        raise ValueError(f"`camera`: expected one for each of {count} views, got {len(cameras)}")
    return list(cameras)


def _checked(
    points3d: ArrayLike, points2d: ArrayLike, weights: ArrayLike | None
) -> list[PointArrays]:
    """Each view's points in float64, NaN and a weight of 0 where not seen. Raises ValueError for
    others."""
    many = np.ndim(points2d) == 3
    seen_at = np.asarray(points2d)
    if seen_at.dtype.kind not in "fiu" or seen_at.ndim not in (2, 3) or seen_at.shape[-1] != 2:
        raise ValueError(
            "`points2d`: expected real numbers of shape (N, 2), or (V, N, 2) for V views, got"
            f" shape {seen_at.shape}, dtype {seen_at.dtype}"
        )
    seen_at = np.array(seen_at if many else seen_at[None], float)
    V, N = seen_at.shape[:2]
    if np.any(np.isinf(seen_at)):
        raise ValueError("`points2d`: expected finite values, or NaN where not seen, got inf")
    shape = (V, N, 3) if np.ndim(points3d) == 3 else (N, 3)
    points = np.asarray(checked("points3d", points3d, shape, np.dtype(np.float64)), float)

    seen_at[np.isnan(seen_at).any(axis=-1)] = np.nan
    weight = np.where(np.isnan(seen_at[..., 0]), 0.0, _weights(weights, V, N))
    few = np.sum(weight > 0, axis=1)
    if V == 0 or np.any(few < 3):
        k = int(np.argmin(few)) if V else 0
        raise ValueError(
            "`points2d`: expected at least 3 points in each view, got"
            f" {few[k] if V else 'no view'} in view {k}"
        )
    points = np.broadcast_to(points, (V, N, 3))
    return [PointArrays(*each) for each in zip(points, seen_at, weight, strict=True)]


def _weights(weights: ArrayLike | None, V: int, N: int) -> np.ndarray:
    """Weights that broadcast to (V, N), or raise ValueError."""
    if weights is None:
        return np.ones(N)
    shape = (V, N) if np.ndim(weights) == 2 else (N,)
    weight = np.asarray(checked("weights", weights, shape, np.dtype(np.float64)), float)
    if np.any(weight < 0):
        raise ValueError(f"`weights`: expected none below 0, got {weight.min()}")
    return weight


def _reports(found: PointDescent, given: list[PointArrays]) -> tuple[PointFit, ...]:
    """The fits of all views, and of their other places."""
    problem, views, own = found.problem, found.views, found.problem.own
    seen = problem.look(views)
    parts = problem.parts(views, seen, 1.0)
    solved = solve(parts, problem.size, np.zeros(problem.size))
    beyond = beyond_noise(parts, solved, found.noise)
    slope = np.sum([part.left @ part.rows[:, ~own] for part in parts], axis=0)
    whole = sum(each.squares for each in seen), 2.0 * sum(view.number for view in views)
    spare = () if found.noise.freedom > 0 else (_none_left_over(problem, views),)

    fits = []
    for k, view in enumerate(views):
        known = np.zeros((len(own), len(own)))[: np.sum(~own)]
        known[:, ~own] = known_by_others(solved, parts[k], ~own)
        places = [(view, seen[k]), *((other, other.look()) for other in found.others[k])]
        fit, *modes = (
            _report(
                place,
                _join_others(look, known, slope, own),
                _moves_by_shared(look, own) @ beyond,
                found.noise,
                found.limits[k],
                *whole,
            )
            for place, look in places
        )
        words = (*_left_out(view.number, int(np.sum(given[k].weight > 0))), *spare)
        way = tuple(
            Progress(on_film(there[k].camera, view.film), view.film.W, view.film.H, steps)
            for there, steps in found.way
        )
        fit = fit._replace(history=way, weak=(*fit.weak, *words))
        fits.append(with_modes(fit, modes))
    return tuple(fits)


def _join_others(
    seen: PointRows, known: np.ndarray, slope: np.ndarray, own: np.ndarray
) -> PointRows:
    """What is seen, with what other views know (., n) of moves as such, and with the `slope` of all
    views' squares by those that are shared."""
    scale = np.asarray(seen.scale, float)
    triangle, along = (np.asarray(x, float) for x in (seen.triangle, seen.along))
    gradient = np.where(own, triangle.T @ along, 0.0)
    gradient[~own] = slope * scale[~own]
    whole: Any = np.linalg.qr(np.concatenate([triangle, known * scale]), mode="r")
    # (As NumPy's: within `grad` JAX's would be traced, and no report could look at them.)
    return seen._replace(triangle=whole, along=np.linalg.lstsq(whole.T, gradient, rcond=None)[0])


def _moves_by_shared(seen: PointRows, own: np.ndarray) -> np.ndarray:
    """The derivative of a view's moves (n,) by shared ones as such (s,), its own following."""
    scale = np.asarray(seen.scale, float)
    rows = np.asarray(seen.triangle, float) / scale
    result = np.eye(len(own))[:, ~own]
    result[own] = -np.linalg.pinv(rows[:, own]) @ rows[:, ~own]
    return result / scale[:, None]


def _none_left_over(problem: PointProblem, views: list[PointView]) -> str:
    """A sentence: nothing shows how far points err."""
    some, unknowns = coordinates(views), problem.size
    repeated = " (repeated points count once)" if some < 2 * sum(v.number for v in views) else ""
    return (
        f"{some} coordinates{repeated} for {unknowns} unknowns: none is left over to show how far"
        " points err, so there are no error bars; `noise_px` gives them"
    )


def _left_out(number: int, given: int) -> list[str]:
    """Sentences on how many points do not count."""
    words = f"{given - number} of {given} points are far from where they are seen, and left out"
    return [] if number == given else [words]


def _report(
    view: PointView,
    seen: PointRows,
    beyond: np.ndarray,
    noise: Noise,
    limit: float,
    squares: float,
    count: float,
) -> PointFit:
    """The fit of a view, given what is seen there and what other views know.

    `beyond` (n, s) is the root of its moves' covariance beyond that of independent errors. Above
    the rms `limit` (px) it is a misfit; `squares` is the sum of this many residuals' squares of all
    views.
    """
    freed, dtype = view.freed, np.dtype(view.film.e.dtype)
    triangle, ended = without_ended(seen.triangle, view.camera, freed, view.bounds)
    along = np.asarray(seen.along, float)
    labels, camera = labels_of(freed), on_film(view.camera, view.film)
    if not (np.isfinite(squares) and np.all(np.isfinite(triangle))):
        nothing = np.full((len(labels), len(labels)), np.nan)
        known = {"names": labels, "covariance": nothing, "rms_px": float("nan")}
        return PointFit(camera=camera, status="non_finite", **known)
    blind, weak = weak_directions(triangle, components(freed), axes_of(camera), BLIND[dtype])
    reported = to_units(seen.to_reported, freed, camera)
    cov = covariance(triangle, reported, triangle.T @ triangle, BLIND[dtype])
    cov += reported @ beyond @ (reported @ beyond).T
    # (Where nothing shows how points err, nothing is known.)
    known = np.isfinite(noise.variance)
    cov = noise.variance * cov if known else np.where(np.eye(len(cov)) > 0, np.inf, np.nan)
    rms = float(np.sqrt(float(seen.sum_squares) / np.sum(view.weight)))
    status, words = _judge(cov, labels, camera, noise)
    if blind:
        status = "rank_deficient"
    if rms > limit:
        status = "misfit"
        words = (f"points lie {rms:.3g} px (rms) from where they are seen: {WRONG}",)
    if not at_rest(triangle, along, squares, count, dtype):
        status = "max_steps"
    if not float(seen.nearest) > 0:
        status = "behind"
    return PointFit(
        camera=camera,
        status=status,
        names=labels,
        covariance=cov,
        rms_px=rms,
        weak=(*weak, *ended, *words),
    )


def _judge(
    cov: np.ndarray, labels: tuple[str, ...], camera: Camera, noise: Noise
) -> tuple[str, tuple[str, ...]]:
    """A status by the error bars alone, and words about them."""
    if not noise.freedom > 0:
        return "unchecked", ()
    limit, more = (RULES.uncertain if noise.at_most < FOUR_SIGMA else UNCERTAIN_OF_FEW), ""
    if noise.freedom <= FEW:
        spare = f"{noise.freedom:.0f} coordinate{'s' * (noise.freedom > 1)}"
        more = f", itself a guess from {spare} more than unknowns"
    words = uncertain_rotation(cov, labels, camera, limit / noise.at_most, more)
    return "uncertain" if words else "converged", words
