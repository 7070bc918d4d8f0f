"""OpenCV's K, R, t: the convention through which all others go."""

import numpy as np

from .._camera.camera import Camera, check_camera, focal_px, principal_point
from .._camera.distortion import Distortion
from .._camera.matrices import Centres, half_pixel
from .._numerics.arrays import ArrayLike, Input


def from_opencv(
    K: Input[ArrayLike, "3 3"],
    R: Input[ArrayLike, "3 3"],
    t: Input[ArrayLike, "3"],
    W: Input[int, "px"],
    H: Input[int, "px"],
    *,
    pixel_centres: Input[Centres, "of K"],
    d: float = 1.0,
    distortion: Distortion | None = None,
) -> Camera:
    """Return the camera of OpenCV's K (3, 3) in px, R (3, 3) and t (3,): `Camera.from_K`, beside
    the other conventions.

    Raises ValueError as it does.

    ```python
    same = pj.formats.from_opencv(K, R, t, 96, 80, pixel_centres="integer")
    ```
    """
    return Camera.from_K(K, R, t, W, H, pixel_centres=pixel_centres, d=d, distortion=distortion)


def to_opencv(
    camera: Camera, *, pixel_centres: Input[Centres, "of K"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return OpenCV's matrices in float64: x right, y down, z forward.

    - K (3, 3): `(u, v, 1) ~ K X_camera`, px, y down.
    - R (3, 3) and t (3,): `X_camera = R X_world + t`.

    `pixel_centres` says where the reader puts them: "integer" (OpenCV: the first pixel's centre is
    0) or "half" (0.5). A lens's distortion is not in them: `camera.lens.distortion` goes beside.

    ```python
    K, R, t = pj.formats.to_opencv(camera, pixel_centres="integer")
    ```
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
