"""A camera's axes in float64, without a compiled program."""

import numpy as np

from .camera import Camera


def axes_of(camera: Camera) -> np.ndarray:
    """Return the camera's axes as rows (3, 3) in float64, without a compiled program."""
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    v = (p - e) / np.linalg.norm(p - e)
    b1 = np.cross(v, u)
    b1 /= np.linalg.norm(b1)
    return np.stack([b1, np.cross(b1, v), v])


def angle(a: Camera, b: Camera) -> float:
    """Return the angle between two cameras' orientations (rad)."""
    chord = np.linalg.norm(axes_of(a) - axes_of(b)) / 8**0.5
    return float(2 * np.arcsin(min(chord, 1)))
