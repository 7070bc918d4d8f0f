"""Rigid transforms in float64: the pose of one frame in another, as a matrix (4, 4).

A camera's own frame is OpenCV's: x right, y down, z forward.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._numerics.arrays import ArrayLike, checked
from .axes import axes_of, skew
from .camera import Camera
from .matrices import ORTHOGONAL, is_rotation

Pose = Float[np.ndarray, "4 4"]


def pose_of(camera: Camera) -> Pose:
    """Return the pose of a camera in its world."""
    right, up, forward = axes_of(camera)
    return rigid(np.stack([right, -up, forward], axis=1), np.asarray(camera.e, float))


def at_pose(camera: Camera, pose: Pose) -> Camera:
    """Return the camera moved rigidly to a pose in its world; u keeps its angle to the axes."""
    right, down, forward = pose[:3, :3].T
    axes = np.stack([right, -down, forward])
    up = (axes_of(camera) @ np.asarray(camera.u, float)) @ axes
    moved = camera.with_pose(pose[:3, 3], axes)
    return eqx.tree_at(lambda c: c.u, moved, jnp.asarray(up, camera.u.dtype))


def rigid(rotation: np.ndarray, translation: np.ndarray) -> Pose:
    """Return the matrix (4, 4) of x -> rotation x + translation."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, translation
    return result


def inverse(pose: Pose) -> Pose:
    """Return the inverse of a rigid transform."""
    back = pose[:3, :3].T
    return rigid(back, -back @ pose[:3, 3])


def moved(pose: Pose, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return points of a frame at `pose` in the world."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def exponential(twist: Float[np.ndarray, "6"]) -> Pose:
    """Return a twist's pose: a rotation vector (rad), then a translation.

    The translation is not the screw's: both are the same to first order.
    """
    from scipy.spatial.transform import Rotation

    return rigid(Rotation.from_rotvec(twist[:3]).as_matrix(), twist[3:])


def adjoint(pose: Pose) -> Float[np.ndarray, "6 6"]:
    """Return the map Ad of twists to the frame that `pose` is in: pose exp(x) = exp(Ad x) pose."""
    rotation = pose[:3, :3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = rotation
    result[3:, :3] = skew(pose[:3, 3]) @ rotation
    return result


def check_pose(name: str, value: ArrayLike) -> Pose:
    """Return a rigid transform, its rotation orthogonal to the last digit; or raise ValueError."""
    matrix = np.asarray(checked(name, value, (4, 4), np.dtype(float)), float)
    rotation, last = matrix[:3, :3], np.abs(matrix[3] - [0, 0, 0, 1])
    if not (is_rotation(rotation.T) and np.max(last) < ORTHOGONAL):
        raise ValueError(f"`{name}`: expected a rotation and a translation, got\n{matrix}")
    left, _, right = np.linalg.svd(rotation)
    return rigid(left @ right, matrix[:3, 3])
