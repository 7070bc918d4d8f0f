"""Batches of what is better worked off one after another than in lock step."""

from collections.abc import Callable
from typing import Any

import jax


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
