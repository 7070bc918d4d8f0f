"""What lies between the ideal pinhole and the pixels: principal point and pixel aspect.

Both are affine on the film, so a straight edge stays straight. A camera without a lens pays nothing.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float


class Lens(eqx.Module):
    """Principal point and pixel aspect of a camera.

    - `principal_point`: where the view axis meets the film, in film coordinates (px, origin at the
      film's bottom-left corner, y up). A centred camera has (W/2, H/2).
    - `aspect`: focal length in pixels along x over focal length in pixels along y (`fx / fy`).
    """

    principal_point: Float[Array, "2"]
    aspect: Float[Array, ""]

    def __init__(self, principal_point: ArrayLike, aspect: ArrayLike = 1.0):
        self.principal_point = jnp.asarray(principal_point, float)
        self.aspect = jnp.asarray(aspect, float)
        if self.principal_point.shape != (2,):
            raise ValueError(
                f"`principal_point`: expected shape (2,), got {self.principal_point.shape}"
            )
        if self.aspect.shape != ():
            raise ValueError(f"`aspect`: expected a scalar, got shape {self.aspect.shape}")
