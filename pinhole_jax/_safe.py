"""Norms, roots and divisions whose derivatives stay finite.

`jnp.where` alone does not help at a singular point: the branch that is not taken is still
differentiated, and 0 * inf is NaN. Each function here therefore feeds the singular branch a
harmless argument first (the "double where").
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the square root of x where x > 0, else 0 with derivative 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_divide(
    numerator: Float[Array, "*#shape"], denominator: Float[Array, "*#shape"]
) -> Float[Array, "*shape"]:
    """Return numerator / denominator where the denominator is not 0, else 0 with derivative 0."""
    nonzero = denominator != 0
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1), 0)


def dot(a: Float[Array, "*#batch n"], b: Float[Array, "*#batch n"]) -> Float[Array, "*batch"]:
    """Return the inner product over the last axis, at full precision on every device."""
    return jnp.sum(a * b, axis=-1)


def norm(vector: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the Euclidean length; scaled by the largest entry, so nothing over- or underflows."""
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(vector), axis=-1, keepdims=True))
    unit = safe_divide(vector, scale)
    return scale[..., 0] * safe_sqrt(dot(unit, unit))


def normalize(vector: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """Return vector / |vector|; the null vector maps to itself, with derivative 0."""
    return safe_divide(vector, norm(vector)[..., None])
