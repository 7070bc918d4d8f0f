"""OpenCV's K, R, t: the convention through which all others go."""

import contextlib
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._camera.camera import Camera, check_camera, focal_px, principal_point, resolution
from .._camera.distortion import Distortion
from .._camera.lens import Lens
from .._numerics.arrays import Numbers
from .fields import Fields


def from_opencv(
    K: Numbers,
    R: Numbers,
    t: Numbers,
    W: Any,
    H: Any,
    *,
    pixel_centres: Any,
    d: float = 1.0,
    distortion: Distortion | None = None,
) -> Camera:
    """Return the camera of OpenCV's K (3, 3), R (3, 3), t (3,): x right, y down, z forward.

    `X_camera = R X_world + t` and `(u, v, 1) ~ K X_camera`. `pixel_centres` says where the source
    puts them: "integer" (OpenCV, M3T: the first pixel's centre is 0) or "half" (COLMAP, NeRF: 0.5).
    It costs half a pixel to get it wrong, so it has no default. Skew must be 0.

    `distortion` is the lens's (`BrownConrady(*distCoeffs)`, `Fisheye`). The view point is put at
    unit distance, up along the image's columns.

    Raises ValueError naming the argument where one has another shape, is not finite, or makes no
    camera: R no rotation, focal lengths not positive, K with skew or another last row.
    """
    half = half_pixel(pixel_centres)
    W, H = resolution("W", W), resolution("H", H)
    with contextlib.suppress(ValueError):  # what is ragged has no shape
        t = np.ravel(t) if np.shape(t) == (3, 1) else t
    fields = Fields({"K": K, "R": R, "t": t}, "the arguments")
    K, R, t = (fields.array(x, shape) for x, shape in (("K", (3, 3)), ("R", (3, 3)), ("t", (3,))))
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-4 or np.linalg.det(R) < 0:
        raise fields.wrong("R", "a rotation matrix", R)
    if abs(K[0, 1]) > 1e-9 * abs(K[0, 0]):
        raise fields.wrong("K", "no skew", f"{K[0, 1]}")
    if K[1, 0] != 0 or np.any(K[2] != [0, 0, 1]):
        raise fields.wrong("K", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", K)
    fx, fy = K[0, 0], K[1, 1]
    for focal, size in ((fx, W), (fy, H)):
        angle = 2 * np.arctan2(size, 2 * focal)
        if not (focal > 0 and 0 < np.float32(angle) < np.float32(np.pi)):
            expected = "positive focal lengths in px, with a field of view in (0, pi) rad"
            raise fields.wrong("K", expected, f"fx = {fx:g}, fy = {fy:g}")
    centre = (K[0, 2] + half, H - (K[1, 2] + half))  # film coordinates: y up
    eye = -R.T @ t
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


def to_opencv(camera: Camera, *, pixel_centres: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return OpenCV's matrices in float64: x right, y down, z forward.

    - K (3, 3): `(u, v, 1) ~ K X_camera`, px, y down.
    - R (3, 3) and t (3,): `X_camera = R X_world + t`.

    `pixel_centres` says where the reader puts them: "integer" (OpenCV: the first pixel's centre is
    0) or "half" (0.5). A lens's distortion is not in them: `camera.lens.distortion` goes beside.
    """
    check_camera(camera)
    half = half_pixel(pixel_centres)
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


def half_pixel(pixel_centres: Any) -> float:
    """Return what is added to pixel coordinates to count from the first pixel's corner."""
    if not isinstance(pixel_centres, str) or pixel_centres not in ("integer", "half"):
        raise ValueError(f"`pixel_centres`: expected 'integer' or 'half', got {pixel_centres!r}")
    return 0.5 if pixel_centres == "integer" else 0.0
