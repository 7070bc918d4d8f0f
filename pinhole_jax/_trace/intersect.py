"""One ray, one primitive: where they meet. Units: t in world lengths, for a unit direction."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics.components import Parts, inner, perpendicular
from .._numerics.safe import safe_divide, safe_sqrt


def _beside(direction: Parts, *corners: Parts) -> list[Parts]:
    """Return corners' two coordinates beside a ray from the origin, and the one along it."""
    axes = *perpendicular(direction), direction
    return [[inner(corner, axis) for axis in axes] for corner in corners]


def ray_plane(direction: Parts, a: Parts, b: Parts, c: Parts) -> tuple[Array, Parts]:
    """Return the distance (never inf) and barycentric coordinates of known hits of triangles.

    Rays begin at the origin; all is by components. Of a sliver rounding may leave nothing but signs
    that disagree: the ray is held within it.
    """
    p, q, r = _beside(direction, a, b, c)
    u, v, w = (x - y for x, y in _edges(p, q, r))
    sign = jnp.where(u + v + w < 0, -1, 1).astype(u.dtype)
    u, v, w = (jnp.where(x * sign < 0, 0, x * sign) for x in (u, v, w))
    det = u + v + w
    flat = det == 0
    u, v, w = (jnp.where(flat, 1 / 3, safe_divide(x, det)) for x in (u, v, w))
    return u * p[2] + v * q[2] + w * r[2], (u, v, w)


def ray_triangle(direction: Parts, a: Parts, b: Parts, c: Parts) -> Float[Array, "*batch"]:
    """Return the distances of triangles in front of the origin; inf for misses.

    Either side counts, and so do edges and vertices.

    Watertight in the sense of Woop, Benthin and Wald (2013): each corner's coordinates beside the
    ray depend on ray and corner alone, and the signs of three edge functions decide. Each compares
    two products of them, so two triangles that share an edge never disagree.
    """
    p, q, r = _beside(direction, a, b, c)
    u, v, w = (x - y for x, y in _edges(p, q, r))
    det = u + v + w
    met = _around(p, q, r) & (det != 0)
    # XLA works out a quotient once, what comes after it once for each use.
    t = jnp.where(met, u * p[2] + v * q[2] + w * r[2], jnp.inf) / jnp.where(met, det, 1)
    return jnp.where(t > 0, t, jnp.inf)


def _edges(p, q, r) -> list[tuple[Array, Array]]:
    """Return two products for each side: their difference is its doubled area with the ray."""
    return [(a[0] * b[1], a[1] * b[0]) for a, b in ((q, r), (r, p), (p, q))]


def _around(p, q, r) -> Array:
    """Return True for rays within a triangle of either winding, or on its edge.

    An edge's sign is taken from its two products, not from their difference: a fused multiply and
    add would round the two differently, and the edge's two triangles could both lose the ray. Of a
    triangle seen from its side all products may be equal by rounding, far beside it too: so the ray
    has to be in the box about the corners, which holds whatever it meets.
    """
    boxed = True
    for k in range(2):
        boxed &= jnp.minimum(jnp.minimum(p[k], q[k]), r[k]) <= 0
        boxed &= jnp.maximum(jnp.maximum(p[k], q[k]), r[k]) >= 0
    (a, b), (c, d), (e, f) = _edges(p, q, r)
    return boxed & (((a >= b) & (c >= d) & (e >= f)) | ((a <= b) & (c <= d) & (e <= f)))


def ray_sphere(direction: Parts, center: Parts, radius: Array) -> Float[Array, "*batch"]:
    """Return the distances of spheres in front of the origin (from inside: of the far wall); inf
    for misses.

    The discriminant is taken from the perpendicular distance to the ray, and the near root from the
    product of the roots: no cancellation at a distance (Haines et al., Ray Tracing Gems, ch. 7). A
    ray that touches a sphere meets it; there the root's infinite derivative counts as 0.
    """
    along = inner(center, direction)
    aside = [x - along * way for x, way in zip(center, direction, strict=True)]
    distance = safe_sqrt(inner(aside, aside))
    half_chord_squared = (radius - distance) * (radius + distance)
    root = safe_sqrt(half_chord_squared)
    far = along + jnp.where(along < 0, -root, root)  # the root of larger magnitude
    length = safe_sqrt(inner(center, center))
    near = safe_divide((length - radius) * (length + radius), far)
    near = jnp.where(root > 0, near, far)  # a ray that touches: the same derivative, too
    least, most = jnp.minimum(near, far), jnp.maximum(near, far)
    t = jnp.where(least > 0, least, most)
    met = (half_chord_squared >= 0) & (t > 0)
    return jnp.where(met, t, jnp.inf)
