"""Curves that are monotone in x and y, and their pieces in the pixels of a film.

Points on a grid line count for the pixel above it or to its right.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.safe import safe_divide
from .conics import film_at, unit_at


class Arcs(NamedTuple):
    """The conics of curves that are arcs, and True for these."""

    conic: Float[Array, "*K 3 3"]
    there: Bool[Array, "*K"]

    def other_at(
        self, axis: int, value: Float[Array, "K"], growing: Array, straight: Float[Array, "K"]
    ) -> Float[Array, "K"]:
        """The other coordinate of arcs where the one of an axis has a value; that of other curves
        is known."""
        bent = film_at(self.conic, unit_at(self.conic, axis, value, growing))[:, 1 - axis]
        return jnp.where(self.there, bent, straight)


class Monotone(NamedTuple):
    """Curves from a lower to an upper end (px).

    `rising` is 1 where that is their direction, else -1; `jump` is the number of layers on their
    right less those on their left; `arcs` is None where all are straight.
    """

    low: Float[Array, "K 2"]
    high: Float[Array, "K 2"]
    rising: Float[Array, "K"]
    jump: Float[Array, "K"]
    arcs: Arcs | None

    @classmethod
    def from_ends(cls, tail: Array, head: Array, weight: Array, arcs: Arcs | None) -> "Monotone":
        """Curves from tail to head, `weight` layers more on their left."""
        up = head[..., 1] >= tail[..., 1]
        low, high = jnp.where(up[..., None], tail, head), jnp.where(up[..., None], head, tail)
        rising = jnp.where(up, 1, -1).astype(low.dtype)
        return cls(low, high, rising, -rising * weight, arcs)

    @property
    def rightward(self) -> Float[Array, "K"]:
        """1 where the upper end is the right one, else -1."""
        return jnp.where(self.high[:, 0] >= self.low[:, 0], 1, -1).astype(self.low.dtype)

    @property
    def steep(self) -> Bool[Array, "K"]:
        """True for curves of more height than width."""
        width, height = (self.high - self.low).T
        return height > jnp.abs(width)

    def x_at(self, y: Float[Array, "K"]) -> Float[Array, "K"]:
        """The abscissa at a height, or at the nearer end."""
        (x0, y0), (x1, y1) = self.low.T, self.high.T
        x = self.other_at(1, y, self.low, self.high)
        return jnp.where(y <= y0, x0, jnp.where(y >= y1, x1, x))

    def other_at(
        self, axis: int, value: Float[Array, "K"], low: Array, high: Array
    ) -> Float[Array, "K"]:
        """The other coordinate where the one of an axis has a value, from `low` to `high`."""
        (a0, b0), (a1, b1) = ((p[:, axis], p[:, 1 - axis]) for p in (low, high))
        other = b0 + _share(b1 - b0, (value - a0) * safe_divide(b1 - b0, a1 - a0))
        if self.arcs is not None:
            growing = self.rising if axis else self.rising * self.rightward
            other = self.arcs.other_at(axis, value, growing, other)
        return jnp.clip(other, jnp.minimum(b0, b1), jnp.maximum(b0, b1))


def _share(whole: Array, part: Array) -> Array:
    """A part of a whole, bounded: rounding does not take it beyond.

    Kernels work out a curve's point anew, and must agree on it. A sum of a product is rounded once
    or twice, as the compiler likes; a bounded product is rounded before it is added.
    """
    return jnp.clip(part, jnp.minimum(whole, 0), jnp.maximum(whole, 0))


class PieceKeys(NamedTuple):
    """Pieces by the number of their curve's part and by their pixel.

    Columns -1 and W hold the pieces left and right of the film.
    """

    part: Int[Array, "P"]
    row: Int[Array, "P"]
    column: Int[Array, "P"]

    def pixel(self, film: tuple[int, int]) -> Int[Array, "P"]:
        """The pixels' numbers, row by row from the bottom; W H outside of the film."""
        W, H = film
        inside = (self.column >= 0) & (self.column < W)
        return jnp.where(inside, self.row * W + self.column, W * H)

    def corner(self, real: jnp.dtype) -> Float[Array, "P 2"]:
        """The pixels' lower left corners."""
        return jnp.stack([self.column, self.row], axis=-1).astype(real)


class Pieces(NamedTuple):
    """Parts of curves in one pixel each, upwards: from `low` to `high`, in px from the pixel's
    lower left corner.

    - `left`: layers above less those below where it crosses the pixel's left side, at its lower or
      (`left_at_end`) upper end.
    - `bottom`: it crosses the line just above the row's bottom, in this pixel.
    - `on_bottom`: it lies on the row's bottom.
    """

    low: Float[Array, "P 2"]
    high: Float[Array, "P 2"]
    left: Float[Array, "P"]
    left_at_end: Bool[Array, "P"]
    bottom: Bool[Array, "P"]
    on_bottom: Bool[Array, "P"]


class InRow(NamedTuple):
    """Curves' points of entry into a row and exit, and their columns."""

    low: Float[Array, "P 2"]
    high: Float[Array, "P 2"]
    first: Int[Array, "P"]
    last: Int[Array, "P"]


def in_row(m: Monotone, row: Int[Array, "P"], W: int) -> InRow:
    """The parts of curves in rows of a film of W columns."""
    low, high = (_at_height(m, (row + k).astype(m.low.dtype)) for k in (0, 1))
    most = jnp.asarray(W, m.low.dtype)
    columns = (jnp.floor(jnp.clip(p[:, 0], -1, most)).astype(jnp.int32) for p in (low, high))
    return InRow(low, high, *columns)


def _at_height(m: Monotone, y: Float[Array, "P"]) -> Float[Array, "P 2"]:
    """The points of curves at a height, or their nearer ends."""
    return jnp.stack([m.x_at(y), jnp.clip(y, m.low[:, 1], m.high[:, 1])], axis=-1)


def rows_met(m: Monotone, H: int) -> tuple[Int[Array, "K"], Int[Array, "K"]]:
    """The first row from 0 to H that curves meet, and the one after the last."""
    low, high, top = m.low[:, 1], m.high[:, 1], jnp.asarray(H, m.low.dtype)
    first = jnp.clip(jnp.floor(low), 0, top)
    last = jnp.minimum(jnp.maximum(jnp.ceil(high), first + 1), top)
    # (False for NaN.)
    met = (m.jump != 0) & (high >= 0) & (low < top) & (m.low[:, 0] + m.high[:, 0] < jnp.inf)
    return first.astype(jnp.int32), jnp.where(met, last, first).astype(jnp.int32)


def pieces_at(m: Monotone, places: PieceKeys, W: int) -> Pieces:
    """The pieces of curves at their places."""
    own, column = in_row(m, places.row, W), places.column
    right, first, last = own.last >= own.first, column == own.first, column == own.last
    corner = places.corner(m.low.dtype)

    def end(at_end, point, sides):
        x = jnp.where(sides, corner[:, 0] + 1, corner[:, 0])
        beside = jnp.stack([x, m.other_at(0, x, own.low, own.high)], axis=-1)
        return jnp.where(at_end[:, None], point, beside) - corner

    passes = m.high[:, 1] > corner[:, 1]
    crosses = jnp.where(right, ~first, ~last) & passes
    return Pieces(
        end(first, own.low, ~right),
        end(last, own.high, right),
        jnp.where(crosses, jnp.where(right, -m.jump, m.jump), 0),
        ~right,
        passes & first & (own.low[:, 1] <= corner[:, 1]) & (m.high[:, 1] > m.low[:, 1]),
        ~passes,
    )
