"""COCO's run lengths of a mask: how data sets of detections and segmentations write one."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import UInt8

from .._numerics.arrays import Input
from .images import MOST_PIXELS


def mask_of_rle(rle: Input[Mapping[str, object], "size, counts"]) -> UInt8[np.ndarray, "H W"]:
    """Return the mask of COCO's run lengths, 255 where the object is.

    - `rle`: `size` [H, W], and `counts`: how many pixels are 0, then 1, then 0, ... down the
      columns from the top left, as numbers or as pycocotools' text.

    Raises ValueError where a field is missing, or the runs do not fill the picture.

    ```python
    pj.io.mask_of_rle({"size": [2, 3], "counts": [2, 4]})  # (2, 3): down the columns, 0 first
    ```
    """
    if not isinstance(rle, dict) or not {"size", "counts"} <= rle.keys():
        raise ValueError("`rle`: expected run lengths with `size` and `counts`")
    size: Any = rle["size"]
    counts: Any = rle["counts"]
    fits = isinstance(size, list) and len(size) == 2 and all(_is_count(n) for n in size)
    if not fits or not 0 < size[0] * size[1] <= MOST_PIXELS:
        raise ValueError(f"`rle`: expected `size` [H, W], got {size!r}")
    if isinstance(counts, str):
        counts = _counts_of_text(counts)
    if not isinstance(counts, list) or not all(_is_count(n) for n in counts):
        raise ValueError("`rle`: expected `counts`, at least 0 each, or their text")
    if sum(counts) != size[0] * size[1]:
        words = f"expected runs of {size[0] * size[1]} pixels, got {sum(counts)}"
        raise ValueError(f"`rle`: {words}")
    values = np.arange(len(counts), dtype=np.uint8) % 2 * 255
    columns = np.repeat(values, counts).reshape(size[1], size[0])
    return np.ascontiguousarray(columns.T)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _counts_of_text(text: str) -> list[int]:
    """Return the numbers of pycocotools' text: five bits a character, lowest first, a sixth where
    more follow; from the fourth on they are differences to the last but one."""
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
