"""One least-squares problem over many views: each is reduced to a few rows, by its own program.

The rows of a view are its R of J = QR times how its moves follow the unknowns.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from typing import NamedTuple

import numpy as np

from .._numerics.threads import in_threads
from .._solver.least_squares import (
    Descent,
    Rows,
    column_norms,
    held_to_the_end,
    levenberg_marquardt,
)
from .priors import JointPrior
from .views import ZERO, Eye, State, Unknown, stepped
from .zeros import Seen, with_joints

#: A residual errs by at least as much, where there are priors: what is exact outweighs them.
LEAST_NOISE = 1e-3


class Layout:
    """Where each unknown's numbers are among all, and which views depend on it."""

    def __init__(
        self, unknowns: Sequence[Unknown], eyes: Sequence[Eye], priors: Sequence[JointPrior] = ()
    ):
        self.unknowns, self.eyes = list(unknowns), list(eyes)
        number = {(u.name, u.kind): k for k, u in enumerate(self.unknowns)}
        self._number = number
        self.priors = [b for b in priors if (b.name, b.kind) in number]
        #: How many times as large as of independent residuals the masks' variance is.
        self.design = 1.0
        ends = np.cumsum([u.size for u in self.unknowns], dtype=int)
        self.size = int(ends[-1]) if len(ends) else 0
        self._places = [np.arange(end - u.size, end) for u, end in zip(unknowns, ends, strict=True)]
        self._of = [
            sorted(number[key] for key in eye.depends_on() if key in number) for eye in self.eyes
        ]
        #: One view that depends on each unknown.
        self._seen_by = {j: k for k, of in enumerate(self._of) for j in of}
        self.shared = held_to_the_end(self._of, [u.size for u in self.unknowns])

    def seeing(self, others: Mapping[int, Eye]) -> "Layout":
        """Return the layout with other eyes in place of some."""
        result = copy(self)
        result.eyes = [others.get(k, eye) for k, eye in enumerate(self.eyes)]
        return result

    def weighing(self, design: float) -> "Layout":
        """Return the layout in which priors are weighed against masks of this design effect."""
        result = copy(self)
        result.design = design
        return result

    def of(self, k: int) -> list[Unknown]:
        """Return the unknowns that a view depends on."""
        return [self.unknowns[j] for j in self._of[k]]

    def place(self, name: str, kind: str) -> np.ndarray | None:
        """Return where an unknown's numbers are, None for what is none."""
        number = self._number.get((name, kind))
        return None if number is None else self._places[number]

    def rows(self, k: int, rows: np.ndarray, left: np.ndarray) -> Rows:
        """Return rows of a view, by the unknowns that it depends on."""
        own = [np.full(len(self._places[j]), not self.shared[j]) for j in self._of[k]]
        return Rows(rows, left, self.columns(k), np.concatenate(own))

    def columns(self, k: int) -> np.ndarray:
        """Return where the numbers are that a view depends on."""
        return np.concatenate([self._places[j] for j in self._of[k]])

    def look(self, state: State, depth: int) -> list[Seen]:
        """Return what all views see on a level."""
        solvers = [eye.looking(state) for eye in self.eyes]
        at = [(eye.canonical(state), eye.level(depth)) for eye in self.eyes]
        look = lambda given: given[0].look(*given[1])
        program = lambda given: given[0].program(*given[1])
        result = []
        for k, view in enumerate(in_threads(look, list(zip(solvers, at, strict=True)), program)):
            eye = self.eyes[k]
            rigid = [u for u in self.of(k) if u.kind != ZERO]
            seen = Seen(view, eye.moves(state, view, rigid))
            joints = [u.name for u in self.of(k)[len(rigid) :]]
            result.append(with_joints(eye, state, seen, joints) if joints else seen)
        return result

    def least_squares(self, seen: list[Seen], weights: np.ndarray) -> list[Rows]:
        """Return the rows of all views' residuals."""
        return [
            self.rows(
                k,
                np.asarray(s.view.triangle, float) @ s.moves,
                np.asarray(s.view.along, float),
            ).times(weights[k] ** 0.5)
            for k, s in enumerate(seen)
        ]

    def noise(self, seen: list[Seen]) -> float:
        """Return what a residual of the masks errs by, as priors are weighed against it:
        where neighbours err together, by more."""
        if not self.priors:
            return 1.0
        touched = sum(float(s.view.sums.touched) for s in seen)
        squares = sum(float(s.view.sums.touched_squares) for s in seen)
        return max(self.design * squares / max(touched, 1.0), LEAST_NOISE**2) ** 0.5

    def prior_rows(self, state: State, seen: list[Seen], noise: float) -> list[Rows]:
        """Return the rows of priors, which err by a residual's noise."""
        result = []
        for prior in self.priors:
            j = self._number[prior.name, prior.kind]
            view = self._seen_by[j]
            left, rows = prior.residuals(state, self.eyes[view], seen[view].view)
            own = np.full(rows.shape[1], not self.shared[j])
            result.append(Rows(rows, left, self._places[j], own).times(noise))
        return result

    def ways_out(self, state: State, seen: list[Seen]) -> np.ndarray:
        """Return which way numbers (size,) would leave their bounds: 1 or -1 at an end, else 0."""
        result = np.zeros(self.size)
        for k, (eye, one) in enumerate(zip(self.eyes, seen, strict=True)):
            for j in self._of[k]:
                result[self._places[j]] = eye.ways_out(state, one.view, self.unknowns[j])
        return result


class _OnLevel(NamedTuple):
    """Views of weights (V,) on one level, as `LeastSquares`."""

    layout: Layout
    depth: int
    weights: np.ndarray

    @property
    def size(self) -> int:
        """Return the number of unknowns."""
        return self.layout.size

    @property
    def dtype(self) -> np.dtype:
        """Return the float type that views are worked out in."""
        return self.layout.eyes[0].solver.dtype

    def look(self, state: State) -> list[Seen]:
        """Return what all views see."""
        return self.layout.look(state, self.depth)

    def noise(self, seen: list[Seen]) -> float:
        """Return what a residual errs by."""
        return self.layout.noise(seen)

    def squares(self, state: State, seen: list[Seen], noise: float) -> float:
        """Return the sum of the squares of all residuals, those of priors among them."""
        views = sum(w * s.view.squares for w, s in zip(self.weights, seen, strict=True))
        return float(views + sum(p.squares for p in self.layout.prior_rows(state, seen, noise)))

    def parts(self, state: State, seen: list[Seen], noise: float) -> list[Rows]:
        """Return the rows of the views, and of priors."""
        views = self.layout.least_squares(seen, self.weights)
        return [*views, *self.layout.prior_rows(state, seen, noise)]

    def sizes(self, seen: list[Seen], parts: list[Rows]) -> np.ndarray:
        """Return how much each unknown shows."""
        del seen
        return column_norms(parts, self.size)

    def ways_out(self, state: State, seen: list[Seen]) -> np.ndarray:
        """Return which way numbers would leave their bounds."""
        return self.layout.ways_out(state, seen)

    def stepped(self, state: State, x: np.ndarray) -> State:
        """Return the state after a step."""
        return stepped(state, self.layout.unknowns, x, self.layout.eyes)

    def moved(self, seen: list[Seen], x: np.ndarray) -> float:
        """Return the largest move that a step makes in any view, in its solver's units."""
        moves = (s.moves @ x[self.layout.columns(k)] for k, s in enumerate(seen))
        return max(float(np.max(np.abs(y), initial=0)) for y in moves)


def descend(
    layout: Layout,
    state: State,
    depth: int,
    weights: np.ndarray,
    most: int,
    px: float,
) -> Descent:
    """Return the state after Levenberg-Marquardt on one level."""
    return levenberg_marquardt(_OnLevel(layout, depth, weights), state, most, px)
