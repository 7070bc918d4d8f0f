"""The whole exact image as a function of a camera's moves: what a fit's own pixels leave out.

A fit does not resolve pixels in which contours overlap, and for a mask with soft edges leaves them
out. They are few, but they lie where the outline folds, and hold much of what tells distance from
focal length. Where a mask is noisy they are brought back for the last steps.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._numerics.tracing import collector_at_rest
from .._scene.scene import Scene
from .._silhouette.silhouette import silhouette
from .mask import Mask
from .moves import Move, moved, on_film
from .problem import FINE_PX, UNIT_PX, View
from .residuals import HIDDEN, Sums
from .solver import Found, Solver

#: Mean square residuals of a touched pixel between which it pays: with less noise there is nothing
#: to gain (8 bits leave 1e-6), with more the mask is not exact.
WORTHWHILE = (1e-5, 1e-2)
STEPS = 10


class At(NamedTuple):
    """Where an image's moves start, on which film, of what; whether overlaps are resolved."""

    move: Move
    film: Camera
    scene: Scene
    names: tuple[str, ...]
    overlaps: bool

    def camera(self, y: Float[Array, "n"]) -> Camera:
        """Return the camera moved by y."""
        return on_film(moved(self.move, y, self.names), self.film)


@eqx.filter_jit
def image(y: Float[Array, "n"], at: At) -> Float[Array, "H W"]:
    """Return the image after a move."""
    return silhouette(at.camera(y), at.scene, overlaps=at.overlaps)


@collector_at_rest()
@eqx.filter_jit
def image_and_jacobian(
    y: Float[Array, "n"], at: At
) -> tuple[Float[Array, "H W"], Float[Array, "H W n"]]:
    """Return the image after a move, and its derivative by further ones."""
    both = lambda y: (lambda x: (x, x))(image(y, at))
    jacobian, value = jax.jacfwd(both, has_aux=True)(y)
    return value, jacobian


def worthwhile(solver: Solver, view: View) -> bool:
    """Return whether a mask has soft edges, and so much noise that every pixel should count."""
    low, high = WORTHWHILE
    return not solver.kind.hard and low < view.touched_misfit < high


def with_overlaps(solver: Solver, mask: Mask, found: Found) -> Found:
    """Return the camera after Gauss-Newton steps in which every pixel counts, and its view."""
    unit, before = found.unit, np.inf
    view = completed(solver, mask, unit)
    for _ in range(STEPS):
        y = np.linalg.lstsq(np.asarray(view.triangle), -np.asarray(view.along), rcond=None)[0]
        size = float(np.max(np.abs(y))) * UNIT_PX
        # Steps shrink while they mean something. (Sums of squares cannot tell in float32.)
        if not FINE_PX[solver.dtype] < size < before:
            break
        unit, before = solver.step(unit, solver.finest, y), size
        view = completed(solver, mask, unit)
    return found._replace(unit=unit, view=view)


def completed(solver: Solver, mask: Mask, unit: Camera) -> View:
    """Return the view of a mask with soft edges at a camera, with the pixels that it leaves out."""
    view = solver.look(unit, -1)
    at = At(solver.move(unit, solver.finest), mask.camera, solver.problem.scene, solver.names, True)
    shown, J = image_and_jacobian(jnp.zeros_like(at.move.unit), at)
    out = solver.left_out(unit) & (mask.weight > 0)
    weight, target, coverage = (np.asarray(x, float)[out] for x in (mask.weight, mask.image, shown))
    root = np.sqrt(weight)
    rows = np.column_stack([np.asarray(J, float)[out], coverage - target]) * root[:, None]
    known = np.column_stack([np.asarray(view.triangle, float), np.asarray(view.along, float)])
    n = len(known)
    table: Any = np.linalg.qr(np.concatenate([known, rows]), mode="r")
    squares = rows[:, -1] ** 2
    outline = (coverage > HIDDEN) & (coverage < 1 - HIDDEN)
    more = {
        "squares": np.sum(squares),
        "overlap": np.sum(weight * np.minimum(coverage, target)),
        "union": np.sum(weight * np.maximum(coverage, target)),
        "weight": np.sum(weight),
        "touched": np.sum(outline),
        "touched_squares": np.sum(squares[outline]),
        "off": np.sum(squares[outline] > float(solver.levels[-1].explained) ** 2),
    }
    # NumPy arrays: what is made by jnp inside a derivative is traced.
    total: dict[str, Any] = {k: float(v) + float(more[k]) for k, v in view.sums._asdict().items()}
    sums = Sums(**total)
    return view._replace(triangle=table[:n, :n], along=table[:n, n], sums=sums)
