"""The film: homogeneous points of it, a lens's bend, and the part that is looked at."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numerics.safe import binary_scale
from .distortion import Distortion


class Bend(eqx.Module):
    """Ideal film points (px) to those of a lens with distortion, whose formula is trusted up to a
    radius (which is the same for all points: it is looked for once)."""

    distortion: Distortion
    trusted: Float[Array, ""]
    focal: Float[Array, "2"]
    centre: Float[Array, "2"]

    def __call__(self, points: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Return the film points (px) of ideal ones."""
        x, y = ((points[..., k] - self.centre[k]) / self.focal[k] for k in (0, 1))
        distorted = self._distorted(x, y)
        return jnp.stack([self.focal[k] * distorted[k] + self.centre[k] for k in (0, 1)], axis=-1)

    def _distorted(self, x: Array, y: Array) -> tuple[Array, Array]:
        return self.distortion.continued(self.trusted, x, y)

    def around(self, part: "FilmPart") -> Float[Array, "4"]:
        """Return an ideal rectangle (left, right, bottom, top) about a part of the film, of which
        each side is seen beyond that side of the part; not differentiated."""
        held = jax.lax.stop_gradient(self)
        sides = (jnp.stack(part[:4]) - jnp.repeat(held.centre, 2)) / jnp.repeat(held.focal, 2)
        sign = jnp.asarray([-1, 1, -1, 1], sides.dtype)
        size = jnp.max(jnp.abs(sides))
        outer = sign * jnp.maximum(sign * sides, size / 10)
        boxes = jnp.asarray(np.geomspace(1.02, 600, 96)[:, None], sides.dtype) * outer[None]
        share = jnp.asarray(np.linspace(0, 1, 33)[None], sides.dtype)
        x, y = (boxes[:, k : k + 1] * (1 - share) + boxes[:, k + 1 : k + 2] * share for k in (0, 2))
        none = jnp.zeros_like(x)
        seen = [held._distorted(boxes[:, k : k + 1] + none, y)[0] for k in (0, 1)]
        seen += [held._distorted(x, boxes[:, k : k + 1] + none)[1] for k in (2, 3)]
        beyond = jnp.min(
            sign[:, None, None] * (jnp.stack(seen) - sides[:, None, None]), axis=(0, 2)
        )
        box = boxes[jnp.argmax(jnp.append(beyond[:-1] > size / 50, jnp.ones(1, bool)))]
        return box * jnp.repeat(held.focal, 2) + jnp.repeat(held.centre, 2)


class FilmPart(NamedTuple):
    """A part of the film that is looked at (in film coordinates), and pixels per unit of these."""

    left: Any
    right: Any
    bottom: Any
    top: Any
    px: Any


class FilmMap(eqx.Module):
    """World points to the film: `matrix (x - eye)` is (x z, y z, z), film coordinates times depth.

    All that a contour needs of a camera, worked out once. Of points nearer to the view point than
    to the eye what counts is their place beside the view point, whose film point is known (`base`):
    so an object that is looked at from a distance keeps its digits. The film is the ideal one:
    `bend` (None: nothing) says where its points lie in the image.
    """

    eye: Float[Array, "3"]
    view: Float[Array, "3"]
    matrix: Float[Array, "3 3"]
    base: Float[Array, "3"]
    W: int = eqx.field(static=True)
    H: int = eqx.field(static=True)
    bend: Bend | None = None
    limits: Float[Array, "4"] | None = None
    px: Any = None

    @property
    def bounds(self) -> list[Array]:
        """Return what contours are cut off at: left, right, bottom, top, well outside the film."""
        if self.limits is not None:
            return list(self.limits)
        sides = (-self.W, 2 * self.W, -self.H, 2 * self.H)
        return [jnp.asarray(x, self.eye.dtype) for x in sides]

    def looking_at(self, part: FilmPart) -> "FilmMap":
        """Return the map for a part of the film: contours are cut off well outside that."""
        left, right, bottom, top, px = (jnp.asarray(x, self.eye.dtype) for x in part)
        if self.bend is None:
            width, height = right - left, top - bottom
            limits = jnp.stack([left - width, right + width, bottom - height, top + height])
        else:
            limits = self.bend.around(FilmPart(left, right, bottom, top, px))
        fields = (self.eye, self.view, self.matrix, self.base, self.W, self.H, self.bend)
        return FilmMap(*fields, jax.lax.stop_gradient(limits), px)

    def __call__(self, points: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Return the homogeneous film points (px times depth, depth) of world points."""
        from_eye, from_view = (
            [points[..., k] - origin[k] for k in range(3)] for origin in (self.eye, self.view)
        )
        far, near = (
            jnp.maximum(jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.abs(z))
            for x, y, z in (from_eye, from_view)
        )
        there = jax.lax.stop_gradient(near < far)
        chosen = (jnp.where(there, a, b) for a, b in zip(from_view, from_eye, strict=True))
        return self.turn(*chosen) + jnp.where(
            there[..., None], self.base.reshape((1,) * there.ndim + (3,)), 0
        )

    def turn(self, x: Array, y: Array, z: Array) -> Float[Array, "*batch 3"]:
        """Return the homogeneous film points of directions from the eye."""
        column = lambda k: self.matrix[:, k].reshape((1,) * x.ndim + (3,))
        return column(0) * x[..., None] + column(1) * y[..., None] + column(2) * z[..., None]


def film_points(film: FilmMap, points: Float[Array, "*K 3"]) -> Float[Array, "*K 3"]:
    """Return homogeneous film points that are no larger than the points: none overflows."""
    unit = binary_scale(film.matrix)
    where = lambda f: (f.matrix, f.base)
    return eqx.tree_at(where, film, [x * unit for x in where(film)])(points)
