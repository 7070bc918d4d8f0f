"""Vectors as three arrays, x, y and z: the compiler runs through each in its widest instructions.

A last axis of length 3 prevents that: what a million rays meet takes 10 times as long with it.
"""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .safe import length, safe_divide

Parts = Sequence[Array]


def parts(vectors: Float[Array, "*shape 3"]) -> list[Array]:
    """Return x, y and z."""
    return [vectors[..., k] for k in range(3)]


def whole(vector: Parts) -> Float[Array, "N 3"]:
    """Return vectors of three components (N,) as one array.

    Each component is written by itself: of a stack the compiler makes one loop that works out all
    of each vector for each of its numbers.
    """
    out = jnp.zeros((vector[0].shape[0], 3), vector[0].dtype)
    for k, component in enumerate(vector):
        out = jax.lax.dynamic_update_slice(out, component[:, None], (0, k))
    return out


def inner(a: Parts, b: Parts) -> Array:
    """Return the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def outer(a: Parts, b: Parts) -> list[Array]:
    """Return the cross product."""
    cycle = ((1, 2), (2, 0), (0, 1))
    return [a[i] * b[j] - a[j] * b[i] for i, j in cycle]


def largest(*vectors: Parts) -> Array:
    """Return the largest absolute component of vectors, ray by ray; not differentiated."""
    sizes = [jnp.abs(jax.lax.stop_gradient(x)) for vector in vectors for x in vector]
    return functools.reduce(jnp.maximum, sizes)


def unit(vector: Parts) -> list[Array]:
    """Return vector / |vector|; the null vector maps to itself, with derivative 0."""
    size = length(*vector)
    return [safe_divide(x, size) for x in vector]


def perpendicular(direction: Any) -> tuple[list[Any], list[Any]]:
    """Return two unit vectors that make a right-handed frame with a unit one, of JAX or NumPy.

    Frisvad's basis (2012) in the form of Duff et al. (2017), which has no singular direction.
    """
    x, y, z = direction
    sign = 1 - 2 * (z < 0).astype(z.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    return [1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]
