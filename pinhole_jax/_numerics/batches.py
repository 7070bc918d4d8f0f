"""Loops over chunks, one after another rather than in lock step."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

#: What a loop adds up.
Total = TypeVar("Total")


def in_chunks(
    add: Callable[[Total, Array], Total], start: Total, size: int, end: Int[Array, ""]
) -> Total:
    """Return `start` after `add(total, first)` for each chunk of numbers from 0 up to `end`,
    which begins with `first`; the last one may reach beyond the end."""

    def body(state: tuple[Array, Total]) -> tuple[Array, Total]:
        first, total = state
        return first + size, add(total, first)

    return jax.lax.while_loop(lambda s: s[0] < end, body, (jnp.int32(0), start))[1]
