"""Edges cut off at bounds outside the film."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._numerics.safe import safe_divide

#: Tails and heads of curves on the film (px), and their weights.
Curve = tuple[Float[Array, "K 2"], Float[Array, "K 2"], Float[Array, "K"]]
#: Both ends of edges as homogeneous film points: x z, y z and z, of the first end and the last.
Ends = Float[Array, "3 2 K"]


def cut_off(ends: Ends, weight: Array, bounds: Float[Array, "4"]) -> list[Curve]:
    """Edges on the film, cut off at bounds (left, right, low, high), then their parts left of it.

    Edges are cut before the division by depth, so those that pass the eye or end behind it lose no
    accuracy. Parts right of the film are invisible and have weight 0; parts left of it still bound
    the rows: they become uprights on the left. A cut end lies at exactly its bound. An edge that
    passes through the eye's x axis leaves for infinity at the top (`surrounding` decides alike).
    """
    left, right, low, high = bounds
    cut, height, none = _between_rows(ends, low, high)
    weight = jnp.where(none | jnp.all(ends[2] <= 0, axis=0), 0, weight).astype(ends.dtype)
    x, _, z = cut
    past_left, past_right = left * z - x, x - right * z
    is_left, is_right = past_left > 0, past_right > 0
    y_left, y_right = (_height_of_crossing(past, cut, height) for past in (past_left, past_right))
    x = jnp.where(is_left, left, jnp.where(is_right, right, safe_divide(x, z)))
    y = jnp.where(is_left, y_left, jnp.where(is_right, y_right, height))
    beyond = jnp.all(is_left, axis=0) | jnp.all(is_right, axis=0)
    beside = jnp.full_like(x, left), jnp.where(is_left, height, y_left)
    return [
        (*jnp.stack([x, y], axis=-1), jnp.where(beyond, 0, weight)),
        (*jnp.stack(beside, axis=-1), jnp.where(jnp.any(is_left, axis=0), weight, 0)),
    ]


def _between_rows(
    ends: Ends, low: Array, high: Array
) -> tuple[Ends, Float[Array, "2 K"], Bool[Array, "K"]]:
    """Return edges' ends between two heights, the ends' heights, and True if no part is there."""
    _, y, z = ends
    below, above = low * z - y, y - high * z
    is_low, is_high = below > 0, above > 0
    t_low, t_high = _crossing(below), _crossing(above)
    both = jnp.stack([jnp.maximum(t_low, t_high), jnp.minimum(t_low, t_high)])
    t = jnp.where(is_low & is_high, both, jnp.where(is_low, t_low, t_high))
    out = is_low | is_high
    t = jnp.where(out, t, jnp.array([[0], [1]], t.dtype))
    at_top = is_high & (~is_low | (t == t_high[None]))
    cut = jnp.where(out, _along(ends, t), ends)
    height = jnp.where(at_top, high, jnp.where(is_low, low, safe_divide(cut[1], cut[2])))
    none = jnp.all(is_low, axis=0) | jnp.all(is_high, axis=0) | (t[0] > t[1])
    return cut, height, none


def _crossing(value: Float[Array, "2 K"]) -> Float[Array, "K"]:
    """Return the share of an edge at which a value, known at its ends, is 0."""
    return safe_divide(value[0], value[0] - value[1])


def _along(ends: Ends, t: Float[Array, "n K"]) -> Float[Array, "3 n K"]:
    """Return the points at shares of edges."""
    first, last = ends[:, :1], ends[:, 1:]
    return first + t[None] * (last - first)


def _height_of_crossing(
    past: Float[Array, "2 K"], ends: Ends, height: Float[Array, "2 K"]
) -> Float[Array, "K"]:
    """Return the height at which an edge crosses an upright bound, between its ends' heights."""
    _, y, z = _along(ends, jnp.clip(_crossing(past), 0, 1)[None])[:, 0]
    return jnp.clip(safe_divide(y, z), jnp.min(height, axis=0), jnp.max(height, axis=0))
