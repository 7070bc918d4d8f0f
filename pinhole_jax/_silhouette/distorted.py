"""Contours under a lens's distortion: cut into parts so short that straight ones follow the image.

A part's ends are points of the ideal film, seen through the lens. They move with the camera (its
lens too) and the scene, and straight pieces between them are all that the rasteriser sees.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._camera.film import Bend, FilmMap
from .._numerics.bitset import count_upto
from .._numerics.running import running_sum
from .._numerics.safe import dot, norm, safe_divide
from .curves import Arcs, Segments, edge_fractions, ends, film_at, homogeneous, unit_at

#: How far straight parts may lie from the bent image, in px, and how many one curve may have.
TOLERANCE_PX = 1e-3
MOST_PARTS = 1 << 14
#: Curves counted at a time, and points of an arc that its bending is judged by.
COUNTED = 2048
SAMPLES = 17
#: Second derivatives between the points where they are looked at are taken to be larger by this.
MARGIN = 1.3


class Cuts(NamedTuple):
    """How many parts the curves up to each have: id -> (curve, part) by a search."""

    upto: Int[Array, "K"]

    @property
    def total(self) -> Int[Array, ""]:
        """Return the number of all parts."""
        return self.upto[-1]

    def find(self, ids: Int[Array, "*P"]) -> tuple[Array, Array, Array]:
        """Return the curve of each part, the part's number, and how many parts the curve has."""
        curve = count_upto(self.upto, ids)
        curve = jnp.minimum(curve, self.upto.shape[0] - 1)
        before = jnp.where(curve > 0, self.upto[jnp.maximum(curve - 1, 0)], 0)
        return curve, ids - before, self.upto[curve] - before


def cuts(number: Callable[[Array], Array], total: Int[Array, ""] | int, capacity: int) -> Cuts:
    """Return the cuts of curves 0 to `total` - 1 into `number(ids)` parts; `capacity` is static."""

    def body(state):
        first, counts = state
        ids = first + jnp.arange(min(COUNTED, capacity), dtype=jnp.int32)
        n = jnp.where(ids < total, number(jnp.minimum(ids, capacity - 1)), 0)
        return first + COUNTED, counts.at[ids].set(n.astype(jnp.int32), mode="drop")

    start = (jnp.int32(0), jnp.zeros(capacity, jnp.int32))
    return Cuts(running_sum(jax.lax.while_loop(lambda s: s[0] < total, body, start)[1]))


class Bending(NamedTuple):
    """How much the lens bends straight lines up to some radii: second derivatives, px / px^2."""

    centre: Float[Array, "2"]
    radii: Float[Array, "R"]
    most: Float[Array, "R"]

    def parts(self, segments: Segments, px: Array) -> Int[Array, "K"]:
        """Return into how many parts straight lines are to be cut; 0 where there is no line."""
        a, b = segments.a, segments.b
        radius = jnp.maximum(*(norm(x - self.centre[None]) for x in (a, b)))
        ring = jnp.searchsorted(self.radii, radius)
        most = self.most[jnp.minimum(ring, self.most.shape[0] - 1)]
        square = most * jnp.sum((b - a) ** 2, axis=1)
        return jnp.where(segments.weight == 0, 0, _enough(square * px))


def _enough(second_px: Array) -> Array:
    """Return how many equal parts of a curve, whose second derivative over all of it is this many
    px, stray from it by no more than the tolerance."""
    n = jnp.ceil(jnp.sqrt(MARGIN * second_px / (8 * TOLERANCE_PX)))
    return jnp.clip(n, 1, MOST_PARTS).astype(jnp.int32)


def bending(film: FilmMap) -> Bending:
    """Return how much the lens bends what lies within the film's bounds."""
    assert film.bend is not None
    bend: Bend = jax.lax.stop_gradient(film.bend)
    left, right, bottom, top = film.bounds
    centre, dtype = bend.centre, bend.centre.dtype
    reach = jnp.stack([jnp.maximum(jnp.abs(left - centre[0]), jnp.abs(right - centre[0]))])
    reach = jnp.append(reach, jnp.maximum(jnp.abs(bottom - centre[1]), jnp.abs(top - centre[1])))
    radii = norm(reach) * jnp.asarray(np.geomspace(1 / 64, 1, 32), dtype)
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    way = jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], axis=-1), dtype)
    points = centre[None, None] + radii[:, None, None] * way[None]

    def second(u, v):
        along = lambda p: jax.jvp(bend, (p,), (jnp.broadcast_to(u, p.shape),))[1]
        return norm(jax.jvp(along, (points,), (jnp.broadcast_to(v, points.shape),))[1])

    x, y = (jnp.asarray(v, dtype)[None, None] for v in ([1.0, 0.0], [0.0, 1.0]))
    most = jnp.maximum(second(x, x), second(y, y)) + second(x, y)
    return Bending(centre, radii, jax.lax.cummax(jnp.max(most, axis=1)))


def seen_through(film: FilmMap, points: Float[Array, "K 2 2"]) -> Float[Array, "K 2 3"]:
    """Return the ends of parts on the ideal film as the homogeneous points that their image moves
    with."""
    assert film.bend is not None
    image = film.bend(points)
    return jnp.concatenate([image, jnp.ones_like(image[..., :1])], axis=-1)


def along(
    segments: Segments, part: Int[Array, "K"], parts: Int[Array, "K"]
) -> Float[Array, "K 2 2"]:
    """Return the ends of parts of straight lines; parts that meet agree on where."""
    share = _fractions(part, parts, segments.a.dtype)[..., None]
    a, b = segments.a[:, None], segments.b[:, None]
    return jnp.where(share >= 1, b, a + share * (b - a))


def _fractions(part: Array, parts: Array, dtype) -> Float[Array, "K 2"]:
    """Return at which shares of a curve a part begins and ends."""
    number = jnp.stack([part, part + 1], axis=-1).astype(dtype)
    return number / jnp.maximum(parts, 1).astype(dtype)[:, None]


def following(
    homogeneous: Float[Array, "K 2 3"], points: Float[Array, "K 2 2"]
) -> Float[Array, "K 2 2"]:
    """Return points of edges, which move as their edges do."""
    held, points = jax.lax.stop_gradient((homogeneous, points))
    line = jnp.cross(held[:, 0], held[:, 1])
    steep = jnp.abs(line[:, 0]) > jnp.abs(line[:, 1])
    both = jnp.broadcast_to(homogeneous[:, None], (*points.shape[:2], 2, 3))
    share = edge_fractions(jax.lax.stop_gradient(both), jnp.repeat(steep[:, None], 2, 1), points)
    offset = both[..., :2] - points[..., None, :] * both[..., 2:]
    move = jnp.sum(share[..., None] * offset, axis=-2)
    return points + (move - jax.lax.stop_gradient(move))


# --- arcs of conics ------------------------------------------------------------------------------


class _Stretch(NamedTuple):
    """What of an arc is within the bounds: from `start` on by `turn` rad to `end`; and the part of
    it that lies left of them, as heights, where `beside`."""

    frame: Float[Array, "K 3 3"]
    start: Float[Array, "K 2"]
    end: Float[Array, "K 2"]
    turn: Float[Array, "K"]
    beside: Int[Array, "K"]
    heights: Float[Array, "K 2"]
    weight: Float[Array, "K"]

    def at(self, share: Float[Array, "K n"]) -> Float[Array, "K n 2"]:
        """Return points of the unit circle."""
        angle = share * self.turn[:, None]
        c, s = jnp.cos(angle), jnp.sin(angle)
        x, y = self.start[:, :1], self.start[:, 1:]
        w = jnp.stack([x * c - y * s, y * c + x * s], axis=-1)
        return jnp.where((share >= 1)[..., None], self.end[:, None], w)


def _stretch(film: FilmMap, arcs: Arcs) -> _Stretch:
    bounds = film.bounds
    first, last = ends(arcs)
    turn = lambda w: _turn(arcs.start, w)
    whole = turn(arcs.end)
    begin, finish = jnp.zeros_like(whole), whole
    start, end = arcs.start, arcs.end
    heights = jnp.stack([first[:, 1], last[:, 1]], axis=-1)
    beside = jnp.zeros_like(whole, bool)
    for axis in (0, 1):
        grows = jnp.where(last[:, axis] >= first[:, axis], 1, -1).astype(whole.dtype)
        for value, side in ((bounds[2 * axis], -1), (bounds[2 * axis + 1], 1)):
            w = unit_at(arcs.frame, axis, jnp.full_like(whole, value), grows)
            out_first, out_last = (side * (p[:, axis] - value) > 0 for p in (first, last))
            cut = jnp.clip(turn(w), 0, whole)
            if (axis, side) == (0, -1):
                crossing = film_at(arcs.frame, w)[:, 1]
                stays = jnp.stack([out_first, out_last], axis=-1)
                heights = jnp.where(stays, heights, crossing[:, None])
                beside = out_first | out_last
            later = out_first & (jnp.where(out_last, jnp.inf, cut) > begin)
            begin = jnp.where(later, jnp.where(out_last, jnp.inf, cut), begin)
            start = jnp.where(later[:, None], w, start)
            sooner = out_last & (cut < finish)
            finish = jnp.where(sooner, cut, finish)
            end = jnp.where(sooner[:, None], w, end)
    heights = jnp.clip(heights, bounds[2], bounds[3])
    shown = arcs.weight != 0
    turned = jnp.where(shown & (begin < finish), finish - begin, 0)
    return _Stretch(
        arcs.frame, start, end, turned, (beside & shown).astype(jnp.int32), heights, arcs.weight
    )


def _turn(a: Float[Array, "K 2"], b: Float[Array, "K 2"]) -> Float[Array, "K"]:
    """Return the angle from a to b, counter-clockwise; as 0 if b is a little before a."""
    angle = jnp.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], dot(a, b))
    return jnp.where(angle < -np.pi / 2, angle + 2 * np.pi, angle)


def arc_parts(film: FilmMap, arcs: Arcs) -> Int[Array, "K"]:
    """Return into how many parts arcs are to be cut."""
    assert film.bend is not None
    stretch = _stretch(film, arcs)
    share = jnp.asarray(np.linspace(0, 1, SAMPLES)[None], arcs.weight.dtype)
    w = stretch.at(jnp.broadcast_to(share, (arcs.weight.shape[0], SAMPLES)))
    points = film.bend(film_at(arcs.frame[:, None], w))
    bend = norm(points[:, 2:] - 2 * points[:, 1:-1] + points[:, :-2])
    inner = _enough(jnp.max(bend, axis=1) * (SAMPLES - 1) ** 2 * film.px)
    return jnp.where(stretch.turn > 0, inner, 0) + stretch.beside


def arc_part_ends(
    film: FilmMap, arcs: Arcs, frame: Float[Array, "K 3 3"], part: Array, parts: Array
) -> Float[Array, "K 2 2"]:
    """Return the ends of parts of arcs on the ideal film, which move as the frames do."""
    stretch = _stretch(film, jax.lax.stop_gradient(arcs))
    inner = parts - stretch.beside
    w = stretch.at(_fractions(part, inner, frame.dtype))
    held = film_at(stretch.frame[:, None], w)
    point = homogeneous(frame[:, None], w)
    z = jax.lax.stop_gradient(point[..., 2:])
    move = safe_divide(point[..., :2] - held * point[..., 2:], z)
    moving = held + (move - jax.lax.stop_gradient(move))
    left = jnp.full_like(stretch.heights, film.bounds[0])
    beside = jnp.stack([left, stretch.heights], axis=-1)
    return jnp.where((part < inner)[:, None, None], moving, beside)
