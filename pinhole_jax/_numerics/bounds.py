"""The least and the most of two numbers, for kernels of single numbers.

`jnp.minimum` and `jnp.maximum` pass on what is no number, and tell 0 from -0: ten instructions of a
processor, where these are one. Of a number and of what is none they return the second.
"""

import jax.numpy as jnp
from jaxtyping import Array, Num


def least(x: Num[Array, "*#K"], y: Num[Array, "*#K"] | int | float) -> Num[Array, "*K"]:
    """Return the smaller one."""
    return jnp.where(x < y, x, y)


def most(x: Num[Array, "*#K"], y: Num[Array, "*#K"] | int | float) -> Num[Array, "*K"]:
    """Return the larger one."""
    return jnp.where(x > y, x, y)


def within(
    x: Num[Array, "*#K"],
    low: Num[Array, "*#K"] | int | float,
    high: Num[Array, "*#K"] | int | float,
) -> Num[Array, "*K"]:
    """Return x, or the bound that it is beyond."""
    return least(most(x, low), high)
