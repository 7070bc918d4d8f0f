"""`fit_points`: cameras from points whose places in the world are known (calibration, pose).

The problem of `fit_cameras` with other residuals: where points are seen, less where they project.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.axes import axes_of
from .._camera.camera import Camera, check_camera, lens_holds, to_camera
from .._camera.film import FilmPart
from .._camera.rays import project
from .._fit.fit_camera import check_steps
from .._fit.result import at_rest, to_units, without_ended
from .._fit.words import parameter_lines
from .._numerics.arrays import Numbers, float_array
from .._numerics.jitted import jitted
from .._numerics.thin_qr import triangle_and_rhs
from .._scene.scene import Ball, ball_about
from .._solver.least_squares import Rows, levenberg_marquardt
from .._solver.moves import Bounds, Move, canonical, moved, on_film, reported, scales
from .._solver.parameters import components, labels_of, with_lens
from .._solver.priors import Prior, bounds_of, prior_of
from .._solver.problem import FINE_PX, UNIT_PX
from .._solver.uncertainty import BLIND, covariance, weak_directions
from .resection import resected
from .shared_unknowns import alike, joint, others, reduced, shared_and_free

#: What several views share if nothing is said: the intrinsics of one physical camera.
INTRINSICS = ("phi", "principal_point", "distortion")


#: A move of `UNIT_PX` counts as this many residuals of as much, as damping has it.
FILM = 10.0
#: How often a prior is weighed anew by what the points err by.
ROUNDS = 3


class PointFit(NamedTuple):
    """The result of `fit_points` for one view.

    - `camera`: the fitted camera.
    - `status`: "converged" (trust the camera only then), "rank_deficient" (some direction moves no
      point: `weak` names it), "max_steps", "behind" (a point would lie behind the eye) or
      "non_finite".
    - `names`: the fitted parameters, in the order of `covariance` (n, n) and `std` (n,), as in
      `Fit`. The covariance is that of the joint problem and assumes that all coordinates err
      independently and alike, by as much as the residuals say.
    - `rms_px`: root mean square distance of the view's points from where they are seen.
    - `steps`: Levenberg-Marquardt steps.
    - `weak`: directions that the points determine badly or not at all, as sentences.
    """

    camera: Camera
    status: str
    names: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]
    std: Float[np.ndarray, "n"]
    rms_px: float
    steps: int
    weak: tuple[str, ...]

    def __str__(self) -> str:
        """Return it as a table."""
        lines = [*parameter_lines(self), f"status     {self.status}"]
        lines.append(f"rms        {self.rms_px:.3g} px")
        return "\n".join([*lines, *(f"note       {weak}" for weak in self.weak)])

    def __repr__(self) -> str:
        """Return it in a line, its arrays left out."""
        return f"<PointFit: {self.status}, rms {self.rms_px:.3g} px, {', '.join(self.names)}>"


def fit_points(
    points3d: Numbers,
    points2d: Numbers,
    camera: Any,
    free: str | Sequence[str] = ("pose",),
    shared: str | Sequence[str] | None = None,
    *,
    prior: Mapping[str, Any] | None = None,
    bounds: Mapping[str, Any] | None = None,
    max_steps: int = 100,
) -> Any:
    """Return the camera that sees points where they were seen: a `PointFit`, or one for each view.

    - `points3d`: (N, 3), world units; or (V, N, 3) if each of V views has its own.
    - `points2d`: (N, 2), or (V, N, 2) for V views: film coordinates (px, origin at the film's
      bottom-left corner, y up; of OpenCV's (u, v) they are (u + 1/2, H - v - 1/2)). NaN: not seen.
    - `camera`: resolution, and where to start; one for all views, or one for each. Its pose is used
      only where it is nearer than what a plane homography (4 points of a plane) or a direct linear
      transformation (6 points) says, or where there are fewer points. The focal length may be off
      by some tens of percent.
    - `free`: what each view has of its own; `shared`: what all have in common. Names are those of
      `fit_camera`. None: with several views phi, principal_point and distortion, else nothing.
    - `prior`, `bounds`: as in `fit_camera`; of what is shared once, else for each view.

    Returns a `PointFit` for points2d (N, 2), a tuple of them for (V, N, 2). Levenberg-Marquardt as
    in `fit_cameras`: a step's cost is linear in the views. Works in the float type of `camera`.
    Steps that would make the lens fold within the film are not taken.

    Raises ValueError for arguments that make no fit; what the solver met is in each `status`.
    """
    single = isinstance(camera, Camera)
    cameras = [camera] if single else camera
    if not isinstance(cameras, Sequence):
        kind = type(camera).__name__
        raise ValueError(f"`camera`: expected a Camera, or one for each view, got {kind}")
    for one in cameras:
        check_camera(one)
    check_steps(max_steps)
    seen_at, points = _checked(points3d, points2d)
    count = len(seen_at)
    cameras = [camera] * count if single else list(cameras)
    if len(cameras) != count:
        raise ValueError(f"`camera`: expected one for each of {count} views, got {len(cameras)}")
    if shared is None:
        shared = INTRINSICS if count > 1 else ()
    names, common = shared_and_free(shared, free, cameras[0])
    cameras = alike([with_lens(c, names) for c in cameras], common)
    views = [
        _begun(
            _view(c, X, x, names)._replace(
                bounds=bounds_of(bounds, c, names), prior=prior_of(prior, c, names, common, count)
            ),
            "pose" in names,
        )
        for c, X, x in zip(cameras, points, seen_at, strict=True)
    ]
    own = np.array([name not in common for name in names for _ in components((name,))])
    steps, unknowns = 0, count * int(own.sum()) + int((~own).sum())
    problem = _Problem(own, unknowns, np.dtype(cameras[0].e.dtype))
    for _ in range(ROUNDS if prior else 1):
        views = _believed(views, unknowns)
        found = levenberg_marquardt(problem, views, max_steps, FINE_PX[problem.dtype])
        views, steps = found.state, steps + found.steps
    fits = _reports(views, names, own, steps)
    return fits if np.ndim(points2d) == 3 else fits[0]


def _checked(points3d: Numbers, points2d: Numbers) -> tuple[np.ndarray, np.ndarray]:
    """Return (V, N, 2) and (V, N, 3) in float64, or raise ValueError."""
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
    points = np.asarray(float_array("points3d", points3d, shape, np.dtype(np.float64)), float)
    seen_at[np.isnan(seen_at).any(axis=-1)] = np.nan
    few = np.sum(~np.isnan(seen_at[..., 0]), axis=1)
    if V == 0 or np.any(few < 3):
        k = int(np.argmin(few)) if V else 0
        raise ValueError(
            "`points2d`: expected at least 3 points in each view, got"
            f" {few[k] if V else 'no view'} in view {k}"
        )
    return seen_at, np.broadcast_to(points, (V, N, 3))


class _Seen(NamedTuple):
    """What is known at one camera (as `problem.View`): in px over `UNIT_PX`; `nearest` is the least
    depth of a point."""

    triangle: Float[Array, "n n"]
    along: Float[Array, "n"]
    scale: Float[Array, "n"]
    to_reported: Float[Array, "m n"]
    sum_squares: Float[Array, ""]
    prior_squares: Float[Array, ""]
    nearest: Float[Array, ""]

    @property
    def squares(self) -> float:
        """Return the sum of squared residuals, those of a prior among them."""
        return float(self.sum_squares) + float(self.prior_squares)


class _View(NamedTuple):
    """One view: film, points in film heights, names, and the camera so far (canonical)."""

    film: Camera
    points: Float[np.ndarray, "N 3"]
    seen_at: Float[np.ndarray, "N 2"]
    ball: Ball
    names: tuple[str, ...]
    camera: Camera
    bounds: Bounds | None = None
    prior: Prior | None = None

    @property
    def number(self) -> int:
        """Return how many points are seen."""
        return int(np.sum(~np.isnan(self.seen_at[:, 0])))

    def look(self) -> _Seen:
        """Return what is seen."""
        return _look(self.camera, self._data(), self.names)

    def stepped(self, y: np.ndarray) -> "_View":
        """Return the view after a step."""
        y = np.asarray(y, self.film.e.dtype)
        return self._replace(camera=_step(self.camera, self._data(), y, self.names))

    def _data(self) -> "_Data":
        to = lambda x: np.asarray(x, self.film.e.dtype)
        there = ~np.isnan(self.seen_at[:, 0])
        seen_at = np.where(there[:, None], self.seen_at, 0) / self.film.H
        centre, radius = self.ball
        return _Data(
            points=to(self.points),
            seen_at=to(seen_at),
            pivot=to(centre),
            radius=to(radius),
            there=there,
            width=to(self.film.W / self.film.H),
            H=to(self.film.H),
            bounds=self.bounds,
            prior=self.prior,
        )


class _Data(NamedTuple):
    points: Any
    seen_at: Any
    pivot: Any
    radius: Any
    there: Any
    width: Any
    H: Any
    bounds: Bounds | None
    prior: Prior | None

    def move(self, camera: Camera, names: tuple[str, ...]) -> Move:
        """Return where moves of a camera start, in the solver's units."""
        pivot, radius, H = (jnp.asarray(x) for x in (self.pivot, self.radius, self.H))
        return Move(camera, pivot, UNIT_PX * scales(camera, pivot, radius, H, names), self.bounds)

    def residuals(self, camera: Camera) -> Float[Array, "k"]:
        """Return where points project less where they are seen (px), NaN where the lens folds."""
        off = (project(camera, jnp.asarray(self.points)) - self.seen_at) * self.H
        off = jnp.where(jnp.asarray(self.there)[:, None], off, 0).reshape(-1)
        return jnp.where(lens_holds(camera, FilmPart(0, self.width, 0, 1, self.H)), off, jnp.nan)


class _Problem(NamedTuple):
    """Views of points as `LeastSquares`, whose state are the views: which of a view's
    moves are its own, the number of unknowns, and the float type. Shared ones come last."""

    own: np.ndarray
    size: int
    dtype: np.dtype

    def look(self, state: list[_View]) -> list[_Seen]:
        """Return what is seen in each view."""
        return [view.look() for view in state]

    def noise(self, seen: list[_Seen]) -> float:
        """Return that priors are weighed already."""
        del seen
        return 1.0

    def squares(self, state: list[_View], seen: list[_Seen], noise: float) -> float:
        """Return the sum of the squares of all residuals."""
        del state, noise
        return sum(one.squares for one in seen)

    def parts(self, state: list[_View], seen: list[_Seen], noise: float) -> list[Rows]:
        """Return the rows of all views."""
        del state, noise
        return [
            Rows(
                np.asarray(one.triangle, float) / np.asarray(one.scale, float),
                np.asarray(one.along, float),
                self._columns(k),
                self.own,
            )
            for k, one in enumerate(seen)
        ]

    def sizes(self, seen: list[_Seen], parts: list[Rows]) -> np.ndarray:
        """Return a step's size on the film: where points hardly tell a lens, it would soon fold."""
        del parts
        result = np.zeros(self.size)
        for k, one in enumerate(seen):
            columns = self._columns(k)
            result[columns] = np.maximum(result[columns], FILM / np.asarray(one.scale, float))
        return result

    def ways_out(self, state: list[_View], seen: list[_Seen]) -> np.ndarray:
        """Return that bounds hold nothing: within them steps swing to and fro."""
        del state, seen
        return np.zeros(self.size)

    def stepped(self, state: list[_View], x: np.ndarray) -> list[_View]:
        """Return the views after a step."""
        return [view.stepped(x[self._columns(k)]) for k, view in enumerate(state)]

    def moved(self, seen: list[_Seen], x: np.ndarray) -> float:
        """Return the largest move that a step makes in any view, in its units."""
        moves = (x[self._columns(k)] / np.asarray(one.scale) for k, one in enumerate(seen))
        return max(float(np.max(np.abs(y))) for y in moves)

    def _columns(self, k: int) -> np.ndarray:
        """Return where the numbers are that a view depends on."""
        m, shared = int(self.own.sum()), int((~self.own).sum())
        result = np.empty(len(self.own), int)
        result[self.own] = k * m + np.arange(m)
        result[~self.own] = self.size - shared + np.arange(shared)
        return result


@jitted
def _step(camera: Camera, data: _Data, y: Any, names: tuple[str, ...]) -> Camera:
    return moved(data.move(camera, names)._replace(scale=jnp.ones_like(y)), y, names)


@jitted
def _look(start: Camera, data: _Data, names: tuple[str, ...]) -> _Seen:
    move = data.move(start, names)
    zero = jnp.zeros_like(move.scale)
    room = jnp.zeros(zero.shape[0] + 1, zero.dtype)  # more rows than columns

    def at(y):
        camera = moved(move, y, names)
        r, known = data.residuals(camera), room[:0]
        if data.prior is not None:
            known = data.prior.residuals(camera, names)
        rows = jnp.concatenate([r, known, room])
        return rows, (rows, jnp.sum(r * r), jnp.sum(known * known))

    jacobian, (rows, squares, prior) = jax.jacfwd(at, has_aux=True)(zero)
    triangle, along = triangle_and_rhs(jacobian, rows)
    to_reported = jax.jacfwd(lambda y: reported(start, moved(move, y, names), names))(zero)
    depth = to_camera(start, jnp.asarray(data.points))[:, 2]
    nearest = jnp.min(jnp.where(jnp.asarray(data.there), depth, jnp.inf))
    return _Seen(triangle, along, move.scale, to_reported, squares, prior, nearest)


def _view(camera: Camera, points: np.ndarray, seen_at: np.ndarray, names: tuple) -> _View:
    used = points[~np.isnan(seen_at[:, 0])]
    ball = ball_about(np.stack([used.min(axis=0), used.max(axis=0)]))
    return _View(camera, points, seen_at, ball, names, canonical(camera))


def _begun(view: _View, anywhere: bool) -> _View:
    """Return the view from where the direct linear solution says, if the pose is free and that is
    nearer than the camera's own."""
    found = resected(view.film, view.points, view.seen_at) if anywhere else None
    view = _inside(view)
    if found is None:
        return view
    other = _inside(view._replace(camera=canonical(found)))
    own, direct = view.look(), other.look()
    nearer = float(own.sum_squares) <= float(direct.sum_squares)
    return view if float(own.nearest) > 0 and nearer else other


def _inside(view: _View) -> _View:
    """Return the view from within its bounds."""
    return view if view.bounds is None else view.stepped(np.zeros(len(components(view.names))))


def _believed(views: list[_View], unknowns: int) -> list[_View]:
    """Return the views with their priors weighed by what the points of all err by."""
    if views[0].prior is None:
        return views
    more = max(2 * sum(v.number for v in views) - unknowns, 1)
    mean = sum(float(v.look().sum_squares) for v in views) / more
    noise = np.asarray(np.sqrt(mean), views[0].film.e.dtype)
    put = lambda view: eqx.tree_at(lambda p: p.noise, view.prior, noise)
    return [view._replace(prior=put(view)) for view in views]


def _reports(
    views: list[_View], names: tuple[str, ...], own: np.ndarray, steps: int
) -> tuple[PointFit, ...]:
    seen = [v.look() for v in views]
    parts = [reduced(s, own) for s in seen]
    count = [v.number for v in views]
    squares = sum(float(s.sum_squares) for s in seen)
    unknowns = len(views) * int(own.sum()) + int((~own).sum())
    variance = squares / max(2 * sum(count) - unknowns, 1)
    slope: Any = sum(part.slope for part in parts)
    fits = []
    for view, one, known, n in zip(
        views, seen, others([p.rest for p in parts]), count, strict=True
    ):
        fit = _report(view, joint(one, known, slope, own), variance, squares, 2 * sum(count))
        rms = float(np.sqrt(float(one.sum_squares) / n))
        fits.append(fit._replace(rms_px=rms, steps=steps))
    return tuple(fits)


def _report(view: _View, seen: _Seen, variance: float, squares: float, count: int) -> PointFit:
    names, dtype = view.names, np.dtype(view.film.e.dtype)
    triangle, ended = without_ended(seen.triangle, view.camera, names, view.bounds)
    along = np.asarray(seen.along, float)
    labels, camera = labels_of(names), on_film(view.camera, view.film)
    if not (np.isfinite(squares) and np.all(np.isfinite(triangle))):
        nothing = np.full((len(labels), len(labels)), np.nan)
        nan = float("nan")
        return PointFit(camera, "non_finite", labels, nothing, np.diag(nothing), nan, 0, ())
    blind, weak = weak_directions(triangle, components(names), axes_of(camera), BLIND[dtype])
    gradient = variance * triangle.T @ triangle
    cov = covariance(triangle, to_units(seen.to_reported, names, camera), gradient, BLIND[dtype])
    status = "rank_deficient" if blind else "converged"
    if not at_rest(triangle, along, squares, float(count), dtype):
        status = "max_steps"
    if not float(seen.nearest) > 0:
        status = "behind"
    return PointFit(camera, status, labels, cov, np.sqrt(np.diag(cov)), 0.0, 0, weak + ended)
