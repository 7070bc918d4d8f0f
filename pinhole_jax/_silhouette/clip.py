"""Edges cut off at bounds outside the film."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._numerics.safe import safe_divide

#: Tails and heads of curves on the film (px), and their weights.
Curve = tuple[Float[Array, "K 2"], Float[Array, "K 2"], Float[Array, "K"]]

#: Edges' ends as homogeneous film points (x z, y z, z); numbers of their ends, and of edges.
Edges = Float[Array, "E 2 3"]
Ends = Float[Array, "*k E 2"]
Each = Float[Array, "E"]


def cut_off(edges: Edges, weight: Each, bounds: Float[Array, "4"]) -> list[Curve]:
    """Edges on the film, cut off at bounds (left, right, low, high), then their parts left of it.

    The ends' coordinates are of about 1. They are cut before the division by depth, so those that
    pass the eye or end behind it lose no accuracy. Parts right of the film are invisible and have
    weight 0; parts left of it still bound the rows: they become uprights on the left. A cut end
    lies at exactly its bound. An edge that passes through the eye's x axis leaves for infinity at
    the top (`surrounding` decides alike).
    """
    left, right, low, high = bounds
    weight = jnp.where(jnp.any(edges[..., 2] > 0, axis=1), weight, 0)
    edges, height, there = _between_rows(_kept(edges, weight != 0), low, high)
    edges, weight = _kept(edges, there), jnp.where(there, weight, 0)
    x, z = edges[..., 0], edges[..., 2]
    past = left * z - x, x - right * z
    is_left, is_right = (p > 0 for p in past)
    y_left, y_right = (_crossed_at(edges, height, p) for p in past)

    seen_x = jnp.where(is_left, left, jnp.where(is_right, right, safe_divide(x, z)))
    seen_y = jnp.where(is_left, y_left, jnp.where(is_right, y_right, height))
    beyond = jnp.all(is_left, axis=1) | jnp.all(is_right, axis=1)
    upright = jnp.full_like(x, left), jnp.where(is_left, height, y_left)
    curve = lambda x, y, w: (*jnp.moveaxis(jnp.stack([x, y], axis=2), 1, 0), w)
    return [
        curve(seen_x, seen_y, jnp.where(beyond, 0, weight)),
        curve(*upright, jnp.where(jnp.any(is_left, axis=1), weight, 0)),
    ]


def _kept(edges: Edges, there: Bool[Array, "E"]) -> Edges:
    """The edges that are there; in place of others some without a singular derivative."""
    return jnp.where(there[:, None, None], edges, 1)


def _between_rows(edges: Edges, low: Array, high: Array) -> tuple[Edges, Ends, Bool[Array, "E"]]:
    """Edges cut off at two heights, the heights of their ends, and False if no part is there."""
    y, z = edges[..., 1], edges[..., 2]
    past = jnp.stack([low * z - y, y - high * z])
    t, (is_low, is_high) = crossings(past), past > 0
    begin, end, there = within(past > 0, t)
    cut = jnp.stack([_along(edges, begin), _along(edges, end)], axis=1)
    cut = jnp.where((is_low | is_high)[..., None], cut, edges)
    at_high = jnp.stack([begin, end], axis=1) == t[1, :, None]
    height = jnp.where(is_low, low, safe_divide(cut[..., 1], cut[..., 2]))
    return cut, jnp.where(is_high & (~is_low | at_high), high, height), there


def within(
    is_out: Bool[Array, "k E 2"], crossing: Float[Array, "k E"], whole: float = 1
) -> tuple[Each, Each, Bool[Array, "E"]]:
    """The stretches of curves, from 0 to `whole`, that are within k bounds; False if there is none.

    Of curves whose ends are out or not, and which cross the bounds at these places.
    """
    begin = jnp.max(jnp.where(is_out[..., 0], crossing, 0), axis=0)
    end = jnp.min(jnp.where(is_out[..., 1], crossing, whole), axis=0)
    return begin, end, ~jnp.any(jnp.all(is_out, axis=2), axis=0) & (begin <= end)


def crossings(past: Ends) -> Float[Array, "*k E"]:
    """The shares of edges at which values, known at their ends, are 0."""
    return safe_divide(past[..., 0], past[..., 0] - past[..., 1])


def _along(edges: Edges, share: Each) -> Float[Array, "E 3"]:
    return edges[:, 0] + share[:, None] * (edges[:, 1] - edges[:, 0])


def _crossed_at(edges: Edges, height: Ends, past: Ends) -> Float[Array, "E 1"]:
    """The heights at which edges cross an upright bound, between their ends' heights."""
    _, y, z = _along(edges, jnp.clip(crossings(past), 0, 1)).T
    return jnp.clip(safe_divide(y, z), height.min(axis=1), height.max(axis=1))[:, None]
