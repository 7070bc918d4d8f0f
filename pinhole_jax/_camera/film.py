"""The film: homogeneous film points, a lens's bend, and the part of the film in view."""

import functools
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numerics.components import largest, parts
from .._numerics.safe import binary_scale
from .distortion import Distortion

#: Sizes, in films, of the rectangles that are tried for what a lens sees; points along each side.
BOXES = np.geomspace(1.02, 600, 96)
SAMPLES = 33
#: The outward direction at the left, right, bottom and top.
OUT = np.array([-1, 1, -1, 1])


class FilmPart(NamedTuple):
    """A rectangle of the film, in film coordinates."""

    left: Array | float
    right: Array | float
    bottom: Array | float
    top: Array | float


class Bend(eqx.Module):
    """A lens's map from ideal film points to distorted ones (px).

    `trusted` is the radius up to which the distortion's formula counts, found once for all points.
    """

    distortion: Distortion
    trusted: Float[Array, ""]
    focal: Float[Array, "2"]
    centre: Float[Array, "2"]

    @property
    def numbers(self) -> Float[Array, "n"]:
        """Coefficients, focal lengths, principal point; and the trusted radius, held."""
        coefficients = jnp.stack(jax.tree.leaves(self.distortion))
        trusted = jax.lax.stop_gradient(self.trusted)[None]
        return jnp.concatenate([coefficients, self.focal, self.centre, trusted])

    def __call__(self, points: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Distorted film points (px) of ideal ones."""
        x, y = ((points[..., k] - self.centre[k]) / self.focal[k] for k in range(2))
        seen = self.distortion.continued(self.trusted, x, y)
        return jnp.stack([seen[k] * self.focal[k] + self.centre[k] for k in range(2)], axis=-1)

    def around(self, part: FilmPart) -> Float[Array, "4"]:
        """An ideal rectangle (left, right, bottom, top) whose sides are seen outside of `part`.

        The first of `BOXES` for which that is true, or the last; not differentiated.
        """
        bend, part = jax.lax.stop_gradient((self, part))
        real = self.focal.dtype
        out, share = jnp.asarray(OUT, real), jnp.linspace(0, 1, SAMPLES, dtype=real)
        focal, centre = jnp.repeat(bend.focal, 2), jnp.repeat(bend.centre, 2)
        ends = (jnp.stack([jnp.asarray(x, real) for x in part]) - centre) / focal
        size = jnp.max(jnp.abs(ends))
        nearest = out * jnp.maximum(out * ends, size / 10)

        def tried(scale: Array) -> tuple[Array, Array]:
            box = left, right, bottom, top = scale * nearest
            x, y = (a * (1 - share) + b * share for a, b in ((left, right), (bottom, top)))
            one = jnp.ones_like(share)
            along = jnp.stack([left * one, right * one, x, x])
            up = jnp.stack([y, y, bottom * one, top * one])
            seen_x, seen_y = bend.distortion.continued(bend.trusted, along, up)
            seen = jnp.concatenate([seen_x[:2], seen_y[2:]])
            beyond = out[:, None] * (seen - ends[:, None])
            return box * focal + centre, jnp.min(beyond) > size / 50

        boxes, holds = jax.vmap(tried)(jnp.asarray(BOXES, real))
        return boxes[jnp.argmax(holds.at[-1].set(True))]


class FilmMap(eqx.Module):
    """The map of world points to the ideal film: `matrix (x - eye)` is (x z, y z, z).

    Film coordinates are the first two over the third, the depth. A point nearer to the view point
    than to the eye is taken relative to the view point, whose film point `base` is known: an object
    seen from a distance keeps its digits. `bend` (None: nothing) maps the ideal film to the image.
    """

    eye: Float[Array, "3"]
    view: Float[Array, "3"]
    matrix: Float[Array, "3 3"]
    base: Float[Array, "3"]
    W: int = eqx.field(static=True)
    H: int = eqx.field(static=True)
    bend: Bend | None = None
    limits: Float[Array, "4"] | None = None

    @property
    def bounds(self) -> Float[Array, "4"]:
        """Where contours are cut off: left, right, bottom, top, well outside the film."""
        if self.limits is not None:
            return self.limits
        return self.looking_at(FilmPart(0, self.W, 0, self.H)).bounds

    def looking_at(self, part: FilmPart) -> "FilmMap":
        """The map for a part of the film: contours are cut off well outside it."""
        if self.bend is None:
            left, right, bottom, top = (jnp.asarray(x, self.eye.dtype) for x in part)
            width, height = right - left, top - bottom
            limits = jnp.stack([left - width, right + width, bottom - height, top + height])
        else:
            limits = self.bend.around(part)
        return replace(self, limits=jax.lax.stop_gradient(limits))

    def __call__(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Homogeneous film points (px times depth, depth) of world points."""
        raised = lambda x: x.reshape((1,) * (points.ndim - 1) + (3,))
        ways = points - raised(self.eye), points - raised(self.view)
        far, near = (largest(parts(way))[..., None] for way in ways)
        there = near < far
        film = turned(self.matrix, jnp.where(there, ways[1], ways[0]))
        return film + jnp.where(there, raised(self.base), 0)


def turned(matrix: Float[Array, "3 3"], directions: Float[Array, "*batch 3"]) -> Array:
    """The product of a matrix and directions.

    Column by column: XLA's CPU compiler makes a kernel of its own of a sum over an axis of three.
    That takes 40 ns a number, and was more than half of a fit's step.
    """
    columns = matrix.T.reshape((3,) + (1,) * (directions.ndim - 1) + (3,))
    return functools.reduce(jnp.add, [columns[k] * directions[..., k, None] for k in range(3)])


def film_points(film: FilmMap, points: Float[Array, "*K 3"]) -> Float[Array, "*K 3"]:
    """Homogeneous film points that are no larger than the points: none overflows."""
    unit = binary_scale(film.matrix)
    where = lambda f: (f.matrix, f.base)
    return eqx.tree_at(where, film, [x * unit for x in where(film)])(points)
