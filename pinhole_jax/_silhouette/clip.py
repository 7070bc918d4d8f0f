"""Edges cut off where they leave what the film can show."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.one_kernel import put_down
from .._numerics.safe import safe_divide
from .curves import Segments


def clipped(
    homogeneous: Float[Array, "K 2 3"],
    weight: Int[Array, "K"],
    beside: Bool[Array, "K"],
    bounds: list[Array],
) -> Segments:
    """Return edges as segments on the film, cut off at bounds (left, right, low, high) outside it.

    Edges are clipped before the division by depth, so those that pass the eye or end behind it lose
    no accuracy. What lies right of the film shows nowhere in it and is left out; what lies left of
    it still bounds the rows: where `beside`, that is returned, as an upright segment on the left.
    A cut end lies at exactly its bound. An edge that passes through the eye's x axis leaves for
    infinity at the top (`surrounding` decides alike).
    """
    left, right, low, high = bounds
    rows = put_down(_in_rows, homogeneous, low, high)
    sides = put_down(_at_sides, rows, left, right)
    return put_down(_shown, homogeneous, weight, rows, sides, beside, left, right)


class _InRows(NamedTuple):
    """Edges between two rows: their ends' homogeneous points and heights, and of which is none."""

    spot: Float[Array, "K 2 3"]
    height: Float[Array, "K 2"]
    none: Bool[Array, "K"]


def _in_rows(homogeneous: Float[Array, "K 2 3"], low: Array, high: Array) -> _InRows:
    """Return edges cut off below and above."""
    first = jnp.array([[True, False]])
    is_low, is_high = (f > 0 for f in _rows_outside(homogeneous, low, high))
    t_low, t_high = (_crossing(f)[:, None] for f in _rows_outside(homogeneous, low, high))
    later, sooner = jnp.maximum(t_low, t_high), jnp.minimum(t_low, t_high)
    both = jnp.where(first, later, sooner)
    t = jnp.where(is_low & is_high, both, jnp.where(is_low, t_low, t_high))
    t = jnp.where(is_low | is_high, t, jnp.where(first, 0, 1))
    at_top = is_high & (~is_low | (t == t_high))
    spot = homogeneous[:, :1] + t[..., None] * (homogeneous[:, 1:] - homogeneous[:, :1])
    spot = jnp.where((is_low | is_high)[..., None], spot, homogeneous)
    at = safe_divide(spot[..., 1], spot[..., 2])
    height = jnp.where(at_top, high, jnp.where(is_low, low, at))
    none = jnp.all(is_low, axis=1) | jnp.all(is_high, axis=1) | (t[:, 0] > t[:, 1])
    return _InRows(spot, height, none)


class _AtSides(NamedTuple):
    """Which ends of edges are beyond upright bounds, and the heights at which edges cross these."""

    is_left: Bool[Array, "K 2"]
    is_right: Bool[Array, "K 2"]
    y_left: Float[Array, "K 1"]
    y_right: Float[Array, "K 1"]


def _at_sides(rows: _InRows, left: Array, right: Array) -> _AtSides:
    x, y, z = jnp.moveaxis(rows.spot, -1, 0)
    beyond = left * z - x, x - right * z
    crossings = (_height_of_crossing(f, y, z, rows.height) for f in beyond)
    return _AtSides(*(f > 0 for f in beyond), *crossings)


def _shown(
    homogeneous: Float[Array, "K 2 3"],
    weight: Int[Array, "K"],
    rows: _InRows,
    sides: _AtSides,
    beside: Bool[Array, "K"],
    left: Array,
    right: Array,
) -> Segments:
    """Return what is left of the edges on the film, or (`beside`) left of it."""
    is_left, is_right, y_left, y_right = sides
    x = safe_divide(rows.spot[..., 0], rows.spot[..., 2])
    inner_x = jnp.where(is_left, left, jnp.where(is_right, right, x))
    inner_y = jnp.where(is_left, y_left, jnp.where(is_right, y_right, rows.height))
    outer_y = jnp.where(is_left, rows.height, y_left)
    x, y = jnp.where(beside[:, None], left, inner_x), jnp.where(beside[:, None], outer_y, inner_y)
    ends = jnp.stack([x, y], axis=-1)
    none = rows.none | jnp.all(homogeneous[..., 2] <= 0, axis=1)
    weight = jnp.where(none, 0, weight).astype(homogeneous.dtype)
    beyond = jnp.all(is_left, axis=1) | jnp.all(is_right, axis=1)
    shown = jnp.where(beside, jnp.any(is_left, axis=1), ~beyond)
    return Segments(ends[:, 0], ends[:, 1], jnp.where(shown, weight, 0))


def _rows_outside(homogeneous: Float[Array, "K 2 3"], low: Array, high: Array) -> list:
    """Return by how much the ends are below and above the rows, times depth."""
    y, z = homogeneous[..., 1], homogeneous[..., 2]
    return [low * z - y, y - high * z]


def _crossing(f: Float[Array, "K 2"]) -> Float[Array, "K"]:
    """Return where along an edge a value given at its ends is 0."""
    return safe_divide(f[:, 0], f[:, 0] - f[:, 1])


def _height_of_crossing(beyond, y, z, height) -> Float[Array, "K 1"]:
    """Return the height at which an edge crosses an upright bound, between its ends' heights."""
    t = jnp.clip(_crossing(beyond), 0, 1)
    y, z = (p[:, 0] + t * (p[:, 1] - p[:, 0]) for p in (y, z))
    return jnp.clip(safe_divide(y, z), jnp.min(height, axis=1), jnp.max(height, axis=1))[:, None]
