"""The planes of a mesh's faces, and the faces whose front the eye sees.

Planes of vertices that are not traced are made by NumPy, for which nothing is compiled.
"""

from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._numerics.arrays import is_concrete


class Planes(NamedTuple):
    """A mesh's face planes: x is before face f where `normal[:, f].(x - corner[:, f]) > 0`.

    A normal's length is the face's area in a unit of the mesh's own, so that it neither overflows
    nor vanishes. `box` holds the vertices' least and largest coordinates, `fingerprint` names the
    vertices that all this was made from; None for vertices that will not change.
    """

    normal: Float[Array, "3 F"]
    corner: Float[Array, "3 F"]
    box: Float[Array, "2 3"]
    fingerprint: UInt32[Array, ""] | None


def planes_of(
    vertices: Float[Array | np.ndarray, "V 3"], faces: Int[Array | np.ndarray, "F 3"]
) -> Planes:
    """Return the faces' planes; not differentiated."""
    if not is_concrete(vertices, faces):
        return _traced_planes(jax.lax.stop_gradient(vertices), faces)
    with np.errstate(all="ignore"):  # (overflow is infinite, as in a program)
        planes = _planes(np.asarray(vertices), np.asarray(faces), np)
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), x.dtype), planes)


def _planes(points: Any, faces: Any, xp: ModuleType) -> Planes:
    """Return planes as arrays of `xp`: NumPy or `jax.numpy`."""
    a, b, c = (xp.take(points, corner, axis=0).T for corner in faces.T)
    kind = np.finfo(points.dtype)
    most = -kind.minexp - 1  # both the power and its inverse are normal numbers
    exponent = xp.frexp(xp.max(xp.abs(points), initial=0))[1]
    unit = xp.ldexp(xp.ones((), points.dtype), -xp.clip(exponent, -most, most)) / 4
    (bx, by, bz), (cx, cy, cz) = (b - a) * unit, (c - a) * unit
    normal = xp.stack([by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx])
    return Planes(normal, a, box_of(points, xp), fingerprint(points, xp))


_traced_planes = jax.jit(partial(_planes, xp=jnp))


def box_of(points: Any, xp: ModuleType = jnp) -> Any:
    """Return the least and largest coordinates (2, 3); zeros without points."""
    if not points.shape[0]:
        return xp.zeros((2, 3), points.dtype)
    return xp.stack([points.min(axis=0), points.max(axis=0)])


def fingerprint(points: Any, xp: ModuleType = jnp) -> Any:
    """Return a checksum of the bits (uint32), for NumPy or `jax.numpy`.

    Integer sums do not depend on the order of summation. Points at 0 at the end change nothing.
    """
    bits = xp.ravel(points).view(np.uint32)
    weight = xp.arange(bits.shape[0], dtype=np.uint32) * np.uint32(2654435761) | np.uint32(1)
    mixed = (bits ^ (bits >> 16)) * weight  # round numbers have nothing but zeros in their low bits
    return xp.sum(mixed ^ (mixed >> 15), dtype=np.uint32)


def in_front(planes: Planes, e: Float[Array, "3"]) -> Bool[Array, "*F"]:
    """Return the faces whose planes the eye is before.

    Relative to the planes' own corners: a scene that is much larger than the object, and the eye
    beside it, loses nothing.
    """
    x, y, z = (planes.normal[k] * (e[k] - planes.corner[k]) for k in range(3))
    return x + y + z > 0
