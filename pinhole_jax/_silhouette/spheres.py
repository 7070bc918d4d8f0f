"""Spheres on the film: conics, cut into arcs that are monotone in x and in y."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._numerics.safe import normalize
from .conics import arc_end, cut_circle, film_at, homogeneous, turned_by, unit_at

#: A conic has at most 4 points where it turns back in x or y, and 2 where it leaves for infinity.
ARCS_PER_SPHERE = 6

#: Points of the unit circle.
Points = Float[Array, "A 2"]


def shown_arcs(
    frames: Float[Array, "S 3 3"], outside: Bool[Array, "S"]
) -> tuple[Points, Points, Float[Array, "A"]]:
    """The ends of arcs on the unit circle, six to a sphere, and their weight (1, or 0: not seen).

    The conic is cut where it is level or upright, and where it meets the plane through the eye;
    arcs behind the eye are left out, and so are spheres that the eye is not `outside` of.
    """
    start = _turning_points(frames)
    end = jnp.roll(start, -1, axis=1)
    (x, y), (after_x, after_y) = (jnp.moveaxis(w, -1, 0) for w in (start, end))
    across = jnp.stack([after_y - y, x - after_x], axis=-1)
    half_way = normalize(across)  # from end to end
    depth = homogeneous(frames[:, None], half_way)[..., 2]
    shown = outside[:, None] & (depth > 0) & jnp.any(start != end, axis=-1)
    return start.reshape(-1, 2), end.reshape(-1, 2), shown.reshape(-1).astype(frames.dtype)


def _turning_points(frames: Float[Array, "S 3 3"]) -> Float[Array, "S 6 2"]:
    """The points where conics turn or are cut, by angle."""
    x, y, z = jnp.moveaxis(frames, -1, 0)
    sign = jnp.array([[-1, 1, 1]], frames.dtype)
    cuts: list[Array] = []
    # At infinity, and where the derivative of x (of y) by the angle vanishes.
    for level in (z, sign * jnp.cross(x, z), sign * jnp.cross(y, z)):
        exists = jnp.abs(level[:, 0]) < jnp.sqrt(level[:, 1] ** 2 + level[:, 2] ** 2)
        for growing in (1.0, -1.0):
            cut = cut_circle(level, growing)
            # The first cut counts in any case: at the point nearest to infinity, if none is there.
            # Cuts that do not exist repeat it.
            cuts.append(jnp.where(exists[:, None], cut, (cuts or [cut])[0]))
    w = jnp.stack(cuts, axis=1)
    order = jnp.argsort(jnp.arctan2(w[..., 1], w[..., 0]), axis=-1)
    return jnp.take_along_axis(w, order[..., None], axis=1)


class Arc(NamedTuple):
    """An arc's entry into the film's bounds and its exit, on the unit circle, `turn` rad apart."""

    start: Points
    end: Points
    turn: Float[Array, "A"]

    def turned(self, share: Float[Array, "A"]) -> Points:
        """Points of the unit circle at a share of it."""
        w = turned_by(share * self.turn, *self.start.T)
        return jnp.where((share >= 1)[:, None], self.end, w)


def arc_within(
    bounds: Float[Array, "4"], frame: Float[Array, "A 3 3"], start: Points, end: Points
) -> tuple[Arc, Float[Array, "2 A"], Bool[Array, "A"]]:
    """The parts of arcs within bounds (left, right, low, high).

    Also the heights between which they are left of the bounds, and True if they are.
    """
    ends = jnp.stack([arc_end(frame, start, 1), arc_end(frame, end, -1)])
    whole, heights = _turn(start, end), ends[..., 1]
    begin, finish, enters, leaves = jnp.zeros_like(whole), whole, start, end
    beside = jnp.zeros_like(whole, bool)
    for k in range(4):
        axis, side, value = k // 2, (-1, 1)[k % 2], bounds[k]
        grows = jnp.where(ends[1, :, axis] >= ends[0, :, axis], 1, -1).astype(whole.dtype)
        w = unit_at(frame, axis, jnp.broadcast_to(value, whole.shape), grows)
        out = out_first, out_last = side * (ends[..., axis] - value) > 0
        cut = jnp.clip(_turn(start, w), 0, whole)
        if k == 0:
            heights = jnp.where(jnp.stack(out), heights, film_at(frame, w)[:, 1])
            beside = out_first | out_last
        entry = jnp.where(out_last, jnp.inf, cut)
        later, sooner = out_first & (entry > begin), out_last & (cut < finish)
        begin, enters = jnp.where(later, entry, begin), jnp.where(later[:, None], w, enters)
        finish, leaves = jnp.where(sooner, cut, finish), jnp.where(sooner[:, None], w, leaves)
    turn = jnp.where(begin < finish, finish - begin, 0)
    return Arc(enters, leaves, turn), jnp.clip(heights, *bounds[2:]), beside


def _turn(a: Points, b: Points) -> Float[Array, "A"]:
    """The angle from a to b, counter-clockwise; a negative one if b is a little before a."""
    (ax, ay), (bx, by) = a.T, b.T
    angle = jnp.arctan2(ax * by - ay * bx, ax * bx + ay * by)
    return jnp.where(angle < -np.pi / 2, angle + 2 * np.pi, angle)
