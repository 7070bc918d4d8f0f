"""Label pictures: some values, each on a flat area, where a mask has two levels and soft edges."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from .._files.pictures import Image, rows

#: Pixels are flat where all that touch them are alike. A value is a level if it has at least this
#: many of them, and they are this share of its pixels: values of edges and noise have fewer.
FLAT_PX, FLAT_SHARE = 4, 0.25
#: This many values are a few. Of more, a level covers this share of all but the background: soft
#: edges that were enlarged without smoothing have flat pixels, too.
FEW, AREA = 16, 5e-3
#: Edges are soft where this share of the pixels beside another value is of no level.
SOFT = 0.1
#: Levels of a picture with soft edges differ by more than this share of the largest value.
NOISE = 8 / 255
#: The dark level of a mask is at most this share of its light one, which is at least that of its
#: largest value.
DARK, LIGHT = 0.1, 0.9
#: A part of a picture that has more values holds no labels.
MOST_VALUES = 4096


def labels_in(image: Image, values: Callable[[Image], np.ndarray] = np.asarray) -> np.ndarray:
    """Return the labels that a picture holds, in order; none where it may be a mask.

    A mask has two levels, dark and light; noise and soft edges may lie between them. More levels
    are labels, and so are two that are both light, or not its largest value.

    - `values`: the numbers (H, W) of some rows of the picture.
    """
    try:
        counts = _counted(_with_flat(image, values))
    except OverflowError:
        return np.zeros(0)
    levels = counts.values[_is_level(counts)]
    if len(levels) < 2:
        return levels[:0]
    most = float(counts.values[-1])
    if len(counts.values) > FEW and _is_soft(counts):
        levels = levels[[*np.flatnonzero(np.diff(levels) > NOISE * most), -1]]
        return levels if len(levels) > 2 else levels[:0]
    is_mask = levels[0] <= DARK * levels[1] and levels[1] >= LIGHT * most
    return levels[:0] if len(levels) == 2 and is_mask else levels


class _Counts(NamedTuple):
    """The values of a picture in order, how many pixels and how many flat ones each has, and how
    many pixels are beside another value."""

    values: np.ndarray
    pixels: np.ndarray
    flat: np.ndarray
    edges: int


def _with_flat(
    image: Image, values: Callable[[Image], np.ndarray]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the numbers of some rows at a time, and which of their pixels are flat.

    Pixels of the picture's border are left out.
    """
    W, H = image.size
    for part in rows(H, W):
        top, bottom = max(part.start - 1, 0), min(part.stop + 1, H)
        here = np.asarray(values(image.crop((0, top, W, bottom))))
        same = here[:, 1:] == here[:, :-1]
        same = same[:, 1:] & same[:, :-1]
        below = here[1:, 1:-1] == here[:-1, 1:-1]
        flat = same[1:-1] & same[2:] & same[:-2] & below[1:] & below[:-1]
        yield here[1:-1, 1:-1], flat


def _counted(parts: Iterator[tuple[np.ndarray, np.ndarray]]) -> _Counts:
    """Return the counts of all values; raise OverflowError where there are too many."""
    table: dict[float, np.ndarray] = {}
    edges = 0
    for here, flat in parts:
        for k, some in enumerate((here, here[flat])):
            there, counts = _unique(some)
            if len(there) > MOST_VALUES:
                raise OverflowError
            for value, count in zip(there.tolist(), counts, strict=True):
                table.setdefault(value, np.zeros(2))[k] += count
        edges += flat.size - int(np.count_nonzero(flat))
    order = sorted(table)
    counts = np.array([table[value] for value in order]).reshape(-1, 2)
    return _Counts(np.array(order), counts[:, 0], counts[:, 1], edges)


def _unique(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `np.unique`'s values and counts; of short integers without sorting them."""
    if values.dtype not in (np.uint8, np.uint16):
        return np.unique(values, return_counts=True)
    counts = np.bincount(values.ravel())
    there = np.flatnonzero(counts)
    return there, counts[there]


def _is_level(counts: _Counts) -> np.ndarray:
    least = FLAT_PX
    if len(counts.values) > FEW:
        least = max(least, AREA * (np.sum(counts.flat) - np.max(counts.flat)))
    return (counts.flat >= least) & (counts.flat >= FLAT_SHARE * counts.pixels)


def _is_soft(counts: _Counts) -> bool:
    return bool(np.sum(counts.pixels[~_is_level(counts)]) > SOFT * counts.edges)
