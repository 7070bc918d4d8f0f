"""Spheres on the film: conics, cut into arcs that are monotone in x and in y."""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._numerics.safe import length, safe_divide
from .conics import Frame, Point, arc_end, cut_at, frame_of, homogeneous_at, point_at

#: A conic has at most 4 points where it turns back in x or y, and 2 where it leaves for infinity.
ARCS_PER_SPHERE = 6


def shown_arcs(
    frames: Float[Array, "S 3 3"], outside: Bool[Array, "S"]
) -> tuple[Point, Point, Float[Array, "A"]]:
    """The ends of arcs on the unit circle, six to a sphere, and their weight (1, or 0: not seen).

    The conic is cut where it is level or upright, and where it meets the plane through the eye;
    what is behind is left out, and so is a sphere that the eye is not `outside` of.
    """
    x, y = _turning_points(frame_of(frames))
    after = jnp.roll(x, -1, axis=1), jnp.roll(y, -1, axis=1)
    across = after[1] - y, x - after[0]
    size = length(*across)
    middle = safe_divide(across[0], size), safe_divide(across[1], size)  # half way from end to end
    depth = homogeneous_at(frame_of(frames[:, None]), middle)[2]
    shown = outside[:, None] & (depth > 0) & ((x != after[0]) | (y != after[1]))
    flat = lambda x: x.reshape(-1)
    ends = (x, y), after
    start, end = (tuple(map(flat, w)) for w in ends)
    return start, end, flat(shown).astype(frames.dtype)


def _turning_points(frame: Frame) -> Point:
    """The points (S, 6) where conics turn or are cut, by angle."""
    levels = [[row[2] for row in frame]]
    for i in (0, 1):  # where the derivative of x (of y) by the angle vanishes
        minor = lambda k, m, i=i: frame[k][i] * frame[m][2] - frame[m][i] * frame[k][2]
        levels.append([minor(2, 1), minor(2, 0), minor(0, 1)])
    cuts: list[Point] = []
    for level in levels:
        exists = jnp.abs(level[0]) < jnp.sqrt(level[1] ** 2 + level[2] ** 2)
        for growing in (1.0, -1.0):
            cut = cut_at(level, growing)
            # The first cut counts in any case: at the point nearest to infinity, if none is there.
            # Cuts that do not exist repeat it.
            x, y = (jnp.where(exists, a, b) for a, b in zip(cut, (cuts or [cut])[0], strict=True))
            cuts.append((x, y))
    x, y = (jnp.stack(values, axis=-1) for values in zip(*cuts, strict=True))
    order = jnp.argsort(jnp.arctan2(y, x), axis=-1)
    return jnp.take_along_axis(x, order, -1), jnp.take_along_axis(y, order, -1)


class Arc(NamedTuple):
    """Where an arc enters on the unit circle what the film may show, and where it leaves it, `turn`
    rad later."""

    start: Point
    end: Point
    turn: Float[Array, "*K"]

    def at(self, share: Float[Array, "*K"]) -> Point:
        """Points of the unit circle at a share of it."""
        angle = share * self.turn
        c, s = jnp.cos(angle), jnp.sin(angle)
        (x, y), last = self.start, share >= 1
        return (
            jnp.where(last, self.end[0], x * c - y * s),
            jnp.where(last, self.end[1], y * c + x * s),
        )


def arc_within(
    bounds: Float[Array, "4"], frame: Frame, start: Point, end: Point
) -> tuple[Arc, tuple[Array, Array], Array]:
    """What of arcs is within bounds (left, right, low, high); between which heights they are left
    of these, and whether they are there at all."""
    first, last = arc_end(frame, start, 1), arc_end(frame, end, -1)
    turn = partial(_turn, start)
    whole = turn(end)
    begin, finish, enters, leaves = jnp.zeros_like(whole), whole, start, end
    either = lambda there, a, b: (jnp.where(there, a[0], b[0]), jnp.where(there, a[1], b[1]))
    heights, beside = (first[1], last[1]), jnp.zeros_like(whole, bool)
    for axis in (0, 1):
        grows = jnp.where(last[axis] >= first[axis], 1, -1).astype(whole.dtype)
        for value, side in ((bounds[2 * axis], -1), (bounds[2 * axis + 1], 1)):
            w = cut_at([row[axis] - value * row[2] for row in frame], grows)
            out_first, out_last = (side * (p[axis] - value) > 0 for p in (first, last))
            cut = jnp.clip(turn(w), 0, whole)
            if (axis, side) == (0, -1):
                crossing = point_at(frame, w)[1]
                stays = zip((out_first, out_last), heights, strict=True)
                heights = tuple(jnp.where(out, y, crossing) for out, y in stays)
                beside = out_first | out_last
            entry = jnp.where(out_last, jnp.inf, cut)
            later, sooner = out_first & (entry > begin), out_last & (cut < finish)
            begin, enters = jnp.where(later, entry, begin), either(later, w, enters)
            finish, leaves = jnp.where(sooner, cut, finish), either(sooner, w, leaves)
    low, high = (jnp.clip(y, bounds[2], bounds[3]) for y in heights)
    turned = jnp.where(begin < finish, finish - begin, 0)
    return Arc(enters, leaves, turned), (low, high), beside


def _turn(a: Point, b: Point) -> Array:
    """The angle from a to b, counter-clockwise; as 0 if b is a little before a."""
    angle = jnp.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
    return jnp.where(angle < -np.pi / 2, angle + 2 * np.pi, angle)
