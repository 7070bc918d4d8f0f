"""One ray, one primitive: where they meet. Units: t in world lengths, for a unit direction."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._safe import dot, safe_divide, safe_sqrt

Vector = Float[Array, "*#batch 3"]


class Meeting(NamedTuple):
    """Distance `t` (inf where they do not meet) and barycentric coordinates (0 for spheres)."""

    t: Float[Array, "*batch"]
    barycentric: Float[Array, "*batch 3"]


def perpendicular(direction: Float[Array, "*batch 3"]) -> tuple[Array, Array]:
    """Return two unit vectors orthogonal to a unit direction and to one another.

    Frisvad's basis (2012) in the form of Duff et al. (2017), which has no singular direction.
    """
    x, y, z = (direction[..., k] for k in range(3))
    sign = jnp.where(z < 0, -1, 1).astype(z.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    return first, jnp.stack([b, sign + y * y * a, -y], axis=-1)


def ray_triangle(
    origin: Vector, direction: Vector, axes: tuple[Vector, Vector], a: Vector, b: Vector, c: Vector
) -> Meeting:
    """Return where rays meet triangles, from either side, edges and vertices included.

    Watertight in the sense of Woop, Benthin and Wald (2013): corners are seen from the ray in a
    frame (`axes` from `perpendicular`, and the direction), and the signs of three edge functions
    decide. Each corner's coordinates depend on ray and corner alone, and an edge function is worked
    out from the edge's lesser end, so two triangles that share an edge never disagree about it,
    also where the compiler fuses a multiply and an add.
    """
    first, second = axes
    p, q, r = (_seen(origin, direction, first, second, corner) for corner in (a, b, c))
    u, v, w = _edge(q, r), _edge(r, p), _edge(p, q)
    det = u + v + w
    inside = ((u >= 0) & (v >= 0) & (w >= 0)) | ((u <= 0) & (v <= 0) & (w <= 0))
    u, v, w = safe_divide(u, det), safe_divide(v, det), safe_divide(w, det)
    t = u * p[2] + v * q[2] + w * r[2]
    met = inside & (det != 0) & (t > 0)
    return Meeting(jnp.where(met, t, jnp.inf), jnp.stack([u, v, w], axis=-1))


def _seen(origin: Vector, direction: Vector, first: Vector, second: Vector, corner: Vector):
    offset = corner - origin
    return dot(offset, first), dot(offset, second), dot(offset, direction)


def _edge(p, q) -> Array:
    """Return the doubled area of (ray, p, q); exactly minus that of (ray, q, p)."""
    swap = (q[0] < p[0]) | ((q[0] == p[0]) & (q[1] < p[1]))
    ax, bx = jnp.where(swap, q[0], p[0]), jnp.where(swap, p[0], q[0])
    ay, by = jnp.where(swap, q[1], p[1]), jnp.where(swap, p[1], q[1])
    area = ax * by - ay * bx
    return jnp.where(swap, -area, area)


def ray_sphere(
    origin: Vector, direction: Vector, center: Vector, radius: Float[Array, "*#batch"]
) -> Meeting:
    """Return where rays first meet spheres in front of the origin (from inside: the far wall).

    The discriminant is taken from the perpendicular distance to the ray, and the near root from the
    product of the roots: no cancellation at a distance (Haines et al., Ray Tracing Gems, ch. 7).
    """
    offset = center - origin
    along = dot(offset, direction)
    aside = offset - along[..., None] * direction
    distance = safe_sqrt(dot(aside, aside))
    room = (radius - distance) * (radius + distance)
    root = safe_sqrt(room)
    far = along + jnp.where(along < 0, -root, root)  # the root of larger magnitude
    length = safe_sqrt(dot(offset, offset))
    near = safe_divide((length - radius) * (length + radius), far)
    least, most = jnp.minimum(near, far), jnp.maximum(near, far)
    t = jnp.where(least > 0, least, most)
    met = (room >= 0) & (t > 0)
    return Meeting(jnp.where(met, t, jnp.inf), jnp.zeros((*t.shape, 3), t.dtype))


def ray_box(
    origin: Vector, inverse: Vector, low: Vector, high: Vector, limit: Float[Array, "*#batch"]
) -> Bool[Array, "*batch"]:
    """Return whether rays can meet something in a box before `limit`; never False by rounding.

    `inverse` is one over the direction, finite. The far end is stretched by the error bound of
    three roundings (Ize, "Robust BVH Ray Traversal", 2013).
    """
    t0, t1 = (low - origin) * inverse, (high - origin) * inverse
    near = jnp.max(jnp.minimum(t0, t1), axis=-1)
    far = jnp.min(jnp.maximum(t0, t1), axis=-1) * (1 + 8 * jnp.finfo(origin.dtype).eps)
    return (near <= far) & (far > 0) & (near <= limit)
