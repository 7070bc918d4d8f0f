"""Spheres on the film: conics, cut into arcs that are monotone in x and in y."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._numerics.safe import norm, safe_divide
from .clip import within
from .conics import Frames, Points, arc_end, cut_circle, film_at, homogeneous, unit_at

#: A conic has at most 4 points where it turns back in x or y, and 2 where it leaves for infinity.
ARCS_PER_SPHERE = 6


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
    middle = safe_divide(across, norm(across)[..., None])  # half way from end to end
    depth = homogeneous(frames[:, None], middle)[..., 2]
    shown = outside[:, None] & (depth > 0) & jnp.any(start != end, axis=-1)
    return start.reshape(-1, 2), end.reshape(-1, 2), shown.reshape(-1).astype(frames.dtype)


def _turning_points(frames: Float[Array, "S 3 3"]) -> Float[Array, "S 6 2"]:
    """The points where conics turn or are cut, by angle."""
    levels = [frames[..., 2]]
    for i in (0, 1):  # where the derivative of x (of y) by the angle vanishes
        one, first, second = (frames[:, k, i] for k in range(3))
        z, by_first, by_second = (frames[:, k, 2] for k in range(3))
        minors = (
            second * by_first - first * by_second,
            second * z - one * by_second,
            one * by_first - first * z,
        )
        levels.append(jnp.stack(minors, axis=-1))
    cuts: list[Array] = []
    for level in levels:
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
    """Arcs between two points of the unit circle, and the stretches of them within the film's
    bounds: from `begin` to `finish` (rad from the start; inf: to the end)."""

    start: Points
    end: Points
    begin: Float[Array, "A"]
    finish: Float[Array, "A"]

    def turned(self, share: Float[Array, "A"]) -> Points:
        """Points of the unit circle at a share of the stretches."""
        finish = jnp.minimum(self.finish, _turn(self.start, self.end))
        angle, (x, y) = self.begin + share * (finish - self.begin), self.start.T
        c, s = jnp.cos(angle), jnp.sin(angle)
        w = jnp.stack([x * c - y * s, y * c + x * s], axis=-1)
        is_end = (share >= 1) & (self.finish == jnp.inf)
        return jnp.where(is_end[:, None], self.end, w)


def arc_within(
    bounds: Float[Array, "4"], frame: Frames, start: Points, end: Points
) -> tuple[Arc, Float[Array, "A 2"], Bool[Array, "A"]]:
    """The parts of arcs within bounds (left, right, low, high).

    Also the heights between which they are left of the bounds, and True if they are.
    """
    ends = jnp.stack([arc_end(frame, start, 1), arc_end(frame, end, -1)])
    grows = jnp.where(ends[1] >= ends[0], 1, -1).astype(frame.dtype)
    whole, past, cuts = _turn(start, end), [], []
    for k in range(4):
        axis, value = k // 2, jnp.broadcast_to(bounds[k], whole.shape)
        past.append((-1, 1)[k % 2] * (ends[..., axis] - value[None]).T)
        cuts.append(unit_at(frame, axis, value, grows[:, axis]))
    is_out = jnp.stack(past) > 0
    turns = jnp.stack([jnp.clip(_turn(start, w), 0, whole) for w in cuts])
    begin, finish, there = within(is_out, turns, np.inf)
    arc = Arc(start, end, begin, jnp.where(there, finish, begin))
    heights = jnp.where(is_out[0], ends[..., 1].T, film_at(frame, cuts[0])[:, 1:])
    return arc, jnp.clip(heights, *bounds[2:]), jnp.any(is_out[0], axis=1)


def _turn(a: Points, b: Points) -> Float[Array, "A"]:
    """The angle from a to b, counter-clockwise; a negative one if b is a little before a."""
    (ax, ay), (bx, by) = a.T, b.T
    angle = jnp.arctan2(ax * by - ay * bx, ax * bx + ay * by)
    return jnp.where(angle < -np.pi / 2, angle + 2 * np.pi, angle)
