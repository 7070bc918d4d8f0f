"""Crumbs and pinholes, which networks and thresholds leave in masks: removed and reported."""

from typing import Any, NamedTuple

import numpy as np

from .._files.pictures import rows
from .._mask.target import as_coverage, check_image
from .._numerics.arrays import ArrayLike, Input

#: Parts and holes smaller than this share of the largest part are noise.
SPECK = 5e-3
#: Pixels that meet at a corner are of one part: thin parts of an object hang on so.
CORNERS = np.ones((3, 3))
#: Soft edges of dropped islands and filled holes reach this far (px).
SOFT_PX = 2


class TidyMask(NamedTuple):
    """A mask (H, W), and sentences on what was changed and what else there is to know about it.

    ```python
    tidied.mask, tidied.notes
    ```
    """

    mask: np.ndarray
    notes: tuple[str, ...]


def tidy_mask(mask: Input[ArrayLike, "H W"], speck: float = SPECK) -> TidyMask:
    """Return a mask without crumbs and pinholes, and sentences on what was done and found.

    - `mask`: (H, W), as `fit_camera` takes it. A pixel that is half covered or more is inside.
    - `speck`: islands smaller than this share of the largest part are dropped, and smaller holes
      filled, both with their soft edges; 0 changes nothing.

    The mask comes back as bool, uint8 or floats. Left as they are, but noted: several large parts,
    edges of the film that cut the mask off, a mask that covers all or nothing.

    Raises ValueError for what is no mask, and for a share outside [0, 1).

    ```python
    tidied = pj.io.tidy_mask(mask > 0.5)
    ```
    """
    if not 0 <= speck < 1:
        raise ValueError(f"`speck`: expected a share of the object, 0 <= speck < 1, got {speck}")
    array = check_image("mask", mask)
    inside = as_coverage(array) >= 0.5
    if np.all(inside) or not np.any(inside):
        return TidyMask(array, ("the mask covers " + ("all" if np.any(inside) else "nothing"),))
    body = inside.copy()
    kept, *small = drop_specks(body, speck)
    result = array.copy()
    result[_with_soft_edge(inside & ~body, body)] = 0
    result[_with_soft_edge(body & ~inside, ~body)] = 255 if array.dtype == np.uint8 else 1
    notes = [
        f"{len(sizes)} {what}{'s'[: len(sizes) > 1]} of at most {sizes.max()} px {done}"
        for sizes, what, done in zip(small, ("island", "hole"), ("dropped", "filled"), strict=True)
        if len(sizes)
    ]
    return TidyMask(result, (*notes, *_oddities(kept, body)))


def drop_specks(inside: np.ndarray, speck: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drop small islands from the pixels (H, W) of a mask and fill small holes, in place; return
    the sizes (px) of the islands that stay, of those dropped, and of the holes filled."""
    sizes, is_small = _drop_small(inside, speck)
    np.logical_not(inside, out=inside)
    holes, is_pinhole = _drop_small(inside, speck, int(sizes.max(initial=0)))
    np.logical_not(inside, out=inside)
    return sizes[~is_small], sizes[is_small], holes[is_pinhole]


def _drop_small(
    inside: np.ndarray, speck: float, island: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Drop parts smaller than this share of the largest, in place; return the sizes of all parts,
    and which were dropped. `island`: they are holes, smaller than this share of it, and those that
    are open to the border stay."""
    from scipy import ndimage

    found: Any = ndimage.label(inside, CORNERS)
    labels, count = found
    sizes = np.zeros(count + 1, np.int64)
    for part in rows(*inside.shape):  # a large mask's numbers are eight times as large as it
        here = np.bincount(labels[part].ravel())
        sizes[: len(here)] += here
    is_small = sizes < speck * (sizes[1:].max(initial=0) if island is None else island)
    if island is not None:
        for side in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
            is_small[side] = False
    for part in rows(*inside.shape):
        inside[part] &= ~is_small[labels[part]]
    return sizes[1:], is_small[1:]


def _with_soft_edge(taken: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return some pixels and those beside them, but for those beside others."""
    from scipy.ndimage import binary_dilation

    if not np.any(taken):
        return taken
    near, apart = (
        np.asarray(binary_dilation(x, iterations=SOFT_PX), bool) for x in (taken, others)
    )
    return taken | (near & ~apart)


def _oddities(sizes: np.ndarray, inside: np.ndarray) -> list[str]:
    """Return notes on a mask that fits accept, but that a user may not have meant."""
    notes = []
    if len(sizes) > 1:
        largest = np.sort(sizes)[::-1] / np.sum(sizes)
        shares = ", ".join(f"{x:.0%}" for x in largest[:3])
        notes.append(f"{len(sizes)} parts ({shares} of the covered area): all one object?")
    sides = {"top": inside[0], "bottom": inside[-1], "left": inside[:, 0], "right": inside[:, -1]}
    if cut := [name for name, side in sides.items() if np.any(side)]:
        notes.append(f"the film cuts the mask off: {', '.join(cut)}")
    return notes
