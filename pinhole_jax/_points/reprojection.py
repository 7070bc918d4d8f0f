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
from .._solver.moves import Bounds, Move, canonical, moved, reported
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
    or velocities of these."""

    points: Any
    seen_at: Any
    weight: Any

    def off(self, camera: Camera, H: Any) -> Float[Array, "N 2"]:
        """Projected points less where they are seen (px), 0 of those that do not count."""
        off = project(camera, self.points) * H - self.seen_at
        return jnp.where((self.weight > 0)[:, None], off, 0)


class PointView(NamedTuple):
    """One view, as programs take it: points are filled up, so there is a program of few sizes.

    - `given`: points, where they are seen, and how much they count.
    - `ball`: a sphere about them; `start`, `camera`: the user's camera and that so far (canonical);
      `aspect`, `H`: the film's width in its heights, and its height in px.
    - `freed`: what is free, `alone` what of it no other view shares; `moving`: what moves, as some
      may be held.
    """

    given: PointArrays
    ball: Ball
    start: Camera
    camera: Camera
    aspect: Any
    H: Any
    freed: tuple[str, ...]
    alone: tuple[str, ...]
    moving: tuple[str, ...]
    bounds: Bounds | None
    prior: Prior | None

    @classmethod
    def from_points(
        cls,
        film: Camera,
        given: PointArrays,
        freed: tuple[str, ...],
        alone: tuple[str, ...],
        bounds: Bounds | None,
        prior: Prior | None,
    ) -> "PointView":
        """The view from where its film's camera is."""
        used = given.points[given.weight > 0]
        ball = ball_about(np.stack([used.min(axis=0), used.max(axis=0)]))
        to = lambda x: np.asarray(x, film.e.dtype)
        # (What does not count may be NaN, whose derivative would be, too.)
        given = given._replace(seen_at=np.where((given.weight > 0)[:, None], given.seen_at, 0))
        start = canonical(film)
        sides, known = (to(film.W / film.H), to(film.H)), (freed, alone, freed, bounds, prior)
        return cls(filled_up(given, to), Ball(*map(to, ball)), start, start, *sides, *known)

    @property
    def counts(self) -> np.ndarray:
        """The indices of the points that count."""
        return np.flatnonzero(self.given.weight)

    @property
    def weight(self) -> float:
        """The weight of all points together."""
        return float(np.sum(self.given.weight, dtype=float))

    @property
    def moves(self) -> int:
        """The number of moves."""
        return len(components(self.moving))

    def in_heights(self, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Some of the points (k, 3), and where they are seen (k, 2) in film heights."""
        points, seen_at, _ = self.given
        return np.asarray(points[some], float), np.asarray(seen_at[some] / self.H, float)

    def different(self, some: np.ndarray, and_seen: bool) -> np.ndarray:
        """The indices of points among some, without those that repeat another one (`and_seen`: and
        where that is seen)."""
        rows = []
        for x in self.in_heights(some)[: 1 + and_seen]:
            spread = float(np.ptp(x, axis=0).max())
            rows.append(np.round((x - x[0]) / (REPEATED * (spread or 1))))
        return some[np.sort(np.unique(np.hstack(rows), axis=0, return_index=True)[1])]

    def posed(self, camera: Camera) -> "PointView":
        """The view from a camera's pose, its lens as it is."""
        pose = lambda c: (c.e, c.p, c.u)
        return self._replace(camera=eqx.tree_at(pose, self.camera, pose(camera)))

    def weighed(self, weight: np.ndarray) -> "PointView":
        """The view whose points count so much."""
        return self._replace(given=self.given._replace(weight=weight))

    def look(self) -> PointRows:
        """The view's least squares."""
        return _look(self)

    def stepped(self, y: np.ndarray) -> "PointView":
        """The view after a step."""
        return self._replace(camera=_stepped(self, np.asarray(y, self.H.dtype)))

    def distances(self) -> Float[np.ndarray, "N"]:
        """Distances (px) of points from where they are seen, infinite behind the eye."""
        return np.asarray(_distances(self), float)

    def slope(self, rates: PointArrays, columns: np.ndarray) -> Slope:
        """The slope of the view's squares, as what it is given moves, by unknowns at some columns
        (moves as such)."""
        bend, pull = _bend_and_pull(self, rates)
        return Slope(columns, np.asarray(bend, float), pull)

    def move(self) -> Move:
        """A start of the camera's moves, in the solver's units."""
        pivot, radius, height = map(jnp.asarray, (*self.ball, self.H))
        return move_about(self.camera, pivot, radius, self.bounds, height, self.moving)

    def plain_move(self) -> Move:
        """A start of the camera's moves as such."""
        move = self.move()
        return move._replace(scale=jnp.ones_like(move.scale))


class PointProblem(NamedTuple):
    """Views of points as `LeastSquares`, whose state are the views.

    - `own` (n,): which of a view's moves are its own; the shared ones come last.
    - `size`: the number of unknowns; `dtype`: the float type.
    """

    own: np.ndarray
    size: int
    dtype: np.dtype

    @classmethod
    def from_views(cls, views: Sequence[PointView]) -> "PointProblem":
        """The joint problem of these views: parameters that are not `alone` are shared."""
        names = [name for name in views[0].moving for _ in components((name,))]
        own = np.isin(names, views[0].alone)
        size = len(views) * int(own.sum()) + int((~own).sum())
        return cls(own, size, np.dtype(views[0].H.dtype))

    def columns(self, k: int) -> np.ndarray:
        """Indices of the numbers that a view depends on."""
        of_view, shared = np.cumsum(self.own) - 1, np.cumsum(~self.own)
        first = self.size - 1 - np.sum(~self.own)
        return np.where(self.own, k * np.sum(self.own) + of_view, first + shared)

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
        result = []
        for k, one in enumerate(seen):
            triangle, scale, along = (
                np.asarray(x, float) for x in (one.triangle, one.scale, one.along)
            )
            result.append(Rows(triangle / scale, along, self.columns(k), self.own))
        return result

    def sizes(self, seen: list[PointRows], parts: list[Rows]) -> np.ndarray:
        """The change of each unknown that moves points by `FILM` px: a trust region, without which
        a lens that points hardly show would fold."""
        result = np.zeros(self.size)
        for part, one in zip(parts, seen, strict=True):
            np.maximum.at(result, part.columns, FILM / np.asarray(one.scale, float))
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


def filled_up(given: PointArrays, to: Any) -> PointArrays:
    """Arrays of points, each as `to` has it, filled up with what does not count."""
    size = room(len(given.points))
    values = None, 0, 0
    return PointArrays(*(padded(to(x), size, v) for x, v in zip(given, values, strict=True)))


@eqx.filter_jit
def _stepped(view: PointView, y: Any) -> Camera:
    return moved(view.plain_move(), y, view.moving)


@eqx.filter_jit
def _distances(view: PointView) -> Float[Array, "N"]:
    off = view.given.off(view.camera, view.H)
    ahead = to_camera(view.camera, view.given.points)[:, 2] > 0
    return jnp.where(ahead, jnp.sqrt(jnp.sum(off * off, axis=1)), jnp.inf)


@eqx.filter_jit
def _look(view: PointView) -> PointRows:
    move, given = view.move(), view.given
    zero = jnp.zeros_like(move.scale)
    padding = jnp.zeros(zero.shape[0] + 1, zero.dtype)  # more rows than columns

    def residuals(y):
        camera, from_prior = moved(move, y, view.moving), padding[:0]
        off = jnp.sqrt(given.weight)[:, None] * given.off(camera, view.H)
        # (No step leads to where the lens folds.)
        holds = lens_holds(camera, FilmPart(0, view.aspect, 0, 1))
        r = jnp.where(holds, off.reshape(-1), jnp.nan)
        if view.prior is not None:
            from_prior = view.prior.residuals(camera, view.freed)
        rows = jnp.concatenate([r, from_prior, padding])
        return rows, (rows, jnp.sum(r * r), jnp.sum(from_prior * from_prior))

    jacobian, (rows, squares, prior) = jax.jacfwd(residuals, has_aux=True)(zero)
    triangle, along = triangle_and_rhs(jacobian, rows)
    values = lambda y: reported(view.camera, moved(move, y, view.moving), view.moving)
    depth = to_camera(view.camera, given.points)[:, 2]
    nearest = jnp.min(jnp.where(given.weight > 0, depth, jnp.inf))
    to_reported = jax.jacfwd(values)(zero)
    return PointRows(triangle, along, move.scale, to_reported, squares, prior, nearest)


@eqx.filter_jit
def _bend_and_pull(view: PointView, rates: PointArrays) -> tuple[Array, Array]:
    """Half the gradient of the squares by moves as such: its derivative by these (n, n), and its
    rate of change (n,) with what is given."""
    move = view.plain_move()

    def half_squares(y: Array, given: PointArrays) -> Array:
        off = given.off(moved(move, y, view.moving), view.H)
        return jnp.sum(given.weight[:, None] * off * off) / 2

    slope, still = jax.grad(half_squares), jnp.zeros_like(move.scale)
    pull = jax.jvp(lambda given: slope(still, given), (view.given,), (rates,))[1]
    return jax.jacfwd(slope)(still, view.given), pull
