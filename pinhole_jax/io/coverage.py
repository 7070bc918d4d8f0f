"""A mask of any type as coverage."""

import numpy as np
from jaxtyping import Float

from .._mask.target import as_coverage as unclipped, check_image
from .._numerics.arrays import ArrayLike, Input


def as_coverage(mask: Input[ArrayLike, "H W"]) -> Float[np.ndarray, "H W"]:
    """Return a mask as fits read it: float64 in [0, 1], where 255 of uint8, and True, are 1.

    Raises ValueError unless it is (H, W), of bools, uint8 or floats, or of integers that are all 0
    or 1 (or 255, or 65535).

    ```python
    coverage = pj.io.as_coverage(np.uint8(255 * mask))  # the masks of `load_mask`, too
    ```
    """
    return unclipped(check_image("mask", mask)).clip(0, 1)
