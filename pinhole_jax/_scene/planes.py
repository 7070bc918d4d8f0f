"""The planes of a mesh's faces, and which of them the eye is before.

Of vertices that are there planes are made by NumPy, for which nothing is compiled; of traced ones
within their program.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._numerics.safe import binary_scale


class Planes(NamedTuple):
    """A mesh's face planes: x is before face f where `normal[:, f].(x - corner[:, f]) > 0`.

    A normal's length is the face's area in a unit of the mesh's own, so that it neither overflows
    nor vanishes. `box` holds the vertices' least and largest coordinates, `fingerprint`
    names the vertices that all this was made from; None where these are known to stay.
    """

    normal: Float[Array, "3 F"]
    corner: Float[Array, "3 F"]
    box: Float[Array, "2 3"]
    fingerprint: UInt32[Array, ""] | None


@jax.jit
def planes_of(vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]) -> Planes:
    """Return the faces' planes."""
    vertices = jax.lax.stop_gradient(vertices)
    a, b, c = jnp.moveaxis(vertices[faces], 1, 0)
    unit = binary_scale(vertices) / 4
    normal = jnp.cross((b - a) * unit, (c - a) * unit)
    return Planes(normal.T, a.T, box_of(vertices), fingerprint(vertices))


def box_of(vertices: Float[Array, "V 3"]) -> Float[Array, "2 3"]:
    """Return the least and largest coordinates; zeros where there are no vertices."""
    if not vertices.shape[0]:
        return jnp.zeros((2, 3), vertices.dtype)
    return jnp.stack([jnp.min(vertices, axis=0), jnp.max(vertices, axis=0)])


@jax.jit
def fingerprint(vertices: Float[Array, "V 3"]) -> UInt32[Array, ""]:
    """Return a checksum of the bits; integer sums do not depend on the order of summation."""
    return _checksum(jax.lax.bitcast_convert_type(vertices, jnp.uint32).reshape(-1), jnp)


def fingerprint_of(points: np.ndarray) -> np.uint32:
    """Return `fingerprint` of vertices that are there."""
    return _checksum(np.ascontiguousarray(points).view(np.uint32).reshape(-1), np)


def _checksum(bits: Any, of: Any) -> Any:
    weight = of.arange(bits.shape[0], dtype=np.uint32) * of.uint32(2654435761) | of.uint32(1)
    mixed = (bits ^ (bits >> 16)) * weight  # round numbers have nothing but zeros in their low bits
    return of.sum(mixed ^ (mixed >> 15), dtype=np.uint32)


def planes_at_hand(
    vertices: Float[Array | np.ndarray, "V 3"], faces: Int[Array | np.ndarray, "F 3"]
) -> Planes:
    """Return the planes of vertices that are there."""
    points, triangles = np.asarray(vertices), np.asarray(faces)
    with np.errstate(all="ignore"):  # (what overflows is infinite, as in a program)
        a, b, c = (np.take(points, corner, axis=0).T for corner in triangles.T)
        unit = _binary_scale(points) / 4
        (bx, by, bz), (cx, cy, cz) = (b - a) * unit, (c - a) * unit
        normal: Any = np.stack([by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx])
    box = np.stack([points.min(axis=0), points.max(axis=0)]) if len(points) else np.zeros((2, 3))
    rest: Any = a, box.astype(points.dtype), fingerprint_of(points)
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), x.dtype), Planes(normal, *rest))


def _binary_scale(x: np.ndarray) -> Any:
    """Return `binary_scale` of numbers that are there."""
    most = 1 - np.finfo(x.dtype).minexp - 2  # both the power and its inverse are normal numbers
    _, exponent = np.frexp(np.abs(x).max(initial=0))
    return np.ldexp(np.ones((), x.dtype), -np.clip(exponent, -most, most))


def in_front(planes: Planes, e: Float[Array, "3"]) -> Bool[Array, "*F"]:
    """Return which planes the eye is before; taken from the planes' own corners, so that a scene
    that is much larger than the object and the eye beside it loses nothing."""
    x, y, z = (planes.normal[k] * (e[k] - planes.corner[k]) for k in range(3))
    return x + y + z > 0
