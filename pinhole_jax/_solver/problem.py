"""What a fit looks at, and in which units it moves."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._mask.kinds import RESOLVED
from .._mask.pyramid import Level, Pyramid
from .._scene.scene import Ball, Scene
from .moves import Bounds, Move, moved, scales
from .parameters import components
from .priors import Prior

#: One unit of the solver in pixels. Its damping begins at 1 in its own units, whatever they are:
#: larger units make bolder first steps.
UNIT_PX = 30.0
#: A step is negligible below this many pixels; on coarse levels, and on the finest.
COARSE_PX, FINE_PX = 0.02, RESOLVED
#: ... or where it would change the residuals by less than this share of their norm: MINPACK's
#: cosine between residual and Jacobian, some thousandths of the error that noise leaves anyway.
COSINE = {np.dtype(np.float32): 1e-4, np.dtype(np.float64): 1e-5}
#: ... or, of a mask that is not exact, by this share of a standard error, were its pixels
#: independent.
SETTLED = 0.02


class Problem(eqx.Module):
    """A scene and a target's pyramid; moves are taken about the scene's bounding sphere.

    A look is differentiated by moves of the camera, then by `motions`: velocities of vertices.
    """

    scene: Scene
    pyramid: Pyramid
    ball: Ball
    bounds: Bounds | None
    prior: Prior
    motions: tuple[Float[Array, "V 3"], ...] = ()

    def still(self, freed: tuple[str, ...]) -> Float[Array, "n"]:
        """No moves."""
        number = len(components(freed)) + len(self.motions)
        return jnp.zeros(number, self.pyramid.cells.dtype)

    def moved(self, move: Move, y: Array, freed: tuple[str, ...]) -> tuple[Camera, Scene]:
        """The camera and the scene after moves."""
        n, place, scene = len(move.scale), lambda scene: scene.mesh.vertices, self.scene
        if self.motions:
            change = sum(x * motion for x, motion in zip(y[n:], self.motions, strict=True))
            scene = eqx.tree_at(place, scene, place(scene) + change)
        return moved(move, y[:n], freed), scene

    def move(self, camera: Camera, level: Level, freed: tuple[str, ...]) -> Move:
        """Where moves of a camera start, in the solver's units."""
        return move_about(camera, self.ball, self.bounds, level.scale, freed)


def move_about(
    camera: Camera, ball: Ball, bounds: Bounds | None, scale: Any, freed: tuple[str, ...]
) -> Move:
    """The origin of a camera's moves about a ball, in the solver's units where a film height has
    this many pixels."""
    units = UNIT_PX * scales(camera, ball.centre, ball.radius, scale, freed)
    return Move(camera, ball.centre, units, bounds)
