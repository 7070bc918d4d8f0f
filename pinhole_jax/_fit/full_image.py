"""The whole exact image less a mask; and as a function of a camera's moves, with its derivative."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera, check_camera
from .._mask.mask import Mask
from .._mask.target import check_target, levelled
from .._numerics.arrays import ArrayLike, Input, is_concrete
from .._scene.scene import Scene, check_scene
from .._silhouette.silhouette import silhouette
from .._solver.moves import Move, moved, on_film


def residuals(
    camera: Camera,
    scene: Scene,
    target: Input[ArrayLike, "H W"],
    weight: Input[ArrayLike | None, "H W"] = None,
    *,
    outlier_px: float | None = None,
) -> Float[Array, "H W"]:
    """Return coverage minus mask in each pixel, times the root of its weight: the sum of squares is
    what `fit_camera` minimises, and `Fit.rms` squared is their weighted mean.

    - `target`, `weight`: as in `fit_camera`: numbers, not traced.
    - `outlier_px`: pixels farther than this from the mask's edge lose their weight, as they do at
      the end of a fit to a mask that is not exact (2.0 there); None: all count.

    Differentiable with respect to camera and scene, forward and reverse; also within `jit`. A fit
    looks at the same differences on smaller images first, where starts far off are pulled in.

    Raises ValueError for what is no mask of the camera's size, or no weight.

    ```python
    loss = lambda camera: jnp.sum(pj.residuals(camera, scene, mask) ** 2)
    slope = jax.grad(loss)(start)
    ```
    """
    check_camera(camera)
    check_scene(scene)
    if not is_concrete(target, weight):
        raise ValueError("`target`, `weight`: expected numbers, got traced values; give constants")
    image, weights = check_target(target, weight, camera.W, camera.H)
    image = levelled(image, weights)
    mask = Mask(image, weights, camera)
    if outlier_px is not None:
        weights = mask.near_edge(outlier_px).image()
    dtype = camera.e.dtype
    difference = silhouette(camera, scene) - jnp.asarray(mask.image, dtype)
    return jnp.asarray(np.sqrt(weights), dtype) * difference


class At(NamedTuple):
    """Where an image's moves start, on which film, of what."""

    move: Move
    film: Camera
    scene: Scene
    freed: tuple[str, ...]

    def camera(self, y: Float[Array, "n"]) -> Camera:
        """Return the camera moved by y."""
        return on_film(moved(self.move, y, self.freed), self.film)


@eqx.filter_jit
def image(y: Float[Array, "n"], at: At) -> Float[Array, "H W"]:
    """Return the image after a move."""
    return silhouette(at.camera(y), at.scene)


@eqx.filter_jit
def image_and_jacobian(
    y: Float[Array, "n"] | Float[np.ndarray, "n"], at: At
) -> tuple[Float[Array, "H W"], Float[Array, "H W n"]]:
    """Return the image after a move, and its derivative by further ones."""
    both = lambda y: (lambda x: (x, x))(image(y, at))
    jacobian, value = jax.jacfwd(both, has_aux=True)(y)
    return value, jacobian
