"""Rotations as quaternions (w, x, y, z) and as rotation vectors (axis times angle in rad).

Twenty lines, for scipy's would cost every import of the library a fifth of a second.
"""

import numpy as np


def is_unit(q: np.ndarray) -> bool:
    """Return whether a quaternion has length 1, to within a file's rounding."""
    return bool(np.all(np.abs(q) < 2) and abs(np.linalg.norm(q) - 1) <= 1e-4)


def matrix_of_quaternion(q: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a quaternion, which is brought to length 1."""
    w, x, y, z = q / np.linalg.norm(q)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross)


def quaternion_of_matrix(R: np.ndarray) -> np.ndarray:
    """Return the quaternion of a rotation matrix, w >= 0: an eigenvector (Bar-Itzhack, 2000)."""
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    form = np.zeros((4, 4))
    form[0, 0], form[0, 1:], form[1:, 0] = np.trace(R), skew, skew
    form[1:, 1:] = R + R.T - np.trace(R) * np.eye(3)
    q = np.linalg.eigh(form)[1][:, -1]
    return q if q[0] >= 0 else -q


def matrix_of_vector(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix of a rotation vector (Rodrigues)."""
    half = np.linalg.norm(vector) / 2
    # sin(half)/half is numpy's sinc, 1 for no rotation at all.
    return matrix_of_quaternion(np.r_[np.cos(half), np.sinc(half / np.pi) * vector / 2])


def vector_of_matrix(R: np.ndarray) -> np.ndarray:
    """Return the rotation vector of a rotation matrix, its angle at most pi."""
    w, *xyz = quaternion_of_matrix(R)
    sine = np.linalg.norm(xyz)
    return 2 * np.arctan2(sine, w) * np.asarray(xyz) / (sine if sine > 0 else 1.0)
