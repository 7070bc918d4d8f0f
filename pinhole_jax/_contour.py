"""What a mask sees of a scene: the occluding contour, as curves on the film.

A closed mesh is seen as its front-facing triangles; they end where a front- meets a back-facing
one. An open mesh shows both sides of each triangle, and its borders end it too. A sphere is seen
as an ellipse. Every curve is cut into parts that are monotone in x and in y, which is all that the
rasteriser asks of a curve: its lower and its upper end, x at a height and y at an abscissa.

Direction: the covered side lies on the left of a curve (counter-clockwise around what it bounds).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._camera import Camera, focal_px, principal_point, to_camera
from ._safe import safe_divide, safe_sqrt
from ._scene import Mesh, Spheres, front_facing


class Segments(NamedTuple):
    """Straight contour pieces from `a` to `b` (film px); `weight` layers of cover on the left."""

    a: Float[Array, "K 2"]
    b: Float[Array, "K 2"]
    weight: Float[Array, "K"]


class Arcs(NamedTuple):
    """Quarters of ellipses `centre + L w`, |w| = 1, with `L = [[l11, 0], [l21, l22]]` (film px).

    `quarter` 0..3 runs counter-clockwise from the ellipse's rightmost point to its topmost, its
    leftmost, its lowest and back.
    """

    centre: Float[Array, "K 2"]
    shape: Float[Array, "K 3"]
    quarter: Int[Array, "K"]
    weight: Float[Array, "K"]


def contour_weights(mesh: Mesh, e: Float[Array, "3"]) -> Int[Array, "E"]:
    """Return for each edge how many layers of cover it bounds on its left less on its right.

    0 for an edge that is not on the contour. A closed mesh counts front-facing triangles only; any
    other mesh counts every triangle, from whichever side it is seen.
    """
    front = front_facing(mesh, e).astype(jnp.int8)
    first, second = mesh.edge_faces[:, 0], mesh.edge_faces[:, 1]
    if mesh.closed:
        return front[first] - front[second]
    side = 2 * front - 1
    return side[first] - jnp.where(second < 0, 0, side[jnp.maximum(second, 0)])


class Selection(NamedTuple):
    """A set of edges as bits, 32 to a word, with the number of set bits before each word."""

    words: Array
    before: Int[Array, "words"]
    total: Int[Array, ""]


def select(mask: Bool[Array, "E"]) -> Selection:
    """Return the set of the mask's true entries, to be listed by `nth`.

    Counting bits in words is 10 times cheaper than `jnp.nonzero` over the edges of a large mesh.
    """
    padding = -mask.shape[0] % 32
    bits = jnp.pad(mask, (0, padding)).reshape(-1, 32).astype(jnp.uint32)
    words = jnp.sum(bits << jnp.arange(32, dtype=jnp.uint32)[None], axis=1, dtype=jnp.uint32)
    ones = jax.lax.population_count(words).astype(jnp.int32)
    upto = jnp.cumsum(ones)
    return Selection(words, upto - ones, upto[-1] if upto.shape[0] else jnp.int32(0))


def nth(selection: Selection, rank: Int[Array, "K"]) -> Int[Array, "K"]:
    """Return the indices of the set's entries number `rank`; an index within range past the end."""
    word = jnp.searchsorted(selection.before, rank, side="right").astype(jnp.int32) - 1
    word = jnp.maximum(word, 0)
    bits, rest = selection.words[word], (rank - selection.before[word]).astype(jnp.uint32)
    position = jnp.zeros_like(bits)
    for width in (16, 8, 4, 2, 1):  # binary search for the bit that `rest` set bits precede
        half = (bits >> position) & jnp.uint32((1 << width) - 1)
        ones = jax.lax.population_count(half)
        upper = rest >= ones
        rest = jnp.where(upper, rest - ones, rest)
        position = jnp.where(upper, position + jnp.uint32(width), position)
    return word * 32 + position.astype(jnp.int32)


def mesh_segments(
    camera: Camera,
    vertices: Float[Array, "V 3"],
    edges: Int[Array, "K 2"],
    weight: Int[Array, "K"],
) -> Segments:
    """Return the edges as segments on the film, cut off just in front of the eye."""
    ends = to_camera(camera, vertices[edges])
    ends = _clip_to_front(ends)
    fx, fy = focal_px(camera)
    centre = principal_point(camera)
    x = fx * ends[..., 0] / ends[..., 2] + centre[0]
    y = fy * ends[..., 1] / ends[..., 2] + centre[1]
    film = jnp.stack([x, y], axis=-1)
    # An edge wholly behind the eye projects nowhere.
    shown = jnp.where(jax.lax.stop_gradient(ends[:, 0, 2] > 0), weight, 0)
    return Segments(film[:, 0], film[:, 1], shown.astype(film.dtype))


def _clip_to_front(ends: Float[Array, "K 2 3"]) -> Float[Array, "K 2 3"]:
    """Return the part of each edge with z above a small positive bound.

    The bound is relative to the edge's own extent, so that film coordinates stay finite. Edges
    wholly behind it come back with z = -1.
    """
    z = ends[..., 2]
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(ends), axis=(1, 2)))
    near = jnp.maximum(scale * 1e-6, jnp.finfo(ends.dtype).tiny * 1e8)[:, None]
    outside = z < near
    other = ends[:, ::-1]
    along = safe_divide(near - z, other[..., 2] - z)
    cut = ends + along[..., None] * (other - ends)
    cut = jnp.concatenate([cut[..., :2], jnp.broadcast_to(near[..., None], cut[..., :1].shape)], -1)
    clipped = jnp.where(outside[..., None], cut, ends)
    behind = jnp.all(outside, axis=1)[:, None, None]
    nowhere = jnp.array([[[0, 0, -1]]], ends.dtype)
    return jnp.where(behind, nowhere, clipped)


def sphere_arcs(camera: Camera, spheres: Spheres) -> Arcs:
    """Return each sphere's outline as four arcs, quarter by quarter: (4 S,).

    The cone from the eye that touches a sphere (centre (x, y, z) in camera coordinates, radius r)
    meets the film in an ellipse with centre `(x, y) z / (z^2 - r^2)` and shape matrix
    `r^2 ((z^2 - r^2) I + (x, y)(x, y)^T) / (z^2 - r^2)^2`, of which L is the Cholesky factor.
    Spheres that reach behind the plane through the eye are left out.
    """
    x, y, z = jnp.moveaxis(to_camera(camera, spheres.centers), -1, 0)
    r = spheres.radii
    shown = jax.lax.stop_gradient(z > r)
    z = jnp.where(shown, z, 2 * r)
    fx, fy = focal_px(camera)
    room = (z - r) * (z + r)
    axis = principal_point(camera)
    centre = jnp.stack([fx * x * z / room + axis[0], fy * y * z / room + axis[1]], axis=-1)
    l11 = jnp.sqrt(room + x * x)
    shape = jnp.stack(
        [fx * l11, fy * x * y / l11, fy * safe_sqrt(room * (room + x * x + y * y)) / l11], axis=-1
    )
    shape = shape * (r / room)[:, None]
    quarter = jnp.repeat(jnp.arange(4, dtype=jnp.int32), x.shape[0])
    weight = jnp.tile(shown.astype(x.dtype), 4)
    return Arcs(jnp.tile(centre, (4, 1)), jnp.tile(shape, (4, 1)), quarter, weight)
