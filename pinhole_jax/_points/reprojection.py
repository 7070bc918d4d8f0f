"""Views of points whose places in the world are known, as least squares.

The problem of `fit_cameras` with other residuals: where points are seen, less where they project.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera, lens_holds, to_camera
from .._camera.film import FilmPart
from .._camera.rays import project
from .._fit.implicit import Slope
from .._numerics.pointwise import padded, room
from .._numerics.thin_qr import triangle_and_rhs
from .._scene.scene import Ball, ball_about
from .._solver.least_squares import Rows
from .._solver.moves import Bounds, Move, camera_velocity, canonical, moved, reported
from .._solver.parameters import components
from .._solver.priors import Prior
from .._solver.problem import move_about

#: A move of `UNIT_PX` counts as this many residuals of as much, as damping has it. (40 draws of 12
#: points, phi and k1 free: 4.3 steps with 0.1 and 1, 4.8 with 10, 6.7 with 100, all end right.)
FILM = 10.0
#: Points, and where they are seen, are repeated where they differ by less than this share of how
#: far all spread.
REPEATED = 1e-9


class PointRows(NamedTuple):
    """What is known at one camera (as `looks.View`): in px over `UNIT_PX`.

    - `sum_squares` (px^2, weighed) is of the points alone, `prior_squares` of a prior.
    - `nearest`: the least depth of a point.
    """

    triangle: Float[Array, "n n"]
    along: Float[Array, "n"]
    scale: Float[Array, "n"]
    to_reported: Float[Array, "m n"]
    sum_squares: Float[Array, ""]
    prior_squares: Float[Array, ""]
    nearest: Float[Array, ""]

    @property
    def squares(self) -> float:
        """The sum of squared residuals, those of a prior among them."""
        return float(self.sum_squares) + float(self.prior_squares)


class PointArrays(NamedTuple):
    """Points in the world (N, 3), where they are seen (N, 2) in px, and how much each counts (N,);
    or velocities of these, None where they stay."""

    points: Any
    seen_at: Any
    weight: Any

    def off(self, camera: Camera, H: Any) -> Float[Array, "N 2"]:
        """Projected points less where they are seen (px), 0 of those that do not count."""
        off = project(camera, self.points) * H - self.seen_at
        return jnp.where((self.weight > 0)[:, None], off, 0)


class PointView(NamedTuple):
    """One view: its film, points in the world, where these are seen (px) and how much each counts
    (filled up: there is a program of few sizes), what is free, and the camera so far (canonical).
    """

    film: Camera
    points: Float[np.ndarray, "N 3"]
    seen_at: Float[np.ndarray, "N 2"]
    weight: Float[np.ndarray, "N"]
    ball: Ball
    freed: tuple[str, ...]
    camera: Camera
    bounds: Bounds | None = None
    prior: Prior | None = None

    @classmethod
    def from_points(cls, film: Camera, given: PointArrays, freed: tuple[str, ...]) -> "PointView":
        """The view from where its film's camera is."""
        points, seen_at, weight = given
        used = points[weight > 0]
        ball = ball_about(np.stack([used.min(axis=0), used.max(axis=0)]))
        # (What does not count may be NaN, whose derivative would be, too.)
        seen_at = np.where((weight > 0)[:, None], seen_at, 0)
        size = room(len(points))  # (what is filled up does not count either)
        arrays = padded(points, size), padded(seen_at, size, 0), padded(weight, size, 0)
        return cls(film, *arrays, ball, freed, canonical(film))

    @property
    def number(self) -> int:
        """The number of points that count."""
        return int(np.sum(self.weight > 0))

    def different(self, shows: np.ndarray, and_seen: bool) -> np.ndarray:
        """The indices of points among those that show something, without those that repeat
        another one (`and_seen`: and where that is seen)."""
        some = np.flatnonzero(shows)
        rows = []
        for x in (self.points, self.seen_at)[: 1 + and_seen]:
            spread = float(np.ptp(x[some], axis=0).max())
            rows.append(np.round((x[some] - x[some[0]]) / (REPEATED * (spread or 1))))
        return some[np.sort(np.unique(np.hstack(rows), axis=0, return_index=True)[1])]

    def look(self) -> PointRows:
        """The view's least squares."""
        return _look(self.camera, self._data(), self.freed)

    def stepped(self, y: np.ndarray) -> "PointView":
        """The view after a step."""
        y = np.asarray(y, self.film.e.dtype)
        return self._replace(camera=_step(self.camera, self._data(), y, self.freed))

    def distances(self) -> Float[np.ndarray, "N"]:
        """Distances (px) of points from where they are seen, infinite behind the eye."""
        return np.asarray(_distances(self.camera, self._data()), float)

    def slope(self, velocity: PointArrays, columns: np.ndarray) -> Slope:
        """The slope of the view's squares, as what it is given moves, by unknowns at some columns
        (moves as such)."""
        data = self._data()
        pairs = zip(velocity, data.given, strict=True)
        changes = PointArrays(*(_change(rate, array) for rate, array in pairs))
        bend, pull = _bend_and_pull(self.camera, data, changes, self.freed)
        return Slope(columns, np.asarray(bend, float), pull)

    def camera_velocity(self, y: Float[Array, "n"]) -> Camera:
        """The camera's rate of change, on its film, with moves as such."""
        return _camera_velocity(self.camera, self._data(), self.film, y, self.freed)

    def _data(self) -> "_Data":
        film, to = self.film, lambda x: np.asarray(x, self.film.e.dtype)
        given = PointArrays(to(self.points), to(self.seen_at), to(self.weight))
        ball = Ball(*map(to, self.ball))
        return _Data(given, ball, to(film.W / film.H), to(film.H), self.bounds, self.prior)


class _Data(NamedTuple):
    given: PointArrays
    ball: Ball
    width: Any
    H: Any
    bounds: Bounds | None
    prior: Prior | None

    def move(self, camera: Camera, freed: tuple[str, ...]) -> Move:
        """A start of moves of a camera, in the solver's units."""
        return move_about(camera, *self.ball, self.bounds, self.H, freed)

    def plain_move(self, camera: Camera, freed: tuple[str, ...]) -> Move:
        """A start of moves of a camera as such."""
        move = self.move(camera, freed)
        return move._replace(scale=jnp.ones_like(move.scale))

    def residuals(self, camera: Camera) -> Float[Array, "k"]:
        """Residuals (px): projected less seen points, weighed; NaN where the lens folds."""
        off = jnp.sqrt(self.given.weight)[:, None] * self.given.off(camera, self.H)
        holds = lens_holds(camera, FilmPart(0, self.width, 0, 1))
        return jnp.where(holds, off.reshape(-1), jnp.nan)


class PointProblem(NamedTuple):
    """Views of points as `LeastSquares`, whose state are the views.

    - `alone`: the names of parameters that each view has for itself; the shared ones come last.
    - `own` (n,): which of a view's moves these are.
    - `size`: the number of unknowns; `dtype`: the float type.
    """

    alone: tuple[str, ...]
    own: np.ndarray
    size: int
    dtype: np.dtype

    @classmethod
    def from_views(cls, views: Sequence[PointView], alone: tuple[str, ...]) -> "PointProblem":
        """The problem in which each view has these parameters alone."""
        names = [name for name in views[0].freed for _ in components((name,))]
        own = np.isin(names, alone)
        size = len(views) * int(own.sum()) + int((~own).sum())
        return cls(alone, own, size, np.dtype(views[0].film.e.dtype))

    def look(self, state: list[PointView]) -> list[PointRows]:
        """The views' least squares."""
        return [view.look() for view in state]

    def noise(self, seen: list[PointRows]) -> float:
        """The noise that weighs priors: 1, as theirs are weighed already."""
        del seen
        return 1.0

    def squares(self, state: list[PointView], seen: list[PointRows], noise: float) -> float:
        """The sum of the squares of all residuals."""
        del state, noise
        return sum(one.squares for one in seen)

    def parts(self, state: list[PointView], seen: list[PointRows], noise: float) -> list[Rows]:
        """The rows of all views."""
        del state, noise
        return [
            Rows(
                np.asarray(one.triangle, float) / np.asarray(one.scale, float),
                np.asarray(one.along, float),
                self.columns(k),
                self.own,
            )
            for k, one in enumerate(seen)
        ]

    def sizes(self, seen: list[PointRows], parts: list[Rows]) -> np.ndarray:
        """The change of each unknown that moves points by `FILM` px: a trust region, without which
        a lens that points hardly show would fold."""
        del parts
        result = np.zeros(self.size)
        for k, one in enumerate(seen):
            columns = self.columns(k)
            result[columns] = np.maximum(result[columns], FILM / np.asarray(one.scale, float))
        return result

    def ways_out(self, state: list[PointView], seen: list[PointRows]) -> np.ndarray:
        """Zeros: bounds hold nothing, as steps swing to and fro within them."""
        del state, seen
        return np.zeros(self.size)

    def stepped(self, state: list[PointView], x: np.ndarray) -> list[PointView]:
        """The views after a step."""
        return [view.stepped(x[self.columns(k)]) for k, view in enumerate(state)]

    def moved(self, seen: list[PointRows], x: np.ndarray) -> float:
        """The largest move that a step makes in any view, in its units."""
        moves = (x[self.columns(k)] / np.asarray(one.scale) for k, one in enumerate(seen))
        return max(float(np.max(np.abs(y))) for y in moves)

    def columns(self, k: int) -> np.ndarray:
        """Indices of the numbers that a view depends on."""
        m, shared = int(self.own.sum()), int((~self.own).sum())
        result = np.empty(len(self.own), int)
        result[self.own] = k * m + np.arange(m)
        result[~self.own] = self.size - shared + np.arange(shared)
        return result


@eqx.filter_jit
def _step(camera: Camera, data: _Data, y: Any, freed: tuple[str, ...]) -> Camera:
    return moved(data.plain_move(camera, freed), y, freed)


@eqx.filter_jit
def _camera_velocity(
    start: Camera, data: _Data, film: Camera, y: Float[Array, "n"], freed: tuple[str, ...]
) -> Camera:
    return camera_velocity(data.plain_move(start, freed), film, freed, y)


@eqx.filter_jit
def _distances(camera: Camera, data: _Data) -> Float[Array, "N"]:
    off = data.given.off(camera, data.H)
    ahead = to_camera(camera, data.given.points)[:, 2] > 0
    return jnp.where(ahead, jnp.sqrt(jnp.sum(off * off, axis=1)), jnp.inf)


@eqx.filter_jit
def _look(start: Camera, data: _Data, freed: tuple[str, ...]) -> PointRows:
    move = data.move(start, freed)
    zero = jnp.zeros_like(move.scale)
    padding = jnp.zeros(zero.shape[0] + 1, zero.dtype)  # more rows than columns

    def residuals(y):
        camera = moved(move, y, freed)
        r, from_prior = data.residuals(camera), padding[:0]
        if data.prior is not None:
            from_prior = data.prior.residuals(camera, freed)
        rows = jnp.concatenate([r, from_prior, padding])
        return rows, (rows, jnp.sum(r * r), jnp.sum(from_prior * from_prior))

    jacobian, (rows, squares, prior) = jax.jacfwd(residuals, has_aux=True)(zero)
    triangle, along = triangle_and_rhs(jacobian, rows)
    to_reported = jax.jacfwd(lambda y: reported(start, moved(move, y, freed), freed))(zero)
    depth = to_camera(start, data.given.points)[:, 2]
    nearest = jnp.min(jnp.where(data.given.weight > 0, depth, jnp.inf))
    return PointRows(triangle, along, move.scale, to_reported, squares, prior, nearest)


@eqx.filter_jit
def _bend_and_pull(
    start: Camera, data: _Data, velocity: PointArrays, freed: tuple[str, ...]
) -> tuple[Array, Array]:
    """Half the gradient of the squares by moves as such: its derivative by these (n, n), and its
    rate of change (n,) with what is given."""
    move = data.plain_move(start, freed)

    def half_squares(y: Array, given: PointArrays) -> Array:
        off = given.off(moved(move, y, freed), data.H)
        return jnp.sum(given.weight[:, None] * off * off) / 2

    slope, still = jax.grad(half_squares), jnp.zeros_like(move.scale)
    pull = jax.jvp(lambda given: slope(still, given), (data.given,), (velocity,))[1]
    return jax.jacfwd(slope)(still, data.given), pull


def _change(velocity: Any, array: np.ndarray) -> Any:
    """The velocity of a filled-up array: 0 where it was added to."""
    if velocity is None:
        return np.zeros_like(array)
    rest = np.zeros((len(array) - len(velocity), *array.shape[1:]), array.dtype)
    return jnp.concatenate([velocity, rest])
