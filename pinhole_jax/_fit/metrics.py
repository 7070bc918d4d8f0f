"""How far two cameras, or two masks, are apart."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera, basis, check_camera
from .._numerics.safe import norm


def pose_error(camera_a: Camera, camera_b: Camera) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The distance between two cameras: angle and length.

    - the angle between their orientations (rad), from the chord between the frames: accurate down
      to rounding.
    - the distance of their eyes (world units).

    Free of the gauge: `|p-e|`, `|u|`, `u.v` and `d` do not count.

    ```python
    angle, distance = pj.pose_error(fit.camera, truth)  # rad, world units: free of the gauge
    ```
    """
    check_camera(camera_a, "camera_a")
    check_camera(camera_b, "camera_b")
    return _apart(*((c.e, c.p, c.u) for c in (camera_a, camera_b)))


@eqx.filter_jit
def _apart(placed_a: tuple, placed_b: tuple) -> tuple[Float[Array, ""], Float[Array, ""]]:
    a, b = (jnp.stack(basis(*placed)) for placed in (placed_a, placed_b))
    # |A - B|_F = 2 sqrt(2) sin(angle / 2)
    half_chord = norm((a - b).reshape(-1)) / (2 * 2**0.5)
    return 2 * jnp.arcsin(jnp.minimum(half_chord, 1)), norm(placed_a[0] - placed_b[0])


def iou(mask_a: Float[Array, "H W"], mask_b: Float[Array, "H W"]) -> Float[Array, ""]:
    """Return intersection over union of two coverage images in [0, 1]; 1 if both are empty.

    Raises ValueError where they are not of one shape.

    ```python
    pj.iou(mask, jnp.round(mask))
    ```
    """
    if np.shape(mask_a) != np.shape(mask_b):
        words = f"a mask of {np.shape(mask_a)}, the shape of `mask_a`, got {np.shape(mask_b)}"
        raise ValueError(f"`mask_b`: expected {words}")
    return _iou(jnp.asarray(mask_a), jnp.asarray(mask_b))


@eqx.filter_jit
def _iou(mask_a: Array, mask_b: Array) -> Float[Array, ""]:
    both, either = jnp.sum(jnp.minimum(mask_a, mask_b)), jnp.sum(jnp.maximum(mask_a, mask_b))
    return jnp.where(either > 0, both / jnp.where(either > 0, either, 1), 1)
