"""A mask's edge: which pixels lie near it, and weights that are 0 elsewhere.

A photo has millions of pixels and an edge of thousands: what is asked of pixels near the edge is
worked out from the list of those beside it.
"""

from typing import NamedTuple

import numpy as np

from .target import Window, beside, edge_distance, object_window

#: Pixels about each pixel of an edge are visited one by one, unless these are more than this many
#: for each pixel of the image: then the distances of all are worked out at once.
VISITS = 8


class SparseImage(NamedTuple):
    """Some pixels of an image (H, W): their places in the flat image, ascending, and values."""

    shape: tuple[int, ...]
    place: np.ndarray
    value: np.ndarray

    @property
    def rows_columns(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows (from the top) and columns."""
        return np.divmod(self.place, self.shape[1])

    def image(self) -> np.ndarray:
        """Return the image (H, W), 0 at others than these."""
        image = np.zeros(self.shape)
        image.flat[self.place] = self.value
        return image

    def within(self, window: Window) -> "SparseImage":
        """Return the pixels in a window."""
        row, column = self.rows_columns
        row, column = row - (self.shape[0] - window.bottom - window.H), column - window.left
        inside = (row >= 0) & (row < window.H) & (column >= 0) & (column < window.W)
        place = (row * window.W + column)[inside]
        return SparseImage((window.H, window.W), place, self.value[inside])


#: Weights of an image (H, W).
Weights = np.ndarray | SparseImage


def weights_at(weights: Weights, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return weights at rows (from the top) and columns, 0 where none are listed."""
    if not isinstance(weights, SparseImage):
        return weights[row, column]
    shape, place, value = weights
    if not place.size:
        return np.zeros(row.shape)
    asked = row * shape[1] + column
    slot = np.minimum(np.searchsorted(place, asked), len(place) - 1)
    return np.where(place[slot] == asked, value[slot], 0.0)


def within(weights: Weights, window: Window) -> Weights:
    """Return the weights of a window."""
    return weights.within(window) if isinstance(weights, SparseImage) else window.crop(weights)


def values_of(weights: Weights) -> np.ndarray:
    """All weights that are not 0 for certain."""
    return weights.value if isinstance(weights, SparseImage) else weights


def alike(weights: Weights) -> bool:
    """True if all weights are for certain the same: one number, seen as an image."""
    return not isinstance(weights, SparseImage) and weights.size > 0 and weights.strides == (0, 0)


def edge_band(inside: np.ndarray, reach: float) -> SparseImage:
    """Return the pixels of an image, of bools, that are less than `reach` + 1 (px) from one beside
    an edge, and how far they are from it; those in the object's window."""
    window, shape = object_window(inside), inside.shape
    shown, margin = window.crop(inside), int(np.ceil(1 + reach))
    edge = beside(shown)
    if margin > 255 or np.pi * (1 + reach) ** 2 * len(edge) > VISITS * shown.size:
        distance = edge_distance(inside)
        place = np.flatnonzero(distance < 1 + reach)
        return SparseImage(shape, place, distance.flat[place])

    offsets = np.indices((2 * margin + 1,) * 2).reshape(2, -1).T - margin
    squares = np.sum(offsets**2, axis=1)
    disc = np.flatnonzero(squares < (1 + reach) ** 2)
    # From the farthest on, so that the nearest have the last word. (What is not written to of
    # zeros takes no time.)
    H, W = window.H + 2 * margin, window.W + 2 * margin
    seen = np.zeros(H * W, np.uint16)
    row, column = np.divmod(edge, window.W)
    start, shifts = row * W + column, (offsets + margin) @ [W, 1]
    for k in disc[np.argsort(-squares[disc])]:
        seen[start + shifts[k]] = squares[k] + 1
    place = np.flatnonzero(seen)
    band = SparseImage((H, W), place, np.sqrt(seen[place] - 1.0))
    band = band.within(Window(margin, margin, window.W, window.H))
    return band.within(Window(-window.left, -window.bottom, shape[1], shape[0]))
