"""How the covered areas of a fit's pixels grow as curves move.

Of a rough mesh's pieces most are hidden and bound nothing. On a CPU these are passed over, and the
others are gone through one after the other, in a single kernel; elsewhere side by side.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._numerics.one_kernel import on_cpu, put
from .one_pixel import loop


class Bounds(NamedTuple):
    """Pieces of one kind: whose curve each is; the derivative of its pixel's area by the curve's
    homogeneous points; in which slot that pixel is (past the end: in none)."""

    curve: Int[Array, "K"]
    flux: Float[Array, "K n 3"]
    slot: Int[Array, "K"]


@jax.custom_jvp
def growing(
    points: list[Float[Array, "_ _ 3"]], bounds: list[Bounds], moves: Bool[Array, "P"]
) -> Float[Array, "P"]:
    """Return zeros whose derivative is that of pixels' areas by the curves' points; of pixels that
    do not `move` it is 0."""
    del bounds
    return jnp.zeros(moves.shape, points[0].dtype)


@growing.defjvp
def _(primals, tangents):
    held = primals[1:]
    return growing(*primals), _grown(tangents[0], *jax.lax.stop_gradient(held))


@jax.custom_batching.custom_vmap
def _grown(moved, bounds, moves):
    """Return by how much areas grow as points move."""
    return _along_each([x[None] for x in moved], bounds, moves)[0]


@_grown.def_vmap
def _(size, batched, moved, bounds, moves):
    if any(jax.tree.leaves(batched[1:])):
        every = jax.tree.map(
            lambda x, own: x if own else jnp.broadcast_to(x, (size, *x.shape)),
            (moved, bounds, moves),
            tuple(batched),
        )
        return jax.lax.map(lambda given: _grown(*given), every), True
    each = [x if own else x[None] for x, own in zip(moved, batched[0], strict=True)]
    each = [jnp.broadcast_to(x, (size, *x.shape[1:])) for x in each]
    return _along_each(each, bounds, moves), True


def _along_each(
    moved: list[Float[Array, "n _ _ 3"]], bounds: list[Bounds], moves: Bool[Array, "P"]
) -> Float[Array, "n P"]:
    """Return by how much areas grow, along each of some ways in which points move."""
    n, P = moved[0].shape[0], moves.shape[0]
    none = jnp.zeros(n * P, moved[0].dtype)
    return on_cpu(_in_turn, moved, bounds, moves, none, elsewhere=_side_by_side).reshape(n, P)


def _in_turn(moved, bounds, moves, table):
    for way, pieces in zip(moved, bounds, strict=True):
        number = jnp.int32(pieces.slot.shape[0])
        table = loop(number, functools.partial(_with_piece, way, pieces, moves), table)
    return table


def _with_piece(moved: Array, pieces: Bounds, moves: Array, k: Array, table: Array) -> Array:
    """Return the table of what pixels grow by, with one more piece."""
    n, P = moved.shape[0], moves.shape[0]
    slot, curve = jnp.minimum(pieces.slot[k], P - 1), pieces.curve[k]
    columns = [*np.ndindex(moved.shape[2:])]
    flux = [pieces.flux[k, i, j] for i, j in columns]
    bounds_it = functools.reduce(jnp.logical_or, [x != 0 for x in flux])
    bounds_it &= (pieces.slot[k] < P) & moves[slot]

    def along(way, table):
        parts = [x * moved[way, curve, i, j] for x, (i, j) in zip(flux, columns, strict=True)]
        place = way * P + slot
        return put(table, table[place] + functools.reduce(jnp.add, parts), place)

    return loop(jnp.where(bounds_it, jnp.int32(n), 0), along, table)


def _side_by_side(moved, bounds, moves, table):
    # (Column by column: to gather whole points with their derivatives took a fifth of a step.)
    table = table.reshape(-1, moves.shape[0])
    for way, pieces in zip(moved, bounds, strict=True):
        columns = np.ndindex(way.shape[2:])
        parts = [pieces.flux[None, :, i, j] * way[:, :, i, j][:, pieces.curve] for i, j in columns]
        table = table.at[:, pieces.slot].add(functools.reduce(jnp.add, parts), mode="drop")
    return jnp.where(moves, table, 0).reshape(-1)
