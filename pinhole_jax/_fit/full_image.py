"""The whole exact image less a mask."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera, check_camera
from .._mask.mask import Mask
from .._mask.target import check_target, levelled
from .._numerics.arrays import ArrayLike, Input, is_concrete
from .._scene.scene import Scene, check_scene
from .._silhouette.silhouette import silhouette


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
