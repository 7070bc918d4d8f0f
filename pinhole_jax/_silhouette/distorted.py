"""Contours under a lens's distortion: cut into parts so short that straight ones follow the image.

A part's ends are points of the ideal film, seen through the lens. They move with the camera (its
lens too) and the scene, and straight pieces between them are all that the rasteriser sees.

All that is worked out of a curve or a part is written for one of them, in single numbers: `rows`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from .._camera.film import FilmMap
from .._numerics.bitset import count_upto
from .._numerics.one_kernel import on_cpu, put, rows, rows_of_each
from .._numerics.running import running_sum
from .._numerics.safe import length, safe_divide
from .curves import Frame, Point, Segments, arc_end, cut_at, homogeneous_at, point_at

#: How far straight parts may lie from the bent image, in px, and how many one curve may have.
TOLERANCE_PX = 1e-3
MOST_PARTS = 1 << 14
#: Curves counted at a time, and points of an arc that its bending is judged by.
COUNTED = 2048
SAMPLES = 17
#: Second derivatives between the points where they are looked at are taken to be larger by this.
MARGIN = 1.3
#: Radii at which a lens's bending is looked at, as shares of the largest, and in how many ways.
RADII = np.geomspace(1 / 64, 1, 32)
WAYS = 16


class Cuts(NamedTuple):
    """How many parts the curves up to each have: id -> (curve, part) by a search.

    `curves` is what is known of each curve (see `Arc`), None if it is worked out for each part.
    """

    upto: Int[Array, "K"]
    curves: Float[Array, "K numbers"] | None = None

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


def cuts(
    number: Callable[..., Array], total: Int[Array, ""] | int, capacity: int, *held: Any
) -> Cuts:
    """Return the cuts of curves 0 to `total` - 1 into `number(id, *held)` parts; `capacity` is
    static."""

    def one_by_one(total, held, upto):
        def more(state):
            k, sum_, upto = state
            sum_ = sum_ + number(k, *held)
            return k + 1, sum_, put(upto, sum_, k)

        begin = jnp.int32(0), jnp.int32(0), upto
        k, sum_, upto = jax.lax.while_loop(lambda s: s[0] < total, more, begin)
        return jax.lax.fori_loop(k, jnp.int32(len(upto)), lambda k, upto: put(upto, sum_, k), upto)

    def side_by_side(total, held, upto):
        def more(state):
            first, counts = state
            ids = first + jnp.arange(min(COUNTED, capacity), dtype=jnp.int32)
            n = jax.vmap(lambda k: number(k, *held))(jnp.minimum(ids, capacity - 1))
            return first + COUNTED, counts.at[ids].set(jnp.where(ids < total, n, 0), mode="drop")

        start = jnp.int32(0), upto
        return running_sum(jax.lax.while_loop(lambda s: s[0] < total, more, start)[1])

    # (Of one curve more than one: see `one_kernel`.)
    upto = jnp.zeros(max(capacity, 2), jnp.int32)
    return Cuts(on_cpu(one_by_one, jnp.int32(total), held, upto, elsewhere=side_by_side))


class Bending(NamedTuple):
    """How much the lens bends straight lines at some radii: second derivatives, px / px^2."""

    radii: Float[Array, "R"]
    most: Float[Array, "R"]

    def parts(self, film: FilmMap, ends: tuple[Point, Point], weight: Array) -> Int[Array, ""]:
        """Return into how many parts a straight line is to be cut; 0 where there is no line."""
        assert film.bend is not None
        centre, (a, b) = film.bend.centre, ends
        radius = jnp.maximum(*(length(x - centre[0], y - centre[1]) for x, y in (a, b)))
        within = jnp.arange(len(RADII)) <= jnp.sum(self.radii < radius)
        most = jnp.max(jnp.where(within, self.most, 0))
        square = (b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2
        return jnp.where(weight == 0, 0, _enough(most * square * film.px))


def _enough(second_px: Array) -> Array:
    """Return how many equal parts of a curve, whose second derivative over all of it is this many
    px, stray from it by no more than the tolerance."""
    n = jnp.ceil(jnp.sqrt(MARGIN * second_px / (8 * TOLERANCE_PX)))
    return jnp.clip(n, 1, MOST_PARTS).astype(jnp.int32)


def bending(film: FilmMap) -> Bending:
    """Return how much the lens bends what lies within the film's bounds."""
    angle = np.linspace(0, 2 * np.pi, WAYS, endpoint=False)
    tables = RADII, np.stack([np.cos(angle), np.sin(angle)], axis=1)
    tables = [jnp.asarray(x, film.eye.dtype) for x in tables]
    ids = jnp.arange(len(RADII), dtype=jnp.int32)
    return Bending(*jnp.moveaxis(rows(_bending_at, ids, film, *tables), 1, 0))


def _bending_at(
    ring: Array, film: FilmMap, shares: Float[Array, "R"], ways: Float[Array, "ways 2"]
) -> tuple[Array, Array]:
    """Return a radius, and how much the lens bends there."""
    assert film.bend is not None
    bend, centre = film.bend, film.bend.centre
    left, right, bottom, top = film.bounds
    reach = [jnp.maximum(jnp.abs(left - centre[0]), jnp.abs(right - centre[0]))]
    reach.append(jnp.maximum(jnp.abs(bottom - centre[1]), jnp.abs(top - centre[1])))
    radius = length(*reach) * shares[ring]
    one, none = jnp.ones_like(radius), jnp.zeros_like(radius)

    def at(k, most):
        point = centre[0] + radius * ways[k, 0], centre[1] + radius * ways[k, 1]

        def second(u, v):
            along = lambda x, y: jax.jvp(bend.at, (x, y), u)[1]
            return length(*jax.jvp(along, point, v)[1])

        x, y = (one, none), (none, one)
        return jnp.maximum(most, jnp.maximum(second(x, x), second(y, y)) + second(x, y))

    return radius, jax.lax.fori_loop(0, WAYS, at, none)


# --- parts ---------------------------------------------------------------------------------------


class End(NamedTuple):
    """An end of a part on the ideal film: a point, and how much it moves with each of the
    homogeneous points that it moves with, over its depth; and the part's weight."""

    x: Array
    y: Array
    shares: Sequence[Array]
    weight: Array


#: `part(id, *held)` gives the ends of a part, 0 and 1.
Part = Callable[..., Callable[[Array], End]]


def fraction(part: Array, parts: Array, dtype: Any) -> Array:
    """Return at which share of a curve a part begins."""
    return part.astype(dtype) / jnp.maximum(parts, 1).astype(dtype)


def along(ends: tuple[Point, Point], share: Array) -> Point:
    """Return the point of a straight line at a share of it; parts that meet agree on where."""
    x, y = (jnp.where(share >= 1, b, a + share * (b - a)) for a, b in zip(*ends, strict=True))
    return x, y


def bent_parts(part: Part, film: FilmMap, ids: Int[Array, "K"], *held: Any) -> Segments:
    """Return parts as they are seen."""
    table = _bent(part, False, film, ids, *held)
    return Segments(table[:, 0, :2], table[:, 1, :2], table[:, 0, 2])


def moving_parts(
    part: Part,
    points: Float[Array, "K n 3"],
    film: FilmMap,
    ids: Int[Array, "K"],
    *held: Any,
) -> Float[Array, "K 2 3"]:
    """Return the ends of the same as the homogeneous points that their image moves with: it moves
    as homogeneous points of the ideal film do, and as the lens's numbers."""
    assert film.bend is not None
    K, n = ids.shape[0], 3 * points.shape[1]

    @jax.custom_jvp
    def image(points, numbers, film, ids, held):
        del points, numbers
        return _lifted(_bent(part, False, film, ids, *held)[..., :2], 1)

    def pushed(primals, tangents):
        table = _bent(part, True, *primals[2:4], *primals[4])
        by_points, by_numbers = jnp.split(table[..., 3:], [2 * n], axis=-1)
        moves, changes = tangents[:2]
        rate = jnp.zeros((K, 2, 2), table.dtype)
        if not isinstance(moves, SymbolicZero):
            rate += _sum(by_points.reshape(K, 2, 2, n), moves.reshape(K, 1, 1, n))
        if not isinstance(changes, SymbolicZero):
            rate += _sum(by_numbers.reshape(K, 2, 2, -1), changes.reshape(1, 1, 1, -1))
        return _lifted(table[..., :2], 1), _lifted(rate, 0)

    image.defjvp(pushed, symbolic_zeros=True)
    return image(points, film.bend.numbers, *jax.lax.stop_gradient((film, ids, held)))


def _bent(
    part: Part, slopes: bool, film: FilmMap, ids: Int[Array, "K"], *held: Any
) -> Float[Array, "K 2 m"]:
    """Return where the lens shows the ends of parts, x and y, and the weight; if asked for, after
    them the derivatives of x and y by the homogeneous points, and those by `Bend.numbers`."""

    def ends(id, film, *held):
        end = part(id, film, *held)

        def row(k):
            x, y, shares, weight = end(k)
            if not slopes:
                return *film.bend.at(x, y), weight
            place, by_point, by_numbers = film.bend.moving_at(x, y)
            moved = ((gx, gy, -(gx * x + gy * y)) for gx, gy in by_point)
            by_points = [share * g for of in moved for share in shares for g in of]
            return *place, weight, *by_points, *by_numbers[0], *by_numbers[1]

        return row

    return rows_of_each(ends, 2, ids, film, *held)


def _lifted(xy: Float[Array, "K 2 2"], z: int) -> Float[Array, "K 2 3"]:
    return jnp.pad(xy, ((0, 0), (0, 0), (0, 1)), constant_values=z)


def _sum(slopes: Array, moves: Array) -> Array:
    return jnp.sum(slopes * moves, axis=-1)


# --- arcs of conics ------------------------------------------------------------------------------


class Arc(NamedTuple):
    """What is known of an arc: its frame's rows; where on the unit circle it enters what the film
    may show, and leaves it, `turn` rad later; `beside` (1 or 0), whether a part of it lies left of
    that, with the `heights` of this; its weight."""

    frame: Frame
    start: Point
    end: Point
    turn: Array
    beside: Array
    heights: tuple[Array, Array]
    weight: Array

    @staticmethod
    def of(row: Sequence[Array]) -> "Arc":
        """Return it from its numbers, in this order."""
        frame = tuple(tuple(row[3 * k + i] for i in range(3)) for k in range(3))
        start, end, heights = ((row[k], row[k + 1]) for k in (9, 11, 15))
        return Arc(frame, start, end, row[13], row[14], heights, row[17])

    @property
    def numbers(self) -> list[Array]:
        """Return its numbers, in order."""
        return jax.tree.leaves(self)

    def at(self, share: Array) -> Point:
        """Return a point of the unit circle."""
        angle = share * self.turn
        c, s = jnp.cos(angle), jnp.sin(angle)
        x, y = self.start
        w = x * c - y * s, y * c + x * s
        return _either(share >= 1, self.end, w)


def _either(there: Array, a: Point, b: Point) -> Point:
    return jnp.where(there, a[0], b[0]), jnp.where(there, a[1], b[1])


def arc_within(film: FilmMap, frame: Frame, start: Point, end: Point, weight: Array) -> Arc:
    """Return what of an arc is within the film's bounds, or left of them."""
    bounds = film.bounds
    first, last = arc_end(frame, start, 1), arc_end(frame, end, -1)
    turn = partial(_turn, start)
    whole = turn(end)
    begin, finish = jnp.zeros_like(whole), whole
    heights, beside = (first[1], last[1]), jnp.zeros_like(whole, bool)
    from_ = start
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
            begin, from_ = jnp.where(later, entry, begin), _either(later, w, from_)
            finish, end = jnp.where(sooner, cut, finish), _either(sooner, w, end)
    low, high = (jnp.clip(y, bounds[2], bounds[3]) for y in heights)
    shown = weight != 0
    turned = jnp.where(shown & (begin < finish), finish - begin, 0)
    beside = (beside & shown).astype(turned.dtype)
    return Arc(frame, from_, end, turned, beside, (low, high), weight)


def _turn(a: Point, b: Point) -> Array:
    """Return the angle from a to b, counter-clockwise; as 0 if b is a little before a."""
    angle = jnp.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
    return jnp.where(angle < -np.pi / 2, angle + 2 * np.pi, angle)


def arc_parts(film: FilmMap, arc: Arc) -> Int[Array, ""]:
    """Return into how many parts an arc is to be cut."""
    assert film.bend is not None
    bend = film.bend

    def at(k, state):
        (before, last), most = state
        place = bend.at(*point_at(arc.frame, arc.at(k.astype(arc.turn.dtype) / (SAMPLES - 1))))
        second = length(*(c - 2 * b + a for a, b, c in zip(before, last, place, strict=True)))
        return (last, place), jnp.where(k >= 2, jnp.maximum(most, second), most)

    zero = jnp.zeros_like(arc.turn)
    most = jax.lax.fori_loop(0, SAMPLES, at, (((zero, zero), (zero, zero)), zero))[1]
    inner = _enough(most * (SAMPLES - 1) ** 2 * film.px)
    return jnp.where(arc.turn > 0, inner, 0) + arc.beside.astype(jnp.int32)


def arc_part(id: Int[Array, ""], film: FilmMap, parts: Cuts) -> Callable[[Array], End]:
    """Return the ends of a part of an arc, which move as its frame does; of an id past the last
    part nothing."""
    assert parts.curves is not None
    number, part, all_of = parts.find(id)
    arc = Arc.of([parts.curves[number, k] for k in range(parts.curves.shape[1])])
    inner = all_of - arc.beside.astype(jnp.int32)
    inside = part < inner
    weight = jnp.where(id < parts.total, arc.weight, 0)

    def end(k):
        w = arc.at(fraction(part + k, inner, weight.dtype))
        x, y, z = homogeneous_at(arc.frame, w)
        beside = film.bounds[0], jnp.where(k == 0, *arc.heights)
        place = _either(inside, (safe_divide(x, z), safe_divide(y, z)), beside)
        shares = [jnp.where(inside, safe_divide(s, z), 0) for s in (jnp.ones_like(z), *w)]
        return End(*place, shares, weight)

    return end
