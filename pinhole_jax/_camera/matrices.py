"""OpenCV's K, R and t as the note's parameters: x right, y down, z forward."""

from typing import Literal

import numpy as np
from jaxtyping import Array

from .._numerics.arrays import ArrayLike, float_array, float_dtype, is_concrete

#: The centre of the first pixel: at 0, or at 1/2.
Centres = Literal["integer", "half"]
#: A rotation matrix is orthogonal to this.
ORTHOGONAL = 1e-4

#: An array of NumPy's, or a traced one of JAX's.
Numbers = np.ndarray | Array


def as_intrinsics(K: ArrayLike, W: int, H: int) -> Numbers:
    """Return K (3, 3), in float64 unless traced.

    Raises ValueError for skew, another last row, or focal lengths that are not positive.
    """
    k = _real("K", K, (3, 3))
    if not is_concrete(k):
        return k
    if abs(k[0, 1]) > 1e-9 * abs(k[0, 0]):
        raise ValueError(f"`K`: expected no skew, got {k[0, 1]}")
    if k[1, 0] != 0 or np.any(k[2] != np.array([0, 0, 1])):
        raise ValueError(f"`K`: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {k.tolist()}")
    for focal, size in ((k[0, 0], W), (k[1, 1], H)):
        angle = 2 * np.arctan2(size, 2 * focal)
        if not (focal > 0 and 0 < np.float32(angle) < np.float32(np.pi)):
            raise ValueError(
                "`K`: expected positive focal lengths in px, with a field of view in (0, pi) rad,"
                f" got fx = {k[0, 0]:g}, fy = {k[1, 1]:g}"
            )
    return k


def as_rigid(R: ArrayLike, t: ArrayLike) -> tuple[Numbers, Numbers]:
    """Return R (3, 3) and t (3,), which may be a column, in float64 unless traced.

    Raises ValueError unless R is a rotation.
    """
    rows = isinstance(t, list) and all(np.ndim(row) == 1 for row in t)
    column = rows or getattr(t, "shape", None) == (3, 1)
    r, shift = _real("R", R, (3, 3)), _real("t", t, (3, 1) if column else (3,))
    if is_concrete(r) and not is_rotation(r):
        raise ValueError(f"`R`: expected a rotation matrix, got {r.tolist()}")
    return r, shift.reshape(3)


def half_pixel(pixel_centres: object) -> float:
    """Return the first pixel's centre less its place in the source (px)."""
    if not isinstance(pixel_centres, str) or pixel_centres not in ("integer", "half"):
        raise ValueError(f"`pixel_centres`: expected 'integer' or 'half', got {pixel_centres!r}")
    return 0.5 if pixel_centres == "integer" else 0.0


def is_rotation(matrix: Numbers) -> bool:
    """Return True for a rotation matrix (3, 3), to within rounding."""
    matrix = np.asarray(matrix)
    apart = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(apart < ORTHOGONAL and np.linalg.det(matrix) > 0)


def _real(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Numbers:
    """Return finite numbers of this shape, in float64 unless traced; or raise ValueError."""
    array = float_array(name, value, shape, float_dtype(value))
    return np.asarray(value, float) if is_concrete(array) else array
