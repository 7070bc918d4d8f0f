"""COCO's run lengths of a mask: how data sets of detections and segmentations write one."""

from collections.abc import Mapping
from reprlib import repr as brief

import numpy as np
from jaxtyping import UInt8

from .._files.fields import Fields
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
        words = f"expected run lengths with `size` and `counts`, got {brief(rle)}"
        hint = "give one of a list; pycocotools makes them of polygons (mask.frPyObjects)"
        raise ValueError(f"`rle`: {words}; {hint}")
    fields, counts = Fields(rle, "`rle`"), rle["counts"]
    size = fields.counts("size", "[H, W]")
    if len(size) != 2 or not 0 < size[0] * size[1] <= MOST_PIXELS:
        raise fields.wrong("size", "[H, W]", size)
    H, W = size
    text = counts.decode("latin-1") if isinstance(counts, bytes) else counts
    if isinstance(text, str):
        fields = Fields({"counts": _counts_of_text(text)}, "`rle`")
    runs = np.array(fields.counts("counts", "whole numbers of at least 0, or pycocotools' text"))
    if np.sum(runs) != H * W:
        raise fields.wrong("counts", f"runs of {H * W} pixels", f"{np.sum(runs)}")
    values = np.arange(len(runs), dtype=np.uint8) % 2 * 255
    return np.ascontiguousarray(np.repeat(values, runs).reshape(W, H).T)


def _counts_of_text(text: str) -> list[int]:
    """Return the numbers of pycocotools' text: five bits a character, lowest first, a sixth if more
    follow. From the fourth number on they are differences to the last but one."""
    counts: list[int] = []
    number, shift = 0, 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64 or shift > 60:  # (longer numbers are of no picture)
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
