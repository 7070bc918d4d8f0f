"""Batches of what is better worked off one after another than in lock step."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int


def in_turn(function: Callable[..., Any], batched: Any, args: tuple[Any, ...]) -> Any:
    """Return the function of each element of a batch, one element after another.

    `batched` says of each leaf of the arguments whether its first axis counts the batch.
    """
    leaves, structure = jax.tree.flatten(args)
    which = jax.tree.leaves(batched)

    def one(moving):
        rest = iter(moving)
        whole = [next(rest) if b else x for x, b in zip(leaves, which, strict=True)]
        return function(*jax.tree.unflatten(structure, whole))

    return jax.lax.map(one, [x for x, b in zip(leaves, which, strict=True) if b])


def in_chunks(
    add: Callable[[Any, Array], Any],
    start: Any,
    size: int,
    end: Int[Array, ""],
    begin: Int[Array, ""] | None = None,
) -> Any:
    """Return `start` after `add(total, first)` for each chunk of numbers from `begin` (or 0) up to
    `end`, which begins with `first`; the last one may reach beyond the end."""

    def body(state: tuple[Array, Any]) -> tuple[Array, Any]:
        first, total = state
        return first + size, add(total, first)

    place = jnp.int32(0) if begin is None else begin
    return jax.lax.while_loop(lambda s: s[0] < end, body, (place, start))[1]
