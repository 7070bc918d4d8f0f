"""Exact area under contour curves, pixel by pixel, and its exact derivative.

A curve is split where it crosses the pixel grid. By Green's theorem each piece adds its signed area
to its own pixel and its signed height to every pixel to the right (as exact font rasterisers work),
so a sum along the row gives the winding-weighted coverage. The derivative is the boundary integral:
a pixel's area grows by the piece's length times its outward normal velocity.

Splitting is a closed formula per piece, not a loop: a curve that is monotone in x and y passes
`j + |column(y_j) - column(y_0)|` pixels before its j-th row, so the k-th pixel that it meets is
found by bisection, and pieces of one curve agree exactly on the points where they meet.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._contour import Arcs, Segments
from ._safe import safe_divide, safe_sqrt

Curves = Segments | Arcs


class Pieces(NamedTuple):
    """Contour pieces, each within one pixel; from its lower to its upper end.

    `row` counts up from the film's bottom. `column` -1 and W hold what lies left and right of the
    film. `height` is added to the coverage of all pixels to the right, `area` to the pixel's own.
    """

    curve: Int[Array, "P"]
    row: Int[Array, "P"]
    column: Int[Array, "P"]
    start: Float[Array, "P 2"]
    end: Float[Array, "P 2"]
    height: Float[Array, "P"]
    area: Float[Array, "P"]
    valid: Bool[Array, "P"]


class Monotone(NamedTuple):
    """Curves from a lower end to an upper end; `rising` is +1 where that is their direction."""

    low: Float[Array, "K 2"]
    high: Float[Array, "K 2"]
    rising: Float[Array, "K"]
    curves: Curves


def monotone(curves: Curves) -> Monotone:
    """Return the curves ordered by height."""
    if isinstance(curves, Segments):
        start, end = curves.a, curves.b
    else:
        start, end = _quarter_ends(curves)
    rising = end[:, 1] >= start[:, 1]
    low = jnp.where(rising[:, None], start, end)
    high = jnp.where(rising[:, None], end, start)
    return Monotone(low, high, jnp.where(rising, 1, -1).astype(low.dtype), curves)


def _take(tree, index):
    return jax.tree.map(lambda x: x[index], tree)


# --- splitting -----------------------------------------------------------------------------------


class _Rows(NamedTuple):
    first: Int[Array, "K"]
    number: Int[Array, "K"]


def _rows(m: Monotone, H) -> _Rows:
    """Return which rows of the film a curve meets; a level one meets one row all the same."""
    top = jnp.asarray(H, m.low.dtype)
    first = jnp.clip(jnp.floor(m.low[:, 1]), 0, top)
    last = jnp.clip(jnp.maximum(jnp.ceil(m.high[:, 1]), first + 1), 0, top)
    inside = (m.high[:, 1] >= 0) & (m.low[:, 1] < top)
    count = jnp.where(inside, last - first, 0)
    return _Rows(first.astype(jnp.int32), count.astype(jnp.int32))


def _column(x: Float[Array, "K"], W) -> Int[Array, "K"]:
    return jnp.clip(jnp.floor(x), -1, jnp.asarray(W, x.dtype)).astype(jnp.int32)


def _at_row(m: Monotone, y: Float[Array, "K"]) -> tuple[Float[Array, "K"], Float[Array, "K"]]:
    """Return the curve's point at height y, or the end that y lies beyond."""
    between_low = jnp.minimum(m.low[:, 0], m.high[:, 0])
    between_high = jnp.maximum(m.low[:, 0], m.high[:, 0])
    x = jnp.clip(_x_at(m, y), between_low, between_high)
    below, above = y <= m.low[:, 1], y >= m.high[:, 1]
    x = jnp.where(below, m.low[:, 0], jnp.where(above, m.high[:, 0], x))
    y = jnp.where(below, m.low[:, 1], jnp.where(above, m.high[:, 1], y))
    return x, y


def piece_counts(m: Monotone, W, H) -> Int[Array, "K"]:
    """Return how many pixels (with those left and right of the film) each curve meets."""
    rows = _rows(m, H)
    x0, _ = _at_row(m, rows.first.astype(m.low.dtype))
    x1, _ = _at_row(m, (rows.first + rows.number).astype(m.low.dtype))
    first, last = _column(x0, W), _column(x1, W)
    weight = m.curves.weight
    count = rows.number + jnp.abs(last - first)
    return jnp.where((weight == 0) | (rows.number == 0), 0, count)


def split(m: Monotone, upto: Int[Array, "K"], slots: Int[Array, "P"], W, H, max_H: int) -> Pieces:
    """Return pieces number `slots` of the curves, of which `upto` is the running count.

    W and H may be traced; `max_H` is a static bound of H.
    """
    curve = jnp.searchsorted(upto, slots, side="right").astype(jnp.int32)
    valid = slots < upto[-1]
    curve = jnp.minimum(curve, upto.shape[0] - 1)
    rank = slots - jnp.where(curve > 0, upto[curve - 1], 0)
    m = _take(m, curve)
    rows = _rows(m, H)
    dtype = m.low.dtype

    x_first, _ = _at_row(m, rows.first.astype(dtype))
    column_first = _column(x_first, W)

    def passed(j):
        x, _ = _at_row(m, (rows.first + j).astype(dtype))
        return j + jnp.abs(_column(x, W) - column_first)

    # A loop, not unrolled: the compiler of jax 0.12 takes minutes over the unrolled chain.
    bits = max(max_H - 1, 0).bit_length()

    def bisect(k, row):
        step = row + (jnp.int32(1) << (bits - 1 - k))
        return jnp.where((step < rows.number) & (passed(step) <= rank), step, row)

    row = jax.lax.fori_loop(0, bits, bisect, jnp.zeros_like(rows.first))

    x0, y0 = _at_row(m, (rows.first + row).astype(dtype))
    x1, y1 = _at_row(m, (rows.first + row + 1).astype(dtype))
    # The film cuts off what lies above and below it.
    top = jnp.asarray(H, dtype)
    y0, y1 = jnp.clip(y0, 0, top), jnp.clip(y1, 0, top)
    c0, c1 = _column(x0, W), _column(x1, W)
    rightward = c1 >= c0
    along = jnp.clip(rank - passed(row), 0, jnp.abs(c1 - c0))
    column = jnp.where(rightward, c0 + along, c0 - along)
    left, right = column.astype(dtype), (column + 1).astype(dtype)
    x_in = jnp.where(column == c0, x0, jnp.where(rightward, left, right))
    x_out = jnp.where(column == c1, x1, jnp.where(rightward, right, left))
    y_in = jnp.where(column == c0, y0, jnp.clip(_y_at(m, x_in, x0, y0, x1, y1), y0, y1))
    y_out = jnp.where(column == c1, y1, jnp.clip(_y_at(m, x_out, x0, y0, x1, y1), y0, y1))

    start, end = jnp.stack([x_in, y_in], -1), jnp.stack([x_out, y_out], -1)
    height, area = _areas(m, start, end, column, W)
    height, area = jnp.where(valid, height, 0), jnp.where(valid, area, 0)
    return Pieces(curve, rows.first + row, column, start, end, height, area, valid)


def _areas(m: Monotone, start, end, column, W):
    """Return what a piece adds to the pixels on its right and to its own pixel."""
    height = -m.rising * m.curves.weight * (end[:, 1] - start[:, 1])
    inside = (column >= 0) & (column < W)
    middle = (start[:, 0] + end[:, 0]) / 2 - column.astype(start.dtype)
    share = jnp.where(inside, 1 - jnp.clip(middle, 0, 1), jnp.where(column < 0, 1, 0))
    area = height * share
    if isinstance(m.curves, Arcs):
        area = area + jnp.where(inside, m.curves.weight * _bulge(m.curves, start, end), 0)
    return height, area


# --- derivative ----------------------------------------------------------------------------------


def flux(curves: Curves, pieces: Pieces, W) -> Float[Array, "P"]:
    """Return a function of the curves, linear in them, with the derivative of each piece's area.

    `curves` are those of the pieces (one each). Only its derivative has a meaning: the coefficients
    are held, and it is the length of the piece times the normal velocity of the curve.
    """
    inside = pieces.valid & (pieces.column >= 0) & (pieces.column < W)
    held = jax.lax.stop_gradient(curves)
    start, end = jax.lax.stop_gradient((pieces.start, pieces.end))
    if isinstance(curves, Segments) and isinstance(held, Segments):
        along = held.b - held.a
        axis = jnp.argmax(jnp.abs(along), axis=1)[:, None]
        pick = lambda x: jnp.take_along_axis(x, axis, axis=1)[:, 0]
        length = pick(along)
        s0 = jnp.clip(safe_divide(pick(start - held.a), length), 0, 1)
        s1 = jnp.clip(safe_divide(pick(end - held.a), length), 0, 1)
        middle = ((s0 + s1) / 2)[:, None]
        moved = curves.a * (1 - middle) + curves.b * middle
        value = jnp.abs(s1 - s0) * (along[:, 1] * moved[:, 0] - along[:, 0] * moved[:, 1])
    elif isinstance(curves, Arcs) and isinstance(held, Arcs):
        value = _arc_flux(curves, held, start, end)
    else:  # pragma: no cover
        raise TypeError(type(curves))
    return jnp.where(inside, held.weight * value, 0)


# --- points of a curve ---------------------------------------------------------------------------


def _x_at(m: Monotone, y):
    if isinstance(m.curves, Segments):
        rise = m.high[:, 1] - m.low[:, 1]
        slope = safe_divide(m.high[:, 0] - m.low[:, 0], rise)
        return m.low[:, 0] + (y - m.low[:, 1]) * slope
    l11, l21, l22 = m.curves.shape.T
    # Half height of the ellipse; its points at height y are found in the frame whose second axis
    # is that height (L with rows exchanged).
    half = jnp.sqrt(l21 * l21 + l22 * l22)
    t = jnp.clip((y - m.curves.centre[:, 1]) / half, -1, 1)
    side = jnp.where((m.curves.quarter == 0) | (m.curves.quarter == 3), 1, -1).astype(y.dtype)
    across = side * safe_sqrt((1 - t) * (1 + t))
    return m.curves.centre[:, 0] + l11 * (l21 / half * t + l22 / half * across)


def _y_at(m: Monotone, x, x0, y0, x1, y1):
    if isinstance(m.curves, Segments):
        return y0 + (x - x0) * safe_divide(y1 - y0, x1 - x0)
    l11, l21, l22 = m.curves.shape.T
    t = jnp.clip((x - m.curves.centre[:, 0]) / l11, -1, 1)
    side = jnp.where(m.curves.quarter < 2, 1, -1).astype(x.dtype)
    return m.curves.centre[:, 1] + l21 * t + l22 * side * safe_sqrt((1 - t) * (1 + t))


# --- ellipses ------------------------------------------------------------------------------------


def _quarter_ends(arcs: Arcs):
    """Return the points where the quarters begin and end: right, top, left, bottom, right."""
    l11, l21, l22 = arcs.shape.T
    half = jnp.sqrt(l21 * l21 + l22 * l22)
    right = jnp.stack([l11, l21], -1)
    top = jnp.stack([l11 * l21 / half, half], -1)
    extremes = jnp.stack([right, top, -right, -top, right])  # (5, K, 2)
    at = lambda k: jnp.take_along_axis(extremes, k[None, :, None], axis=0)[0]
    return arcs.centre + at(arcs.quarter), arcs.centre + at(arcs.quarter + 1)


def _unit(arcs: Arcs, points):
    """Return w with `centre + L w = point`: a point of the unit circle."""
    l11, l21, l22 = arcs.shape.T
    first = (points[:, 0] - arcs.centre[:, 0]) / l11
    second = (points[:, 1] - arcs.centre[:, 1] - l21 * first) / l22
    return jnp.stack([first, second], axis=-1)


def _turn(w0, w1):
    """Return the angle between two points of the unit circle, and its half chord."""
    half = jnp.clip(jnp.sqrt(jnp.sum((w1 - w0) ** 2, axis=-1)) / 2, 0, 1)
    return 2 * jnp.arcsin(half), half


def _bulge(arcs: Arcs, start, end):
    """Return the area between a piece of an ellipse and its chord: det L (a - sin a) / 2."""
    angle, half = _turn(_unit(arcs, start), _unit(arcs, end))
    # a - sin a by its series while a is small, where the difference would cancel.
    a2 = angle * angle
    series = angle * a2 / 6 * (1 - a2 / 20 * (1 - a2 / 42 * (1 - a2 / 72 * (1 - a2 / 110))))
    direct = angle - 2 * half * safe_sqrt(1 - half * half)
    segment = jnp.where(angle < 0.7, series, direct)
    return arcs.shape[:, 0] * arcs.shape[:, 2] * segment / 2


def _arc_flux(arcs: Arcs, held: Arcs, start, end):
    """Return the integral of (moving point) x (tangent) over a piece, counter-clockwise.

    With w = (cos, sin) of the angle t, the point is `centre + L w` and its tangent `L J w`; the
    integrals of w, w w^T over the piece are closed forms about its middle angle.
    """
    rising = (held.quarter == 0) | (held.quarter == 3)
    w0, w1 = _unit(held, start), _unit(held, end)
    w0, w1 = jnp.where(rising[:, None], w0, w1), jnp.where(rising[:, None], w1, w0)
    angle, half = _turn(w0, w1)
    middle = w0 + w1
    middle = middle / jnp.sqrt(jnp.sum(middle * middle, axis=-1, keepdims=True))
    c, s = middle[:, 0], middle[:, 1]
    sine = 2 * half * safe_sqrt(1 - half * half)  # sin(angle)
    cos2, sin2 = (c - s) * (c + s), 2 * c * s
    cc = (angle + sine * cos2) / 2  # integral of cos^2
    ss = (angle - sine * cos2) / 2  # integral of sin^2
    cs = sine * sin2 / 2  # integral of cos sin
    int_c, int_s = 2 * half * c, 2 * half * s
    l11, l21, l22 = held.shape.T
    # tangent = (-l11 sin, -l21 sin + l22 cos); outward flux = dx tangent_y - dy tangent_x
    chord_x, chord_y = -l11 * int_s, -l21 * int_s + l22 * int_c
    d11, d21, d22 = arcs.shape.T
    return (
        arcs.centre[:, 0] * chord_y
        - arcs.centre[:, 1] * chord_x
        + d11 * (-l21 * cs + l22 * cc)
        + d21 * (l11 * cs)
        + d22 * (l11 * ss)
    )
