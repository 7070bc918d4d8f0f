"""A lens's distortion of film points, and back: arrays of any number of points."""

import numpy as np
from jaxtyping import Array, Float

from .._numerics.pointwise import pointwise
from .camera import Camera, ResizableCamera, bend


def bent(camera: Camera, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Return the distorted points (px) of ideal film points."""
    return _by_lens(_bent, camera, points)


def straightened(
    camera: Camera, points: Float[np.ndarray, "*batch 2"]
) -> Float[np.ndarray, "*batch 2"]:
    """Return the ideal film points (px) of distorted ones."""
    return _by_lens(_straightened, camera, points)


def _by_lens(function: pointwise, camera: Camera, points: np.ndarray) -> np.ndarray:
    if camera.distortion is None:
        return points
    points = np.asarray(points, camera.e.dtype)
    return np.asarray(function(ResizableCamera.from_camera(camera), points), float)


@pointwise
def _bent(camera: ResizableCamera, points: Array) -> Array:
    lens = bend(camera)
    return points if lens is None else lens(points)


@pointwise
def _straightened(camera: ResizableCamera, points: Array) -> Array:
    lens = bend(camera)
    return points if lens is None else lens.undone(points)
