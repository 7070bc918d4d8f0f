"""Norms, roots and divisions whose derivatives stay finite.

`jnp.where` alone does not help at a singular point: the branch that is not taken is still
differentiated, and 0 * inf is NaN. Each function here therefore feeds the singular branch a
harmless argument first (the "double where").
"""

import functools

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


def times(a: Float[Array, "*rows n"], b: Float[Array, "n *columns"]) -> Float[Array, "..."]:
    """Return the product of small matrices, written out: no library is called for it."""
    left = a.reshape(*a.shape, *(1,) * (b.ndim - 1))
    right = b.reshape(*(1,) * (a.ndim - 1), *b.shape)
    return jnp.sum(left * right, axis=a.ndim - 1)


def norm(vector: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Return the Euclidean length; scaled by the largest entry, so nothing over- or underflows."""
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(vector), axis=-1, keepdims=True))
    unit = safe_divide(vector, scale)
    return scale[..., 0] * safe_sqrt(dot(unit, unit))


def length(*components: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return the Euclidean length of a vector's components, as `norm` does."""
    size = functools.reduce(jnp.maximum, map(jnp.abs, components))
    scale = jax.lax.stop_gradient(size)
    units = [safe_divide(x, scale) for x in components]
    return scale * safe_sqrt(functools.reduce(jnp.add, [x * x for x in units]))


def normalize(vector: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
    """Return vector / |vector|; the null vector maps to itself, with derivative 0."""
    return safe_divide(vector, norm(vector)[..., None])


def binary_scale(x: Float[Array, "..."]) -> Float[Array, ""]:
    """Return a power of 2 that brings the largest entry's size to between 1/2 and 1; not
    differentiated.

    Products of numbers scaled by it do not overflow, and nothing is rounded. 1 where all are 0.
    """
    x = jax.lax.stop_gradient(x)
    return binary_inverse(jnp.max(jnp.abs(x), initial=0))


def binary_inverse(size: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return powers of 2 whose products with the sizes are between 1/2 and 1, or nearly.

    1 for sizes of 0 and for what is not finite.
    """
    size = jax.lax.stop_gradient(size)
    kind = jnp.finfo(size.dtype)
    integer = jnp.dtype(f"int{kind.bits}")
    bits = jax.lax.bitcast_convert_type(jnp.abs(size), integer)
    field = bits >> kind.nmant
    bias = 1 - kind.minexp
    most = bias - 2  # both the power and its inverse are normal numbers
    exponent = jnp.where((field > 2 * bias) | (bits == 0), 0, field - (bias - 1))
    power = bias - jnp.clip(exponent, -most, most)
    return jax.lax.bitcast_convert_type(power << kind.nmant, size.dtype)


def cross_of_difference(
    head: Float[Array, "3"], tail: Float[Array, "3"], other: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Return a vector along (head - tail) x other, right to rounding however parallel they are.

    The rounding errors of difference and products are worked out (Knuth, Dekker) and added.
    """
    a, b = head - tail, other
    scale_a, scale_b = (binary_inverse(jnp.max(jnp.abs(x))) for x in (a, b))
    plain = jnp.cross(a * scale_a, b * scale_b)
    head, tail, b = jax.lax.stop_gradient((head * scale_a, tail * scale_a, b * scale_b))
    a = _held(head - tail)
    back = _held(a - head)
    low = (head - _held(a - back)) - (tail + back)

    def pairs(x, y):
        return jnp.roll(x, -1) * jnp.roll(y, 1), jnp.roll(x, 1) * jnp.roll(y, -1)

    first, second = (_held(x) for x in pairs(a, b))
    left = _product_error(jnp.roll(a, -1), jnp.roll(b, 1), first)
    right = _product_error(jnp.roll(a, 1), jnp.roll(b, -1), second)
    more, less = pairs(low, b)
    exact = (first - second) + ((left - right) + (more - less))
    return plain + (exact - jax.lax.stop_gradient(plain))


def _product_error(x: Array, y: Array, product: Array) -> Array:
    """Return x y - product, exactly (Dekker)."""
    factor = 2.0 ** (-(jnp.finfo(x.dtype).nmant + 2) // -2) + 1

    def halves(value):
        large = _held(value * factor)
        high = _held(large - _held(large - value))
        return high, value - high

    (xh, xl), (yh, yl) = halves(x), halves(y)
    return ((xh * yh - product) + xh * yl + xl * yh) + xl * yl


def _held(x: Array) -> Array:
    """Return x, hidden from the compiler: it is rounded as it is written."""
    return jax.lax.optimization_barrier(x)
