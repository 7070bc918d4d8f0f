"""`fit_points`: cameras from points whose places in the world are known (calibration, pose)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, replace
from functools import partial
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from .._camera.axes import axes_of
from .._camera.camera import Camera, check_camera
from .._camera.poses import pose_of
from .._camera.rays import project
from .._files.progress import shown
from .._fit.fit_camera import check_px
from .._fit.implicit import Vantage, ViewInputs, check_plain, slope_of, through, velocities_of
from .._fit.result import (
    CameraResult,
    Progress,
    at_rest,
    held_words,
    to_units,
    uncertain_rotation,
    with_modes,
)
from .._joint.door import bounds_by_name, owners_of, priors_of, with_unknowns
from .._joint.system import Descent, Minimum
from .._joint.views import JointView, State
from .._numerics.arrays import (
    ArrayLike,
    Input,
    array_of,
    as_count,
    check_kind,
    checked,
    is_concrete,
)
from .._rules import RULES
from .._scene.scene import Scene
from .._solver.moves import canonical, on_film
from .._solver.parameters import components, labels_of
from .._solver.priors import Pair
from .._solver.uncertainty import BLIND, covariance, moves_in_words, weak_directions
from .descent import PointDescent, begin, descend
from .noise import FEW, Noise, beyond_noise
from .reprojection import Matches, PointArrays, PointEye, PointProblem
from .smooth import alike

#: What several views share by default: the intrinsics of one physical camera.
INTRINSICS = ("phi", "principal_point", "distortion")
#: Words for steps that end beside every minimum.
BARRED = (
    "more steps do not help: the lens that fits best folds within the film; hold some of its"
    " coefficients, show points all over the film, or give `outlier_px` if some are wrong"
)
#: Where standard errors may be this many times as large by chance, as 1 to 4 coordinates alone show
#: how points err, a rotation is open that is uncertain by this much (rad). (By Student's t four of
#: them are passed by 1 fit in 40 to 200 there, of 9 coordinates by 1 in 1000.)
FOUR_SIGMA, UNCERTAIN_OF_FEW = 4.0, np.deg2rad(1)
#: A point whose weight is a smaller share of the largest of its view does not count.
NEGLIGIBLE = 1e-6
WRONG = "are they the same points, in the right order, units and focal length?"
ALIKE = "residuals of neighbouring points agree: the lens or the points are off by more than noise"


class PointFit(CameraResult):
    """The result of `fit_points` for one view.

    - `camera`: the fitted camera.
    - `status`: "converged" (trust the camera only then), "ambiguous" (the cameras of `modes` see
      the points as well), "unchecked" (no more coordinates than unknowns: the camera meets the
      points however far these err). Or "uncertain" (the points' errors may leave a rotation of
      several degrees open), "misfit" (points lie far from where they are seen), "rank_deficient"
      (some direction moves no point: `weak` names it). Or "max_steps", "behind" (a point would lie
      behind the eye), "non_finite".
    - `names`: the fitted parameters, in the order of `covariance` (n, n) and `std` (n,), as in
      `Fit`. The covariance is that of the joint problem and assumes that all coordinates err
      independently and alike, by `noise_px` or by as much as the residuals say. (Weights divide
      variances.) Where these say that errors are
      alike within each view, as a bent board's, it is widened by as much as views disagree; where
      views share nothing, by as much as residuals of neighbouring points agree (`weak`). Few
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
      only if it is better than direct solutions by three points each. Among equals the nearest to
      it comes first. Its focal length may be off by some tens of percent.
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

    Points of a plane, or nearly of one, are seen almost as well with their depths reversed, the
    farther away the better. Three points have up to four exact poses. The fit tests whether each
    view's points rule such cameras out, exact poses for up to 8 points (`PointFit.modes`).

    Returns a `PointFit` for points2d (N, 2), a tuple of them for (V, N, 2). Levenberg-Marquardt as
    in `fit_cameras`: a step's cost is linear in the views. Works in the float type of `camera`.
    Steps that would make the lens fold within the film are not taken.

    Runs outside `jit` and `vmap`. Cameras of the result are differentiable (once, forward and
    reverse) with respect to points3d, points2d and weights, by the implicit function theorem, as
    points count in the end; where nothing is known beforehand.

    Raises ValueError for arguments that make no fit; the solver's troubles are in each `status`.

    ```python
    points = scene.mesh.vertices[::50]
    seen_at = pj.project(truth, points)
    found = pj.fit_points(points, seen_at, start)  # no pose is needed to start from
    found = pj.fit_points(points, seen_at, start, outlier_px=1.0)  # some may be wrong
    ```
    """
    as_count("max_steps", max_steps)
    check_px(outlier_px=outlier_px, noise_px=noise_px)

    def run(inputs: Any) -> tuple[tuple[PointFit, ...], PointDescent]:
        given = _checked(*inputs)
        number, scale = len(given.weight), _usual_weight(given)
        several = INTRINSICS if number > 1 else ()
        cameras = {str(k): c for k, c in enumerate(_cameras(camera, number))}
        common = several if shared is None else shared
        problem = _problem(given, scale, cameras, free, common, prior, bounds, max_steps)
        start, robust = problem.start, outlier_px is not None
        begun = {
            eye.shot.camera: begin(matches, eye.canonical(start), robust)
            for eye, matches in zip(problem.eyes, problem.matches, strict=True)
        }
        known = None if noise_px is None else Noise(noise_px**2 / scale, np.inf)
        problem, start = replace(problem, known=known), start._replace(lenses=begun)
        with shown(progress, "fitting points", in_words=True):
            found = descend(problem, start, outlier_px)
        return _reports(found, given.weight), found

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
    problem, given, dtype, slopes = found.problem, _checked(*inputs), fits[0].camera.e.dtype, []
    rates = [
        jnp.broadcast_to(jnp.asarray(0.0 if change is None else change, dtype), array.shape)
        for change, array in zip(velocity, given, strict=True)
    ]
    of_view = lambda points, seen_at, weight: ViewInputs(points, seen_at, weight[:, None])
    for k, (eye, matches) in enumerate(zip(problem.eyes, problem.matches, strict=True)):
        at = eye.canonical(found.end.state)
        vantage = Vantage(at, fits[k].camera, pose_of(at), matches.freed, drawn=project)
        points, seen_at, counted = (x[: given.weight.shape[1]] for x in matches.given)
        asked = of_view(points, seen_at, given.weight[k].astype(dtype))
        changes = of_view(*(rate[k] for rate in rates))
        slopes.append(slope_of(vantage, asked, counted[:, None], changes, problem.columns(k)))
    return tuple(camera for camera, *_ in velocities_of(slopes))


def _problem(
    given: PointArrays,
    scale: float,
    cameras: Mapping[str, Camera],
    free: Any,
    shared: Any,
    prior: Any,
    bounds: Any,
    max_steps: int,
) -> PointProblem:
    """The problem of points with weights in units of `scale`, from the cameras as given.

    Raises ValueError for names, priors and bounds of none.
    """
    cameras, unknowns = with_unknowns(cameras, free, shared, [*cameras])
    limits, eyes, still = bounds_by_name(bounds, cameras, unknowns), [], np.eye(4)
    freed = tuple(dict.fromkeys(unknown.kind for unknown in unknowns))
    for (name, film), points, seen_at, weight in zip(cameras.items(), *given, strict=True):
        arrays = PointArrays(points, seen_at, weight / scale)
        matches = Matches.on(film, arrays, freed, limits[name])
        known = owners_of(name, unknowns), name, still, still, still
        eyes.append(PointEye(JointView(Scene(), None, name), None, matches, *known))
    problem = PointProblem(
        unknowns=unknowns,
        eyes=eyes,
        start=State({}, {name: canonical(film) for name, film in cameras.items()}, {}, {}),
        cameras=cameras,
        outlier_px=None,
        max_steps=max_steps,
        weights=np.ones(len(eyes)),
    )
    return replace(problem, priors=priors_of(prior, problem))


def _usual_weight(given: PointArrays) -> float:
    """The mean of all weights that count: what weights are times is nothing."""
    return float(np.mean(given.weight[given.weight > 0]))


def _cameras(camera: Any, count: int) -> list[Camera]:
    """A camera for each of this many views, or raise ValueError."""
    cameras = [camera] * count if isinstance(camera, Camera) else camera
    check_kind("camera", cameras, Sequence, "a Camera, or one for each view")
    for one in cameras:
        check_camera(one)
    if len(cameras) != count:
        raise ValueError(f"`camera`: expected one for each of {count} views, got {len(cameras)}")
    return list(cameras)


def _checked(points3d: ArrayLike, points2d: ArrayLike, weights: ArrayLike | None) -> PointArrays:
    """All views' points (V, N, .) in float64, NaN and a weight of 0 where not seen. Raises
    ValueError for others."""
    expected = "real numbers of shape (N, 2), or (V, N, 2) for V views"
    seen_at = np.asarray(array_of("points2d", points2d, expected))
    if seen_at.dtype.kind not in "fiu" or seen_at.ndim not in (2, 3) or seen_at.shape[-1] != 2:
        raise ValueError(
            f"`points2d`: expected {expected}, got shape {seen_at.shape}, dtype {seen_at.dtype}"
        )
    seen_at = np.array(seen_at, float, ndmin=3)
    V, N, _ = seen_at.shape
    if np.any(np.isinf(seen_at)):
        raise ValueError("`points2d`: expected finite values, or NaN where not seen, got inf")

    def in_each(name: str, value: ArrayLike, *shape: int) -> np.ndarray:
        whole, given = (V, *shape), array_of(name, value, f"a real array of shape {shape}")
        known = whole if given.ndim == len(whole) else shape
        array = np.asarray(checked(name, given, known, np.dtype(np.float64)), float)
        return np.broadcast_to(array, whole)

    points = in_each("points3d", points3d, N, 3)
    weight = in_each("weights", np.ones(N) if weights is None else weights, N)
    if np.any(weight < 0):
        raise ValueError(f"`weights`: expected none below 0, got {weight.min()}")
    seen_at[np.isnan(seen_at).any(axis=-1)] = np.nan
    least = NEGLIGIBLE * np.max(weight, axis=1, keepdims=True, initial=0)
    seen = ~np.isnan(seen_at[..., 0])
    weight = np.where(seen & (weight > least), weight, 0.0)
    number = np.sum(weight > 0, axis=1)
    if not np.min(number, initial=3 if V else 0) >= 3:
        views = ", ".join(map(str, number)) or "no view"
        name = "weights" if V and np.min(np.sum(seen, axis=1)) >= 3 else "points2d"
        raise ValueError(f"`{name}`: expected at least 3 points in each view, got {views}")
    return PointArrays(points, seen_at, weight)


def _reports(found: PointDescent, weights: np.ndarray) -> tuple[PointFit, ...]:
    """The fits of all views, and of their other places; points had these `weights` (V, N)."""
    problem, end = found.problem, found.end
    if not np.isfinite(end.squares):
        return tuple(_without_answer(problem, k, end) for k in range(len(problem.eyes)))
    here, noise = Minimum(problem, end), problem.shown(end)
    beyond = beyond_noise(here.solved, len(end.seen), noise)
    spare = () if noise.freedom > 0 else (_none_left_over(problem),)
    fits = []
    for k, matches in enumerate(problem.matches):
        others = (Minimum(problem, problem.stay(place.state)) for place in found.others[k])
        fit, *modes = (_report(found, k, x, beyond) for x in (here, *others))
        given = int(np.sum(weights[k] > 0))
        if left_out := given - len(matches.counts):
            words = f"{left_out} of {given} points are far from where they are seen, and left out"
            fit = fit._replace(weak=(*fit.weak, words))
        film, eye = problem.cameras[str(k)], problem.eyes[k]
        way = tuple(
            Progress(on_film(eye.canonical(state), film), film.W, film.H, steps)
            for state, _, steps in end.way
        )
        fits.append(with_modes(fit._replace(history=way, weak=(*fit.weak, *spare)), modes))
    return tuple(fits)


def _none_left_over(problem: PointProblem) -> str:
    """A sentence: nothing shows how far points err."""
    some, unknowns = problem.coordinates, problem.size
    repeated = some < 2 * sum(len(matches.counts) for matches in problem.matches)
    return (
        f"{some} coordinates{' (repeated points count once)' * repeated} for {unknowns} unknowns:"
        " none is left over to show how far points err, so there are no error bars; `noise_px`"
        " gives them"
    )


def _without_answer(problem: PointProblem, k: int, end: Descent) -> PointFit:
    """The fit of a view that no step could be taken in."""
    camera = on_film(problem.eyes[k].canonical(end.state), problem.cameras[str(k)])
    labels = labels_of(problem.matches[k].freed)
    known = {"names": labels, "covariance": np.full(2 * (len(labels),), np.nan)}
    return PointFit(camera=camera, status="non_finite", rms_px=np.nan, **known)


def _report(found: PointDescent, k: int, here: Minimum, beyond: np.ndarray) -> PointFit:
    """The fit of a view where all views' squares are least; `beyond` is the root of the shared
    unknowns' covariance beyond that of independent errors."""
    problem, end, known = found.problem, here.descent, here.solved
    eye, matches, noise = problem.eyes[k], problem.matches[k], problem.shown(end)
    at, film = eye.canonical(end.state), problem.cameras[str(k)]
    camera, blind = on_film(at, film), BLIND[problem.dtype]
    view, freed, place = end.seen[k].view, matches.freed, problem.columns(k)
    labels, scale = labels_of(freed), view.scale
    reported = to_units(view.to_reported, freed, camera)
    triangle = known.triangle_by(place) * scale
    # (As NumPy's: within `grad` JAX's would be traced, and no report could look at them.)
    along = np.linalg.lstsq(triangle.T, here.slope[place] * scale, rcond=None)[0]
    in_words = partial(moves_in_words, components(freed), axes_of(camera))
    unseen, weak = weak_directions(triangle, in_words, blind)
    spread = reported / scale @ known.follows[place] @ beyond
    gradient = triangle.T @ triangle
    # (Shared unknowns are known by many views, whose agreement tells.)
    excess = np.zeros_like(gradient) if beyond.size else alike(matches, at, noise)
    cov = covariance(triangle, reported, gradient + excess, blind) + spread @ spread.T
    # (Where nothing shows how points err, nothing is known.)
    is_known = np.isfinite(noise.variance)
    cov = noise.variance * cov if is_known else np.where(np.eye(len(cov)) > 0, np.inf, np.nan)

    rms = float(np.sqrt(float(view.sums.squares) / matches.weight))
    status, words = _status_by_error_bars(cov, labels, camera, noise)
    if np.any(excess):
        words = (*words, ALIKE)
    if unseen:
        status = "rank_deficient"
    if here.contradictions:
        status, words = "misfit", here.contradictions
    if rms > found.limits[k]:
        status = "misfit"
        words = (f"points lie {rms:.3g} px (rms) from where they are seen: {WRONG}",)
    count = 2.0 * sum(len(matches.counts) for matches in problem.matches)
    if not at_rest(triangle, along, end.squares, count, problem.dtype):
        status, words = "max_steps", (*words, *(BARRED,) * end.ended)
    if not np.isfinite(matches.squares(at)):
        status = "behind"
    return PointFit(
        camera=camera,
        status=status,
        names=labels,
        covariance=cov,
        rms_px=rms,
        weak=(*weak, *held_words(eye.ended(end.state)), *words),
    )


def _status_by_error_bars(
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
