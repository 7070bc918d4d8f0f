"""`depth` and `normals`: what a camera sees of a scene, pixel by pixel, as `trace` does.

One ray through each pixel's centre: unlike a silhouette, these are samples and not averages over
the pixel. They are differentiable where the primitive that a ray hits stays the same. At outlines
and folds they jump, which no derivative shows: edges move in the derivative of `silhouette`.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._camera.camera import Camera, camera_basis
from .._numerics.components import inner, parts
from .._scene.scene import Scene, check_view
from .trace import FirstHits, first_hits, hits


def depth(camera: Camera, scene: Scene) -> Float[Array, "H W"]:
    """Return the depth of each pixel's first hit along the view axis: (H, W), row 0 on top.

    World units along the view axis (z-depth, as depth buffers hold it), not along the ray: a wall
    that faces the camera has one depth in all pixels. Rays go through pixel centres; inf where
    nothing is met.

    Differentiable in camera, vertices, centers and radii where the hit primitive stays the same;
    the derivative of a miss is 0. Outlines move without it noticing: use `silhouette` for these.

    ```python
    far = pj.depth(camera, scene)  # inf where nothing is
    ```
    """
    check_view(camera, scene)
    return _ahead(camera, scene, first_hits(scene, camera))


def normals(camera: Camera, scene: Scene) -> Float[Array, "H W 3"]:
    """Return the unit normal at each pixel's first hit: (H, W, 3), row 0 on top.

    In world coordinates, turned towards the eye whatever way a face is wound, and for a sphere seen
    from inside. Of a mesh the flat normals of its faces. Rays go through pixel centres; zeros where
    nothing is met.

    Differentiable where the hit primitive stays the same: a face's normal in its vertices, a
    sphere's also in the camera. Outlines move without it noticing: use `silhouette` for these.

    ```python
    towards = pj.normals(camera, scene)  # (H, W, 3)
    ```
    """
    check_view(camera, scene)
    return _towards_eye(camera, scene, first_hits(scene, camera))


@eqx.filter_jit
def _ahead(camera: Camera, scene: Scene, seen: FirstHits) -> Float[Array, "H W"]:
    """The hits' depth along the view axis; inf where there is none."""
    t = hits(scene, seen).t
    met = jnp.isfinite(t)
    ahead = inner(parts(seen.rays.direction), parts(camera_basis(camera).v))
    # A miss must not reach the product: the derivative of inf * cosine is not finite.
    return jnp.where(met, jnp.where(met, t, 0) * ahead, jnp.inf)


@eqx.filter_jit
def _towards_eye(camera: Camera, scene: Scene, seen: FirstHits) -> Float[Array, "H W 3"]:
    normal = hits(scene, seen).normal
    away = inner(parts(normal), parts(seen.rays.direction)) > 0
    return jnp.where(away[..., None], -normal, normal)
