"""OpenCV's K, R and t as the note's parameters: x right, y down, z forward."""

from types import ModuleType
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._numerics.arrays import ArrayLike, float_array, float_dtype, is_concrete

#: The centre of the first pixel: at 0, or at 1/2.
Centres = Literal["integer", "half"]
#: A rotation matrix is orthogonal to this.
ORTHOGONAL = 1e-4

#: An array of NumPy's, or a traced one of JAX's; one number.
Numbers = np.ndarray | Array
Number = np.floating | Numbers


def from_matrices(
    K: ArrayLike, R: ArrayLike, t: ArrayLike, W: int, H: int, pixel_centres: object
) -> tuple[tuple[Numbers, Numbers, Numbers], tuple[Number, Numbers, Number], bool]:
    """Return the pose, the intrinsics, and True for those of a camera without a lens.

    The pose is (e, p, u), the intrinsics are phi (rad), the principal point in film coordinates
    (px) and fx / fy. K and R are (3, 3), t is (3,) or (3, 1). In float64 unless traced: the
    parameters are rounded once. Raises ValueError for matrices that make no camera.
    """
    half = half_pixel(pixel_centres)
    rows = isinstance(t, list) and all(np.ndim(row) == 1 for row in t)
    column = rows or getattr(t, "shape", None) == (3, 1)
    k, r = _real("K", K, (3, 3)), _real("R", R, (3, 3))
    shift = _real("t", t, (3, 1) if column else (3,)).reshape(3)
    if is_concrete(k):
        _check_intrinsics(np.asarray(k), W, H)
    if is_concrete(r) and not is_rotation(r):
        raise ValueError(f"`R`: expected a rotation matrix, got {r.tolist()}")
    traced = not is_concrete(k, r, shift)
    xp: ModuleType = jnp if traced else np

    fx, fy = k[0, 0], k[1, 1]
    centre = xp.stack([k[0, 2] + half, H - (k[1, 2] + half)])  # film coordinates: y up
    aspect = fx / fy
    eye = -r.T @ shift
    centred = not traced and np.allclose(centre, (W / 2, H / 2), rtol=0, atol=1e-9)
    plain = bool(centred and abs(aspect - 1) < 1e-12)
    return (eye, eye + r[2], -r[1]), (2 * xp.arctan(H / (2 * fy)), centre, aspect), plain


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


def _check_intrinsics(K: np.ndarray, W: int, H: int) -> None:
    """Raise ValueError for skew, another last row, or focal lengths that are not positive."""
    if abs(K[0, 1]) > 1e-9 * abs(K[0, 0]):
        raise ValueError(f"`K`: expected no skew, got {K[0, 1]}")
    if K[1, 0] != 0 or np.any(K[2] != [0, 0, 1]):
        raise ValueError(f"`K`: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}")
    for focal, size in ((K[0, 0], W), (K[1, 1], H)):
        angle = 2 * np.arctan2(size, 2 * focal)
        if not (focal > 0 and 0 < np.float32(angle) < np.float32(np.pi)):
            raise ValueError(
                "`K`: expected positive focal lengths in px, with a field of view in (0, pi) rad,"
                f" got fx = {K[0, 0]:g}, fy = {K[1, 1]:g}"
            )
