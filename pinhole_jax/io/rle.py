"""COCO's run lengths of a mask: how data sets of detections and segmentations write one."""

from collections.abc import Mapping
from reprlib import repr as brief
from typing import Any

import numpy as np
from jaxtyping import UInt8

from .._numerics.arrays import Input
from .images import MOST_PIXELS


def mask_of_rle(rle: Input[Mapping[str, object], "size, counts"]) -> UInt8[np.ndarray, "H W"]:
    """Return the mask of COCO's run lengths, 255 where the object is.

    - `rle`: `size` (H, W), and `counts`: how many pixels are 0, then 1, then 0, ... down the
      columns from the top left, as numbers or as pycocotools' text or bytes.

    Raises ValueError where a field is missing, for polygons, and where the runs do not fill the
    picture.

    ```python
    pj.io.mask_of_rle({"size": [2, 3], "counts": [2, 4]})  # (2, 3): down the columns, 0 first
    ```
    """
    if not isinstance(rle, Mapping) or not {"size", "counts"} <= rle.keys():
        raise ValueError(f"`rle`: expected run lengths with `size` and `counts`, got {_seen(rle)}")
    size = _counts(rle["size"])
    if size is None or len(size) != 2 or not 0 < size[0] * size[1] <= MOST_PIXELS:
        raise ValueError(f"`rle`: expected `size` [H, W], got {brief(rle['size'])}")
    H, W = size
    counts: Any = rle["counts"]
    if isinstance(counts, bytes):
        counts = counts.decode("latin-1")
    counts = _counts_of_text(counts) if isinstance(counts, str) else counts
    runs = _counts(counts)
    if runs is None:
        words = "expected `counts`, whole numbers of at least 0, or pycocotools' text or bytes"
        raise ValueError(f"`rle`: {words}, got {brief(counts)}")
    if sum(runs) != H * W:
        raise ValueError(f"`rle`: expected runs of {H * W} pixels, got {sum(runs)}")
    values = np.arange(len(runs), dtype=np.uint8) % 2 * 255
    return np.ascontiguousarray(np.repeat(values, runs).reshape(W, H).T)


def _seen(rle: Any) -> str:
    """Return the words for what is no run lengths, and what to do with it."""
    if not isinstance(rle, list | tuple | np.ndarray) or getattr(rle, "ndim", 1) == 0:
        return brief(rle)
    if len(rle) == 0:
        return "nothing in a list: no mask"
    if isinstance(rle, np.ndarray) and rle.dtype in (bool, np.uint8) and rle.ndim > 1:
        return f"an array of shape {rle.shape}: a mask already?"
    if all(isinstance(part, Mapping) for part in rle):
        return f"a list of {len(rle)} mask{'s' * (len(rle) > 1)}: give one of them, such as rle[0]"
    if not all(
        isinstance(part, list | tuple | np.ndarray | int | float | np.number) for part in rle
    ):
        return brief(rle)
    words = "polygons; pycocotools makes run lengths of them"
    return f"{words}: mask.merge(mask.frPyObjects(polygons, H, W)), each a list [x, y, x, y, ...]"


def _counts(values: Any) -> list[int] | None:
    """Return whole numbers of at least 0 as Python's, None for what is none."""
    if isinstance(values, np.ndarray):
        values = values.tolist()
    if not isinstance(values, list | tuple):
        return None
    is_whole = lambda x: isinstance(x, int | np.integer) and not isinstance(x, bool) and x >= 0
    return [int(x) for x in values] if all(map(is_whole, values)) else None


def _counts_of_text(text: str) -> list[int]:
    """Return the numbers of pycocotools' text: five bits a character, lowest first, a sixth if more
    follow. From the fourth number on they are differences to the last but one."""
    counts: list[int] = []
    number, shift = 0, 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64:
            raise ValueError(f"`rle`: expected pycocotools' text, got {character!r} in it")
        number |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:  # a negative one
            number -= 1 << shift
        counts.append(number + (counts[-2] if len(counts) > 2 else 0))
        number, shift = 0, 0
    return counts
