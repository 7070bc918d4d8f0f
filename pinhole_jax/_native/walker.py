"""Rays' first hits by the compiled library."""

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from .._numerics.on_devices import spread
from .._scene.scene import Scene
from .rasteriser import scene_arrays


def walked(
    scene: Scene,
    origin: Float[Array, "m 3"],
    direction: Float[Array, "N 3"],
    *,
    any_hit: bool = False,
) -> Int[Array, "N"]:
    """The face that each ray hits first, or F + the sphere; -1 for none.

    All are of one float type, and rays have an origin each or one in common. `any_hit` stops at the
    first primitive found.
    """
    vertices, faces, _, _, centers, radii = scene_arrays(scene, direction.dtype)
    given = vertices, faces, centers, radii, origin, direction
    like = jax.ShapeDtypeStruct(direction.shape[:1], np.int32)
    call = jax.ffi.ffi_call("pinhole_walk", like, vmap_method="expand_dims")
    return spread([call(*spread(given, []), any=np.int64(any_hit))], given)[0]
