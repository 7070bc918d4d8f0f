"""Label pictures: some values, each on a flat area, where a mask has two levels and soft edges."""

from collections import Counter

import numpy as np

from .._files.pictures import BAND, rows

#: Pixels are flat where all that touch them are alike. A value is a level if it has at least this
#: many of them, and they are this share of its pixels: values of edges and noise have fewer.
FLAT_PX, FLAT_SHARE = 4, 0.25
#: This many values are a few. Of more, a level covers this share of all but the background: soft
#: edges that were enlarged without smoothing have flat pixels, too.
FEW, AREA = 16, 5e-3
#: Edges are soft where this share of the pixels beside another value is of no level.
SOFT = 0.1
#: Where some pixels do not count, labels are all that the others show, up to this share.
OTHERS = 0.01
#: Levels of a picture with soft edges differ by more than this share of the largest value.
NOISE = 8 / 255
#: The dark level of a mask is at most this share of its light one, which is at least that of its
#: largest value.
DARK, LIGHT = 0.1, 0.9
#: A part of a picture that has more values holds no labels.
MOST_VALUES = 4096


def labels_in(numbers: np.ndarray, seen: np.ndarray | None = None) -> np.ndarray:
    """Return the labels among a picture's numbers (H, W), in order; none where it may be a mask.

    A mask has two levels, dark and light; noise and soft edges may lie between them. More levels
    are labels, and so are two that are both light, or not its largest value.

    - `seen`: the pixels that count, True; None: all.
    """
    counts = _counted(numbers, seen)
    if counts is None:
        return numbers[:0, 0]
    values, pixels, flat = counts
    is_few, total = len(values) <= FEW, np.sum(pixels)
    least = FLAT_PX if is_few else max(FLAT_PX, AREA * (np.sum(flat) - np.max(flat)))
    is_level = (flat >= least) & (flat >= FLAT_SHARE * pixels)
    levels, others = values[is_level], total - np.sum(pixels[is_level])
    if len(levels) < 2 or (seen is not None and others > OTHERS * total):
        return levels[:0]
    most = values[-1].astype(float)
    if not is_few and others > SOFT * (total - np.sum(flat)):
        levels = levels[[*np.flatnonzero(np.diff(levels) > NOISE * most), -1]]
        return levels if len(levels) > 2 else levels[:0]
    is_mask = levels[0] <= DARK * levels[1] and levels[1] >= LIGHT * most
    return levels[:0] if len(levels) == 2 and is_mask else levels


def value_counts(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an array's values in order, and how many times it has each."""
    if numbers.dtype != np.uint8:
        return np.unique(numbers, return_counts=True)
    flat = numbers.ravel()
    parts = (flat[k : k + BAND] for k in range(0, len(flat), BAND))
    counts = sum((np.bincount(part, minlength=256) for part in parts), np.zeros(256, int))
    values = np.flatnonzero(counts)
    return values.astype(np.uint8), counts[values]


def _counted(numbers: np.ndarray, seen: np.ndarray | None) -> tuple[np.ndarray, ...] | None:
    """Return the values in order, how many pixels each has, and how many flat ones, all but those
    of the border; None where there are too many."""
    from scipy.ndimage import maximum_filter, minimum_filter

    pixels, flat_pixels = Counter[float](), Counter[float]()
    H, W = numbers.shape
    for part in rows(H - 2, W):  # of the pixels within the border
        here = numbers[part.start : part.stop + 2]
        flat = (minimum_filter(here, 3) == maximum_filter(here, 3))[1:-1, 1:-1]
        here = here[1:-1, 1:-1]
        if seen is not None:
            shown = seen[1:-1, 1:-1][part]
            here, flat = here[shown], flat[shown]
        for total, some in ((pixels, here), (flat_pixels, here[flat])):
            values, counts = value_counts(some)
            if len(values) > MOST_VALUES:
                return None
            total.update(dict(zip(values.tolist(), counts.tolist(), strict=True)))
    order = sorted(pixels)
    counts = (np.array([total[value] for value in order]) for total in (pixels, flat_pixels))
    return np.array(order, numbers.dtype), *counts
