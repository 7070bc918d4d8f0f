"""A camera's axes in float64, without a compiled program."""

import numpy as np

from .camera import Camera


def axes_of(camera: Camera) -> np.ndarray:
    """Return the camera's axes as rows (3, 3) in float64, without a compiled program."""
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    v = (p - e) / np.linalg.norm(p - e)
    b1 = _cross(v, u)
    b1 /= np.linalg.norm(b1)
    return np.array([b1, _cross(b1, v), v])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product of two vectors (3,). (A fit asks a hundred times; NumPy's takes
    fifty times as long, for all that it has to tell apart.)"""
    (a0, a1, a2), (b0, b1, b2) = a, b
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def angle(a: Camera, b: Camera) -> float:
    """Return the angle between two cameras' orientations (rad)."""
    chord = np.linalg.norm(axes_of(a) - axes_of(b)) / 8**0.5
    return float(2 * np.arcsin(min(chord, 1)))
