"""Scenes that surround the eye: the number of layers where no curve is."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._camera.film import FilmMap, film_points
from .._numerics.safe import binary_inverse, dot, norm, normalize, safe_sqrt
from .._scene.scene import Mesh, Scene, front_facing

#: A number of layers that covers everything.
EVERYWHERE = 1 << 20


def surrounding(film: FilmMap, scene: Scene) -> Int[Array, ""]:
    """The number of layers far to the left of the film, where no curve is.

    0 unless the scene reaches through the plane of the eye; `EVERYWHERE` and more if the eye is
    within a closed mesh or a sphere.
    """
    layers = jnp.int32(0)
    film, scene = jax.lax.stop_gradient((film, scene))
    if scene.mesh is not None:
        mesh, points = scene.mesh, film_points(film, scene.mesh.vertices)
        layers = layers + jax.lax.cond(
            jnp.any(points[:, 2] <= 0),
            lambda: _layers_on_the_left(mesh, points, front_facing(mesh, film.eye)),
            lambda: jnp.int32(0),
        )
    if scene.spheres is not None:
        centre, radius = scene.spheres.centers - film.eye[None], scene.spheres.radii
        distance = norm(centre)
        tangent = safe_sqrt(distance - radius) * safe_sqrt(distance + radius)
        forward, up = film.matrix[2], film.matrix[1]
        left = normalize(jnp.cross(up, forward))
        beside = (dot(centre, left[None]) >= tangent) & (distance > radius)
        within = EVERYWHERE * jnp.sum(distance <= radius, dtype=jnp.int32)
        layers = layers + jnp.sum(beside, dtype=jnp.int32) + within
    return layers


def _layers_on_the_left(
    mesh: Mesh, points: Float[Array, "V 3"], front: Bool[Array, "F"]
) -> Int[Array, ""]:
    """The number of layers on the ray along -x from the eye, by signed crossings.

    The ray is thought to lie a little below y = 0, and much less in front of z = 0, so that it
    never meets an edge.
    """
    points = points * binary_inverse(jnp.max(jnp.abs(points), axis=1))[:, None]
    corners = mesh.faces.T
    value, sign = _side(points, corners, jnp.roll(corners, -1, axis=0))
    toward = jnp.sum(points[jnp.roll(corners, -2, axis=0), 0] * value, axis=0)
    signs = jnp.sum(sign, axis=0, dtype=jnp.int32)
    met = ((signs == 3) & (toward < 0)) | ((signs == -3) & (toward > 0))
    # 1 where the ray leaves, -1 where it enters.
    crossings = jnp.where(met, -jnp.sign(signs), 0)
    total = lambda x: jnp.sum(x, dtype=jnp.int32)
    fronts = total(jnp.where(front, crossings, 0))
    inside = jnp.where(total(crossings) != 0, EVERYWHERE, 0)
    return jnp.where(mesh.closed, fronts + inside, 2 * fronts - total(crossings))


def _side(points: Float[Array, "V 3"], first: Int[Array, "*F"], second: Int[Array, "*F"]):
    """The side on which the ray passes an edge, seen along x: value and sign.

    The same for both faces that share the edge, but for the sign.
    """
    swap = first > second
    ends = points[jnp.minimum(first, second)], points[jnp.maximum(first, second)]
    (ay, az), (by, bz) = ((end[..., 1], end[..., 2]) for end in ends)
    # Two rounded products are compared: their difference might be contracted, and unlike 0.
    left, right = ay * bz, by * az
    tie = jnp.where(az != bz, bz - az, by - ay)
    sign = jnp.where(left != right, jnp.where(left > right, 1, -1), jnp.sign(tie).astype(jnp.int32))
    value = left - right
    return jnp.where(swap, -value, value), jnp.where(swap, -sign, sign)
