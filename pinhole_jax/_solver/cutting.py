"""The pieces that pixels cut curves into, for a fit.

On a CPU curve by curve, row by row and pixel by pixel, in a single kernel, so that a buffer with
more room than pieces costs nothing; elsewhere side by side.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._numerics.one_kernel import on_cpu, put
from .._numerics.running import running_sum
from .._silhouette.coverage import (
    Pieces,
    in_pixel,
    in_row,
    monotone,
    piece_counts,
    rows_of,
    split,
    taken,
)
from .._silhouette.curves import Curves
from .._silhouette.marks import marks, winding_jumps
from .._silhouette.sweep import sweepable
from .by_pixel import Steps
from .one_pixel import loop

MAX_ROWS = 1 << 14


class Cut(NamedTuple):
    """Pieces: what they add to their pixels, unused slots past the end (see `Steps`); what a sweep
    asks of them, column by column (see `Cells`); whose curve each is, and where it begins and ends
    (px: x, y, x, y)."""

    steps: Steps
    swept: tuple[Float[Array, "*P"], ...]
    curve: Int[Array, "*P"]
    ends: tuple[Float[Array, "*P"], ...]


def cut(
    curves: Curves, count: Int[Array, ""], P: int, W: Int[Array, ""], H: Int[Array, ""]
) -> tuple[Cut, Int[Array, ""]]:
    """Return the pieces of the first so many curves, P of them at most, and how many there are: if
    these are more, some are missing."""
    real, whole = jnp.zeros(P, curves.weight.dtype), jnp.zeros(P, jnp.int32)
    end = H * (W + 2)
    steps = Steps(whole + end, real, real, real, real, whole)
    none = Cut(steps, (real,) * 6, whole, (real,) * 4)
    return on_cpu(_in_turn, curves, count, W, H, none, elsewhere=_side_by_side)


def _of(pieces: Pieces, W, end) -> Cut:
    cell = jnp.where(pieces.valid, pieces.row * (W + 2) + pieces.column + 1, end)
    sizes = pieces.height, pieces.area, winding_jumps(pieces), pieces.jump
    steps = Steps(cell, *sizes, marks(pieces).counters)
    ends = tuple(point[..., k] for point in (pieces.start, pieces.end) for k in (0, 1))
    return Cut(steps, sweepable(pieces), pieces.curve, ends)


def _in_turn(curves: Curves, count, W, H, none: Cut) -> tuple[Cut, Int[Array, ""]]:
    P, K = none.curve.shape[0], curves.weight.shape[0]

    def of_curve(k, state):
        found, needed, made = state
        m = monotone(taken(curves, k))
        rows, number = rows_of(m, H, 0), piece_counts(m, W, H)

        def of_row(row, state):
            own = in_row(m, rows.first + row, W, H)

            def of_pixel(along, state):
                found, place = state
                piece = in_pixel(m, own, along, k, jnp.array(True), W)
                at = jnp.minimum(place, P - 1)
                new = _of(piece, W, H * (W + 2))
                return jax.tree.map(lambda x, value: put(x, value, at), found, new), place + 1

            return loop(own.further + 1, of_pixel, state)

        # (What there is no room for is not looked at: the number tells.)
        fits = (number > 0) & (made + number <= P)
        found, made = loop(jnp.where(fits, rows.number, 0), of_row, (found, made))
        return found, needed + number, made

    none_yet = jnp.int32(0)
    return loop(jnp.minimum(count, K), of_curve, (none, none_yet, none_yet))[:2]


def _side_by_side(curves: Curves, count, W, H, none: Cut) -> tuple[Cut, Int[Array, ""]]:
    del count
    m = monotone(curves)
    upto = running_sum(piece_counts(m, W, H))
    slots = jnp.arange(len(none.curve), dtype=jnp.int32)
    pieces = split(m, upto, slots, W, H, MAX_ROWS)
    # (Each column of a table of these would work out all of them anew: 1.3 of a step's 5 ms.)
    pieces = jax.lax.optimization_barrier(pieces)
    return _of(pieces, W, H * (W + 2)), upto[-1].astype(jnp.int32)
