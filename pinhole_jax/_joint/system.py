"""Many views as one least-squares problem: each is reduced to a few rows, by its own program.

The rows of a view are its R of J = QR, times how its moves follow the unknowns.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from .._camera.camera import Camera
from .._numerics.threads import in_threads
from .._solver.least_squares import (
    Descent,
    Rows,
    column_norms,
    held_to_the_end,
    levenberg_marquardt,
)
from .._solver.looks import View
from .._solver.problem import COARSE_PX, FINE_PX
from .knowledge import JointPrior
from .views import POSE, ZERO, Eye, State, Unknown, stepped
from .zeros import with_joints

#: A residual errs by at least as much, where there are priors: what is exact outweighs them.
LEAST_NOISE = 1e-3


class ViewRows(NamedTuple):
    """A view at a state, and its moves (n, k) by the unknowns that it depends on."""

    view: View
    moves: np.ndarray


class LevelEnd(NamedTuple):
    """Where steps on a level ended: how far it is from the finest, and their number."""

    state: State
    depth: int
    steps: int


@dataclass(frozen=True, eq=False)
class JointProblem:
    """Unknowns and views, and where they begin, as `LeastSquares` on one level.

    - `unknowns`, `eyes` (the views), `priors`, and those of `zeros` of joints, sought at last.
    - `start`: where unknowns begin; `cameras`: those that were given.
    - `outlier_px`, `max_steps`: as in `fit_joint`.
    - `widens`: whether error bars grow where views differ by more than their masks err.
    - `design`: how many times as large the masks' variance is as of independent residuals.
    - `depth`: the level, counted from the finest (1); `weights` (V,) of the views.
    """

    unknowns: list[Unknown]
    eyes: list[Eye]
    priors: list[JointPrior]
    zeros: list[JointPrior]
    start: State
    cameras: Mapping[str, Camera]
    outlier_px: float | None
    max_steps: int
    weights: np.ndarray
    widens: bool = True
    design: float = 1.0
    depth: int = 1

    def __post_init__(self) -> None:
        for k, seen in enumerate(self._seen):
            if not seen:
                raise ValueError(f"`views[{k}]`: expected a view of something unknown, got none")

    @cached_property
    def _number(self) -> dict[tuple[str, str], int]:
        return {(u.name, u.kind): k for k, u in enumerate(self.unknowns)}

    @cached_property
    def _places(self) -> list[np.ndarray]:
        ends = np.cumsum([u.size for u in self.unknowns], dtype=int)
        return [np.arange(end - u.size, end) for u, end in zip(self.unknowns, ends, strict=True)]

    @cached_property
    def _seen(self) -> list[list[int]]:
        """Numbers of the unknowns that each view depends on."""
        number = self._number
        return [sorted(number[x] for x in eye.depends_on() if x in number) for eye in self.eyes]

    @cached_property
    def _seen_by(self) -> dict[int, int]:
        """A view that depends on each unknown."""
        return {j: k for k, numbers in enumerate(self._seen) for j in numbers}

    @cached_property
    def _held(self) -> np.ndarray:
        return held_to_the_end(self._seen, [u.size for u in self.unknowns])

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

    def place(self, name: str, kind: str) -> np.ndarray | None:
        """Indices of an unknown's numbers among all, None for what is none."""
        number = self._number.get((name, kind))
        return None if number is None else self._places[number]

    def columns(self, k: int) -> np.ndarray:
        """Indices of the numbers that a view depends on."""
        return np.concatenate([self._places[j] for j in self._seen[k]])

    # --- other problems --------------------------------------------------------------------------

    def seeing(self, others: Mapping[int, Eye]) -> "JointProblem":
        """The problem with other eyes in place of some."""
        return replace(self, eyes=[others.get(k, eye) for k, eye in enumerate(self.eyes)])

    def with_zeros(self) -> "JointProblem":
        """The problem in which the zeros of joints are sought, too."""
        unknowns = [*self.unknowns, *(Unknown(prior.name, ZERO, 1) for prior in self.zeros)]
        return replace(self, unknowns=unknowns, priors=[*self.priors, *self.zeros])

    def only(self, numbers: Sequence[int], unknowns: list[Unknown]) -> "JointProblem":
        """The problem of some views and unknowns, the others held."""
        eyes = [self.eyes[k] for k in numbers]
        seen_by, known = {eye.shot.camera for eye in eyes}, {(u.name, u.kind) for u in unknowns}
        return replace(
            self,
            unknowns=unknowns,
            eyes=eyes,
            priors=[prior for prior in self.priors if (prior.name, prior.kind) in known],
            cameras={name: self.cameras[name] for name in self.cameras if name in seen_by},
            weights=np.ones(len(eyes)),
        )

    def few(self, most: int) -> "JointProblem":
        """The problem with this many views at most, spread among all."""
        numbers = np.unique(np.linspace(0, len(self.eyes) - 1, most).round().astype(int))
        return self if len(numbers) == len(self.eyes) else self.only([*numbers], self.unknowns)

    @cached_property
    def lone_poses(self) -> dict[str, list[int]]:
        """The unknown poses whose views depend on no other one, and these views."""
        poses = [
            [u.name for u in self.unknowns_of(k) if u.kind == POSE] for k in range(len(self.eyes))
        ]
        views: dict[str, list[int]] = {}
        for k, names in enumerate(poses):
            for name in names:
                views.setdefault(name, []).append(k)
        return {n: numbers for n, numbers in views.items() if all(poses[k] == [n] for k in numbers)}

    # --- least squares ---------------------------------------------------------------------------

    def descend(self, state: State, most: int, px: float) -> Descent:
        """The state after at most this many steps; those below `px` are negligible."""
        return levenberg_marquardt(self, state, most, px)

    def look(self, state: State) -> list[ViewRows]:
        """All views at a state."""
        sights = [
            (eye.solver_at(state), eye.canonical(state), eye.level(self.depth)) for eye in self.eyes
        ]
        look = lambda sight: sight[0].look(*sight[1:])
        views = in_threads(look, sights, lambda sight: sight[0].program(*sight[1:]))
        return [self._rows_of(k, state, view) for k, view in enumerate(views)]

    def _rows_of(self, k: int, state: State, view: View) -> ViewRows:
        rigid = [u for u in self.unknowns_of(k) if u.kind != ZERO]
        joints = [u.name for u in self.unknowns_of(k) if u.kind == ZERO]
        moves = self.eyes[k].moves(state, view, rigid)
        if joints:
            view, moves = with_joints(self.eyes[k], state, view, moves, joints)
        return ViewRows(view, moves)

    def noise(self, seen: list[ViewRows]) -> float:
        """The error of a mask's residual, as priors are weighed against it: where neighbours err
        together, more."""
        if not self.priors:
            return 1.0
        touched = sum(float(s.view.sums.touched) for s in seen)
        squares = sum(float(s.view.sums.touched_squares) for s in seen)
        return max(self.design * squares / max(touched, 1.0), LEAST_NOISE**2) ** 0.5

    def squares(self, state: State, seen: list[ViewRows], noise: float) -> float:
        """The sum of the squares of all residuals, those of priors among them."""
        views = sum(w * s.view.squares for w, s in zip(self.weights, seen, strict=True))
        return float(views + sum(p.squares for p in self.prior_rows(state, seen, noise)))

    def parts(self, state: State, seen: list[ViewRows], noise: float) -> list[Rows]:
        """Rows of the views, and of priors."""
        views = [self.view_rows(k, s).times(self.weights[k] ** 0.5) for k, s in enumerate(seen)]
        return [*views, *self.prior_rows(state, seen, noise)]

    def view_rows(self, k: int, seen: ViewRows) -> Rows:
        """Rows of a view, by the unknowns that it depends on."""
        own = [np.full(len(self._places[j]), not self._held[j]) for j in self._seen[k]]
        rows = np.asarray(seen.view.triangle, float) @ seen.moves
        along = np.asarray(seen.view.along, float)
        return Rows(rows, along, self.columns(k), np.concatenate(own))

    def prior_rows(self, state: State, seen: list[ViewRows], noise: float) -> list[Rows]:
        """Rows of priors, which err by a residual's noise."""
        result = []
        for prior in self.priors:
            j = self._number[prior.name, prior.kind]
            k = self._seen_by[j]
            left, rows = prior.residuals(state, self.eyes[k], seen[k].view)
            own = np.full(rows.shape[1], not self._held[j])
            result.append(Rows(rows, left, self._places[j], own).times(noise))
        return result

    def sizes(self, seen: list[ViewRows], parts: list[Rows]) -> np.ndarray:
        """How much each unknown number shows."""
        del seen
        return column_norms(parts, self.size)

    def ways_out(self, state: State, seen: list[ViewRows]) -> np.ndarray:
        """The way in which numbers (size,) would leave their bounds: 1 or -1 at an end, else 0."""
        result = np.zeros(self.size)
        for k, (eye, rows) in enumerate(zip(self.eyes, seen, strict=True)):
            for j in self._seen[k]:
                result[self._places[j]] = eye.ways_out(state, rows.view, self.unknowns[j])
        return result

    def stepped(self, state: State, x: np.ndarray) -> State:
        """The state after a step."""
        return stepped(state, self.unknowns, x, self.eyes)

    def moved(self, seen: list[ViewRows], x: np.ndarray) -> float:
        """The largest move that a step makes in any view, in its solver's units."""
        moves = (s.moves @ x[self.columns(k)] for k, s in enumerate(seen))
        return max(float(np.max(np.abs(y), initial=0)) for y in moves)
