"""Small pictures of a scene from many eyes."""

from contextlib import nullcontext

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.film import FilmMap
from .._native.library import is_available
from .._scene.scene import Ball, Scene
from .._silhouette.silhouette import on_film

#: Width and height (px).
SIZE = 48


def axes_inward(directions: np.ndarray) -> np.ndarray:
    """Return camera axes (N, 3, 3), rows b1, b2, v, that look against directions (N, 3)."""
    v = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
    up = np.where(np.abs(v[:, 2:]) < 0.9, [0.0, 0, 1], [1.0, 0, 0])  # never along the view
    b1 = np.cross(v, up)
    b1 /= np.linalg.norm(b1, axis=1, keepdims=True)
    return np.stack([b1, np.cross(b1, v), v], axis=1)


def thumbnails(
    scene: Scene, ball: Ball, eyes: np.ndarray, axes: np.ndarray, phi: float
) -> np.ndarray:
    """Return coverage (N, SIZE, SIZE), row 0 on top, seen from eyes (N, 3) with camera axes
    (N, 3, 3). Eyes are from the centre of the ball about the scene, in its radii."""
    focal, middle = SIZE / (2 * np.tan(phi / 2)), SIZE / 2
    matrix = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]]) @ axes
    offset = ball.radius * eyes
    base = -(matrix @ offset[..., None])[..., 0]
    arrays = ball.centre + offset, np.broadcast_to(ball.centre, eyes.shape), matrix, base
    # (On the CPU where the library runs there.)
    cpu = jax.default_device(jax.devices("cpu")[0]) if is_available() else nullcontext()
    with cpu:
        real = jax.tree.leaves(scene)[0].dtype
        films = [jnp.asarray(x, real) for x in arrays]
        return np.asarray(_drawn(films, scene), float)


@eqx.filter_jit
def _drawn(films: list[Array], scene: Scene) -> Float[Array, "N H W"]:
    return jax.lax.map(lambda film: on_film(FilmMap(*film, W=SIZE, H=SIZE), scene), films)
