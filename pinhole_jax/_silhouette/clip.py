"""Edges cut off at bounds outside the film."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics.safe import safe_divide

#: Tails and heads of curves on the film (px), and their weights.
Curve = tuple[Float[Array, "K 2"], Float[Array, "K 2"], Float[Array, "K"]]


class Homogeneous(NamedTuple):
    """A homogeneous film point (x z, y z, z)."""

    x: Array
    y: Array
    z: Array


class _Spot(NamedTuple):
    """An edge's end between two rows: a homogeneous point, and its height."""

    x: Array
    y: Array
    z: Array
    height: Array


def cut_off(
    first: Homogeneous, last: Homogeneous, weight: Array, bounds: Float[Array, "4"]
) -> list[Curve]:
    """Edges on the film, cut off at bounds (left, right, low, high), then their parts left of it.

    Edges are cut before the division by depth, so those that pass the eye or end behind it lose no
    accuracy. Parts right of the film are invisible and have weight 0; parts left of it still bound
    the rows: they become uprights on the left. A cut end lies at exactly its bound. An edge that
    passes through the eye's x axis leaves for infinity at the top (`surrounding` decides alike).
    """
    left, right, low, high = bounds
    edge = first, last
    spots, none = _between_rows(edge, low, high)
    weight = jnp.where(none | ((first.z <= 0) & (last.z <= 0)), 0, weight).astype(first.x.dtype)

    past_left, past_right = ([f(p) for p in spots] for f in (_past(left, -1), _past(right, 1)))
    is_left, is_right = ([f > 0 for f in past] for past in (past_left, past_right))
    y_left, y_right = (_height_of_crossing(past, spots) for past in (past_left, past_right))

    def end(k):
        p, out_left, out_right = spots[k], is_left[k], is_right[k]
        x = jnp.where(out_left, left, jnp.where(out_right, right, safe_divide(p.x, p.z)))
        y = jnp.where(out_left, y_left, jnp.where(out_right, y_right, p.height))
        return jnp.stack([x, y], axis=-1)

    def upright_end(k):
        y = jnp.where(is_left[k], spots[k].height, y_left)
        return jnp.stack([jnp.full_like(y, left), y], axis=-1)

    beyond = (is_left[0] & is_left[1]) | (is_right[0] & is_right[1])
    return [
        (end(0), end(1), jnp.where(beyond, 0, weight)),
        (upright_end(0), upright_end(1), jnp.where(is_left[0] | is_left[1], weight, 0)),
    ]


def _past(bound: Array, side: int) -> Callable[[_Spot], Array]:
    """Return the function of points' distance past an upright bound, times depth."""
    return lambda p: side * (p.x - bound * p.z)


def _between_rows(
    edge: tuple[Homogeneous, Homogeneous], low: Array, high: Array
) -> tuple[tuple[_Spot, _Spot], Array]:
    """Return an edge's ends between two heights, and True if no part is there."""
    below, above = [low * p.z - p.y for p in edge], [p.y - high * p.z for p in edge]
    is_low, is_high = ([f > 0 for f in out] for out in (below, above))
    t_low, t_high = _crossing(*below), _crossing(*above)
    both = jnp.maximum(t_low, t_high), jnp.minimum(t_low, t_high)

    def end(k):
        out = is_low[k] | is_high[k]
        t = jnp.where(is_low[k] & is_high[k], both[k], jnp.where(is_low[k], t_low, t_high))
        t = jnp.where(out, t, k)
        at_top = is_high[k] & (~is_low[k] | (t == t_high))
        x, y, z = (
            jnp.where(out, a + t * (b - a), own) for a, b, own in zip(*edge, edge[k], strict=True)
        )
        height = jnp.where(at_top, high, jnp.where(is_low[k], low, safe_divide(y, z)))
        return _Spot(x, y, z, height), t

    (first, begin), (last, finish) = end(0), end(1)
    none = (is_low[0] & is_low[1]) | (is_high[0] & is_high[1]) | (begin > finish)
    return (first, last), none


def _crossing(first: Array, last: Array) -> Array:
    """Return the share of an edge at which a value, known at its ends, is 0."""
    return safe_divide(first, first - last)


def _height_of_crossing(past: list[Array], spots: tuple[_Spot, _Spot]) -> Array:
    """Return the height at which an edge crosses an upright bound, between its ends' heights."""
    t = jnp.clip(_crossing(*past), 0, 1)
    first, last = spots
    y, z = (a + t * (b - a) for a, b in ((first.y, last.y), (first.z, last.z)))
    least, most = (f(first.height, last.height) for f in (jnp.minimum, jnp.maximum))
    return jnp.clip(safe_divide(y, z), least, most)
