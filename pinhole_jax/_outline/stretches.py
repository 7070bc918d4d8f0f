"""Stretches of a view's outline, and how far from them the mask's outline lies."""

from typing import Any, NamedTuple

import numpy as np

from .._mask.edges import Weights, weights_at
from .._mask.pyramid import Level
from .._mask.target import Window, as_coverage
from .._native.look import TouchedPixels
from .._rules import RULES
from .._solver.looks import HIDDEN, View

#: What a pixel's coverage differs by counts for the stretch nearest to it, this many px away at
#: most.
NEAREST = 16.0
#: As many terms of a sawtooth's Fourier series, and the variance that pixels have by themselves,
#: since edges bend.
HARMONICS, BENT = 6, 0.1


class Stretches(NamedTuple):
    """Stretches of an outline.

    - `at` (N, 2): their middle (px), `length` (N,) px.
    - `offset` (N,): how far outside them the mask's outline lies (px).
    - `by_move` (N, n): their own offset by the solver's moves.
    - `share` (N,): what they count for in the sum of squares.
    - `beyond`: how many pixels of the outline the mask has on its wrong side, of this many
      `pixels`.
    """

    at: np.ndarray
    length: np.ndarray
    offset: np.ndarray
    by_move: np.ndarray
    share: np.ndarray
    beyond: int
    pixels: int


class _Outline(NamedTuple):
    """The pixels of an outline: their `place` (P, 2), row from the bottom and column, and the
    stretch (P,) that each is of, out of `number`."""

    place: np.ndarray
    stretch: np.ndarray
    number: int

    def summed(self, values: Any = None) -> np.ndarray:
        """Return the sums (number,) of values (P,), or how many pixels a stretch has."""
        return np.bincount(self.stretch, values, self.number)

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return the means (number, k) of values (P, k)."""
        sums = np.stack([self.summed(column) for column in values.T], axis=1)
        return sums / self.summed()[:, None]

    def nearby(self, place: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the sums (number,) of values at places (k, 2) of the film near the outline."""
        from scipy.spatial import KDTree

        # What is far from all of it is most of a noisy mask: cells of that size sort it out.
        cells = (self.place // NEAREST).astype(int)
        around = np.zeros(cells.max(axis=0) + 3, bool)
        for down, aside in np.ndindex(3, 3):
            around[cells[:, 0] + down, cells[:, 1] + aside] = True
        cell = np.minimum((place // NEAREST).astype(int) + 1, np.array(around.shape) - 1)
        some = around[cell[:, 0], cell[:, 1]]
        place, values = place[some], values[some]
        found: Any = KDTree(self.place).query(place, distance_upper_bound=NEAREST)
        distance, nearest = found
        near = distance < np.inf
        return np.bincount(self.stretch[nearest[near]], values[near], self.number)


def stretches_of(view: View, target: np.ndarray, weights: Weights) -> Stretches | None:
    """Return stretches of the outline that a view shows and that has weight, None where it shows
    none.

    `target` and `weights` (H, W) are those of the whole film, of the level that the view is of.
    """
    level = view.level
    window = level.window()
    shown = _shown(view.pixels, level)
    weight = np.asarray(view.pixels.weight, float)[shown]
    if not np.any(weight):
        return None
    coverage = Coverage.from_view(view)
    place = _places(view.pixels, level)[shown]
    beside, slope = _slopes(coverage, place)
    steepness = np.linalg.norm(slope, axis=1)
    outline = _stretched(place, coverage, float(np.sum(steepness)))

    # Areas, not distances: what the mask has beyond the outline, for each px of it.
    length = outline.nearby(beside, steepness)
    mask = window.crop(target)[::-1]
    differing, missing = _differing(place, coverage, mask)
    seen = _weights_at(weights, window, differing, target.shape[0]) > 0
    offset = outline.nearby(differing[seen], missing[seen]) / np.maximum(length, 0.5)

    # Only pixels with weight say what a move does.
    root = np.sqrt(weight)
    rows = view.jacobian[: len(shown)][shown].astype(float)
    rows /= np.where(root > 0, root, 1)[:, None]
    pixels, counted = outline.summed(), outline.summed(root > 0)
    length_counted = length * counted / pixels
    by_move = outline.means(rows) * (pixels / np.maximum(length_counted, 0.5))[:, None]

    # How much of the outline is in a pixel: what a move covers there for each px.
    of_pixel = by_move[outline.stretch]
    within = np.sum(rows * of_pixel, axis=1) / np.maximum(np.sum(of_pixel**2, axis=1), 1e-300)
    share = outline.summed(weight * np.clip(within, 0, 2**0.5) ** 2)

    least = RULES.small * np.median(weight[weight > 0])
    good = (length_counted > 0.5) & (outline.summed(weight) > least * pixels)
    at, length, offset, by_move, share = (
        x[good] for x in (outline.means(place), length, offset, by_move, share)
    )
    inside = np.asarray(view.pixels.coverage, float)[shown]
    differs = np.abs(inside - as_coverage(mask[tuple(place.T)]))[weight > 0]
    beyond = int(np.sum(differs > RULES.wrong_side))
    return Stretches(at, length, offset, by_move, share, beyond, len(differs))


def outline_pixels(view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pixels that show an outline and have weight: row (from the bottom of the level's window)
    and column (P, 2), the derivatives (P, n) of their coverage by the solver's moves, and their
    coverage (P,)."""
    weight = np.asarray(view.pixels.weight, float)
    shown = _shown(view.pixels, view.level) & (weight > 0)
    rows = view.jacobian[: len(shown)][shown].astype(float)
    share = np.asarray(view.pixels.coverage, float)[shown]
    place = _places(view.pixels, view.level)[shown]
    return place, rows / np.sqrt(weight[shown])[:, None], share


def quantised(view: View) -> np.ndarray:
    """The covariance (n, n) of half the gradient of the sum of squares, of pixels of one bit whose
    errors have the variance 1.

    Where an outline crosses a row of pixels, one bit errs as a sawtooth of coverage: on the way
    from 0 to 1 errors cancel, and along an edge that nearly follows the row they are alike. Of two
    pixels whose coverage differs by s the correlation is 1 - 6 s (1 - s), here as a Fourier series;
    rows are independent.
    """
    row, column = _places(view.pixels, view.level).T
    rows = view.jacobian[: len(row)].astype(float)
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
    phase = np.exp(2j * np.pi * np.asarray(view.pixels.coverage, float)[order])[:, None]
    parts = 6 / (np.pi * np.arange(1, HARMONICS + 1)) ** 2
    sums = [np.add.reduceat(rows * phase**k, begins) for k in range(1, HARMONICS + 1)]
    alike = sum(part * np.real(x.conj().T @ x) for part, x in zip(parts, sums, strict=True))
    return alike + (BENT + 1 - parts.sum()) * rows.T @ rows


class OutlineMeans(NamedTuple):
    """Means over a block about each pixel of an outline: how steep coverage is there (P,), its
    slope by columns and by rows (P, 2), and what some rows (P, k) hold."""

    steepness: np.ndarray
    slope: np.ndarray
    rows: np.ndarray


def outline_means(view: View, place: np.ndarray, rows: np.ndarray, reach: int = 2) -> OutlineMeans:
    """Return means over the pixels up to `reach` away each way from those (P, 2) of an outline;
    `rows` (P, k) are 0 beside it, and all is beside the window."""
    coverage = Coverage.from_view(view)
    H, W = coverage.shape
    width = W + 2 * reach
    steps = np.indices((2 * reach + 1,) * 2).reshape(2, -1)
    around = (place[:, :1] + steps[0]) * width + place[:, 1:] + steps[1]
    # (Of zeros, what is not written to takes no time.)
    slot = np.zeros((H + 2 * reach) * width, np.int32)
    slot[around] = 1
    cells = np.flatnonzero(slot)
    slot[cells] = np.arange(len(cells))
    around, own = slot[around], slot[(place[:, 0] + reach) * width + place[:, 1] + reach]

    row, column = (x - reach for x in np.divmod(cells, width))
    seen = (row >= 0) & (row < H) & (column >= 0) & (column < W)
    row, column = np.clip(row, 0, H - 1), np.clip(column, 0, W - 1)
    up, right = coverage.growth(row, column)
    span = lambda x, size: np.maximum(np.minimum(x + 1, size - 1) - np.maximum(x - 1, 0), 1)
    slope = np.column_stack([right / span(column, W), up / span(row, H)])
    slope *= seen[:, None]
    spread = np.zeros((len(cells), rows.shape[1]))
    spread[own] = rows
    mean = lambda values: np.mean(values[around], axis=1)
    columns = np.stack([mean(x) for x in spread.T], axis=1)
    slopes = np.stack([mean(x) for x in slope.T], axis=1)
    return OutlineMeans(mean(np.hypot(*slope.T)), slopes, columns)


def _stretched(place: np.ndarray, coverage: "Coverage", length: float) -> _Outline:
    """Return pixels (P, 2) of an outline of a length (px) by stretches; both sides of a thin part
    are stretches of their own."""
    up, right = coverage.growth(*place.T)
    side = np.round(np.arctan2(up, right) / (np.pi / 2)) % 4
    key = np.column_stack([place // max(RULES.stretch, length / RULES.stretches), side])
    _, stretch = np.unique(key, axis=0, return_inverse=True)
    stretch = stretch.ravel()
    return _Outline(place, stretch, int(stretch.max()) + 1)


def _slopes(coverage: "Coverage", place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (k, 2) of an outline and beside it, and the coverage's slope there (k, 2):
    its sum is the outline's length."""
    H, W = coverage.shape
    around = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    row, column = (place[:, None] + around).reshape(-1, 2).T
    inside = (row >= 0) & (row < H) & (column >= 0) & (column < W)
    row, column = np.divmod(np.unique(row[inside] * W + column[inside]), W)
    return np.column_stack([row, column]), np.column_stack(coverage.growth(row, column)) / 2


def _places(pixels: TouchedPixels, level: Level) -> np.ndarray:
    """Return row (from the bottom) and column of touched pixels (P, 2)."""
    row, column = np.divmod(np.asarray(pixels.cell), int(level.W) + 2)
    return np.column_stack([row, column - 1])


def _shown(pixels: TouchedPixels, level: Level) -> np.ndarray:
    """Return which touched pixels (P,) show an outline, in a level's window."""
    (row, column), share = _places(pixels, level).T, np.asarray(pixels.coverage)
    inside = (row < int(level.H)) & (column >= 0) & (column < int(level.W))
    return inside & (share > HIDDEN) & (share < 1 - HIDDEN)


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
    def from_view(cls, view: View) -> "Coverage":
        pixels = view.pixels
        shape = int(view.level.H), int(view.level.W)
        return cls(shape, pixels.cell, pixels.coverage, pixels.after, pixels.before)

    def lookup(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return the coverage of pixels."""
        cell = row * (self.shape[1] + 2) + column + 1
        last = np.searchsorted(self.cell, cell, side="right") - 1
        if not self.cell.size:
            return np.full(cell.shape, float(self.before))
        touched = (last >= 0) & (self.cell[last] == cell)
        return np.where(touched, self.share[last], self._covered(last, row))

    def growth(self, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The coverage above pixels less that below them, and right of them less that left of them;
        a pixel at the window's end stands for the one that it lacks."""
        (H, W), at = self.shape, self.lookup
        up = at(np.minimum(row + 1, H - 1), column) - at(np.maximum(row - 1, 0), column)
        right = at(row, np.minimum(column + 1, W - 1)) - at(row, np.maximum(column - 1, 0))
        return up, right

    def begins(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """The cover (bool) just before pixels, in their rows."""
        cell = row * (self.shape[1] + 2) + column + 1
        return self._covered(np.searchsorted(self.cell, cell) - 1, row)

    def changes(self) -> np.ndarray:
        """Return by how much (-1, 0 or 1) what follows each touched cell differs from what comes
        before it."""
        row = self.cell // (self.shape[1] + 2)
        before = self._covered(np.arange(len(row)) - 1, row)
        return self.after.astype(np.int8) - before.astype(np.int8)

    def _covered(self, last: np.ndarray, row: np.ndarray) -> np.ndarray:
        """The cover (bool) after the last touched cells, in rows: these may begin
        later."""
        same = (last >= 0) & (self.cell[last] // (self.shape[1] + 2) == row)
        return np.where(same, self.after[last], self.before)


def _differing(
    outline: np.ndarray, coverage: Coverage, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (k, 2) near an outline's (P, 2) where a target (H, W) is not the coverage, and
    by how much it is more. (Row 0 of the target is at the bottom.)

    What is looked at are blocks about the outline: `nearby` asks for no more.
    """
    (H, W), side = coverage.shape, int(NEAREST)
    around = np.zeros((H // side + 3, W // side + 3), bool)
    for down, aside in np.ndindex(3, 3):
        around[outline[:, 0] // side + down, outline[:, 1] // side + aside] = True
    around = around[1:-1, 1:-1]
    block = np.full(around.shape, -1)
    corner = side * np.argwhere(around)
    block[around] = np.arange(len(corner))
    step = np.arange(side)
    row, column = np.broadcast_arrays(
        (corner[:, :1] + step)[..., None], (corner[:, 1:] + step)[:, None]
    )
    inside = (row < H) & (column < W)
    image = as_coverage(target[np.minimum(row, H - 1), np.minimum(column, W - 1)])

    # In each block's row, what it begins with, and what changes in it.
    change = np.zeros((len(corner), side, side + 1), np.int8)
    change[..., 0] = coverage.begins(row[..., 0], column[..., 0])
    place = np.column_stack(np.divmod(coverage.cell, W + 2)) - [0, 1]
    some = (place[:, 1] >= 0) & (place[:, 1] < W)
    place, share, steps = place[some], coverage.share[some], coverage.changes()[some]
    of = block[tuple((place // side).T)]
    some = of >= 0
    of, (r, c) = of[some], (place[some] % side).T
    change[of, r, c + 1] = steps[some]
    covered = np.cumsum(change, axis=-1, dtype=np.int8)[..., :-1].astype(float)
    covered[of, r, c] = share[some]

    missing = np.where(inside, image - covered, 0)
    differs = np.abs(missing) > HIDDEN
    return np.column_stack([row[differs], column[differs]]), missing[differs]


def _weights_at(weights: Weights, window: Window, place: np.ndarray, H: int) -> np.ndarray:
    """Return the weights of a film of this many rows at a window's pixels (k, 2), rows from the
    bottom."""
    row, column = place.T
    return weights_at(weights, H - 1 - window.bottom - row, column + window.left)


def coverage_of(view: View) -> np.ndarray:
    """Return the coverage (H, W) of a level's window as a view has it, row 0 at the bottom."""
    pixels = view.pixels
    H, W = int(view.level.H), int(view.level.W)
    cell, share, after = pixels.cell, pixels.coverage, pixels.after
    # What a row begins with, and what follows a touched pixel, lasts until the next one.
    starts = np.arange(H) * (W + 2)
    place = np.concatenate([starts, cell])
    value = np.concatenate([np.full(H, pixels.before), after])
    order = np.argsort(place, kind="stable")
    ends = np.append(place[order][1:], H * (W + 2))
    image = np.repeat(value[order].astype(float), ends - place[order])
    image[cell] = share
    return image.reshape(H, W + 2)[:, 1:-1]
