"""OpenCV's K, R, t: the convention through which all others go."""

import jax.numpy as jnp
import numpy as np

from .._arrays import Numbers
from .._camera import Camera, focal_px, principal_point
from .._distortion import Distortion
from .._lens import Lens


def from_opencv(
    K: Numbers,
    R: Numbers,
    t: Numbers,
    W: int,
    H: int,
    *,
    pixel_centres: str,
    d: float = 1.0,
    distortion: Distortion | None = None,
) -> Camera:
    """Return the camera of OpenCV's K (3, 3), R (3, 3), t (3,): x right, y down, z forward.

    `X_camera = R X_world + t` and `(u, v, 1) ~ K X_camera`. `pixel_centres` says where the source
    puts them: "integer" (OpenCV, M3T: the first pixel's centre is 0) or "half" (COLMAP, NeRF: 0.5).
    It costs half a pixel to get it wrong, so it has no default. Skew must be 0.

    `distortion` is the lens's (`BrownConrady(*distCoeffs)`, `Fisheye`). The view point is put at
    unit distance, up along the image's columns.
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
    plain = centred and distortion is None
    return Camera(
        eye,
        eye + R[2],
        -R[1],
        2 * np.arctan(H / (2 * fy)),
        d,
        W,
        H,
        None if plain else Lens(jnp.asarray(centre), float(fx / fy), distortion),
    )


def to_opencv(camera: Camera, *, pixel_centres: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return OpenCV's K (3, 3), R (3, 3), t (3,), float64: x right, y down, z forward.

    `X_camera = R X_world + t` and `(u, v, 1) ~ K X_camera`, px, y down. `pixel_centres` says where
    the reader puts them: "integer" (OpenCV: the first pixel's centre is 0) or "half" (0.5). A
    lens's distortion is not in them: `camera.lens.distortion` goes beside.
    """
    if pixel_centres not in ("integer", "half"):
        raise ValueError(f"`pixel_centres`: expected 'integer' or 'half', got {pixel_centres!r}")
    half = 0.5 if pixel_centres == "integer" else 0.0
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    # In float64 whatever the camera's type: R is to be a rotation.
    v = (p - e) / np.linalg.norm(p - e)
    right = np.cross(v, u / np.linalg.norm(u))
    right /= np.linalg.norm(right)
    R = np.stack([right, -np.cross(right, v), v])
    fx, fy = (float(f) for f in focal_px(camera))
    x, y = (float(c) for c in principal_point(camera))  # film coordinates: y up
    K = np.array([[fx, 0, x - half], [0, fy, camera.H - y - half], [0, 0, 1]])
    return K, R, -R @ e
