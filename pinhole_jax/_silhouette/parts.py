"""The contour's curves by kind: some at a time, or lists of as many as there is room for."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._numerics.one_kernel import one_kernel, put
from .coverage import Monotone, monotone, rightward, taken
from .curves import Arcs, Curves, Segments, placed

#: So many curves are listed. (First passes, ms of the processor: a scan of 82k faces at 2048 px 22;
#: with 2^13 curves, found anew for each band, 56.)
LISTED = 1 << 16
#: Rows that an array has at least: one that is written over as a whole is not read, and XLA's CPU
#: compiler aborts over arguments of a kernel that it need not read.
LEAST = 2


class Part(NamedTuple):
    """Curves of one kind: `curves(ids)` for ids below `total`; `size` is a static chunk of them.

    `homogeneous_of(ids)` is what the curves move with, differentiably. There are at most `most`, if
    known. Of `plain` ones a kernel can make one by itself (see `one_kernel`).
    """

    curves: Callable[[Int[Array, "K"]], Curves]
    homogeneous_of: Callable[[Int[Array, "K"]], Float[Array, "K n 3"]]
    total: Int[Array, ""]
    size: int
    most: int | None
    plain: bool = False

    @property
    def straight(self) -> bool:
        """Whether its curves are segments, not arcs."""
        return self.homogeneous.shape[-2] == 2

    @property
    def dtype(self) -> Any:
        """The float type."""
        return self.homogeneous.dtype

    @property
    def homogeneous(self) -> Any:
        """Shape (1, n, 3) and type of a curve's homogeneous points."""
        return jax.eval_shape(self.homogeneous_of, jnp.zeros(1, jnp.int32))


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

    def body(state):
        first, total = state
        ids = first + jnp.arange(size, dtype=jnp.int32)
        curves = jax.lax.stop_gradient(part.curves(jnp.minimum(ids, part.total - 1)))
        weight = jnp.where(ids < part.total, curves.weight, 0)
        return first + size, add(total, ids, curves._replace(weight=weight))

    return jax.lax.while_loop(lambda s: s[0] < end, body, (begin, start))[1]


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
        ids = jnp.zeros(max(room, LEAST), jnp.int32)
        like = jax.eval_shape(lambda: Ordered.of(part.curves(ids)))
        return CurveList(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like), jnp.int32(-1))

    def fold(
        self,
        part: Part,
        add: Callable[[Any, Ordered, Array, Array], Any],
        start: Any,
        has_all: bool = False,
    ) -> tuple[Any, "CurveList"]:
        """Return `start` after `add(total, curves, begin, number)` over all curves of a part, as
        many at a time as there is room for: the first so many of a list, which begins with an id;
        and the last list. One that `has_all`, where there is room for all, is as it is."""
        room = self.curves.rising.shape[0]
        if has_all and part.most is not None and part.most <= room:
            return add(start, self.curves, jnp.int32(0), part.total), self
        make = _each_made if part.plain else _made_in_chunks

        def more(state):
            begin, total, known = state
            # What is listed already stays.
            end = jnp.where(known.begin == begin, begin, begin + room)
            curves = make(part, begin, end, known.curves)
            total = add(total, curves, begin, jnp.minimum(part.total - begin, room))
            return begin + room, total, CurveList(curves, begin)

        start = jnp.int32(0), start, self
        return jax.lax.while_loop(lambda s: s[0] < part.total, more, start)[1:]


def _made_in_chunks(part: Part, begin: Array, end: Array, known: Ordered) -> Ordered:
    """Return listed curves from one id on, up to another, made as vectors of some."""
    append = one_kernel(_appended)
    chunk = lambda known, ids, curves: append(curves, ids[0] - begin, known)
    return fold_curves(part, chunk, known, part.size, (begin, end))


def _appended(curves: Curves, first: Int[Array, ""], known: Ordered) -> Ordered:
    """Return listed curves with more of them from a place on."""

    def one(k, known):
        row = Ordered.of(taken(curves, k))
        return jax.tree.map(lambda x, new: put(x, new, first + k), known, row)

    return jax.lax.fori_loop(0, curves.weight.shape[0], one, known)


def _each_made(part: Part, begin: Array, end: Array, known: Ordered) -> Ordered:
    """Return listed curves from one id on, up to another, each made by itself, in one kernel: of
    vectors some 25 kernels take twice as long."""
    make = lambda ids: Ordered.of(jax.lax.stop_gradient(part.curves(ids)))
    made = eqx.filter_closure_convert(make, jnp.zeros(1, jnp.int32))
    arrays, rest = eqx.partition(made, eqx.is_array)

    def all_made(arrays, begin, end, known):
        def one(k, known):
            row = eqx.combine(arrays, rest)((begin + k)[None])
            return jax.tree.map(lambda x, new: put(x, new[0], k), known, row)

        return jax.lax.fori_loop(0, end - begin, one, known)

    return one_kernel(all_made)(arrays, begin, jnp.minimum(end, part.total), known)
