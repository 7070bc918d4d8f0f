"""OpenCV's K, R and t as the note's parameters: x right, y down, z forward."""

from types import ModuleType
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._numerics.arrays import ArrayLike, float_array, float_dtype, is_concrete

#: Where a pixel's centre lies: its first one's at 0, or at 1/2.
Centres = Literal["integer", "half"]
#: A matrix is a rotation if it is orthogonal to this.
ORTHOGONAL = 1e-4


class FromMatrices(NamedTuple):
    """What matrices say of a camera: eye, view point and up (3,), the vertical field of view (rad),
    the principal point in film coordinates (px), fx / fy, and whether the last two are those of a
    camera without a lens."""

    e: Any
    p: Any
    u: Any
    phi: Any
    principal_point: Any
    aspect: Any
    plain: bool


def from_matrices(
    K: ArrayLike, R: ArrayLike, t: ArrayLike, W: int, H: int, pixel_centres: object
) -> FromMatrices:
    """Return what K (3, 3), R (3, 3) and t (3,) or (3, 1) say, or raise ValueError.

    In float64, where nothing is traced: the parameters are rounded once.
    """
    half = half_pixel(pixel_centres)
    k, r, shift = _real("K", K, (3, 3)), _real("R", R, (3, 3)), _translation(t)
    if is_concrete(k):
        _check_intrinsics(k, W, H)
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
    return FromMatrices(eye, eye + r[2], -r[1], 2 * xp.arctan(H / (2 * fy)), centre, aspect, plain)


def half_pixel(pixel_centres: object) -> float:
    """Return what is added to pixel coordinates to count from the first pixel's corner."""
    if not isinstance(pixel_centres, str) or pixel_centres not in ("integer", "half"):
        raise ValueError(f"`pixel_centres`: expected 'integer' or 'half', got {pixel_centres!r}")
    return 0.5 if pixel_centres == "integer" else 0.0


def is_rotation(matrix: np.ndarray) -> bool:
    """Return whether a matrix (3, 3) turns and does nothing else, to within rounding."""
    apart = np.abs(matrix @ matrix.T - np.eye(3)).max()
    return bool(apart < ORTHOGONAL and np.linalg.det(matrix) > 0)


def _translation(t: ArrayLike) -> Any:
    """Return a translation (3,), of a column (3, 1), too."""
    column = getattr(t, "shape", None) == (3, 1) or (isinstance(t, list) and _is_column(t))
    return _real("t", t, (3, 1))[:, 0] if column else _real("t", t, (3,))


def _is_column(t: list) -> bool:
    return len(t) == 3 and all(isinstance(row, list | tuple) and len(row) == 1 for row in t)


def _real(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Any:
    """Return finite numbers of this shape, in float64 where they are not traced; or raise."""
    array = float_array(name, value, shape, float_dtype(value))
    return np.asarray(value, float) if is_concrete(array) else array


def _check_intrinsics(K: np.ndarray, W: int, H: int) -> None:
    """Raise ValueError unless K is that of a pinhole without skew."""
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
