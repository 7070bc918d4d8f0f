"""Least squares whose residuals come in parts, of views or of points.

Each part depends on few of the unknowns. What few parts depend on is eliminated there: those of one
camera, or of one object, that have with the others only a lens in common, say. So the cost is
linear in the parts, and no matrix over all of them is ever made (nor normal equations, which would
lose half of the digits).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

#: What shows less in a triangle than this share of the best-seen direction is rounding. A direction
#: moves an unknown if that shows more than this share of the one that shows most.
LEAST_SEEN, ROUNDING = 1e-15, 1e-6


class Rows(NamedTuple):
    """Residuals (m,) `rows x[columns] + left` of one part."""

    rows: np.ndarray
    left: np.ndarray
    columns: np.ndarray

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


def total(parts: list[Rows], size: int, number: Callable[[Rows], np.ndarray]) -> np.ndarray:
    """The sum (size,) of a number that each part has for each of its columns."""
    result = np.zeros(size)
    for part in parts:
        np.add.at(result, part.columns, number(part))
    return result


def slope_of(parts: list[Rows], size: int) -> np.ndarray:
    """Half the squares' derivative (size,)."""
    return total(parts, size, lambda part: part.left @ part.rows)


def blocks_of(views: list[list[int]], sizes: list[int]) -> np.ndarray:
    """Return the block that each unknown (of these `sizes`) is eliminated with, given those that
    each view depends on; -1 for what stays: what most views depend on, as many as make the least
    work."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size, number = np.array(sizes), len(sizes)
    links = np.array([(j, number + k) for k, some in enumerate(views) for j in some])
    seen_by = np.bincount(links[:, 0], minlength=number)
    best, least = np.full(number, -1), np.inf
    for count in np.unique(seen_by):
        held = seen_by >= count
        # A block is views that unknowns link, and these.
        free = links[~held[links[:, 0]]]
        graph = coo_array((np.ones(len(free)), free.T), 2 * (number + len(views),))
        block = connected_components(graph, directed=False)[1]
        within = np.bincount(block[:number], np.where(held, 0, size), len(block))
        rest = float(np.sum(size[held]))
        work = float(np.sum((within[block[number:]] + rest) ** 2 + rest**3))
        if work < least:
            best, least = np.where(held, -1, block[:number]), work
    return best


class LinearSolution(NamedTuple):
    """The least squares' x (size,), and what determines it.

    - `shared` (s,): the unknowns that no block owns, their `triangle`, its inverse `back`, and
      the directions (s, d) that it has `hidden`.
    - `follows` (size, s): the derivative of all unknowns by these.
    - `own`: the same of each block of views, whose triangle is by its unknowns (m,) and the shared
      ones (m, m + s).
    - `owner` (size,): the number of the block that owns an unknown, -1 of shared ones.
    - `reduced`: the rows by shared unknowns that each block leaves.
    - `sizes` (size,): how much each unknown shows, all others held; 1 of those that do not.
    """

    x: np.ndarray
    shared: np.ndarray
    triangle: np.ndarray
    back: np.ndarray
    hidden: np.ndarray
    follows: np.ndarray
    own: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]
    owner: np.ndarray
    reduced: list[Rows]
    sizes: np.ndarray

    def root(self, place: np.ndarray, block: int | None = None) -> np.ndarray:
        """A root of the inverse of the normal matrix between unknowns (p,): it, times its
        transpose, is that, but for what other blocks than this (None: theirs) alone determine."""
        block = int(np.max(self.owner[place], initial=-1)) if block is None else block
        result = self.follows[place] @ self.back
        if block < 0:
            return result
        own, _, back, _ = self.own[block]
        return np.hstack([result, (place[:, None] == own) @ back])

    def triangle_by(self, place: np.ndarray) -> np.ndarray:
        """R of J = QR by the unknowns (p,) of a block and the shared ones, others eliminated."""
        tables = [self.triangle @ (self.shared[:, None] == place)]
        if (block := int(np.max(self.owner[place]))) >= 0:
            own, rows, *_ = self.own[block]
            tables.insert(0, rows @ (np.append(own, self.shared)[:, None] == place))
        return np.concatenate(tables)

    def unseen(self) -> np.ndarray:
        """Directions (size, d) of the unknowns that residuals do not see."""
        directions = [self.follows @ self.hidden]
        for own, _, _, hidden in self.own.values():
            directions.append(np.zeros((len(self.x), hidden.shape[1])))
            directions[-1][own] = hidden
        found = np.hstack(directions)
        # (What shared unknowns leave of others is rounding, if these do not follow.)
        shown = np.abs(found) * self.sizes[:, None]
        return np.where(shown > ROUNDING * np.max(shown, axis=0, initial=0), found, 0)


def _inverted(
    triangle: np.ndarray, sizes: np.ndarray, blind: float
) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of a triangle, but for directions (n, d), of length 1, that are hidden; these.

    Hidden is what shows less than a share `blind` of the best-seen direction, in units in which
    unknowns show alike: by their `sizes`, as rounding alone may be left of a column.
    """
    left, values, directions = np.linalg.svd(triangle / sizes)
    seen = values > max(blind, LEAST_SEEN) * np.max(values, initial=0)
    back = directions[seen].T / values[seen] @ left[:, seen].T / sizes[:, None]
    hidden = directions[~seen] / sizes
    return back, (hidden / np.linalg.norm(hidden, axis=1, keepdims=True)).T


def solve(
    parts: list[Rows], owner: np.ndarray, damping: np.ndarray, blind: float = 0.0
) -> LinearSolution:
    """Return the x (size,) of least squares, `damping` (size,) times x among the residuals; each
    block eliminates the unknowns that it owns (-1: none does). No step is along directions that
    show less than a share `blind` of the best-seen one."""
    size, shared = len(owner), np.flatnonzero(owner < 0)
    sizes = (total(parts, size, lambda part: np.sum(part.rows**2, axis=0)) + damping**2) ** 0.5
    sizes = np.where(sizes > 0, sizes, 1.0)
    blocks: dict[int, list[Rows]] = {}
    for k, part in enumerate(parts):
        block = int(np.max(owner[part.columns]))
        blocks.setdefault(-2 - k if block < 0 else block, []).append(part)
    x, owns, follows = np.zeros(size), {}, np.zeros((size, len(shared)))
    follows[shared] = np.eye(len(shared))
    reduced = []
    for block, some in blocks.items():
        own = np.flatnonzero(owner == block)
        r, m = _triangle(some, np.append(own, shared), damping[own]), len(own)
        reduced.append(Rows(r[m:, m:-1], r[m:, -1], shared))
        if m:
            back, hidden = _inverted(r[:m, :m], sizes[own], blind)
            owns[block] = own, r[:m, :-1], back, hidden
            solved = -back @ r[:m, m:]
            follows[own], x[own] = solved[:, :-1], solved[:, -1]
    r = _triangle(reduced, shared, damping[shared])[: len(shared)]
    triangle = r[:, :-1]
    back, hidden = _inverted(triangle, sizes[shared], blind)
    x += follows @ (-back @ r[:, -1])
    return LinearSolution(x, shared, triangle, back, hidden, follows, owns, owner, reduced, sizes)


def _triangle(parts: list[Rows], order: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return the triangle of some rows by unknowns in an order, then of the residuals; the first
    unknowns are damped."""
    tables = [np.eye(len(damping), len(order) + 1) * damping[:, None]]
    for part in parts:
        rows = part.rows @ (part.columns[:, None] == order)
        tables.append(np.column_stack([rows, part.left]))
    r: Any = np.linalg.qr(np.concatenate(tables), mode="r")
    return r
