"""Crops and resizes of a camera's image."""

import jax
import jax.numpy as jnp

from .._camera.camera import Camera, check_camera, focal_px, principal_point
from .._camera.lens import Lens
from .._numerics.arrays import ArrayLike, Input, float_array, is_concrete


def cropped(
    camera: Camera,
    left: Input[ArrayLike, "px"],
    top: Input[ArrayLike, "px"],
    W: Input[int, "px"],
    H: Input[int, "px"],
) -> Camera:
    """Return the camera of a window of the image: W x H px, whose top-left corner is (left, top).

    In image coordinates (px, from the image's top-left corner, y down): the window is
    `image[top : top + H, left : left + W]`. It may reach out of the image (padding), and its
    corner may lie between pixels. The pose stays, and so do the focal lengths in px.

    ```python
    window = pj.formats.cropped(camera, 16, 8, 64, 64)  # left, top, W, H
    ```
    """
    check_camera(camera)
    plain = camera.replace(W=W, H=H, lens=None)  # checks W and H
    x0, y0 = (
        float_array(name, x, (), camera.e.dtype) for name, x in (("left", left), ("top", top))
    )
    plain = plain.replace(phi=2 * jnp.arctan(jnp.tan(camera.phi / 2) * (H / camera.H)))
    centred = is_concrete(x0, y0) and (2 * x0 + W, 2 * y0 + H) == (camera.W, camera.H)
    if camera.lens is None and centred:
        return plain
    x, y = principal_point(camera)
    return plain.replace(lens=_lens(camera, x - x0, y - (camera.H - H - y0)))


def resized(camera: Camera, W: Input[int, "px"], H: Input[int, "px"]) -> Camera:
    """Return the camera of the image resized to W x H px: corners stay corners.

    This is what resizing does in OpenCV, PIL and torch (`align_corners=False`): film coordinates
    are multiplied by W and H over the old ones. Pose and vertical field of view stay; the pixel
    aspect changes where the two factors differ.

    ```python
    half = pj.formats.resized(camera, 48, 40)
    ```
    """
    check_camera(camera)
    plain = camera.replace(W=W, H=H, lens=None)  # checks W and H
    if camera.lens is None and W * camera.H == H * camera.W:
        return plain
    (x, y), wider, taller = principal_point(camera), W / camera.W, H / camera.H
    return plain.replace(lens=_lens(camera, x * wider, y * taller, wider / taller))


def _lens(camera: Camera, x: jax.Array, y: jax.Array, stretch: float = 1.0) -> Lens:
    """Return the lens with its principal point at (x, y) px, its pixels stretched."""
    fx, fy = focal_px(camera)
    return Lens(jnp.stack([x, y]), fx / fy * stretch, camera.distortion)
