"""One number of turns for all that `vmap` runs side by side."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int


@jax.custom_batching.custom_vmap
def largest(number: Int[Array, ""]) -> Int[Array, ""]:
    """Return a number; under `vmap` the largest of all.

    A loop that runs so many turns is one loop for all. With a number of turns for each, JAX keeps
    what is done already by copying all that the loop carries, at each turn.
    """
    return number


@largest.def_vmap
def _largest_of_all(axis_size: int, in_batched: list[bool], number: Int[Array, "B"]):
    del axis_size
    return largest(jnp.max(number) if in_batched[0] else number), False
