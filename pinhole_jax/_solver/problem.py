"""What a fit looks at, and what is known at one camera of it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._files.programs import like
from .._mask.pyramid import Level, Pyramid
from .._scene.scene import Ball, Scene
from .moves import Bounds, Move, scales
from .priors import Others, Prior
from .residuals import Load, Pixels, Sums

#: One unit of the solver in pixels. Its damping begins at 1 in its own units, whatever they are:
#: larger units make bolder first steps.
UNIT_PX = 30.0
#: A step is negligible below this many pixels; on coarse levels, and on the finest.
COARSE_PX = 0.02
FINE_PX = {np.dtype(np.float32): 3e-4, np.dtype(np.float64): 1e-7}
#: ... or where it would change the residuals by less than this share of their norm: MINPACK's
#: cosine between residual and Jacobian, some thousandths of the error that noise leaves anyway.
COSINE = {np.dtype(np.float32): 1e-4, np.dtype(np.float64): 1e-5}


class Problem(eqx.Module):
    """A scene and a target's pyramid; moves are taken about the scene's bounding sphere."""

    scene: Scene
    pyramid: Pyramid
    pivot: Float[Array, "3"]
    radius: Float[Array, ""]
    bounds: Bounds | None
    prior: Prior | None
    others: Others

    def __init__(
        self,
        scene: Scene,
        pyramid: Pyramid,
        ball: Ball,
        others: Others,
        bounds: Bounds | None = None,
        prior: Prior | None = None,
    ):
        dtype = pyramid.target.dtype
        self.scene, self.pyramid, self.others = scene, pyramid, others
        self.bounds, self.prior = bounds, prior
        self.pivot, self.radius = (jnp.asarray(x, dtype) for x in ball)


class View(NamedTuple):
    """What is known at one camera: R of J = QR, Q^T r, sums, load, reported parameters' derivative.

    J is the residuals' derivative by the moves, in the solver's units (`UNIT_PX` pixels): `scale`.
    Its first rows are those of the touched `pixels`; it is kept column by column, what follows
    them is no column of its. (To turn it took a quarter of a step where a buffer is large.)
    """

    triangle: Float[Array, "n n"]
    along: Float[Array, "n"]
    sums: Sums
    load: Load
    to_reported: Float[Array, "n n"]
    scale: Float[Array, "n"]
    pixels: Pixels
    columns: Float[Array, "k m"]
    prior: Any = 0.0

    @property
    def jacobian(self) -> np.ndarray:
        """Return J (m, n), zeros after its last row."""
        return np.asarray(self.columns)[: len(self.along)].T

    @property
    def squares(self) -> float:
        """Return the sum of weighted squared residuals, those of a prior and of what other
        views know among them."""
        return float(self.sums.squares) + float(self.prior)

    @property
    def touched_misfit(self) -> float:
        """Return the mean square residual of the touched pixels."""
        return float(self.sums.touched_squares) / max(float(self.sums.touched), 1.0)

    @property
    def misfit(self) -> float:
        """Return the mean square residual of a touched pixel, all squares put on these pixels."""
        return self.squares / max(float(self.sums.touched), 1.0)


def move_about(
    camera: Camera,
    pivot: Float[Array, "3"],
    radius: Float[Array, ""],
    bounds: Bounds | None,
    scale: Any,
    freed: tuple[str, ...],
) -> Move:
    """Return where moves of a camera start, in the solver's units, from what a problem says of it
    and a level's scale."""
    return Move(camera, pivot, UNIT_PX * scales(camera, pivot, radius, scale, freed), bounds)


def like_descended(camera: Camera, level: Level) -> tuple[Camera, Any, Any, View]:
    """Return something of the structure of what `levenberg_marquardt.descended` returns."""
    view = like(View)._replace(sums=like(Sums), load=like(Load))
    return camera, 0, 0, view._replace(pixels=like(Pixels)._replace(level=level))
