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
    H, W = np.shape(mask) if np.ndim(mask) == 2 else (0, 0)
    array = check_image("mask", mask, W, H)
    inside = as_coverage(array) >= 0.5
    if np.all(inside) or not np.any(inside):
        return TidyMask(array, ("the mask covers " + ("all" if np.any(inside) else "nothing"),))

    labels, sizes = parts(inside, CORNERS)
    least = speck * np.max(sizes)
    is_crumb = (sizes > 0) & (sizes < least)
    body = inside & ~is_crumb[labels]

    gaps, areas = parts(~body, CORNERS)
    frame = np.concatenate([gaps[0], gaps[-1], gaps[:, 0], gaps[:, -1]])
    is_pinhole = (areas > 0) & (areas < least)
    is_pinhole[frame] = False
    pinholes = is_pinhole[gaps]

    result = array.copy()
    result[_with_soft_edge(is_crumb[labels], body)] = 0
    result[_with_soft_edge(pinholes, ~body & ~pinholes)] = 255 if array.dtype == np.uint8 else 1
    notes = [
        *_changed("island", sizes[is_crumb], "dropped"),
        *_changed("hole", areas[is_pinhole], "filled"),
        *_found(sizes[(sizes > 0) & ~is_crumb], body | pinholes),
    ]
    return TidyMask(result, tuple(notes))


def parts(
    inside: np.ndarray, neighbours: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of each pixel's part (H, W), 0 outside, and the parts' sizes, 0 for 0.

    `neighbours` (3, 3): which pixels hang together (None: those that share a side).
    """
    from scipy import ndimage

    found: Any = ndimage.label(inside, neighbours)
    labels, count = found
    sizes = np.zeros(count + 1, np.int64)
    for part in rows(*inside.shape):  # a large mask's numbers are eight times as large as it
        here = np.bincount(labels[part].ravel())
        sizes[: len(here)] += here
    sizes[0] = 0
    return labels, sizes


def _with_soft_edge(taken: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return some pixels and those beside them, but for those beside others."""
    from scipy.ndimage import binary_dilation

    if not np.any(taken):
        return taken
    near, apart = (
        np.asarray(binary_dilation(x, iterations=SOFT_PX), bool) for x in (taken, others)
    )
    return taken | (near & ~apart)


def _changed(what: str, sizes: np.ndarray, done: str) -> list[str]:
    if not len(sizes):
        return []
    return [f"{len(sizes)} {what}{'s'[: len(sizes) > 1]} of at most {sizes.max()} px {done}"]


def _found(sizes: np.ndarray, inside: np.ndarray) -> list[str]:
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
