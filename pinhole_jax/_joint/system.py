"""Many views as one least-squares problem: each is reduced to a few rows, by its own program.

The rows of a view are its R of J = QR, times how its moves follow the unknowns.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from .._camera.camera import Camera
from .._camera.poses import Pose, adjoint, exponential, inverse
from .._numerics.arrays import evenly
from .._numerics.threads import in_threads
from .._solver.least_squares import LinearSolution, Rows, blocks_of, slope_of, solve, total
from .._solver.looks import View
from .._solver.moves import Move, moved
from .._solver.parameters import LABELS, PARAMETERS, labels_of
from .._solver.priors import contradictions
from .._solver.problem import COARSE_PX, COSINE, FINE_PX, UNIT_PX
from .._solver.uncertainty import BLIND
from .views import (
    MOTIONS,
    POSE,
    SCALE,
    TO_B,
    TWIST,
    ZERO,
    Eye,
    State,
    Unknown,
    indices,
    reported_twist,
    with_parameter,
)

#: Damping of the first step, in squares of `sizes`, and what it is at least.
FIRST_DAMPING, LEAST_DAMPING = 1e-2, 1e-9
#: A residual errs by at least as much, where there are priors: what is exact outweighs them.
LEAST_NOISE = 1e-3
#: The six numbers of an object's pose, as they are reported.
OF_OBJECT = ("rotation_x", "rotation_y", "rotation_z", "x", "y", "z")


AnyProblem = TypeVar("AnyProblem", bound="JointProblem")


class ViewRows(NamedTuple):
    """A view at a state, and its moves (n, k) by the unknowns that it depends on."""

    view: View
    moves: np.ndarray


class LevelEnd(NamedTuple):
    """Where steps on a level ended: how far it is from the finest, and their number."""

    state: State
    depth: int
    steps: int


class Descent(NamedTuple):
    """A state, the views there, the squares (infinite where they are none), the last steps, and
    whether they ended by themselves; the way there from the start (0 steps)."""

    state: State
    seen: list[ViewRows]
    squares: float
    steps: int
    ended: bool
    way: tuple[LevelEnd, ...]

    def total(self, name: str) -> float:
        """A sum over all pixels of all views (see `Sums`)."""
        return sum(float(getattr(rows.view.sums, name)) for rows in self.seen)

    @property
    def taken(self) -> tuple[int, ...]:
        """The number of steps on each level."""
        return tuple(end.steps for end in self.way[1:])

    def then(self, further: "Descent") -> "Descent":
        """A further descent, with the steps of both."""
        return further._replace(way=self.way + further.way[1:])


class Part(NamedTuple):
    """An unknown as it is reported: a pose as that of a camera fixed to it at `rig`, or of an
    object (None); film coordinates by the film's height `H` (px)."""

    name: str
    kind: str
    rig: Pose | None = None
    H: int = 1

    @property
    def labels(self) -> tuple[str, ...]:
        """The labels of its numbers."""
        if self.kind in (SCALE, ZERO):
            return (self.kind,)
        is_object = self.kind == POSE and self.rig is None
        return OF_OBJECT if is_object else labels_of((self.kind,))


class JointPrior(NamedTuple):
    """The mean and standard deviation of a number that reports an unknown, by its label."""

    part: Part
    label: str
    mean: float
    std: float


@dataclass(frozen=True, eq=False)
class JointProblem:
    """Unknowns and views, and where they begin, as least squares on one level.

    - `unknowns`, `eyes` (the views), `priors`, and those of `zeros` of joints, sought at last.
    - `start`: where unknowns begin; `cameras`: those that were given.
    - `outlier_px`, `max_steps`: as in `fit_joint`.
    - `design`: how many times as large the masks' variance is as of independent residuals.
    - `depth`: the level, counted from the finest (1); `weights` (V,) of the views.
    """

    unknowns: list[Unknown]
    eyes: list[Eye]
    start: State
    cameras: Mapping[str, Camera]
    outlier_px: float | None
    max_steps: int
    weights: np.ndarray
    zeros: Sequence[JointPrior] = ()
    priors: Sequence[JointPrior] = ()
    design: float = 1.0
    depth: int = 1
    #: What views are fitted to.
    data: ClassVar[str] = "the masks"

    def __post_init__(self) -> None:
        for k, seen in enumerate(self._seen):
            if not seen:
                raise ValueError(f"`views[{k}]`: expected a view of something unknown, got none")

    @cached_property
    def places(self) -> dict[tuple[str | None, str], np.ndarray]:
        """Indices of each unknown's numbers among all."""
        ends = np.cumsum([u.size for u in self.unknowns], dtype=int)
        each = zip(self.unknowns, ends, strict=True)
        return {(u.name, u.kind): np.arange(end - u.size, end) for u, end in each}

    @cached_property
    def _seen(self) -> list[list[int]]:
        """Numbers of the unknowns that each view depends on."""
        number = {key: k for k, key in enumerate(self.places)}
        return [sorted(number[x] for x in eye.depends_on() if x in number) for eye in self.eyes]

    @cached_property
    def _seen_by(self) -> dict[tuple[str, str], int]:
        """A view that depends on each unknown."""
        each = enumerate(map(self.unknowns_of, range(len(self.eyes))))
        return {(u.name, u.kind): k for k, unknowns in each for u in unknowns}

    @cached_property
    def owner(self) -> np.ndarray:
        """The block that each of the numbers (size,) is eliminated with, -1 of those that stay."""
        sizes = [u.size for u in self.unknowns]
        return np.repeat(blocks_of(self._seen, sizes), sizes)

    @property
    def size(self) -> int:
        """The number of unknown numbers."""
        return sum(u.size for u in self.unknowns)

    @property
    def dtype(self) -> np.dtype:
        """The float type of looks."""
        return self.eyes[0].solver.dtype

    @property
    def px(self) -> float:
        """The step that is negligible before other places are compared: exact masks tell what errs
        by little."""
        exact = all(eye.solver.kind.exact for eye in self.eyes)
        return FINE_PX[self.dtype] if exact else COARSE_PX

    @property
    def levels(self) -> int:
        """The number of levels of the view that has most."""
        return max(len(eye.solver.levels) for eye in self.eyes)

    def unknowns_of(self, k: int) -> list[Unknown]:
        """The unknowns that a view depends on."""
        return [self.unknowns[j] for j in self._seen[k]]

    def eye_of(self, camera: str) -> tuple[int, Eye]:
        """The first view of a camera, and its number."""
        return next((k, eye) for k, eye in enumerate(self.eyes) if eye.shot.camera == camera)

    def objects(self) -> list[str]:
        """The names of unknown objects."""
        return [*dict.fromkeys(e.shot.object for e in self.eyes if e.shot.object is not None)]

    def named(self, kind: str) -> list[str]:
        """The names of unknowns of a kind."""
        return [u.name for u in self.unknowns if u.kind == kind]

    def columns(self, k: int) -> np.ndarray:
        """Indices of the numbers that a view depends on."""
        return np.concatenate([self.places[u.name, u.kind] for u in self.unknowns_of(k)])

    # --- reports ---------------------------------------------------------------------------------

    def parts_of(self, name: str) -> list[Part]:
        """The unknowns of a camera, an object, a scale or a joint, as they are reported."""
        if name in self.cameras:
            eye = self.eye_of(name)[1]
            parts = [Part(eye.moving, kind, eye.rig) for kind in MOTIONS]
            film = self.cameras[name]
            H = lambda row: film.H if PARAMETERS[row].labels[0].unit == "px" else 1
            parts += [Part(own, row, None, H(row)) for row, own in eye.owners.items()]
        else:
            parts = [Part(name, kind) for kind in (POSE, SCALE, ZERO)]
        return [part for part in parts if (part.name, part.kind) in self.places]

    def report(self, part: Part, here: Descent) -> tuple[np.ndarray, np.ndarray]:
        """The numbers (p,) by which an unknown is reported (0 for small turns), and their
        derivative (p, n) by it."""
        (name, kind, rig, _), state = part, here.state
        if kind == SCALE:  # its logarithm is the unknown
            value = np.array([state.scales[name]])
            return value, value[:, None]
        if kind == ZERO:
            return np.array([state.zeros[name]]), np.eye(1)
        if kind in MOTIONS:
            axes, rig = (np.eye(3), np.eye(4)) if rig is None else (TO_B, rig)
            pose, which = state.poses[name] @ rig, MOTIONS[kind]
            by_twist = reported_twist(pose[:3, :3], axes) @ adjoint(inverse(rig))
            return np.append(np.zeros(3), pose[:3, 3])[which], by_twist[which, which]
        return self.by_own_moves(part, here)

    def by_own_moves(self, part: Part, here: Descent) -> tuple[np.ndarray, np.ndarray]:
        """What `report` says of an unknown that is a move of a view's own camera."""
        name, kind, _, H = part
        k = self._seen_by[name, kind]
        eye, view = self.eyes[k], here.seen[k].view
        camera, place = eye.canonical(here.state), indices(eye.solver.freed, kind)
        known = [LABELS[label].value for label in part.labels]
        values = [float(value(camera)) if value else 0.0 for value in known]
        by_unknown = view.to_reported[np.ix_(place, place)] / view.scale[place]
        return H * np.array(values), H * by_unknown

    def reports(self, parts: Sequence[Part], here: Descent) -> tuple[np.ndarray, np.ndarray]:
        """The derivative (p, q) of the numbers by which unknowns are reported, by unknowns at a
        place (q,), and this."""
        from scipy.linalg import block_diag

        each = (self.report(part, here)[1] for part in parts)
        by_unknowns: Any = block_diag(np.zeros((0, 0)), *each)
        places = [self.places[part.name, part.kind] for part in parts]
        return by_unknowns, np.concatenate([np.zeros(0, int), *places])

    # --- other problems --------------------------------------------------------------------------

    def seeing(self: AnyProblem, solvers: Mapping[int, Any]) -> AnyProblem:
        """The problem whose views, by their numbers, have other solvers."""
        eyes = [replace(e, solver=solvers.get(k, e.solver)) for k, e in enumerate(self.eyes)]
        return replace(self, eyes=eyes)

    def with_zeros(self) -> "JointProblem":
        """The problem in which the zeros of joints are sought, too."""
        names, start = [prior.part.name for prior in self.zeros], self.start
        return replace(
            self,
            unknowns=[*self.unknowns, *(Unknown(name, ZERO) for name in names)],
            priors=[*self.priors, *self.zeros],
            start=start._replace(zeros=dict.fromkeys(names, 0.0)),
        )

    def only(self: AnyProblem, numbers: Sequence[int], unknowns: list[Unknown]) -> AnyProblem:
        """The problem of some views and unknowns, the others held."""
        eyes = [self.eyes[k] for k in numbers]
        seen_by, known = {eye.shot.camera for eye in eyes}, {(u.name, u.kind) for u in unknowns}
        return replace(
            self,
            unknowns=unknowns,
            eyes=eyes,
            priors=[p for p in self.priors if (p.part.name, p.part.kind) in known],
            cameras={name: self.cameras[name] for name in self.cameras if name in seen_by},
            weights=np.ones(len(eyes)),
        )

    def few(self, most: int) -> "JointProblem":
        """The problem with this many views at most, spread among all."""
        numbers = evenly(len(self.eyes), most).tolist()
        return self if len(numbers) == len(self.eyes) else self.only(numbers, self.unknowns)

    @cached_property
    def lone_poses(self) -> dict[str, list[int]]:
        """The unknown poses whose views depend on no other one, and these views."""
        views, lone = dict[str, list[int]](), set(self.named(POSE))
        for k in range(len(self.eyes)):
            poses = [u.name for u in self.unknowns_of(k) if u.kind == POSE]
            lone -= {*poses} if len(poses) > 1 else set()
            for name in poses:
                views.setdefault(name, []).append(k)
        return {name: numbers for name, numbers in views.items() if name in lone}

    # --- least squares ---------------------------------------------------------------------------

    def descend(
        self, state: State, most: int, px: float, damping: float = FIRST_DAMPING
    ) -> Descent:
        """The end of at most this many steps of Levenberg-Marquardt; those below `px` are
        negligible. (Damped ones are, too, along what hardly shows: near the end begin with less.)
        """
        here, size = self.stay(state), np.zeros(self.size)
        squares, steps, ended = np.inf, 0, False
        while steps < most and not ended:
            steps += 1
            noise = self.noise(here)
            squares, parts = self.squares(here, noise), self.parts(here, noise)
            if not all(np.all(np.isfinite(p.rows)) and np.all(np.isfinite(p.left)) for p in parts):
                break
            outward = self.ways_out(here) * slope_of(parts, self.size) < 0
            parts = [part.without(outward) for part in parts]
            size = np.maximum(size, self.sizes(here, parts))
            x = solve(parts, self.owner, damping**0.5 * size).x
            moves = (s.moves @ x[self.columns(k)] for k, s in enumerate(here.seen))
            moved = max(float(np.max(np.abs(y), initial=0)) for y in moves)
            change = sum(float(np.sum((p.rows @ x[p.columns]) ** 2)) for p in parts)
            there = self.stay(self.stepped(here.state, x))
            if (after := self.squares(there, noise)) <= squares:
                here, squares = there, after
                damping = max(damping / 10, LEAST_DAMPING)
            else:
                damping *= 10
            ended = moved < px / UNIT_PX or change <= COSINE[self.dtype] ** 2 * squares
        way = LevelEnd(state, self.depth, 0), LevelEnd(here.state, self.depth, steps)
        return Descent(here.state, here.seen, squares, steps, ended, way)

    def stay(self, state: State) -> Descent:
        """A descent of no steps."""
        way = (LevelEnd(state, self.depth, 0),)
        here = Descent(state, self.look(state), np.inf, 0, True, way)
        return here._replace(squares=self.squares(here, self.noise(here)))

    def look(self, state: State) -> list[ViewRows]:
        """All views at a state."""
        look = lambda eye: eye.look(state, self.depth)
        views = in_threads(look, self.eyes, lambda eye: eye.program(state, self.depth))
        each = enumerate(zip(self.eyes, views, strict=True))
        return [ViewRows(v, eye.moves(state, v, self.unknowns_of(k))) for k, (eye, v) in each]

    def noise(self, here: Descent) -> float:
        """The error of a mask's residual, as priors are weighed against it: where neighbours err
        together, more."""
        if not self.priors:
            return 1.0
        misfit = here.total("touched_squares") / max(here.total("touched"), 1.0)
        return max(self.design * misfit, LEAST_NOISE**2) ** 0.5

    def squares(self, here: Descent, noise: float) -> float:
        """The sum of the squares of all residuals, those of priors among them; infinite where it is
        none."""
        views = sum(w * s.view.squares for w, s in zip(self.weights, here.seen, strict=True))
        squares = float(views + sum(p.squares for p in self.prior_rows(here, noise)))
        return squares if np.isfinite(squares) else np.inf

    def parts(self, here: Descent, noise: float) -> list[Rows]:
        """Rows of the views, and of priors."""
        views = []
        for k, (view, moves) in enumerate(here.seen):
            rows = Rows(view.triangle @ moves, view.along, self.columns(k))
            views.append(rows.times(self.weights[k] ** 0.5))
        return [*views, *self.prior_rows(here, noise)]

    def prior_rows(self, here: Descent, noise: float) -> list[Rows]:
        """Rows of priors, which err by a residual's noise."""
        result = []
        for part, label, mean, std in self.priors:
            values, by_unknown = self.report(part, here)
            which = [part.labels.index(label)]
            rows = Rows(by_unknown[which], values[which] - mean, self.places[part[:2]])
            result.append(rows.times(noise / std))
        return result

    def sizes(self, here: Descent, parts: list[Rows]) -> np.ndarray:
        """How much each unknown number shows."""
        del here
        return total(parts, self.size, lambda part: np.sum(part.rows**2, axis=0)) ** 0.5

    def ways_out(self, here: Descent) -> np.ndarray:
        """The way in which numbers (size,) would leave their bounds: 1 or -1 at an end, else 0."""
        result = np.zeros(self.size)
        for eye in self.eyes:
            for label, side in eye.ended(here.state).items():
                part = Part(eye.owners[label], label)
                if (place := self.places.get(part[:2])) is not None:
                    result[place] = side * np.sign(self.report(part, here)[1][0])
        return result

    def stepped(self, state: State, x: np.ndarray) -> State:
        """The state after a step: twists of poses, moves of lenses, logarithms of scales."""
        poses, lenses = dict(state.poses), dict(state.lenses)
        scales, zeros = dict(state.scales), dict(state.zeros)
        for name, kind, cameras in self.unknowns:
            part = x[self.places[name, kind]]
            if kind in MOTIONS:
                twist = np.zeros(TWIST)
                twist[MOTIONS[kind]] = part
                poses[name] = poses[name] @ exponential(twist)
            elif kind == SCALE:
                scales[name] *= float(np.exp(part[0]))
            elif kind == ZERO:
                zeros[name] += float(part[0])
            else:
                eye = self.eyes[self._seen_by[name, kind]]
                begin = lenses[eye.shot.camera]
                y = jnp.asarray(part, begin.e.dtype)
                origin = Move(begin, begin.e, jnp.ones_like(y), eye.solver.bounds)
                lens = moved(origin, y, (kind,))
                for camera in cameras:
                    lenses[camera] = with_parameter(lenses[camera], kind, lens)
        return State(poses, lenses, scales, zeros)


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where a problem's squares are least, and what determines the unknowns there.

    - `descent`: the state, and views there.
    """

    problem: JointProblem
    descent: Descent

    @cached_property
    def noise(self) -> float:
        """What the rows of priors err by."""
        return self.problem.noise(self.descent)

    @cached_property
    def parts(self) -> list[Rows]:
        """The rows of the views, then those of priors, blind to what is at an end of its bounds."""
        parts = self.problem.parts(self.descent, self.noise)
        held = self.problem.ways_out(self.descent) != 0
        return [part.without(held) for part in parts]

    @property
    def prior_rows(self) -> list[Rows]:
        """The rows of priors, which err by `noise`."""
        return self.parts[len(self.descent.seen) :]

    @cached_property
    def solved(self) -> LinearSolution:
        """What determines the unknowns."""
        problem = self.problem
        still = np.zeros(problem.size)
        return solve(self.parts, problem.owner, still, BLIND[problem.dtype])

    @cached_property
    def slope(self) -> np.ndarray:
        """Half the squares' derivative (size,)."""
        return slope_of(self.parts, self.problem.size)

    @cached_property
    def contradictions(self) -> tuple[str, ...]:
        """A sentence on each prior that lies too far from what else is known by the views' data."""
        roots = [part.rows @ self.solved.root(part.columns) for part in self.prior_rows]
        off = np.array([part.left[0] for part in self.prior_rows]) / self.noise
        labels = [prior.label for prior in self.problem.priors]
        known = np.array([np.sum(x**2) for x in roots])
        return contradictions(labels, off, known, f"{self.problem.data} say")
