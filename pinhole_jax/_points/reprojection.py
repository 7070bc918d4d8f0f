"""Views of points whose places in the world are known, as views of a joint problem.

The problem of `fit_cameras` with other residuals: where points are seen, less where they project.
"""

from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera, film_map, lens_holds
from .._camera.film import FilmPart
from .._camera.rays import project
from .._joint.system import Descent, JointProblem
from .._joint.views import Eye, Standpoint, State, Unknown, indices
from .._numerics.pointwise import padded, room
from .._numerics.thin_qr import triangle_of
from .._scene.scene import Ball, ball_about
from .._solver.least_squares import Rows
from .._solver.looks import Sums, View
from .._solver.moves import Bounds, Move, moved, reported
from .._solver.parameters import components
from .._solver.problem import FINE_PX, move_about
from .noise import Noise

#: A move of `UNIT_PX` counts as this many residuals of as much, as damping has it. (40 draws of 12
#: points, phi and k1 free: 4.3 steps with 0.1 and 1, 4.8 with 10, 6.7 with 100, all end right.)
FILM = 10.0
#: Points whose distances from the camera's are this many times what a step may leave out are met
#: exactly.
EXACT = 100
#: A camera that leaves this share of the points' spread on the film, or this share of its diagonal,
#: is a misfit, but not below this many px; or this many times the error that is given.
SPREAD, DIAGONAL, LEAST_PX, TIMES = 0.1, 0.02, 1.0, 2.0
#: Points, and where they are seen, are repeated where they differ by less than this share of how
#: far all spread.
REPEATED = 1e-9


class PointArrays(NamedTuple):
    """Points in the world (N, 3), where they are seen (N, 2) in px, and how much each counts
    (N,)."""

    points: Any
    seen_at: Any
    weight: Any

    def off(self, camera: Camera, H: Any) -> Float[Array, "N 2"]:
        """Projected points, by a camera whose unit is `H` px, less where they are seen (px); 0 of
        those that do not count."""
        off = project(camera, self.points) * H - self.seen_at
        return jnp.where((self.weight > 0)[:, None], off, 0)


class Matches(eqx.Module):
    """Points, and where a view sees them: what an eye looks at, as a `Solver` at a mask.

    - `given`: the points, filled up so that there is a program of few sizes.
    - `ball`: a sphere about them; `aspect`, `H`: the film's width in its heights, its height in px.
    - `freed`: the names of moves; `bounds`: those of the lens.
    """

    given: PointArrays
    ball: Ball
    aspect: Any
    H: Any
    bounds: Bounds | None
    freed: tuple[str, ...] = eqx.field(static=True)
    #: The only one.
    levels: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def on(
        cls, film: Camera, given: PointArrays, freed: tuple[str, ...], bounds: Bounds | None
    ) -> "Matches":
        """The matches of a camera's film."""
        used = given.points[given.weight > 0]
        ball = ball_about(np.stack([used.min(axis=0), used.max(axis=0)]))
        to = lambda x: np.asarray(x, film.e.dtype)
        # (What does not count may be NaN, whose derivative would be, too.)
        seen_at = np.where((given.weight > 0)[:, None], given.seen_at, 0)
        values = (given.points, None), (seen_at, 0), (given.weight, 0)
        arrays = PointArrays(*(padded(to(x), room(len(x)), v) for x, v in values))
        return cls(arrays, Ball(*map(to, ball)), to(film.W / film.H), to(film.H), bounds, freed)

    @property
    def dtype(self) -> np.dtype:
        """The float type of looks."""
        return np.dtype(self.H.dtype)

    @property
    def weight(self) -> float:
        """The weight of all points together."""
        return float(np.sum(self.given.weight, dtype=float))

    @property
    def counts(self) -> np.ndarray:
        """The indices of the points that count."""
        return np.flatnonzero(self.given.weight)

    def in_heights(self, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Some of the points (k, 3), and where they are seen (k, 2) in film heights."""
        points, seen_at, _ = self.given
        return np.asarray(points[some], float), np.asarray(seen_at[some] / self.H, float)

    def different(self, and_seen: bool = False) -> np.ndarray:
        """The indices of points that count, without those that repeat another one (`and_seen`: and
        where that is seen)."""
        rows = []
        for x in self.in_heights(self.counts)[: 1 + and_seen]:
            spread = float(np.ptp(x, axis=0).max())
            rows.append(np.round((x - x[0]) / (REPEATED * (spread or 1))))
        return self.counts[np.sort(np.unique(np.hstack(rows), axis=0, return_index=True)[1])]

    def squares(self, camera: Camera) -> float:
        """The sum of the points' squares (px^2), infinite if one that counts is behind the eye."""
        off = np.asarray(self.distances(camera), float)[self.counts]
        total = float(np.sum(self.given.weight[self.counts] * off**2))
        return total if np.isfinite(total) else np.inf

    def look(self, camera: Camera, level: int = 0) -> View:
        """The view at a camera (canonical)."""
        del level
        found: Any = (np.asarray(x, float) for x in self._look(camera)[:4])
        rows, to_reported, scale, squares = found
        nothing: Any = np.zeros(())
        sums, known = Sums(squares, *[nothing] * 6), np.zeros((0, len(scale)))
        return View(rows[:-1, :-1], rows[:-1, -1], sums, to_reported, scale, known, 0.0)

    def rows(self, camera: Camera, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What moves change the residuals of some points by (k, 2, n), and these (k, 2), in px of a
        point of weight 1."""
        jacobian, r = self._look(camera)[4:]
        by_point: Any = np.asarray(jacobian, float).reshape(len(self.given.weight), 2, -1)
        return by_point[some], np.asarray(r, float).reshape(-1, 2)[some]

    def program(self, camera: Camera, level: int) -> Hashable:
        """A key of the compiled program that looks at a camera."""
        del level
        return self.freed, self.given.weight.shape, self.dtype, jax.tree.structure(camera)

    @eqx.filter_jit
    def distances(self, camera: Camera) -> Float[Array, "N"]:
        """Distances (px) of points from where they are seen, infinite behind the eye."""
        off = self.given.off(camera, self.H)
        ahead = film_map(camera)(self.given.points)[:, 2] > 0
        return jnp.where(ahead, jnp.sqrt(jnp.sum(off * off, axis=1)), jnp.inf)

    @eqx.filter_jit
    def stepped(self, camera: Camera, y: Any) -> Camera:
        """The camera after moves as such."""
        move = Move(camera, jnp.asarray(self.ball.centre), jnp.ones_like(y), self.bounds)
        return moved(move, y, self.freed)

    @eqx.filter_jit
    def _look(self, camera: Camera) -> tuple[Array, ...]:
        """R of [J, r] of the residuals (px) by moves, the reported parameters' derivative, the
        moves' sizes, the sum of squares, and J and r."""
        about = Ball(*map(jnp.asarray, self.ball))
        move = move_about(camera, about, None, jnp.asarray(self.H), self.freed)

        def quantities(y: Array) -> tuple[tuple[Array, Array], Array]:
            there = moved(move, y, self.freed)
            off = jnp.sqrt(self.given.weight)[:, None] * self.given.off(there, self.H)
            # (No step leads to where the lens folds.)
            holds = lens_holds(there, FilmPart(0, self.aspect, 0, 1))
            r = jnp.where(holds, off.reshape(-1), jnp.nan)
            return (r, reported(camera, there, self.freed)), r

        zero = jnp.zeros_like(move.scale)
        (jacobian, to_reported), r = jax.jacfwd(quantities, has_aux=True)(zero)
        rows = triangle_of(jnp.column_stack([jacobian, r]))
        return rows, to_reported, move.scale, jnp.sum(r * r), jacobian, r


@dataclass(frozen=True, eq=False)
class PointEye(Eye):
    """A view of points: the state's `lenses` are cameras where they stand, poses and all."""

    mask: Any
    solver: Any

    def standpoint(self, state: State) -> Standpoint:
        """The view at a state."""
        return Standpoint(self.solver, state.lenses[self.shot.camera])

    def moves(self, state: State, view: View, unknowns: list[Unknown]) -> np.ndarray:
        """Moves of the camera (n, k), in its solver's units, by the unknowns: moves, too."""
        del state
        return np.diag(1 / view.scale)[:, self.place(unknowns)]

    def place(self, unknowns: list[Unknown]) -> np.ndarray:
        """The moves that unknowns are."""
        return np.concatenate([indices(self.solver.freed, unknown.kind) for unknown in unknowns])


@dataclass(frozen=True, eq=False)
class PointProblem(JointProblem):
    """Views of points as one problem, whose unknowns are moves of cameras as such.

    - `known`: how points err, where their residuals are not to show it.
    """

    known: Noise | None = None
    data: ClassVar[str] = "the points"
    report = JointProblem.by_own_moves

    @property
    def matches(self) -> list[Matches]:
        """What each eye looks at."""
        return [eye.solver for eye in cast("list[PointEye]", self.eyes)]

    @cached_property
    def coordinates(self) -> int:
        """The number of different coordinates that points are seen by; repeated ones count once."""
        return 2 * sum(len(matches.different(and_seen=True)) for matches in self.matches)

    @property
    def left_over(self) -> int:
        """The number of coordinates less that of unknowns."""
        return self.coordinates - self.size

    def shown(self, here: Descent) -> Noise:
        """How points err, as is known or as their residuals show."""
        if self.known is not None:
            return self.known
        if self.left_over <= 0:
            return Noise(np.inf, 0)
        count = 2 * sum(len(matches.counts) for matches in self.matches)
        return Noise(here.total("squares") / (count - self.size), self.left_over)

    @cached_property
    def owner(self) -> np.ndarray:
        """The view that alone depends on each of the numbers (size,), -1 where several do."""
        owners = [-1 if len(u.cameras) > 1 else int(u.name) for u in self.unknowns]
        return np.repeat(owners, [u.size for u in self.unknowns])

    def noise(self, here: Descent) -> float:
        """What rows of priors err by: as points do (px)."""
        error = self.shown(here).variance ** 0.5 if self.priors else 1.0
        return error if np.isfinite(error) else 1.0

    def sizes(self, here: Descent, parts: list[Rows]) -> np.ndarray:
        """The change of each unknown that moves points by `FILM` px: a trust region, without which
        a lens that points hardly show would fold."""
        del parts
        result = np.zeros(self.size)
        for k, rows in enumerate(here.seen):
            np.maximum.at(result, self.columns(k), FILM * np.sum(rows.moves, axis=0))
        return result

    def stepped(self, state: State, x: np.ndarray) -> State:
        """The state after a step."""
        cameras = dict(state.lenses)
        for k, eye in enumerate(cast("list[PointEye]", self.eyes)):
            name, matches = eye.shot.camera, eye.solver
            y = np.zeros(len(components(matches.freed)), self.dtype)
            y[eye.place(self.unknowns_of(k))] = x[self.columns(k)]
            cameras[name] = matches.stepped(cameras[name], y)
        return state._replace(lenses=cameras)


def exact_squares(matches: Matches) -> float:
    """The squares (px^2) that rounding and the last step leave."""
    px = EXACT * FINE_PX[matches.dtype]
    return px**2 * len(matches.counts)


def rms_limit(matches: Matches, known: Noise | None, reach: float | None) -> float:
    """The root mean square distance (px) above which a view's points are not explained: that
    of the noise that is known, of outliers, or what is large on the film."""
    if known is not None:
        return TIMES * float(np.sqrt(2 * known.shown * len(matches.counts) / matches.weight))
    if reach is not None:
        return reach
    seen_at = matches.in_heights(matches.counts)[1]
    spread = float(np.sqrt(np.sum(np.var(seen_at, axis=0))))
    diagonal = float(np.hypot(matches.aspect, 1))
    return max(LEAST_PX, float(matches.H) * min(SPREAD * spread, DIAGONAL * diagonal))
