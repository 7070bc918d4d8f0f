"""The whole exact image as a function of a camera's moves, and its derivative."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._numerics.jitted import jitted
from .._numerics.tracing import collector_at_rest
from .._scene.scene import Scene
from .._silhouette.silhouette import silhouette
from .._solver.moves import Move, moved, on_film


class At(NamedTuple):
    """Where an image's moves start, on which film, of what."""

    move: Move
    film: Camera
    scene: Scene
    freed: tuple[str, ...]

    def camera(self, y: Float[Array, "n"]) -> Camera:
        """Return the camera moved by y."""
        return on_film(moved(self.move, y, self.freed), self.film)


@jitted
def image(y: Float[Array, "n"], at: At) -> Float[Array, "H W"]:
    """Return the image after a move."""
    return silhouette(at.camera(y), at.scene)


@collector_at_rest()
@jitted
def image_and_jacobian(
    y: Float[Array, "n"] | Float[np.ndarray, "n"], at: At
) -> tuple[Float[Array, "H W"], Float[Array, "H W n"]]:
    """Return the image after a move, and its derivative by further ones."""
    both = lambda y: (lambda x: (x, x))(image(y, at))
    jacobian, value = jax.jacfwd(both, has_aux=True)(y)
    return value, jacobian
