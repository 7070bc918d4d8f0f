"""The film: homogeneous points of it, a lens's bend, and the part that is looked at."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._numerics.safe import binary_scale
from .distortion import Distortion

#: How many times as large as the film the rectangles are that are tried for what a lens sees, along
#: whose sides so many points are looked at; which way is out at the left, right, bottom and top.
BOXES = np.geomspace(1.02, 600, 96)
SAMPLES = 33
OUT = (-1, 1, -1, 1)


class Bend(eqx.Module):
    """Ideal film points (px) to those of a lens with distortion, whose formula is trusted up to a
    radius (which is the same for all points: it is looked for once)."""

    distortion: Distortion
    trusted: Float[Array, ""]
    focal: Float[Array, "2"]
    centre: Float[Array, "2"]

    @property
    def numbers(self) -> Float[Array, "n"]:
        """Return what the image moves with: coefficients, focal lengths, principal point."""
        return jnp.concatenate(
            [jnp.stack(jax.tree.leaves(self.distortion)), self.focal, self.centre]
        )

    def __call__(self, points: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Return the film points (px) of ideal ones."""
        return jnp.stack(self.at(points[..., 0], points[..., 1]), axis=-1)

    def at(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the film point (px) of an ideal one, by components."""
        return _image(self.distortion, self.trusted, self.focal, self.centre, x, y)

    def around(self, part: "FilmPart") -> Float[Array, "4"]:
        """Return an ideal rectangle (left, right, bottom, top) about a part of the film, of which
        each side is seen beyond that side of the part; not differentiated.

        The first of `BOXES` that is, or the last.
        """
        bend, part = jax.lax.stop_gradient((self, part))
        boxes = jnp.asarray(BOXES, self.focal.dtype)
        box, holds = jax.vmap(lambda size: _box(bend, part, size))(boxes)
        return box[jnp.argmax(holds.at[-1].set(True))]


def _image(
    distortion: Distortion, trusted: Array, focal: Any, centre: Any, x: Array, y: Array
) -> tuple[Array, Array]:
    x, y = (x - centre[0]) / focal[0], (y - centre[1]) / focal[1]
    x, y = distortion.continued(trusted, x, y)
    return focal[0] * x + centre[0], focal[1] * y + centre[1]


class FilmPart(NamedTuple):
    """A part of the film that is looked at (in film coordinates), and pixels per unit of these."""

    left: Any
    right: Any
    bottom: Any
    top: Any
    px: Any


def _box(bend: Bend, part: FilmPart, scale: Array) -> tuple[Float[Array, "4"], Bool[Array, ""]]:
    """Return an ideal rectangle about a part of the film, and whether it is seen beyond it."""
    f, c = bend.focal, bend.centre
    ends = ((part[k] - c[k // 2]) / f[k // 2] for k in range(4))
    left, right, bottom, top = ends = [jnp.asarray(x, f.dtype) for x in ends]
    size = functools.reduce(jnp.maximum, map(jnp.abs, ends))
    outward = [jnp.maximum(sign * x, size / 10) for sign, x in zip(OUT, ends, strict=True)]
    x0, x1, y0, y1 = box = [sign * scale * x for sign, x in zip(OUT, outward, strict=True)]

    share = jnp.linspace(0, 1, SAMPLES, dtype=f.dtype)
    x, y = x0 * (1 - share) + x1 * share, y0 * (1 - share) + y1 * share
    seen = [
        bend.distortion.continued(bend.trusted, *jnp.broadcast_arrays(*side))
        for side in ((x0, y), (x1, y), (x, y0), (x, y1))
    ]
    beyond = (
        left - seen[0][0],
        seen[1][0] - right,
        bottom - seen[2][1],
        seen[3][1] - top,
    )
    least = jnp.min(jnp.stack(beyond))
    placed = [x * f[k // 2] + c[k // 2] for k, x in enumerate(box)]
    return jnp.stack(placed), least > size / 50


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
    px: Any = 1

    @property
    def bounds(self) -> list[Array]:
        """Return what contours are cut off at: left, right, bottom, top, well outside the film."""
        if self.limits is not None:
            return list(self.limits)
        if self.bend is not None:
            return list(self.bend.around(FilmPart(0, self.W, 0, self.H, 1)))
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
        return _mapped(self.eye, self.view, self.matrix, self.base, points)

    def at(self, x: Array, y: Array, z: Array) -> tuple[Array, ...]:
        """Return the homogeneous film points of world points, by components."""
        there, chosen = _from_nearer(self.eye, self.view, (x, y, z))
        turned = self.turn(*chosen)
        return tuple(p + jnp.where(there, b, 0) for p, b in zip(turned, self.base, strict=True))

    def turn(self, x: Array, y: Array, z: Array) -> tuple[Array, ...]:
        """Return the homogeneous film points of directions from the eye, by components."""
        return tuple(row[0] * x + row[1] * y + row[2] * z for row in self.matrix)


def _from_nearer(eye: Array, view: Array, points: Sequence[Array]) -> tuple[Array, list[Array]]:
    """Return whether points are nearer to the view point than to the eye, and where they are from
    the nearer one."""
    from_eye, from_view = ([p - o[k] for k, p in enumerate(points)] for o in (eye, view))
    far, near = (functools.reduce(jnp.maximum, map(jnp.abs, way)) for way in (from_eye, from_view))
    there = jax.lax.stop_gradient(near < far)
    return there, [jnp.where(there, a, b) for a, b in zip(from_view, from_eye, strict=True)]


@jax.custom_jvp
def _mapped(eye: Array, view: Array, matrix: Array, base: Array, points: Array) -> Array:
    film = FilmMap(eye, view, matrix, base, 0, 0)
    return jnp.stack(film.at(*(points[..., k] for k in range(3))), axis=-1)


@_mapped.defjvp
def _(primals: Any, tangents: Any):
    """(By vectors: to go back by components is a kernel for each number of the matrix.)"""
    eye, view, matrix, _, points = primals
    eye_moves, view_moves, turns, base_moves, moves = tangents
    there, chosen = _from_nearer(eye, view, [points[..., k] for k in range(3)])
    there = there[..., None]
    raised = lambda x: x.reshape((1,) * (points.ndim - 1) + x.shape)
    moves = moves - jnp.where(there, raised(view_moves), raised(eye_moves))
    rate = turned(matrix, moves) + turned(turns, jnp.stack(chosen, axis=-1))
    return _mapped(*primals), rate + jnp.where(there, raised(base_moves), 0)


def turned(matrix: Float[Array, "3 3"], directions: Float[Array, "*batch 3"]) -> Array:
    """Return a matrix times directions.

    (Column by column: a sum over an axis of three is a kernel of its own to XLA's CPU compiler,
    which takes 40 ns a number, and was more than half of a fit's step.)
    """
    columns = matrix.T.reshape((3,) + (1,) * (directions.ndim - 1) + (3,))
    return functools.reduce(jnp.add, [columns[k] * directions[..., k, None] for k in range(3)])


def film_points(film: FilmMap, points: Float[Array, "*K 3"]) -> Float[Array, "*K 3"]:
    """Return homogeneous film points that are no larger than the points: none overflows."""
    return scaled(film)(points)


def scaled(film: FilmMap) -> FilmMap:
    """Return the map to homogeneous points that are no larger than what is mapped."""
    unit = binary_scale(film.matrix)
    where = lambda f: (f.matrix, f.base)
    return eqx.tree_at(where, film, [x * unit for x in where(film)])
