"""Where a lens shows points of the ideal film, and back: arrays of any number of points."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._numerics.pointwise import pointwise
from .camera import Camera, bend, focal_px, has_distortion, principal_point


def bent(camera: Camera, points: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
    """Return where the camera's lens shows points of the ideal film (px)."""
    return _on(_bent, camera, points)


def straightened(
    camera: Camera, points: Float[np.ndarray, "*batch 2"]
) -> Float[np.ndarray, "*batch 2"]:
    """Return the points of the ideal film (px) that the camera's lens shows there."""
    return _on(_straightened, camera, points)


def _on(way: pointwise, camera: Camera, points: np.ndarray) -> np.ndarray:
    if not has_distortion(camera):
        return points
    return np.asarray(way(camera, np.asarray(points, camera.e.dtype)), float)


@pointwise
def _bent(camera: Camera, points: Any) -> Any:
    lens: Any = bend(camera)
    return lens(points)


@pointwise
def _straightened(camera: Camera, points: Any) -> Any:
    focal, centre = jnp.stack(focal_px(camera)), principal_point(camera)
    at = ((points[..., k] - centre[k]) / focal[k] for k in range(2))
    lens: Any = camera.lens
    ideal = lens.distortion.undistorted(*at)
    return jnp.stack([focal[k] * x + centre[k] for k, x in enumerate(ideal)], axis=-1)
