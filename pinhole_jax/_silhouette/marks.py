"""Which pixels hold more than one chain of contour: marks that add up over their pieces."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.bounds import most
from .coverage import Pieces

#: How many pieces there are, may come in from other pixels, rise, fall, go right and left. (What
#: they would do if all had their covered side on the same hand.)
COUNTED = ("pieces", "entries", "rise", "fall", "right", "left")
BITS = 5


class Marks(NamedTuple):
    """What tells a pixel that one chain of contour crosses from one where contours overlap.

    Sums over the pixel's pieces: of their layers, and of 6 counters (`COUNTED`), `BITS` bits each.
    """

    layers: Float[Array, "*N"]
    counters: Int[Array, "*N"]


def marks(pieces: Pieces) -> Marks:
    """Return what each piece adds to its pixel's marks."""
    dx, dy = (pieces.end[..., k] - pieces.start[..., k] for k in (0, 1))
    up, right = -pieces.jump * dy, -pieces.jump * dx
    tiny = 8 * jnp.finfo(dx.dtype).eps
    entries = pieces.valid & pieces.enters
    flags = [pieces.valid, entries, up > tiny, up < -tiny, right > tiny, right < -tiny]
    counters = sum(flag.astype(jnp.int32) << (BITS * k) for k, flag in enumerate(flags))
    return Marks(jnp.abs(pieces.jump), jnp.asarray(counters))


def chain_layers(marks: Marks) -> Float[Array, "*N"]:
    """Return how many layers a pixel's contour bounds if it is one chain that never turns back.

    0 where it may be anything else: then parts of the pixel may be uncovered and others covered
    more than once.
    """
    most = (1 << BITS) - 1
    pieces, entries, rise, fall, right, left = (
        (marks.counters >> (BITS * k)) & most for k in range(len(COUNTED))
    )
    straight = (rise == 0) | (fall == 0) | (right == 0) | (left == 0)
    # A piece has a layer at least: with few layers no counter has run over.
    chain = (entries == 1) & straight & (marks.layers <= most)
    pieces = pieces.astype(marks.layers.dtype)
    layers = jnp.where(marks.layers == pieces, 1, jnp.where(marks.layers == 2 * pieces, 2, 0))
    return jnp.where(chain, layers, 0).astype(marks.layers.dtype)


def overlaps(marks: Marks, winding: Float[Array, "*N"]) -> Bool[Array, "*N"]:
    """Return which pixels must be resolved: not crossed by one chain of one layer, and with so few
    layers (`winding`, the mean) that the pieces in them might take all away."""
    layers = marks.layers
    return (layers > 0) & (chain_layers(marks) != 1) & (winding <= layers)


def winding_jumps(pieces: Pieces) -> Float[Array, "*P"]:
    """Return by how much a row's winding number, at its bottom line, jumps at each piece.

    Of the pieces of a curve in a row the first counts, if the curve enters the row there.
    """
    enters = pieces.start[..., 1] <= pieces.row.astype(pieces.jump.dtype)
    return jnp.where(pieces.passes & pieces.first & enters, pieces.jump, 0)


def drops(pieces: Pieces) -> Float[Array, "*P"]:
    """Return how many layers fewer than at the pixel's lower left corner there may be on one side
    of each piece: what is more at the corner than all of these is covered all over the pixel.

    The way from the corner to a point goes up the pixel's left side, then to the right. A piece
    that comes in on that side is met there, and is left behind again where the way turns.
    """
    column, row = pieces.column.astype(pieces.jump.dtype), pieces.row.astype(pieces.jump.dtype)
    # One that comes in at the corner itself has met the row's bottom in the pixel before.
    after = (pieces.start[..., 1] > row) | (pieces.passes & ~pieces.first)
    comes_in = (pieces.start[..., 0] == column) & after
    change = jnp.where(comes_in, -pieces.jump, pieces.jump)
    # Below what lies on the row's bottom there is the pixel's border.
    return jnp.where(pieces.passes, most(-change, 0), jnp.abs(change))
