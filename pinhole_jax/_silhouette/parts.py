"""The contour's curves by kind: some at a time, or lists of as many as there is room for."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._numerics.batches import in_chunks
from .._numerics.one_kernel import one_kernel, put
from .coverage import Monotone, monotone, rightward, taken
from .curves import Arcs, Curves, Point, Segments, placed

#: So many curves are listed. (First passes, ms of the processor: a scan of 82k faces at 2048 px 22;
#: with 2^13 curves, found anew for each band, 56.)
LISTED = 1 << 16
#: Rows that an array has at least: one that is written over as a whole is not read, and XLA's CPU
#: compiler aborts over arguments of a kernel that it need not read.
LEAST = 2


class Together(NamedTuple):
    """Curves so many at a time (as few as run as fast: that compiles sooner): `curves(ids)`, with
    consecutive ids, the first of which is a multiple of their number."""

    number: int
    curves: Callable[[Int[Array, "K"]], Curves]


class InTurn(NamedTuple):
    """Segments one after the other, in single numbers: `before(id)` is the place of the one before
    that of an id, `following(id, before)` the place, the ends and the weight of this."""

    before: Callable[[Int[Array, ""]], Int[Array, ""]]
    following: Callable[
        [Int[Array, ""], Int[Array, ""]], tuple[Int[Array, ""], tuple[Point, Point], Array]
    ]


class Part(NamedTuple):
    """Curves of one kind: `curves(ids)` for ids below `total`; `size` is a static chunk of them.

    `homogeneous_of(ids)` is what the curves move with, differentiably. There are at most `most`, if
    known; a kernel finds some `together`, or one after the other (`in_turn`): neither where that
    would be too large a kernel. They are segments if `straight`, else arcs; `dtype` is the float
    type.
    """

    curves: Callable[[Int[Array, "K"]], Curves]
    homogeneous_of: Callable[[Int[Array, "K"]], Float[Array, "K n 3"]]
    total: Int[Array, ""]
    size: int
    most: int | None
    together: Together | None
    in_turn: InTurn | None
    straight: bool
    dtype: Any


def fold_curves(
    part: Part,
    add: Callable[[Any, Array, Curves], Any],
    start: Any,
    size: int,
    block: tuple[Any, Any] | None = None,
) -> Any:
    """Return `start` after `add(total, ids, curves)` over all curves, `size` at a time; or over a
    block of them, from its first id up to another, in whole chunks."""
    begin, end = (jnp.int32(0), part.total) if block is None else block
    end = jnp.minimum(part.total, end)

    def chunk(total, first):
        ids = first + jnp.arange(size, dtype=jnp.int32)
        curves = jax.lax.stop_gradient(part.curves(jnp.minimum(ids, part.total - 1)))
        weight = jnp.where(ids < part.total, curves.weight, 0)
        return add(total, ids, curves._replace(weight=weight))

    return in_chunks(chunk, start, size, end, begin)


# --- lists ---------------------------------------------------------------------------------------


class Ordered(NamedTuple):
    """What is needed of `Monotone` (all of it is read: see `LEAST`); `frame` of arcs."""

    low: Float[Array, "*K 2"]
    high: Float[Array, "*K 2"]
    rising: Float[Array, "*K"]
    weight: Float[Array, "*K"]
    frame: Float[Array, "*K 3 3"] | None

    @staticmethod
    def of(curves: Curves) -> "Ordered":
        """Return curves ordered by height."""
        low, high, rising, _, own = monotone(curves)
        frame = None if isinstance(own, Segments) else own.frame
        return Ordered(low, high, rising, own.weight, frame)

    @property
    def monotone(self) -> Monotone:
        """Return the curves as what they were made of."""
        low, high, rising, weight, frame = self
        own = Segments(low, high, weight) if frame is None else Arcs(frame, low, high, weight)
        return Monotone(low, high, rising, rightward(low, high), own)

    def placed(self, scale: Array, origin: Array) -> Monotone:
        """Return one of these curves in pixels `scale` times as small, from a film's `origin`."""
        m = self.monotone
        low, high = (m.low - origin) * scale, (m.high - origin) * scale
        own = placed(m.curves, scale, origin)
        return Monotone(low, high, m.rising, rightward(low, high), own)


class CurveList(NamedTuple):
    """Curves of a part from the one with the id `begin` on, as many as there is room for (-1: none
    yet)."""

    curves: Ordered
    begin: Int[Array, ""]

    @staticmethod
    def empty(part: Part) -> "CurveList":
        """Return a list of no curves."""
        room = -(-min(LISTED, part.most or LISTED) // part.size) * part.size
        zeros = lambda *shape: jnp.zeros((max(room, LEAST), *shape), part.dtype)
        frame = None if part.straight else zeros(3, 3)
        return CurveList(Ordered(zeros(2), zeros(2), zeros(), zeros(), frame), jnp.int32(-1))

    def fold(
        self,
        part: Part,
        add: Callable[[Any, Ordered, Array, Array], Any],
        start: Any,
        has_all: bool = False,
    ) -> tuple[Any, "CurveList"]:
        """Return `start` after `add(total, curves, begin, number)` over all curves of a part, as
        many at a time as there is room for: the first so many of a list, which begins with an id;
        and the last list. One that `has_all`, where there is room for all, is as it is.

        Lists go down to the first curve, and from there up again: one is there already.
        """
        room, zero = self.room, jnp.int32(0)
        if self.has_room(part):
            known = self if has_all else self.listing(part, zero)
            return add(start, known.curves, zero, part.total), known
        last = jnp.maximum(part.total - 1, 0) // room * room
        first, step = jnp.where(self.begin == 0, 0, last), jnp.where(self.begin == 0, room, -room)

        def more(state):
            begin, total, known = state
            known = known.listing(part, begin)
            total = add(total, known.curves, begin, jnp.minimum(part.total - begin, room))
            return begin + step, total, known

        inside = lambda s: (s[0] >= 0) & (s[0] < part.total)
        return jax.lax.while_loop(inside, more, (first, start, self))[1:]

    @property
    def room(self) -> int:
        """How many curves there is room for."""
        return self.curves.rising.shape[0]

    def has_room(self, part: Part) -> bool:
        """Return whether there is room for all curves of a part."""
        return part.most is not None and part.most <= self.room

    def listing(self, part: Part, begin: Int[Array, ""]) -> "CurveList":
        """Return a list of a part's curves from an id on. What is listed already stays."""
        end = jnp.where(self.begin == begin, begin, begin + self.room)
        curves = _listing(part)(begin, jnp.minimum(end, part.total), self.curves)
        return CurveList(curves, begin)


def _listing(part: Part) -> Callable[[Array, Array, Ordered], Ordered]:
    """Return the function that makes a list of curves from an id up to another, in one kernel if
    that is not too large."""
    if part.in_turn is not None:
        zero = jnp.int32(0)
        before, following = part.in_turn
        return _in_one_kernel(_listed_in_turn, (before, zero), (following, zero, zero))
    if part.together is None:
        append = one_kernel(_appended)

        def by_chunks(begin: Array, end: Array, known: Ordered) -> Ordered:
            chunk = lambda known, ids, curves: append(curves, ids[0] - begin, known)
            return fold_curves(part, chunk, known, part.size, (begin, end))

        return by_chunks
    number, curves = part.together
    ids = jnp.zeros(number, jnp.int32)
    return _in_one_kernel(partial(_listed, number), (curves, ids))


def _in_one_kernel(listed: Callable[..., Ordered], *functions: tuple) -> Callable[..., Ordered]:
    """Return `listed` of functions, each given with its arguments' like, as one kernel: it is told
    all that they read of."""
    made = [eqx.filter_closure_convert(*function) for function in functions]
    reads, rest = eqx.partition(made, eqx.is_array)
    all_of = lambda reads, *more: listed(*eqx.combine(reads, rest), *more)
    return partial(one_kernel(all_of), reads)


def _appended(
    curves: Curves, first: Int[Array, ""], known: Ordered, number: Int[Array, ""] | None = None
) -> Ordered:
    """Return listed curves with more of them from a place on, so many or (None) all; those that
    come before the list are written over."""

    def one(k, known):
        row = Ordered.of(taken(curves, k))
        return jax.tree.map(lambda x, new: put(x, new, jnp.maximum(first + k, 0)), known, row)

    if number is None:
        return jax.lax.fori_loop(0, curves.weight.shape[0], one, known)
    return jax.lax.fori_loop(jnp.int32(0), number, one, known)


def _listed(
    at_a_time: int,
    curves_of: Callable[[Array], Curves],
    begin: Int[Array, ""],
    end: Int[Array, ""],
    known: Ordered,
) -> Ordered:
    """Return a list that begins with an id, with the curves up to another."""

    def some(known, first):
        ids = first + jnp.arange(at_a_time, dtype=jnp.int32)
        curves = curves_of(jnp.minimum(ids, end - 1))
        number = jnp.minimum(end - first, at_a_time)
        return _appended(curves, first - begin, known, number)

    first = jnp.where(begin >= end, end, begin - begin % at_a_time)
    return in_chunks(some, known, at_a_time, end, first)


def _listed_in_turn(
    before: Callable[[Array], Array],
    following: Callable[[Array, Array], tuple[Array, tuple[Point, Point], Array]],
    begin: Int[Array, ""],
    end: Int[Array, ""],
    known: Ordered,
) -> Ordered:
    """Return the same of segments that are found one after the other."""

    def one(id, state):
        place, known = state
        place, ((x, y), (last_x, last_y)), weight = following(id, place)
        up = last_y >= y
        either = lambda a, b: jnp.where(up, a, b)
        low, high = (either(x, last_x), either(y, last_y)), (either(last_x, x), either(last_y, y))
        row = Ordered(jnp.stack(low), jnp.stack(high), either(1, -1), weight, None)
        return place, jax.tree.map(lambda x, new: put(x, new, id - begin), known, row)

    return jax.lax.fori_loop(begin, end, one, (before(begin), known))[1]
