"""Rotations as quaternions and rotation vectors: scipy's."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


def rotations() -> "type[Rotation]":
    """Return scipy's class of rotations, loaded late: the import takes a fifth of a second."""
    from scipy.spatial.transform import Rotation

    return Rotation


def is_unit(q: np.ndarray) -> bool:
    """Tell if a quaternion has length 1, to within a file's rounding."""
    return bool(np.all(np.abs(q) < 2) and abs(np.linalg.norm(q) - 1) <= 1e-4)
