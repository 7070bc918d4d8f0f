"""Small pictures of a scene from many eyes."""

from contextlib import nullcontext

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera, camera_basis, film_map
from .._native.library import is_available
from .._scene.scene import Ball, Scene
from .._silhouette.silhouette import on_film

#: Width and height (px).
SIZE = 48


def thumbnails(
    scene: Scene, ball: Ball, directions: np.ndarray, reach: float, phi: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return coverage (N, SIZE, SIZE), row 0 on top, and camera axes (N, 3, 3): the scene as it
    looks from unit directions (N, 3), its ball's radius times `reach` away from the middle."""
    up = np.where(np.abs(directions[:, 2:]) < 0.9, [0.0, 0, 1], [1.0, 0, 0])  # never along the view
    given = ball.centre, phi, ball.centre + reach * ball.radius * directions, up
    # (On the CPU where the library runs there.)
    cpu = jax.default_device(jax.devices("cpu")[0]) if is_available() else nullcontext()
    with cpu:
        real = jax.tree.leaves(scene)[0].dtype
        images, axes = _drawn(scene, *(jnp.asarray(x, real) for x in given))
        return np.asarray(images, float), np.asarray(axes, float)


@eqx.filter_jit
def _drawn(
    scene: Scene,
    centre: Float[Array, "3"],
    phi: Float[Array, ""],
    eyes: Float[Array, "N 3"],
    ups: Float[Array, "N 3"],
) -> tuple[Float[Array, "N H W"], Float[Array, "N 3 3"]]:
    def drawn(place: tuple[Array, Array]) -> tuple[Array, Array]:
        camera = Camera(place[0], centre, place[1], phi, 1.0, SIZE, SIZE)
        return on_film(film_map(camera), scene), jnp.stack(camera_basis(camera))

    return jax.lax.map(drawn, (eyes, ups))
