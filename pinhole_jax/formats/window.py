"""Crops and resizes of a camera's image."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._camera.camera import Camera, check_camera, resolution
from .._numerics.arrays import ArrayLike, Input, float_array


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
    corner = [
        float_array(name, x, (), camera.e.dtype) for name, x in (("left", left), ("top", top))
    ]
    return _filmed(camera, camera.K.at[:2, 2].add(0.5 - jnp.stack(corner)), W, H)


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
    factors = resolution("W", W) / camera.W, resolution("H", H) / camera.H, 1
    K = camera.K.at[:2, 2].add(0.5)
    return _filmed(camera, K * jnp.asarray(factors, K.dtype)[:, None], W, H)


def _filmed(camera: Camera, K: Float[Array, "3 3"], W: int, H: int) -> Camera:
    """Return the camera with another film of W x H px, whose pixel centres lie at halves."""
    lens = {"pixel_centres": "half", "distortion": camera.distortion}
    film = Camera.from_K(K, camera.R, camera.t, W, H, **lens)
    return camera.replace(W=W, H=H, phi=film.phi, lens=film.lens)
