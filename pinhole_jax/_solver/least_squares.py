"""Least squares whose residuals come in parts, of views or of points.

Each part depends on few of the unknowns. What few parts depend on is eliminated there: those of one
camera, or of one object, that have with the others only a lens in common, say. So the cost is
linear in the parts, and no matrix over all of them is ever made (nor normal equations, which would
lose half of the digits).
"""

from typing import Any, NamedTuple

import numpy as np


class Rows(NamedTuple):
    """Residuals (m,) `rows x[columns] + left` of one part; `own` (k,) of the unknowns are to be
    eliminated, with the parts that depend on these, too."""

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


def slope_of(parts: list[Rows], size: int) -> np.ndarray:
    """Half the squares' derivative (size,)."""
    total = np.zeros(size)
    for part in parts:
        np.add.at(total, part.columns, part.left @ part.rows)
    return total


def column_norms(parts: list[Rows], size: int) -> np.ndarray:
    """The sensitivity of the rows to each unknown (size,)."""
    total = np.zeros(size)
    for part in parts:
        np.add.at(total, part.columns, np.sum(part.rows**2, axis=0))
    return total**0.5


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


class LinearSolution(NamedTuple):
    """The least squares' x (size,), and what determines it.

    - `shared` (s,): the unknowns that no block owns, and their `triangle`.
    - `follows` (size, s): the derivative of all unknowns by these.
    - `own`: the unknowns of each block of views, their triangle, and its inverse.
    - `owner` (size,): the number of the block that owns an unknown, -1 of shared ones.
    - `reduced`: the rows by shared unknowns that each block leaves, and their residuals.
    """

    x: np.ndarray
    shared: np.ndarray
    triangle: np.ndarray
    follows: np.ndarray
    own: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]
    owner: np.ndarray
    reduced: list[np.ndarray]

    def root(self, place: np.ndarray, block: int | None = None) -> np.ndarray:
        """A root of the inverse of the normal matrix between unknowns (p,): it, times its
        transpose, is that, but for what other blocks than this (None: theirs) alone determine."""
        block = int(np.max(self.owner[place], initial=-1)) if block is None else block
        result = self.follows[place] @ np.linalg.pinv(self.triangle)
        if block < 0:
            return result
        own, _, back = self.own[block]
        return np.hstack([result, (place[:, None] == own) @ back])

    def unseen(self, blind: float) -> np.ndarray:
        """Return directions (size, d) of the unknowns that change residuals by less than a share
        `blind` of the best-seen direction's change."""
        directions = [self.follows @ _null(self.triangle, blind)]
        for own, triangle, _ in self.own.values():
            hidden = _null(triangle, blind)
            directions.append(np.zeros((len(self.x), hidden.shape[1])))
            directions[-1][own] = hidden
        return np.hstack(directions)

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


def solve(parts: list[Rows], size: int, damping: np.ndarray) -> LinearSolution:
    """Return the x (size,) of least squares, `damping` (size,) times x among the residuals."""
    owner = _together([p.columns[p.own].tolist() for p in parts], size)
    shared = np.flatnonzero(owner < 0)
    blocks: dict[int, list[Rows]] = {}
    for k, part in enumerate(parts):
        block = int(owner[part.columns[part.own][0]]) if np.any(part.own) else -2 - k
        blocks.setdefault(block, []).append(part)
    x, owns, follows = np.zeros(size), {}, np.zeros((size, len(shared)))
    follows[shared] = np.eye(len(shared))
    reduced = []
    for block, some in blocks.items():
        own = np.flatnonzero(owner == block)
        r = _eliminated(some, own, shared, damping[own])
        m = len(own)
        reduced.append(r[m:, m:])
        if m:
            owns[block] = own, r[:m, :m], np.linalg.pinv(r[:m, :m])
            solved = -owns[block][2] @ r[:m, m:]
            follows[own], x[own] = solved[:, :-1], solved[:, -1]
    damped = np.column_stack([np.diag(damping[shared]), 0 * shared])
    r: Any = np.linalg.qr(np.concatenate([damped, *reduced]), mode="r")[: len(shared)]
    x += follows @ (-np.linalg.pinv(r[:, :-1]) @ r[:, -1])
    return LinearSolution(x, shared, r[:, :-1], follows, owns, owner, reduced)


def _eliminated(
    parts: list[Rows], own: np.ndarray, shared: np.ndarray, damping: np.ndarray
) -> np.ndarray:
    """Return the triangle of some rows: columns of `own` (damped) unknowns, of shared ones, then
    the residuals."""
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
