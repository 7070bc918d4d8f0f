"""One least-squares problem over many views: each is reduced to a few rows, by its own program.

The rows of a view are its R of J = QR times how its moves follow the unknowns. What few views
depend on is eliminated there: those of one camera, or of one object, that have with the others only
a lens in common, say. So the cost is linear in the views, and no matrix over all of them is ever
made (nor normal equations, which would lose half of the digits).
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import Any, NamedTuple

import jax
import numpy as np

from .._camera.camera import Camera
from .joint_priors import Belief
from .joint_views import ZERO, Eye, State, Unknown, stepped
from .joint_zeros import Seen, with_joints
from .problem import COSINE, UNIT_PX, View

#: Damping of the first step, in squares of the columns' norms, and of what it is at least.
FIRST_DAMPING, LEAST_DAMPING = 1e-2, 1e-9
#: A residual errs by at least as much, where something is believed: what is exact outweighs it.
LEAST_NOISE = 1e-3
#: Held by the thread that asks for a program.
ASKING = Lock()


class Rows(NamedTuple):
    """Residuals (m,) `rows x[columns] + left` of one view; `own` (k,) of the unknowns are to be
    eliminated, with those of the views that depend on these, too."""

    rows: np.ndarray
    left: np.ndarray
    columns: np.ndarray
    own: np.ndarray

    @property
    def squares(self) -> float:
        """Return the sum of the residuals' squares."""
        return float(self.left @ self.left)

    def without(self, held: np.ndarray) -> "Rows":
        """Return them blind to unknowns (size,) that are held."""
        return self._replace(rows=np.where(held[self.columns], 0.0, self.rows))

    def times(self, factor: float) -> "Rows":
        """Return them, each times a factor."""
        return self._replace(rows=factor * self.rows, left=factor * self.left)


class Layout:
    """Where each unknown's numbers are among all, and which views depend on it."""

    def __init__(
        self, unknowns: Sequence[Unknown], eyes: Sequence[Eye], beliefs: Sequence[Belief] = ()
    ):
        self.unknowns, self.eyes = list(unknowns), list(eyes)
        number = {(u.name, u.kind): k for k, u in enumerate(self.unknowns)}
        self._number = number
        self.beliefs = [b for b in beliefs if (b.name, b.kind) in number]
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

    def look(self, state: State, depth: int, grow: bool = True) -> list[Seen]:
        """Return what all views see on a level; NaN of what outgrows its buffers, unless these may
        `grow`."""
        for eye in self.eyes:
            eye.show(state)
        at = [(eye.unit(state), eye.level(depth)) for eye in self.eyes]
        begun = _side_by_side(self.eyes, at)
        result = []
        for k, (eye, a, view) in enumerate(zip(self.eyes, at, begun, strict=True)):
            view = eye.solver.look(*a, view) if grow else view
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
        """Return what a residual of the masks errs by, as what is believed is weighed against it:
        where neighbours err together, by more."""
        if not self.beliefs:
            return 1.0
        touched = sum(float(s.view.sums.touched) for s in seen)
        squares = sum(float(s.view.sums.touched_squares) for s in seen)
        return max(self.design * squares / max(touched, 1.0), LEAST_NOISE**2) ** 0.5

    def known(self, state: State, seen: list[Seen], noise: float) -> list[Rows]:
        """Return the rows of what is believed, which err by a residual's noise."""
        result = []
        for belief in self.beliefs:
            j = self._number[belief.name, belief.kind]
            view = self._seen_by[j]
            left, rows = belief.residuals(state, self.eyes[view], seen[view].view)
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


def held_to_the_end(of: list[list[int]], sizes: list[int]) -> np.ndarray:
    """Return which unknowns (of these `sizes`) stay where the others are eliminated, given those
    that each view depends on: what most views depend on, as many as make the least work."""
    size = np.array(sizes)
    seen_by = np.bincount([j for some in of for j in some], minlength=len(size))
    best, least = np.ones(len(size), bool), np.inf
    for count in np.unique(seen_by):
        held = seen_by >= count
        block = 1 + _together([[j for j in some if not held[j]] for some in of], len(size))
        within = np.bincount(block, np.where(held, 0, size), minlength=len(of) + 1)
        views = [within[max(block[some], default=0)] for some in of]
        rest = float(np.sum(size[held]))
        work = np.sum((np.array(views) + rest) ** 2) + len(of) * rest**3
        if work < least:
            best, least = held, work
    return best


def _together(of: list[list[int]], size: int) -> np.ndarray:
    """Return for each number (size,) which block it is of, given lists of some that are of one; -1
    for what is in no list."""
    block = np.full(size, -1)
    for k, some in enumerate(of):
        known = np.unique(block[some])
        known = known[known >= 0]
        if len(known) > 1:
            block[np.isin(block, known)] = known[0]
        block[some] = known[0] if len(known) else k
    return block


def _side_by_side(eyes: list[Eye], at: list[tuple[Camera, int]]) -> list[View]:
    """Return the views' looks, worked out side by side: a program of its own thread each, as JAX
    runs what one thread asks for one after the other."""

    def look(eye: Eye, place: tuple[Camera, int]) -> View:
        with ASKING:  # (Python's part of it: what is kept of programs is not made for threads.)
            view = eye.solver.begin(*place)
        return jax.block_until_ready(view)

    workers = min(len(eyes), os.cpu_count() or 1)
    if workers == 1:
        return [eye.solver.begin(*place) for eye, place in zip(eyes, at, strict=True)]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(look, eyes, at))


class Solved(NamedTuple):
    """The least squares' x, and what determines it: the shared unknowns' triangle, of each block of
    views the unknowns that are its own, their triangle, and what the shared ones do to these; of
    each unknown the number of the block that owns it, -1 of shared ones."""

    x: np.ndarray
    shared: np.ndarray
    triangle: np.ndarray
    own: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]
    owner: np.ndarray

    def inverse(self, place: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the inverse of the normal matrix between some unknowns (p,) and others (q,)."""
        back = np.linalg.pinv(self.triangle)
        left, right = self.by_shared(place), self.by_shared(columns)
        result = left @ back @ (right @ back).T
        for block in self.owners(place):
            rows, others = (np.flatnonzero(self.owner[x] == block) for x in (place, columns))
            own, triangle, _ = self.own[block]
            inverse = np.linalg.pinv(triangle)
            of = lambda x, inverse=inverse, own=own: inverse[np.searchsorted(own, x)]
            result[np.ix_(rows, others)] += of(place[rows]) @ of(columns[others]).T
        return result

    def unseen(self, blind: float) -> np.ndarray:
        """Return directions (size, d) of the unknowns that change no residual: less than a share
        `blind` of what the best-seen ones do."""
        size, everything = len(self.x), np.arange(len(self.x))
        directions = []
        hidden = _null(self.triangle, blind).T
        if len(hidden):
            directions += [*(self.by_shared(everything) @ hidden.T).T]
        for own, triangle, _ in self.own.values():
            for k in _null(triangle, blind).T:
                direction = np.zeros(size)
                direction[own] = k
                directions.append(direction)
        return np.array(directions).reshape(-1, size).T

    def by_shared(self, place: np.ndarray) -> np.ndarray:
        """Return how unknowns follow the shared ones (p, s)."""
        result = np.zeros((len(place), len(self.shared)))
        held = np.flatnonzero(self.owner[place] < 0)
        result[held, np.searchsorted(self.shared, place[held])] = 1
        for block in self.owners(place):
            at = np.flatnonzero(self.owner[place] == block)
            own, triangle, across = self.own[block]
            result[at] = -(np.linalg.pinv(triangle) @ across)[np.searchsorted(own, place[at])]
        return result

    def owners(self, place: np.ndarray) -> list[int]:
        """Return the blocks that own some of these unknowns."""
        return [int(block) for block in np.unique(self.owner[place]) if block >= 0]


def _null(triangle: np.ndarray, blind: float) -> np.ndarray:
    """Return directions (n, d), of length 1, that a triangle does not see, whatever the units."""
    size = np.linalg.norm(triangle, axis=0)
    size = np.where(size > 0, size, 1.0)
    _, values, directions = np.linalg.svd(triangle / size)
    known = np.zeros(len(size))
    known[: len(values)] = values
    hidden = directions[known <= blind * max(float(np.max(known, initial=0)), 1e-300)]
    return (hidden / np.linalg.norm(hidden / size, axis=1, keepdims=True) / size).T


def solve(parts: list[Rows], size: int, damping: np.ndarray) -> Solved:
    """Return the x (size,) of least squares, `damping` (size,) times x among the residuals."""
    owner = _together([p.columns[p.own].tolist() for p in parts], size)
    shared = np.flatnonzero(owner < 0)
    blocks: dict[int, list[Rows]] = {}
    for k, part in enumerate(parts):
        block = int(owner[part.columns[part.own][0]]) if np.any(part.own) else -2 - k
        blocks.setdefault(block, []).append(part)
    x, owns, left = np.zeros(size), {}, {}
    reduced = [np.column_stack([np.diag(damping[shared]), 0 * shared])]
    for block, some in blocks.items():
        own = np.flatnonzero(owner == block)
        r = _eliminated(some, own, shared, damping[own])
        m = len(own)
        reduced.append(r[m:, m:])
        if m:
            owns[block], left[block] = (own, r[:m, :m], r[:m, m:-1]), r[:m, -1]
    r: Any = np.linalg.qr(np.concatenate(reduced), mode="r")[: len(shared)]
    x[shared] = -np.linalg.pinv(r[:, :-1]) @ r[:, -1]
    for block, (own, triangle, across) in owns.items():
        x[own] = -np.linalg.pinv(triangle) @ (left[block] + across @ x[shared])
    return Solved(x, shared, r[:, :-1], owns, owner)


def _eliminated(
    parts: list[Rows], own: np.ndarray, shared: np.ndarray, damping: np.ndarray
) -> np.ndarray:
    """Return the triangle of some rows, with columns of what is `own` (and damped) first, then of
    what is shared, then the residuals."""
    m, s = len(own), len(shared)
    tables = [np.column_stack([np.diag(damping), np.zeros((m, s + 1))])]
    for part in parts:
        table = np.zeros((len(part.left), m + s + 1))
        table[:, np.searchsorted(own, part.columns[part.own])] = part.rows[:, part.own]
        at = m + np.searchsorted(shared, part.columns[~part.own])
        table[:, at] = part.rows[:, ~part.own]
        table[:, -1] = part.left
        tables.append(table)
    r: Any = np.linalg.qr(np.concatenate(tables), mode="r")
    return r


def moved_by(x: np.ndarray, seen: list[Seen], parts: list[Rows]) -> float:
    """Return the largest move that a step makes in any view, in its solver's units."""
    return max(
        float(np.max(np.abs(s.moves @ x[p.columns]), initial=0))
        for s, p in zip(seen, parts, strict=True)
    )


class Descent(NamedTuple):
    """A state, what is seen there, the squares, steps, and whether they ended by themselves."""

    state: State
    seen: list[Seen]
    squares: float
    steps: int
    ended: bool


def descend(
    layout: Layout,
    state: State,
    depth: int,
    weights: np.ndarray,
    most: int,
    px: float,
    grow: bool = True,
) -> Descent:
    """Return the state after Levenberg-Marquardt on one level; buffers as in `Layout.look`."""
    dtype = layout.eyes[0].solver.dtype
    tolerance = px / UNIT_PX
    seen, damping, size = layout.look(state, depth, grow), FIRST_DAMPING, np.zeros(layout.size)
    squares = _squares(seen, weights)
    for n in range(1, most + 1):
        # (What is believed is weighed by what the masks leave at this step.)
        noise = layout.noise(seen)
        known = layout.known(state, seen, noise)
        squares = _squares(seen, weights) + sum(p.squares for p in known)
        views = layout.least_squares(seen, weights)
        parts = [*views, *known]
        outward = layout.ways_out(state, seen) * _slope(parts, layout.size) < 0
        views, known = ([p.without(outward) for p in some] for some in (views, known))
        parts = [*views, *known]
        size = np.maximum(size, _column_norms(parts, layout.size))
        x = solve(parts, layout.size, damping**0.5 * size).x
        moved = moved_by(x, seen, views)
        change = sum(float(np.sum((p.rows @ x[p.columns]) ** 2)) for p in parts)
        if not np.isfinite(moved):
            return Descent(state, seen, squares, n, False)
        trial = stepped(state, layout.unknowns, x, layout.eyes)
        there = layout.look(trial, depth, grow)
        after = _squares(there, weights)
        after += sum(p.squares for p in layout.known(trial, there, noise))
        if after <= squares:
            state, seen, squares = trial, there, after
            damping = max(damping / 10, LEAST_DAMPING)
        else:
            damping *= 10
        if moved < tolerance or change <= COSINE[dtype] ** 2 * squares:
            return Descent(state, seen, squares, n, True)
    return Descent(state, seen, squares, most, False)


def _squares(seen: list[Seen], weights: np.ndarray) -> float:
    return float(sum(w * s.view.squares for w, s in zip(weights, seen, strict=True)))


def _slope(parts: list[Rows], size: int) -> np.ndarray:
    """Return half the squares' derivative (size,)."""
    total = np.zeros(size)
    for part in parts:
        np.add.at(total, part.columns, part.left @ part.rows)
    return total


def _column_norms(parts: list[Rows], size: int) -> np.ndarray:
    total = np.zeros(size)
    for part in parts:
        np.add.at(total, part.columns, np.sum(part.rows**2, axis=0))
    return total**0.5
