"""The photo that a mask was made of."""

import numpy as np

from .. import io
from .._files.naming import named


def photo_beside(path: str, mask: np.ndarray, option: str) -> np.ndarray:
    """Return the picture of a file that an option names, or raise ValueError if it has not the
    mask's size."""
    with named(path=option):
        picture = io.load_image(path)
    if picture.shape[:2] != mask.shape:
        (h, w), (H, W) = picture.shape[:2], mask.shape
        raise ValueError(f"`{option}`: expected the mask's size {W} x {H}, got {w} x {h} ({path})")
    return picture
