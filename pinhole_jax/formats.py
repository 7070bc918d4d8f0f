"""Cameras of other conventions."""

import jax.numpy as jnp
import numpy as np

from ._arrays import Numbers
from ._camera import Camera
from ._lens import Lens


def from_opencv(
    K: Numbers,
    R: Numbers,
    t: Numbers,
    W: int,
    H: int,
    *,
    pixel_centres: str,
    d: float = 1.0,
) -> Camera:
    """Return the camera of OpenCV's K (3, 3), R (3, 3), t (3,): x right, y down, z forward.

    `X_camera = R X_world + t` and `(u, v, 1) ~ K X_camera`. `pixel_centres` says where the source
    puts them: "integer" (OpenCV, M3T: the first pixel's centre is 0) or "half" (COLMAP, NeRF: 0.5).
    It costs half a pixel to get it wrong, so it has no default. Skew must be 0.

    The view point is put at unit distance, up along the image's columns.
    """
    K, R, t = (np.asarray(x, float) for x in (K, R, t))
    for name, array, shape in (("K", K, (3, 3)), ("R", R, (3, 3)), ("t", t.reshape(-1), (3,))):
        if array.shape != shape or not np.all(np.isfinite(array)):
            raise ValueError(f"`{name}`: expected finite numbers of shape {shape}, got {array}")
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-4 or np.linalg.det(R) < 0:
        raise ValueError(f"`R`: expected a rotation matrix, got {R.tolist()}")
    if pixel_centres not in ("integer", "half"):
        raise ValueError(f"`pixel_centres`: expected 'integer' or 'half', got {pixel_centres!r}")
    if abs(K[0, 1]) > 1e-9 * abs(K[0, 0]):
        raise ValueError(f"`K`: expected no skew, got {K[0, 1]}")
    half = 0.5 if pixel_centres == "integer" else 0.0
    fx, fy = K[0, 0], K[1, 1]
    centre = (K[0, 2] + half, H - (K[1, 2] + half))  # film coordinates: y up
    eye = -R.T @ t.reshape(3)
    centred = np.allclose(centre, (W / 2, H / 2), rtol=0, atol=1e-9) and abs(fx / fy - 1) < 1e-12
    return Camera(
        eye,
        eye + R[2],
        -R[1],
        2 * np.arctan(H / (2 * fy)),
        d,
        W,
        H,
        None if centred else Lens(jnp.asarray(centre), float(fx / fy)),
    )
