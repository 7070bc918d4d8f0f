"""Scenes that surround the eye: how many layers lie where no curve is."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._camera.film import FilmMap, film_points
from .._numerics.one_kernel import on_cpu
from .._numerics.safe import binary_inverse, dot, norm, normalize, safe_divide, safe_sqrt
from .._scene.scene import Mesh, Scene, front_facing, is_closed, planes_are_current, vertex_box

#: Layers that cover everything, whatever else there is.
EVERYWHERE = 1 << 20
#: A box in space is before the eye for sure if its least depth is more than this share of its
#: largest; by which share of its place on the film rounding may then move them, at the most.
DEPTHS, SLACK = 0.01, 1e-3


def surrounding(film: FilmMap, scene: Scene) -> Int[Array, ""]:
    """Return how many layers lie far to the left of the film, where no curve is.

    Not 0 only where the scene reaches through the plane of the eye; `EVERYWHERE` and more if the
    eye is within a closed mesh or a sphere.
    """
    layers = jnp.int32(0)
    film, scene = jax.lax.stop_gradient((film, scene))
    if scene.mesh is not None and scene.mesh.faces.shape[0]:
        mesh, current = scene.mesh, planes_are_current(scene.mesh)
        layers = layers + jax.lax.cond(
            jnp.any(_corners(film, vertex_box(mesh))[:, 2] <= 0),
            lambda: _layers_on_the_left(mesh, film, current),
            lambda: jnp.int32(0),
        )
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        centre, radius = scene.spheres.centers - film.eye[None], scene.spheres.radii
        distance = norm(centre)
        tangent = safe_sqrt(distance - radius) * safe_sqrt(distance + radius)
        forward, up = film.matrix[2], film.matrix[1]
        left = normalize(jnp.cross(up, forward))
        beside = (dot(centre, left[None]) >= tangent) & (distance > radius)
        within = EVERYWHERE * jnp.sum(distance <= radius, dtype=jnp.int32)
        layers = layers + jnp.sum(beside, dtype=jnp.int32) + within
    return layers


def reaches_left(film: FilmMap, mesh: Mesh) -> Bool[Array, ""]:
    """Return whether anything may lie left of what contours are cut off at."""
    x, _, z = jnp.moveaxis(_corners(film, vertex_box(mesh)), -1, 0)
    return jnp.any(x < film.bounds[0] * z)


def rows_seen(film: FilmMap, scene: Scene) -> Int[Array, "2"]:
    """Return where on the film the scene may be seen: from which row (counted from the film's lower
    side), and up to which.

    All of the film where the scene is not surely before the eye, and through a lens that bends.
    """
    whole = jnp.asarray([0, film.H], jnp.int32)
    if film.bend is not None:
        return whole
    film, scene = jax.lax.stop_gradient((film, scene))
    mesh, boxes = scene.mesh, []
    if mesh is not None and mesh.faces.shape[0]:
        boxes.append(vertex_box(mesh))
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        centre, radius = scene.spheres.centers, scene.spheres.radii[:, None]
        boxes.append(
            jnp.stack([jnp.min(centre - radius, axis=0), jnp.max(centre + radius, axis=0)])
        )
    corners = jnp.concatenate([_corners(film, box) for box in boxes])
    z = corners[:, 2:]
    # (False of what is no number.)
    before = jnp.min(z) > DEPTHS * jnp.max(z)
    y = safe_divide(corners[:, 1:2], z)
    slack = 1 + SLACK * jnp.max(jnp.abs(y))
    seen = jnp.stack([jnp.floor(jnp.min(y) - slack), jnp.ceil(jnp.max(y) + slack)])
    seen = jnp.clip(seen, 0, film.H)
    return jnp.where(before, seen.astype(jnp.int32), whole)


def _corners(film: FilmMap, bounds: Float[Array, "2 3"]) -> Float[Array, "8 3"]:
    """Return the corners of a box in space as homogeneous film points."""
    which = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    return film_points(film, jnp.stack([bounds[which[:, k], k] for k in range(3)], axis=-1))


def _layers_on_the_left(mesh: Mesh, film: FilmMap, current: Bool[Array, ""]) -> Int[Array, ""]:
    """Return how many layers the ray along -x from the eye meets, by signed crossings.

    The ray is thought to lie a little below y = 0, and much less in front of z = 0, so that it
    never meets an edge.
    """
    points = film_points(film, mesh.vertices)
    points = points * binary_inverse(jnp.max(jnp.abs(points), axis=1))[:, None]
    front = front_facing(mesh, film.eye, current)
    none = _Layers(*(jnp.int32(0) for _ in _Layers._fields))
    found = on_cpu(_crossed, points, mesh.faces, front, none, elsewhere=_crossed_beside)
    inside = jnp.where(found.crossings != 0, EVERYWHERE, 0)
    closed = is_closed(mesh)
    if closed is False:
        return found.both
    fronts = found.fronts + inside
    return fronts if closed is True else jnp.where(closed, fronts, found.both)


class _Layers(NamedTuple):
    """Sums over the faces that a ray meets: of their orientation (1: it leaves, -1: it enters);
    of this for those that show their front, and for all, seen from whichever side."""

    crossings: Int[Array, ""]
    fronts: Int[Array, ""]
    both: Int[Array, ""]


def _crossed(
    points: Float[Array, "V 3"], faces: Int[Array, "F 3"], front: Bool[Array, "F"], none: _Layers
) -> _Layers:
    """Return what the ray meets, face by face."""

    def one(f, sums):
        more = _crossed_beside(points, faces[f][None], front[f][None], none)
        return jax.tree.map(jnp.add, sums, more)

    return jax.lax.fori_loop(0, faces.shape[0], one, none)


def _crossed_beside(
    points: Float[Array, "V 3"], faces: Int[Array, "F 3"], front: Bool[Array, "F"], none: _Layers
) -> _Layers:
    """Return what the ray meets, all faces side by side."""

    def around(k, sums):
        toward, signs = sums
        first, second, third = (
            jax.lax.dynamic_index_in_dim(faces, (k + j) % 3, 1, keepdims=False) for j in range(3)
        )
        value, sign = _side(points, first, second)
        return toward + points[third, 0] * value, signs + sign

    zero = jnp.zeros(faces.shape[0], points.dtype)
    toward, signs = jax.lax.fori_loop(0, 3, around, (zero, zero.astype(jnp.int32)))
    met = ((signs == 3) & (toward < 0)) | ((signs == -3) & (toward > 0))
    orientation = jnp.where(met, -jnp.sign(signs), 0)
    shown = jnp.where(front, orientation, 0)
    sums = (orientation, shown, 2 * shown - orientation)
    return _Layers(*(jnp.sum(x, dtype=jnp.int32) for x in sums))


def _side(points: Float[Array, "V 3"], first: Int[Array, "F"], second: Int[Array, "F"]):
    """Return on which side of the edge between two vertices, seen along x, the ray passes: value
    and sign.

    The same for both faces that share the edge, but for the sign.
    """
    swap = first > second
    a, b = points[jnp.minimum(first, second)], points[jnp.maximum(first, second)]
    # Two rounded products are compared: their difference might be contracted, and unlike 0.
    left, right = a[:, 1] * b[:, 2], b[:, 1] * a[:, 2]
    tie = jnp.where(a[:, 2] != b[:, 2], b[:, 2] - a[:, 2], b[:, 1] - a[:, 1])
    sign = jnp.where(left != right, jnp.where(left > right, 1, -1), jnp.sign(tie).astype(jnp.int32))
    value = left - right
    return jnp.where(swap, -value, value), jnp.where(swap, -sign, sign)
