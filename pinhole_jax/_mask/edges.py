"""A mask's edge: which pixels lie beside it or near it, and weights that are 0 elsewhere.

A photo has millions of pixels and an edge of thousands: what is asked of pixels near the edge is
worked out from the list of those beside it.
"""

from typing import NamedTuple

import numpy as np

from .target import Window, edge_distance, near_an_edge

#: Pixels about each pixel of an edge are visited one by one, unless these are more than this many
#: for each pixel of the image: then the distances of all are worked out at once.
VISITS = 8


class EdgeBand(NamedTuple):
    """Pixels near an edge: their places in the flat image, ascending, and how far (px) they are
    from the nearest pixel beside the edge."""

    place: np.ndarray
    distance: np.ndarray


class NearWeights(NamedTuple):
    """Weights of an image (H, W) that are 0 but at some places of the flat image, ascending."""

    shape: tuple[int, int]
    place: np.ndarray
    value: np.ndarray

    def lookup(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return the weights at rows (from the top) and columns."""
        return looked_up(self.place, self.value, row * self.shape[1] + column, 0.0)

    def image(self) -> np.ndarray:
        """Return the weights (H, W)."""
        flat = np.zeros(self.shape[0] * self.shape[1])
        flat[self.place] = self.value
        return flat.reshape(self.shape)

    def within(self, window: Window) -> "NearWeights":
        """Return the weights of a window."""
        row, column = np.divmod(self.place, self.shape[1])
        row -= self.shape[0] - window.bottom - window.H
        column -= window.left
        inside = (row >= 0) & (row < window.H) & (column >= 0) & (column < window.W)
        place = (row * window.W + column)[inside]
        return NearWeights((window.H, window.W), place, self.value[inside])


Weights = np.ndarray | NearWeights


def weights_at(weights: Weights, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return weights at rows (from the top) and columns."""
    if isinstance(weights, NearWeights):
        return weights.lookup(row, column)
    return weights[row, column]


def within(weights: Weights, window: Window) -> Weights:
    """Return the weights of a window."""
    if isinstance(weights, NearWeights):
        return weights.within(window)
    return window.crop(weights)


def total(weights: Weights) -> float:
    """Return the sum of weights."""
    return float(np.sum(_values(weights)))


def counted(weights: Weights) -> int:
    """The number of pixels that have a weight."""
    return int(np.count_nonzero(_values(weights)))


def _values(weights: Weights) -> np.ndarray:
    return weights.value if isinstance(weights, NearWeights) else weights


def alike(weights: Weights) -> bool:
    """True if all weights are for certain the same: one number, seen as an image."""
    return not isinstance(weights, NearWeights) and weights.size > 0 and weights.strides == (0, 0)


def looked_up(
    places: np.ndarray, values: np.ndarray, asked: np.ndarray, default: float
) -> np.ndarray:
    """Return the values at the asked of some places, which ascend, and elsewhere a default."""
    if not places.size:
        return np.full(asked.shape, default)
    slot = np.minimum(np.searchsorted(places, asked), len(places) - 1)
    return np.where(places[slot] == asked, values[slot], default)


def crossings(inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places in the flat image (H, W) that differ from the next one below, and from the
    next one to the right."""
    W = inside.shape[1]
    down = np.flatnonzero(inside[1:] != inside[:-1])
    row, column = np.divmod(np.flatnonzero(inside[:, 1:] != inside[:, :-1]), max(W - 1, 1))
    return down, row * W + column


def beside(inside: np.ndarray) -> np.ndarray:
    """Return the places in the flat image of pixels that a neighbour differs from, ascending."""
    down, right = crossings(inside)
    return np.unique(np.concatenate([down, down + inside.shape[1], right, right + 1]))


def edge_band(inside: np.ndarray, reach: float) -> EdgeBand:
    """Return the pixels of an image, of bools, that are less than `reach` + 1 (px) from one beside
    an edge."""
    edge, (H, W) = beside(inside), inside.shape
    margin = int(np.ceil(1 + reach))
    steps = np.arange(-margin, margin + 1)
    squares = (steps[:, None] ** 2 + steps[None] ** 2).ravel()
    disc = np.flatnonzero(squares < (1 + reach) ** 2)
    if len(disc) * len(edge) > VISITS * inside.size:
        distance = edge_distance(inside).ravel()
        place = np.flatnonzero(distance < 1 + reach)
        return EdgeBand(place, distance[place])

    # From the farthest on, so that the nearest have the last word. (What is not written to of
    # zeros takes no time.)
    width = W + 2 * margin
    small = np.max(squares) < np.iinfo(np.uint16).max
    seen = np.zeros((H + 2 * margin) * width, np.uint16 if small else np.int32)
    row, column = np.divmod(edge, W)
    start = row * width + column
    found = []
    for k in disc[np.argsort(-squares[disc], kind="stable")]:
        at = start + int(k // len(steps) * width + k % len(steps))
        found.append(at[seen[at] == 0])
        seen[at] = squares[k] + 1
    place = np.sort(np.concatenate(found))
    distance = np.sqrt(seen[place] - 1.0)
    row, column = np.divmod(place, width)
    row, column = row - margin, column - margin
    good = (row >= 0) & (row < H) & (column >= 0) & (column < W)
    return EdgeBand((row * W + column)[good], distance[good])


def near_weights(
    inside: np.ndarray, weights: np.ndarray, window: Window, reach: float
) -> NearWeights:
    """Return the weights of pixels near the edge of a mask, which lies in a window.

    Less the farther they are from it: none `reach` + 1 (px) away.
    """
    some, (H, W) = edge_band(window.crop(inside), reach), inside.shape
    row, column = np.divmod(some.place, window.W)
    row, column = row + H - window.bottom - window.H, column + window.left
    value = weights[row, column] * near_an_edge(some.distance, reach)
    return NearWeights((H, W), row * W + column, value)
