"""Exact area under contour curves, pixel by pixel, and its exact derivative.

A curve is split where it crosses the pixel grid. By Green's theorem each piece adds its signed area
to its own pixel and its signed height to every pixel to the right (as exact font rasterisers work),
so a sum along the row gives the winding-weighted coverage. The derivative is the boundary integral:
a pixel's area grows by the piece's length times its outward normal velocity.

A curve that is monotone in x and y goes through rows (`in_row`) and in each of them through pixels
(`in_pixel`): pieces of one curve agree exactly on the points where they meet. A loop takes one
after the other (`piece_by_piece.py`). Vectors of pieces (`split`) need none: a curve passes
`j + |column(y_j) - column(y_0)|` pixels before its j-th row, so the k-th pixel that it meets is
found by bisection. Both ask the same expressions, and find the same pieces.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.bitset import count_upto
from .._numerics.bounds import least, most, within
from .._numerics.safe import safe_divide
from .curves import (
    Arcs,
    Curves,
    Point,
    Segments,
    bulge,
    edge_flux,
    edge_fractions,
    ends,
    film_at,
    piece_flux,
    unit_at,
)


class Pieces(NamedTuple):
    """Contour pieces, each within one pixel; from its lower to its upper end.

    `row` counts up from the film's bottom. `column` -1 and W hold what lies left and right of the
    film. `height` is added to the coverage of all pixels to the right, `area` to the pixel's own.
    `jump` is how many layers there are more right of the piece than left of it, and `passes` says
    that the curve goes on above the bottom of the row. `first` is the lowest piece of a curve in a
    row, by its number: rounding may put others on the row's bottom as well. `enters` says that the
    curve, in its own direction, may come from another pixel: the piece does not begin with the
    curve, or it begins on the pixel's side.
    """

    curve: Int[Array, "*P"]
    row: Int[Array, "*P"]
    column: Int[Array, "*P"]
    start: Float[Array, "*P 2"]
    end: Float[Array, "*P 2"]
    height: Float[Array, "*P"]
    area: Float[Array, "*P"]
    valid: Bool[Array, "*P"]
    jump: Float[Array, "*P"]
    passes: Bool[Array, "*P"]
    first: Bool[Array, "*P"]
    enters: Bool[Array, "*P"]


class Monotone(NamedTuple):
    """Curves from a lower end to an upper end; `rising` is +1 where that is their direction, and
    `rightward` is +1 where the upper end is the right one, both else -1."""

    low: Float[Array, "*K 2"]
    high: Float[Array, "*K 2"]
    rising: Float[Array, "*K"]
    rightward: Float[Array, "*K"]
    curves: Curves


def monotone(curves: Curves) -> Monotone:
    """Return the curves ordered by height."""
    start, end = ends(curves)
    up = end[..., 1] >= start[..., 1]
    low, high = jnp.where(up[..., None], start, end), jnp.where(up[..., None], end, start)
    rising = jnp.where(up, 1, -1).astype(low.dtype)
    return Monotone(low, high, rising, rightward(low, high), curves)


def rightward(low: Float[Array, "*K 2"], high: Float[Array, "*K 2"]) -> Float[Array, "*K"]:
    """Return +1 where the upper end is the right one, else -1."""
    return jnp.where(high[..., 0] >= low[..., 0], 1, -1).astype(low.dtype)


def taken(tree: Any, index: Array) -> Any:
    """Return the rows of arrays with these indices, or with this one."""
    return jax.tree.map(lambda x: x[index], tree)


# --- splitting -----------------------------------------------------------------------------------


class Rows(NamedTuple):
    """Which rows a curve meets: the first, and how many."""

    first: Int[Array, "*K"]
    number: Int[Array, "*K"]


def rows_of(m: Monotone, H, bottom) -> Rows:
    """Return which rows of those from `bottom` to H a curve meets; a level one meets one row all
    the same, and none beside it."""
    top, bottom = (jnp.asarray(x, m.low.dtype) for x in (H, bottom))
    first = most(jnp.floor(m.low[..., 1]), 0)
    last = most(jnp.ceil(m.high[..., 1]), first + 1)
    first, last = within(first, bottom, top), within(last, bottom, top)
    inside = (m.high[..., 1] >= 0) & (m.low[..., 1] < top)
    count = jnp.where(inside, last - first, 0)
    return Rows(first.astype(jnp.int32), count.astype(jnp.int32))


def column_of(x: Float[Array, "*K"], W) -> Int[Array, "*K"]:
    """Return the columns of abscissas, -1 left of the film and W right of it."""
    return jnp.floor(within(x, -1, jnp.asarray(W, x.dtype))).astype(jnp.int32)


def at_row(m: Monotone, y: Float[Array, "*K"]) -> tuple[Float[Array, "*K"], Float[Array, "*K"]]:
    """Return the curve's point at height y, or the end that y lies beyond."""
    ends = m.low[..., 0], m.high[..., 0]
    x = within(_x_at(m, y), least(*ends), most(*ends))
    below, above = y <= m.low[..., 1], y >= m.high[..., 1]
    x = jnp.where(below, m.low[..., 0], jnp.where(above, m.high[..., 0], x))
    y = jnp.where(below, m.low[..., 1], jnp.where(above, m.high[..., 1], y))
    return x, y


def piece_counts(m: Monotone, W, H, bottom=0) -> Int[Array, "*K"]:
    """Return how many pixels (with those left and right of the film) each curve meets in the rows
    from `bottom` up to H."""
    rows = rows_of(m, H, bottom)
    x0, _ = at_row(m, rows.first.astype(m.low.dtype))
    x1, _ = at_row(m, (rows.first + rows.number).astype(m.low.dtype))
    first, last = column_of(x0, W), column_of(x1, W)
    weight = m.curves.weight
    count = rows.number + jnp.abs(last - first)
    return jnp.where((weight == 0) | (rows.number == 0), 0, count)


class InRow(NamedTuple):
    """What of a curve is in a row: where it comes in and goes out, and the columns there."""

    row: Int[Array, "*K"]
    x0: Float[Array, "*K"]
    y0: Float[Array, "*K"]
    x1: Float[Array, "*K"]
    y1: Float[Array, "*K"]
    c0: Int[Array, "*K"]
    c1: Int[Array, "*K"]

    @property
    def further(self) -> Int[Array, "*K"]:
        """Return how many pixels there are beside the first."""
        return jnp.abs(self.c1 - self.c0)

    @property
    def goes_right(self) -> Bool[Array, "*K"]:
        """Return whether columns grow along the curve."""
        return self.c1 >= self.c0

    def column(self, along: Int[Array, "*K"]) -> Int[Array, "*K"]:
        """Return the column of the `along`-th pixel."""
        return jnp.where(self.goes_right, self.c0 + along, self.c0 - along)


def in_row(m: Monotone, row: Int[Array, "*K"], W, H, bottom=0) -> InRow:
    """Return what of curves is in these of the rows that they meet (`rows_of`)."""
    return between(row, on_line(m, row, H, bottom), on_line(m, row + 1, H, bottom), W)


def on_line(m: Monotone, row: Int[Array, "*K"], H, bottom=0) -> Point:
    """Return where curves meet the lower line of a row; what lies above and below the film is cut
    off."""
    x, y = at_row(m, row.astype(m.low.dtype))
    return x, within(y, jnp.asarray(bottom, y.dtype), jnp.asarray(H, y.dtype))


def between(row: Int[Array, "*K"], low: Point, high: Point, W) -> InRow:
    """Return what of curves is in a row, from where they come in and where they go out."""
    return InRow(row, *low, *high, column_of(low[0], W), column_of(high[0], W))


def in_pixel(
    m: Monotone, own: InRow, along: Int[Array, "*K"], curve: Int[Array, "*K"], valid: Array, W
) -> Pieces:
    """Return the pieces of curves that are the `along`-th in their row."""
    start, end = entered_at(m, own, along), left_at(m, own, along)
    return piece_between(m, own, along, (start, end), curve, valid, W)


def entered_at(m: Monotone, own: InRow, along: Int[Array, "*K"]) -> Point:
    """Return where curves come into the `along`-th pixel of their row."""
    column = own.column(along)
    side = (column + jnp.where(own.goes_right, 0, 1)).astype(own.x0.dtype)
    return _on_side(m, own, column == own.c0, (own.x0, own.y0), side)


def left_at(m: Monotone, own: InRow, along: Int[Array, "*K"]) -> Point:
    """Return where curves go out of the `along`-th pixel of their row."""
    column = own.column(along)
    side = (column + jnp.where(own.goes_right, 1, 0)).astype(own.x0.dtype)
    return _on_side(m, own, column == own.c1, (own.x1, own.y1), side)


def _on_side(m: Monotone, own: InRow, ends: Array, end: Point, side: Array) -> Point:
    """Return where curves meet a side of a pixel, or the end of what of them is in the row."""
    x, (y0, y1) = jnp.where(ends, end[0], side), (own.y0, own.y1)
    y = within(_y_at(m, x, own.x0, y0, own.x1, y1), y0, y1)
    return x, jnp.where(ends, end[1], y)


def piece_between(
    m: Monotone,
    own: InRow,
    along: Int[Array, "*K"],
    ends: tuple[Point, Point],
    curve: Int[Array, "*K"],
    valid: Array,
    W,
) -> Pieces:
    """Return the pieces of curves from where they come into a pixel to where they go out."""
    (x_in, y_in), (x_out, y_out) = ends
    row, dtype, column = own.row, m.low.dtype, own.column(along)
    left = column.astype(dtype)
    start, end = jnp.stack([x_in, y_in], -1), jnp.stack([x_out, y_out], -1)
    height, area = _areas(m, start, end, column, W)
    height, area = jnp.where(valid, height, 0), jnp.where(valid, area, 0)
    jump = jnp.where(valid, -m.rising * m.curves.weight, 0)
    passes = m.high[..., 1] > row.astype(dtype)

    def beyond(x, y, own):
        # By component: of vectors the compiler makes several kernels.
        sides = zip((x, y), (left, row.astype(dtype)), (0, 1), strict=True)
        each = [(v != own[..., k]) | (v == side) | (v == side + 1) for v, side, k in sides]
        return each[0] | each[1]

    enters = jnp.where(jump <= 0, beyond(x_in, y_in, m.low), beyond(x_out, y_out, m.high))
    first = valid & (along == 0)
    return Pieces(curve, row, column, start, end, height, area, valid, jump, passes, first, enters)


def split(
    m: Monotone, upto: Int[Array, "K"], slots: Int[Array, "P"], W, H, max_H: int, bottom=0
) -> Pieces:
    """Return pieces number `slots` of the curves, of which `upto` is the running count (see
    `piece_counts`).

    W, H and `bottom` may be traced; `max_H` is a static bound of H.
    """
    curve = count_upto(upto, slots)
    valid = slots < upto[-1]
    curve = jnp.minimum(curve, upto.shape[0] - 1)
    rank = slots - jnp.where(curve > 0, upto[curve - 1], 0)
    m = taken(m, curve)
    rows = rows_of(m, H, bottom)
    dtype = m.low.dtype

    x_first, _ = at_row(m, rows.first.astype(dtype))
    column_first = column_of(x_first, W)

    def passed(j):
        x, _ = at_row(m, (rows.first + j).astype(dtype))
        return j + jnp.abs(column_of(x, W) - column_first)

    # A loop, not unrolled: the compiler of jax 0.12 takes minutes over the unrolled chain. Where no
    # curve is in many rows, as of a fine mesh, it is short.
    most = jnp.maximum(jnp.max(rows.number) - 1, 0)
    bits = jnp.minimum(32 - jax.lax.clz(most), max(max_H - 1, 0).bit_length())

    def bisect(k, row):
        step = row + (jnp.int32(1) << (bits - 1 - k))
        return jnp.where((step < rows.number) & (passed(step) <= rank), step, row)

    row = jax.lax.fori_loop(0, bits, bisect, jnp.zeros_like(rows.first))

    own = in_row(m, rows.first + row, W, H, bottom)
    along = jnp.clip(rank - passed(row), 0, own.further)
    return in_pixel(m, own, along, curve, valid, W)


def _areas(m: Monotone, start, end, column, W):
    """Return what a piece adds to the pixels on its right and to its own pixel."""
    height = -m.rising * m.curves.weight * (end[..., 1] - start[..., 1])
    inside = (column >= 0) & (column < W)
    middle = (start[..., 0] + end[..., 0]) / 2 - column.astype(start.dtype)
    share = jnp.where(inside, 1 - within(middle, 0, 1), jnp.where(column < 0, 1, 0))
    area = height * share
    if isinstance(m.curves, Arcs):
        grown = m.rising * m.curves.weight * bulge(m.curves.frame, start, end)
        area = area + jnp.where(inside, grown, 0)
    return height, area


# --- how the area grows as a curve moves ---------------------------------------------------------
# What a straight curve sweeps of a pixel is linear between its ends: these are worked out once, and
# a piece takes its shares of both. An arc's pieces take theirs of all numbers of its frame.


def end_flux(m: Monotone, homogeneous: Float[Array, "K 2 3"]) -> Float[Array, "K 2 2 3"]:
    """Return how the area left of straight curves grows with their points, per px of height (of
    width, if they are not steep): as fast as at the lower and at the upper end."""
    steep = _is_steep(m)
    each = [edge_fractions(homogeneous, steep, point) for point in (m.low, m.high)]
    return jnp.stack([edge_flux(homogeneous, steep, fractions) for fractions in each], axis=1)


def _is_steep(m: Monotone) -> Bool[Array, "*K"]:
    width, height = (jnp.abs(m.high[..., k] - m.low[..., k]) for k in (0, 1))
    return height > width


def shares(m: Monotone, start: Float[Array, "*P 2"], end: Float[Array, "*P 2"]) -> Array:
    """Return by how much the area left of a curve's piece grows (*P, n): of a straight one with
    each number of `end_flux`, of an arc with each of its frame."""
    if isinstance(m.curves, Arcs):
        flux = piece_flux(m.curves.frame, m.curves, start, end)
        return flux.reshape(*flux.shape[:-2], -1)
    steep = _is_steep(m)
    past = lambda a, b: jnp.where(steep, b[..., 1] - a[..., 1], b[..., 0] - a[..., 0])
    before = (past(m.low, start) + past(m.low, end)) / 2
    share, along = jnp.clip(safe_divide(before, past(m.low, m.high)), 0, 1), past(start, end)
    along = jnp.where(steep, along, -along)
    return jnp.stack([along * (1 - share), along * share], axis=-1)


# --- points of a curve ---------------------------------------------------------------------------


def _x_at(m: Monotone, y):
    if isinstance(m.curves, Segments):
        rise = m.high[..., 1] - m.low[..., 1]
        width = m.high[..., 0] - m.low[..., 0]
        return m.low[..., 0] + _share(width, (y - m.low[..., 1]) * safe_divide(width, rise))
    frame = m.curves.frame
    return film_at(frame, unit_at(frame, 1, y, m.rising))[..., 0]


def _y_at(m: Monotone, x, x0, y0, x1, y1):
    if isinstance(m.curves, Segments):
        return y0 + _share(y1 - y0, (x - x0) * safe_divide(y1 - y0, x1 - x0))
    frame = m.curves.frame
    return film_at(frame, unit_at(frame, 0, x, m.rising * m.rightward))[..., 1]


def _share(whole, part):
    """Return a part of the whole, which it is not beyond by rounding.

    Kernels work out a curve's point anew, and must agree on it. A sum of a product is rounded once
    or twice, as the compiler likes; a bounded product is rounded before it is added.
    """
    return within(part, least(whole, 0), most(whole, 0))
