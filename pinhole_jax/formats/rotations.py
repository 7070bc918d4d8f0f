"""Rotations as quaternions and rotation vectors: scipy's."""

from typing import TYPE_CHECKING

import numpy as np

from .fields import Fields

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


def rotations() -> "type[Rotation]":
    """Return scipy's class of rotations, loaded late: the import takes a fifth of a second."""
    from scipy.spatial.transform import Rotation

    return Rotation


def rotation_from_quaternion(quaternion: np.ndarray, fields: Fields, name: str) -> np.ndarray:
    """Return the rotation (3, 3) of a quaternion (x, y, z, w), of length 1 up to rounding."""
    if np.any(np.abs(quaternion) > 2) or abs(np.linalg.norm(quaternion) - 1) > 1e-4:
        raise fields.wrong(name, "a quaternion of length 1", quaternion)
    return rotations().from_quat(quaternion).as_matrix()
