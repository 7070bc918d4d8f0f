"""Stretches of a view's outline, and how far from them the mask's outline lies."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .._mask.edges import Weights, weights_at
from .._mask.target import as_coverage
from .._rules import RULES
from .._solver.looks import HIDDEN, Origin, View

#: What a pixel's coverage differs by counts for the stretch nearest to it, this many px away at
#: most.
NEAREST = 16.0
#: How far away pixels are (px) that means about an outline's pixel are over; the library's, too.
REACH = 2
#: An edge nearly follows the rows, or columns, if its slope is less.
LEVEL = 1 / 8
#: As many terms of a sawtooth's Fourier series, and the variance that pixels have by themselves,
#: since edges bend.
HARMONICS, BENT = 6, 0.1


class Stretches(NamedTuple):
    """Stretches of an outline.

    - `at` (N, 2): their middle (px), `length` (N,) px.
    - `offset` (N,): how far outside them the mask's outline lies (px).
    - `by_move` (N, n): their own offset by the solver's moves.
    - `share` (N,): what they count for in the sum of squares.
    - `alike` (N,): the square of the sum of their pixels' residuals by the sum of the squares: 1 on
      average where pixels err independently, their number where they err alike. NaN where none
      errs, and of edges that nearly follow rows or columns: samples on a grid err alike there.
    - `beyond`: how many pixels of the outline the mask has on its wrong side, of this many
      `pixels`.
    """

    at: np.ndarray
    length: np.ndarray
    offset: np.ndarray
    by_move: np.ndarray
    share: np.ndarray
    alike: np.ndarray
    beyond: int
    pixels: int


class OutlinePixels(NamedTuple):
    """The pixels that show an outline.

    - `place` (P, 2): row, from the bottom of the level's window, and column.
    - `weight` (P,), and their `coverage` (P,).
    - `by_move` (P, n): the derivatives of that by the solver's moves, 0 without weight.
    """

    place: np.ndarray
    weight: np.ndarray
    coverage: np.ndarray
    by_move: np.ndarray

    @classmethod
    def from_view(cls, view: View | Origin) -> "OutlinePixels":
        pixels, window, place = view.pixels, view.level.window(), _places(view)
        (row, column), share = place.T, pixels.coverage
        inside = (row < window.H) & (column >= 0) & (column < window.W)
        shown = inside & (share > HIDDEN) & (share < 1 - HIDDEN)
        weight = pixels.weight[shown]
        by_move = pixels.jacobian[shown] / np.sqrt(np.where(weight > 0, weight, 1))[:, None]
        return cls(place[shown], weight, share[shown], by_move)

    def weighed(self) -> "OutlinePixels":
        """Those that have weight."""
        return OutlinePixels(*(x[self.weight > 0] for x in self))


@dataclass(frozen=True, eq=False)
class Blocks:
    """Points by blocks: which one each is `of` (n,), and their `length` (N,) in px."""

    of: np.ndarray
    length: np.ndarray

    @classmethod
    def alike(cls, key: np.ndarray, step: np.ndarray | None = None) -> "Blocks":
        """The blocks of points with the same key (n, k), each of a length (n,), or of 1 px."""
        _, of = np.unique(key, axis=0, return_inverse=True)
        return cls(of.ravel(), np.bincount(of.ravel(), step))

    def sum(self, values: np.ndarray) -> np.ndarray:
        """The sums (N, ...) of the points' values (n, ...)."""
        if values.ndim == 1:
            return np.bincount(self.of, values)
        return np.stack([np.bincount(self.of, x) for x in values.T], axis=1)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """The means (N, ...) of the points' values (n, ...)."""
        return (self.sum(values).T / np.bincount(self.of)).T


def stretches_of(view: View, target: np.ndarray, weights: Weights) -> Stretches | None:
    """Return stretches of the outline that a view shows and that has weight, None where it shows
    none.

    `target` and `weights` (H, W) are those of the whole film, of the level that the view is of.
    """
    from scipy.spatial import KDTree

    window, pixels = view.level.window(), OutlinePixels.from_view(view)
    place, weight, _, rows = pixels
    if not np.any(weight):
        return None
    coverage = Coverage.from_view(view)
    row, column, inside, _ = _neighbours(place, coverage.shape, 1)
    row, column = row[inside], column[inside]
    steepness = np.hypot(*coverage.growth(row, column)) / 2  # (its sum is the outline's length)
    slopes = np.column_stack(coverage.growth(*place.T))
    blocks, tree = _stretched(place, slopes, float(np.sum(steepness))), KDTree(place)

    def nearby(place: np.ndarray, *values: np.ndarray) -> list[np.ndarray]:
        found: Any = tree.query(place, distance_upper_bound=NEAREST)
        near = found[0] < np.inf
        of = blocks.of[found[1][near]]
        return [np.bincount(of, x[near], len(blocks.length)) for x in values]

    # Areas, not distances: what the mask has beyond the outline, for each px of it.
    (length,) = nearby(np.column_stack([row, column]), steepness)
    mask = window.crop(target)[::-1]
    differing, missing = _differing(place, coverage, mask)
    row, column = differing.T
    up = target.shape[0] - 1 - window.bottom - row
    seen = weights_at(weights, up, column + window.left) > 0
    area, squares = nearby(differing[seen], missing[seen], missing[seen] ** 2)
    offset = area / np.maximum(length, 0.5)
    less, more = np.sort(np.abs(blocks.sum(slopes)), axis=1).T
    squares = np.where(less > LEVEL * more, squares, 0)
    alike = np.where(squares > 0, area**2, np.nan) / np.where(squares > 0, squares, 1)

    # Only pixels with weight say what a move does.
    length_counted = length * blocks.mean(1.0 * (weight > 0))
    by_move = blocks.sum(rows) / np.maximum(length_counted, 0.5)[:, None]

    # How much of the outline is in a pixel: what a move covers there for each px.
    of_pixel = by_move[blocks.of]
    within = np.sum(rows * of_pixel, axis=1) / np.maximum(np.sum(of_pixel**2, axis=1), 1e-300)
    share = blocks.sum(weight * np.clip(within, 0, 2**0.5) ** 2)

    least = RULES.small * np.median(weight[weight > 0])
    good = (length_counted > 0.5) & (blocks.sum(weight) > least * blocks.length)
    at, length, offset, by_move, share, alike = (
        x[good] for x in (blocks.mean(place), length, offset, by_move, share, alike)
    )
    differs = np.abs(pixels.coverage - as_coverage(mask[tuple(place.T)]))[weight > 0]
    beyond = int(np.sum(differs > RULES.wrong_side))
    return Stretches(at, length, offset, by_move, share, alike, beyond, len(differs))


def quantised(view: View) -> np.ndarray:
    """The covariance (n, n) of half the gradient of the sum of squares, of pixels of one bit whose
    errors have the variance 1.

    Where an outline crosses a row of pixels, one bit errs as a sawtooth of coverage: on the way
    from 0 to 1 errors cancel, and along an edge that nearly follows the row they are alike. Of two
    pixels whose coverage differs by s the correlation is 1 - 6 s (1 - s), here as a Fourier series;
    rows are independent.
    """
    (row, column), rows = _places(view).T, view.jacobian
    up, right = Coverage.from_view(view).growth(row, column)
    lies = np.abs(up) >= np.abs(right)  # (along the row)
    line, along = np.where(lies, row, column), np.where(lies, column, row)
    side = 2 * lies + (np.where(lies, up, right) > 0)
    order = np.lexsort((along, line, side))
    order = order[np.any(rows[order] != 0, axis=1)]  # (An edge may lie between pixels.)
    if not order.size:
        return rows.T @ rows
    step = np.diff(np.stack([side, line, along])[:, order], axis=1, prepend=-2)
    begins = np.flatnonzero(np.any(step != [[0], [0], [1]], axis=0))
    rows = rows[order]
    phase = np.exp(2j * np.pi * view.pixels.coverage[order])[:, None]
    parts = 6 / (np.pi * np.arange(1, HARMONICS + 1)) ** 2
    sums = [np.add.reduceat(rows * phase**k, begins) for k in range(1, HARMONICS + 1)]
    alike = sum(part * np.real(x.conj().T @ x) for part, x in zip(parts, sums, strict=True))
    return alike + (BENT + 1 - parts.sum()) * rows.T @ rows


class OutlineMeans(NamedTuple):
    """The pixels with weight that show an outline, and means over a block about each.

    - `place` (P, 2): row, from the bottom of the level's window, and column; `coverage` (P,).
    - `steepness` (P,), `slope` (P, 2): of coverage, the latter by columns and by rows.
    - `by_move` (P, n): its derivatives by the solver's moves.
    """

    place: np.ndarray
    coverage: np.ndarray
    steepness: np.ndarray
    slope: np.ndarray
    by_move: np.ndarray

    @classmethod
    def from_origin(cls, origin: Origin) -> "OutlineMeans":
        """Means over the pixels up to `REACH` away each way; all is 0 beside the window, and
        derivatives are beside the outline."""
        table = origin.outline
        if table is not None:
            return cls(table[:, :2], table[:, 2], table[:, 3], table[:, 4:6], table[:, 6:])
        place, _, share, rows = OutlinePixels.from_view(origin).weighed()
        coverage = Coverage.from_view(origin)
        row, column, inside, around = _neighbours(place, coverage.shape, REACH)
        slope, spread = np.zeros((len(row), 2)), np.zeros((len(row), rows.shape[1]))
        spread[around[:, around.shape[1] // 2]] = rows
        row, column, (H, W) = row[inside], column[inside], coverage.shape
        up, right = coverage.growth(row, column)
        span = lambda x, size: np.maximum(np.minimum(x + 1, size - 1) - np.maximum(x - 1, 0), 1)
        slope[inside] = np.column_stack([right / span(column, W), up / span(row, H)])
        means = np.column_stack([np.hypot(*slope.T), slope, spread])[around].mean(axis=1)
        return cls(place, share, means[:, 0], means[:, 1:3], means[:, 3:])


def _neighbours(
    place: np.ndarray, shape: tuple[int, int], reach: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Row and column (k,) of the pixels up to `reach` away each way from some (P, 2); whether they
    are in a window of a shape (H, W); which of them are about each of those (P, m)."""
    (H, W), side = shape, 2 * reach + 1
    width = W + 2 * reach
    down, aside = np.indices((side, side)).reshape(2, -1)
    around = (place[:, :1] + down) * width + place[:, 1:] + aside
    # (What is not written to takes no time.)
    some = np.zeros((H + 2 * reach) * width, bool)
    some[around] = True
    cells, slot = np.flatnonzero(some), np.empty(len(some), np.int32)
    slot[cells] = np.arange(len(cells))
    row, column = (x - reach for x in np.divmod(cells, width))
    inside = (row >= 0) & (row < H) & (column >= 0) & (column < W)
    return row, column, inside, slot[around]


def _stretched(place: np.ndarray, slopes: np.ndarray, length: float) -> Blocks:
    """Return pixels (P, 2) of an outline of a length (px) by stretches; both sides of a thin part,
    whose slopes (P, 2) differ, are stretches of their own."""
    up, right = slopes.T
    side = np.round(np.arctan2(up, right) / (np.pi / 2)) % 4
    size = max(RULES.stretch, length / RULES.stretches)
    return Blocks.alike(np.column_stack([place // size, side]))


def _places(view: View | Origin) -> np.ndarray:
    """Return row (from the bottom) and column of a view's touched pixels (P, 2)."""
    row, column = np.divmod(view.pixels.cell, int(view.level.W) + 2)
    return np.column_stack([row, column - 1])


class Coverage(NamedTuple):
    """The coverage of a level's window (`shape`), row 0 at the bottom, as a view has it: cells of
    the raster that it touches, ascending, what is covered of these, whether what follows is, and
    whether rows begin covered."""

    shape: tuple[int, int]
    cell: np.ndarray
    share: np.ndarray
    after: np.ndarray
    before: bool

    @classmethod
    def from_view(cls, view: View | Origin) -> "Coverage":
        pixels, shape = view.pixels, (int(view.level.H), int(view.level.W))
        # (The first is in no row.)
        after = np.append(False, pixels.after)
        return cls(
            shape, np.append(-1, pixels.cell), np.append(0, pixels.coverage), after, pixels.before
        )

    def lookup(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return the coverage of pixels."""
        width = self.shape[1] + 2
        cell = row * width + column + 1
        last = np.searchsorted(self.cell, cell, side="right") - 1
        there = self.cell[last]
        covered = np.where(there // width == row, self.after[last], self.before)
        return np.where(there == cell, self.share[last], covered)

    def growth(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The coverage above pixels less that below them, and right of them less that left of them;
        a pixel at the window's end stands for the one that it lacks."""
        (H, W), at = self.shape, self.lookup
        up = at(np.minimum(row + 1, H - 1), column) - at(np.maximum(row - 1, 0), column)
        right = at(row, np.minimum(column + 1, W - 1)) - at(row, np.maximum(column - 1, 0))
        return up, right


def _differing(
    outline: np.ndarray, coverage: Coverage, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (k, 2) near an outline's (P, 2) where a target (H, W) is not the coverage, and
    by how much it is more. (Row 0 of the target is at the bottom.)

    What is looked at are blocks about the outline: what lies farther away counts for no stretch.
    """
    from scipy.ndimage import binary_dilation

    side = int(NEAREST)
    blocks = np.zeros([-(-n // side) for n in coverage.shape], bool)
    blocks[tuple((outline // side).T)] = True
    corner = side * np.argwhere(binary_dilation(blocks, np.ones((3, 3))))
    place = (corner[:, None] + np.indices((side, side)).reshape(2, -1).T).reshape(-1, 2)
    place = place[np.all(place < coverage.shape, axis=1)]
    missing = as_coverage(target[tuple(place.T)]) - coverage.lookup(*place.T)
    differs = np.abs(missing) > HIDDEN
    return place[differs], missing[differs]


def coverage_of(view: View) -> np.ndarray:
    """Return the coverage (H, W) of a level's window as a view has it, row 0 at the bottom."""
    coverage = Coverage.from_view(view)
    H, W = coverage.shape
    return coverage.lookup(*np.ogrid[:H, :W])
