"""Curves cut into pieces by the pixel grid, and what a piece adds to its pixel.

A curve that is monotone in x and y passes `j + |column(y_j) - column(y_0)|` pixels before its j-th
row, so the k-th pixel that it meets is found by bisection. Points on a grid line count for the
pixel above it or to its right.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.batches import Total, in_chunks
from .._numerics.safe import safe_divide
from .conics import bulge, film_at, unit_at

#: Pieces in a chunk.
AT_A_TIME = 4096


class Arcs(NamedTuple):
    """The conics of curves that are arcs, and True for these."""

    conic: Float[Array, "*K 3 3"]
    there: Bool[Array, "*K"]


class Monotone(NamedTuple):
    """Curves from a lower to an upper end (px).

    `rising` is 1 where that is their direction, else -1; `jump` is the number of layers on their
    right less those on their left; `arcs` is None where all are straight.
    """

    low: Float[Array, "*K 2"]
    high: Float[Array, "*K 2"]
    rising: Float[Array, "*K"]
    jump: Float[Array, "*K"]
    arcs: "Arcs | None"

    @classmethod
    def from_ends(cls, tail: Array, head: Array, weight: Array, arcs: "Arcs | None") -> "Monotone":
        """Curves from tail to head, `weight` layers more on their left."""
        up = head[..., 1] >= tail[..., 1]
        low, high = jnp.where(up[..., None], tail, head), jnp.where(up[..., None], head, tail)
        rising = jnp.where(up, 1, -1).astype(low.dtype)
        return cls(low, high, rising, -rising * weight, arcs)

    @property
    def rightward(self) -> Float[Array, "*K"]:
        """1 where the upper end is the right one, else -1."""
        return jnp.where(self.high[..., 0] >= self.low[..., 0], 1, -1).astype(self.low.dtype)

    @property
    def steep(self) -> Bool[Array, "*K"]:
        """True for curves of more height than width."""
        return (self.high - self.low)[..., 1] > jnp.abs((self.high - self.low)[..., 0])

    def x_at(self, y: Float[Array, "*K"]) -> Float[Array, "*K"]:
        """The abscissa at a height, or at the nearer end."""
        (x0, y0), (x1, y1) = (jnp.moveaxis(p, -1, 0) for p in (self.low, self.high))
        x = x0 + _share(x1 - x0, (y - y0) * safe_divide(x1 - x0, y1 - y0))
        if self.arcs is not None:
            conic, there = self.arcs
            bent = film_at(conic, unit_at(conic, 1, y, self.rising))[..., 0]
            x = jnp.where(there, bent, x)
        x = jnp.clip(x, jnp.minimum(x0, x1), jnp.maximum(x0, x1))
        return jnp.where(y <= y0, x0, jnp.where(y >= y1, x1, x))

    def y_at(self, x: Float[Array, "*K"], low: Array, high: Array) -> Float[Array, "*K"]:
        """The height at an abscissa, within a stretch from `low` to `high`."""
        (x0, y0), (x1, y1) = (jnp.moveaxis(p, -1, 0) for p in (low, high))
        y = y0 + _share(y1 - y0, (x - x0) * safe_divide(y1 - y0, x1 - x0))
        if self.arcs is not None:
            conic, there = self.arcs
            w = unit_at(conic, 0, x, self.rising * self.rightward)
            y = jnp.where(there, film_at(conic, w)[..., 1], y)
        return jnp.clip(y, y0, y1)


def _share(whole: Array, part: Array) -> Array:
    """A part of a whole, bounded: rounding does not take it beyond.

    Kernels work out a curve's point anew, and must agree on it. A sum of a product is rounded once
    or twice, as the compiler likes; a bounded product is rounded before it is added.
    """
    return jnp.clip(part, jnp.minimum(whole, 0), jnp.maximum(whole, 0))


class Pieces(NamedTuple):
    """Parts of curves in one pixel each, upwards: from `low` to `high`, in px from the pixel's
    lower left corner.

    - `curve`: the number of the curve, in what was cut.
    - `left`: layers above less those below where it crosses the pixel's left side, at its lower or
      (`left_at_end`) upper end.
    - `bottom`: it crosses the line just above the row's bottom, in this pixel.
    - `on_bottom`: it lies on the row's bottom.
    - `enters`: it comes from another pixel, in the direction that has cover on the left.
    """

    curve: Int[Array, "*P"]
    row: Int[Array, "*P"]
    column: Int[Array, "*P"]
    low: Float[Array, "*P 2"]
    high: Float[Array, "*P 2"]
    jump: Float[Array, "*P"]
    left: Float[Array, "*P"]
    left_at_end: Bool[Array, "*P"]
    bottom: Bool[Array, "*P"]
    on_bottom: Bool[Array, "*P"]
    enters: Bool[Array, "*P"]
    valid: Bool[Array, "*P"]

    @property
    def corner(self) -> Float[Array, "*P 2"]:
        """The pixels' lower left corners."""
        return jnp.stack([self.column, self.row], axis=-1).astype(self.low.dtype)

    @property
    def left_y(self) -> Float[Array, "*P"]:
        """The height of the end that may cross the pixel's left side."""
        return jnp.where(self.left_at_end, self.high[..., 1], self.low[..., 1])

    @property
    def up(self) -> Float[Array, "*P"]:
        """Layers above less those below."""
        return jnp.where(self.high[..., 0] >= self.low[..., 0], -self.jump, self.jump)

    @property
    def drop(self) -> Float[Array, "*P"]:
        """The most layers that one side may have less than the pixel's corner.

        The way from the corner to a point goes up the left side, then to the right. A piece that
        comes in on that side is met there, and left behind where the way turns.
        """
        comes_in = (self.left != 0) & ~self.left_at_end
        change = jnp.where(comes_in, -self.jump, self.jump)
        return jnp.where(self.on_bottom, jnp.abs(change), jnp.maximum(-change, 0))

    def gain(self, m: Monotone) -> Float[Array, "*P"]:
        """The pixel's mean layers less those at its corner: Green's theorem."""
        middle = (self.low[:, 0] + self.high[:, 0]) / 2
        gain = self.left * (1 - self.left_y)
        gain += self.jump * (self.high[:, 1] - self.low[:, 1]) * (1 - middle)
        if m.arcs is None:
            return gain
        swollen = bulge(m.arcs.conic, self.corner + self.low, self.corner + self.high)
        return gain - jnp.where(m.arcs.there, self.jump * swollen, 0)


#: The first column and the last that count; of a film, or of each curve's cells.
Columns = tuple[int, int | Array]


class InRow(NamedTuple):
    """Curves' points of entry into a row and exit, and their columns."""

    low: Float[Array, "P 2"]
    high: Float[Array, "P 2"]
    first: Int[Array, "P"]
    last: Int[Array, "P"]


def in_row(m: Monotone, row: Int[Array, "P"], columns: Columns) -> InRow:
    """The parts of curves in rows; columns are bounded."""
    heights = row.astype(m.low.dtype), (row + 1).astype(m.low.dtype)
    x0, x1 = (m.x_at(y) for y in heights)
    y0, y1 = (jnp.clip(y, m.low[:, 1], m.high[:, 1]) for y in heights)
    low, high = jnp.stack([x0, y0], axis=-1), jnp.stack([x1, y1], axis=-1)
    return InRow(low, high, _column(x0, columns), _column(x1, columns))


def _column(x: Float[Array, "P"], columns: Columns) -> Int[Array, "P"]:
    low, high = (jnp.asarray(k, x.dtype) for k in columns)
    return jnp.floor(jnp.clip(x, low, high)).astype(jnp.int32)


def rows_met(m: Monotone, H: int | Array) -> tuple[Int[Array, "K"], Int[Array, "K"]]:
    """The first row from 0 to H that curves meet, and the one after the last."""
    low, high, top = m.low[:, 1], m.high[:, 1], jnp.asarray(H, m.low.dtype)
    first = jnp.clip(jnp.floor(low), 0, top)
    last = jnp.minimum(jnp.maximum(jnp.ceil(high), first + 1), top)
    # (False for NaN.)
    met = (m.jump != 0) & (high >= 0) & (low < top) & (m.low[:, 0] + m.high[:, 0] < jnp.inf)
    return first.astype(jnp.int32), jnp.where(met, last, first).astype(jnp.int32)


def piece_in(
    m: Monotone, own: InRow, row: Array, column: Array, curve: Array, valid: Array
) -> Pieces:
    """Pieces of curves in pixels."""
    right, first, last = own.last >= own.first, column == own.first, column == own.last
    real = lambda k: k.astype(m.low.dtype)

    def end(at_end, point, side):
        y = m.y_at(real(side), own.low, own.high)
        x, y = jnp.where(at_end, point[:, 0], real(side)), jnp.where(at_end, point[:, 1], y)
        return jnp.stack([x, y], axis=-1)

    low = end(first, own.low, jnp.where(right, column, column + 1))
    high = end(last, own.high, jnp.where(right, column + 1, column))
    passes = m.high[:, 1] > real(row)
    crosses = jnp.where(right, ~first, ~last) & passes
    corner = jnp.stack([real(column), real(row)], axis=-1)
    start, its = (jnp.where((m.jump <= 0)[:, None], *x) for x in ((low, high), (m.low, m.high)))
    on_side = (start == corner) | (start == corner + 1)
    bottom = passes & first & (own.low[:, 1] <= real(row)) & (m.high[:, 1] > m.low[:, 1])
    return Pieces(
        curve,
        row,
        column,
        low - corner,
        high - corner,
        jnp.where(valid, m.jump, 0),
        jnp.where(crosses & valid, jnp.where(right, -m.jump, m.jump), 0),
        ~right,
        bottom & valid,
        ~passes,
        jnp.any((start != its) | on_side, axis=1) & valid,
        valid,
    )


def fold_pieces(
    ids: Int[Array, "K"],
    m: Monotone,
    film: tuple[int, int],
    add: Callable[[Total, Monotone, Pieces], Total],
    start: Total,
) -> Total:
    """`start` after `add(total, curves, pieces)` over all pieces of curves, chunk by chunk.

    On a film of W x H pixels; columns -1 and W hold the pieces left and right of it.
    """
    W, H = film
    columns, (first, end) = (-1, W), rows_met(m, H)
    begin = in_row(m, first, columns).first
    past = lambda m, row, begin: jnp.abs(in_row(m, row, columns).first - begin)
    upto = jax.lax.cumsum(jnp.where(end > first, end - first + past(m, end, begin), 0))

    def chunk(total, slot):
        slots = slot + jnp.arange(AT_A_TIME, dtype=jnp.int32)
        curve = jnp.searchsorted(upto, slots, side="right").astype(jnp.int32)
        curve = jnp.minimum(curve, upto.shape[0] - 1)
        rank = slots - jnp.where(curve > 0, upto[curve - 1], 0)
        own, low, column, number = jax.tree.map(lambda x: x[curve], (m, first, begin, end - first))
        passed = lambda j: j + past(own, low + j, column)
        bits = H.bit_length()

        def bisect(k, row):
            step = row + (jnp.int32(1) << (bits - 1 - k))
            return jnp.where((step < number) & (passed(step) <= rank), step, row)

        row = jax.lax.fori_loop(0, bits, bisect, jnp.zeros_like(curve))
        here = in_row(own, low + row, columns)
        along = jnp.clip(rank - passed(row), 0, jnp.abs(here.last - here.first))
        place = here.first + jnp.where(here.last >= here.first, along, -along)
        valid = slots < upto[-1]
        return add(total, own, piece_in(own, here, low + row, place, ids[curve], valid))

    return in_chunks(chunk, start, AT_A_TIME, upto[-1])
