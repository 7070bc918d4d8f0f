"""Loops over chunks of items that come in groups, one chunk after another."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

#: What a loop adds up.
Total = TypeVar("Total")
#: Items in a chunk.
AT_A_TIME = 4096


def fold_groups(
    sizes: Int[Array, "G"],
    add: Callable[[Total, Int[Array, "K"], Int[Array, "K"], Bool[Array, "K"]], Total],
    start: Total,
) -> Total:
    """`start` after `add(total, group, rank, there)` for all items of groups of these sizes.

    Chunk by chunk: the items' groups, their numbers there, and False past the last item.
    """
    upto = jnp.cumsum(sizes)

    def chunk(state: tuple[Array, Total]) -> tuple[Array, Total]:
        first, total = state
        item = first + jnp.arange(AT_A_TIME, dtype=jnp.int32)
        group = jnp.searchsorted(upto, item, side="right").astype(jnp.int32)
        group = jnp.minimum(group, len(sizes) - 1)
        rank = item - (upto - sizes)[group]
        return first + AT_A_TIME, add(total, group, rank, item < upto[-1])

    return jax.lax.while_loop(lambda s: s[0] < upto[-1], chunk, (jnp.int32(0), start))[1]
