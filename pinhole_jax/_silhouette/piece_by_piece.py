"""Winding numbers of a film's pixels on a CPU: piece by piece, then word by word of 32 pixels.

A loop over curves, the rows that each meets, and the pixels of each row adds up what the pieces do
to their pixels: no piece waits for others. Another goes along the rows and makes an image of the
sums. It passes over the words that no piece is in: what they are is known from what lies left of
them. XLA's CPU compiler makes one kernel of each loop.

A film of many pixels is drawn band by band of rows, so that the sums stay in the processor's cache;
the curves are listed once for all bands, if there is room for them.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._numerics.one_kernel import one_kernel
from .asked import WORD, Asked, Corners, Drawn, Pixels, Sums, judged, words_in_row
from .coverage import Monotone, Pieces, between, left_at, on_line, piece_between, rows_of, taken
from .marks import drops, marks, winding_jumps
from .parts import LEAST, CurveList, Ordered

#: Words in a band. (First passes, ms of the processor: a scan of 82k faces at 2048 px 22; with 2^15
#: words 31. A hedgehog of as many at 1024 px 157; with 2^15 words 113, but a smooth mesh 3.8 and
#: not 3.0.)
BAND = 1 << 13


class _Band(NamedTuple):
    """Sums of a band of rows, row by row from the bottom up and word by word: which words are
    `touched`. The rows are those from `bottom` up to `top`."""

    sums: Sums
    touched: Int[Array, "words"]
    bottom: Int[Array, ""]
    top: Int[Array, ""]


def drawn_piece_by_piece(
    asked: Asked, rows: Int[Array, "2"] | None
) -> tuple[Drawn, list[CurveList]]:
    """Return the film, on which contours may be met in these rows (None: in all), and the curves
    that were listed last."""
    W, H, real = asked.film.W, asked.film.H, asked.film.eye.dtype
    words = words_in_row(W)
    height = min(H, max(BAND // words, 1))
    number = max(height * words, LEAST)
    begin, end = (jnp.int32(0), jnp.int32(H)) if rows is None else (rows[0], rows[1])
    empty = Sums.of(asked.resolves, number * WORD, real)
    nothing = _Band(empty, jnp.zeros(number, jnp.int32), begin, begin)
    judge = partial(judged, keep=asked.keep)
    walk = one_kernel(partial(_walked, W, H))
    draw = one_kernel(partial(_rows_drawn, judge, asked.deep or 0.0, W, H))

    def more(state):
        band, lists, film = state
        band = band._replace(bottom=band.top, top=jnp.minimum(band.top + height, end))
        more_lists = []
        for part, known in zip(asked.parts, lists, strict=True):
            add = lambda band, curves, begin, number: walk(curves, number, band)
            band, known = known.fold(part, add, band)
            more_lists.append(known)
        band, film = draw(band, film, asked.base.astype(real))
        return band, more_lists, film

    start = nothing, [CurveList.empty(part) for part in asked.parts], _Film.empty(asked)
    _, lists, film = jax.lax.while_loop(lambda s: s[0].top < end, more, start)
    return film.whole(W, H), lists


# --- pieces --------------------------------------------------------------------------------------


def walked(
    size: tuple[int, int],
    curves: Ordered,
    number: Int[Array, ""],
    rows: tuple[Any, Any],
    add: Callable[[Any, Int[Array, ""], Monotone, Pieces], Any],
    start: Any,
    first: Int[Array, ""] | int = 0,
) -> Any:
    """Return `start` after `add(total, k, curve, piece)` over the pieces of so many curves from the
    `first` on, the k-th of these, on a film of W x H pixels, in the rows from one up to another."""
    (W, H), (bottom, top) = size, rows

    def of_curve(state):
        k, total = state
        m = taken(curves, first + k).monotone
        rows = rows_of(m, top, bottom)

        def of_row(state):
            row, low, total = state
            high = on_line(m, row + 1, H)
            own = between(row, low, high, W)

            def of_pixel(state):
                along, ends, total = state
                piece = piece_between(m, own, along, ends, k, jnp.array(True), W)
                after = ends[1], left_at(m, own, along + 1)
                return along + 1, after, add(total, k, m, piece)

            # (What is in a loop's state is worked out once, not for each that asks.)
            along = jnp.int32(0)
            start = along, (low, left_at(m, own, along)), total
            total = jax.lax.while_loop(lambda s: s[0] <= own.further, of_pixel, start)[2]
            return row + 1, high, total

        end = rows.first + jnp.where(m.curves.weight == 0, 0, rows.number)
        start = rows.first, on_line(m, rows.first, H), total
        return k + 1, jax.lax.while_loop(lambda s: s[0] < end, of_row, start)[2]

    return jax.lax.while_loop(lambda s: s[0] < number, of_curve, (jnp.int32(0), start))[1]


def _walked(W: int, H: int, curves: Ordered, number: Int[Array, ""], band: _Band) -> _Band:
    """Return a band with the pieces of the first so many curves."""
    bottom, top = band.bottom, band.top

    def add(state, k, m, piece):
        del k, m
        return _with_piece(W, piece, piece.row - bottom, *state)

    start = band.sums, band.touched
    sums, touched = walked((W, H), curves, number, (bottom, top), add, start)
    return _Band(sums, touched, bottom, top)


def _with_piece(
    W: int, piece: Pieces, row: Int[Array, ""], sums: Sums, touched: Int[Array, "words"]
) -> tuple[Sums, Int[Array, "words"]]:
    """Return sums with a piece; what lies left of the film counts at its left side."""
    width = words_in_row(W) * WORD
    inside, follows = (piece.column >= 0) & (piece.column < W), piece.column < W - 1
    # (No sign: the compiler need not ask for it.)
    place = lambda column: (row * width + jnp.clip(column, 0, W - 1)).astype(jnp.uint32)
    own, after = place(piece.column), place(piece.column + 1)
    add = lambda x, at, value: jax.lax.dynamic_update_slice(x, (x[at] + value)[None], (at,))
    touch = lambda x, at: jax.lax.dynamic_update_slice(x, jnp.ones(1, x.dtype), (at // WORD,))
    only = lambda there, value: jnp.where(there, value, 0).astype(value.dtype)

    deltas = add(sums.deltas, own, only(inside, piece.area))
    rest = piece.height - only(inside, piece.area)
    deltas = add(deltas, after, only(follows, rest))
    touched = touch(touch(touched, own), after)
    if sums.marks is None or sums.jumps is None or sums.drops is None:
        return Sums(deltas, None, None, None), touched
    here = lambda x, value: add(x, own, only(inside, value))
    jumps = add(sums.jumps, after, only(follows, winding_jumps(piece)))
    of_pixel = jax.tree.map(here, sums.marks, marks(piece))
    return Sums(deltas, of_pixel, jumps, here(sums.drops, drops(piece))), touched


# --- rows ----------------------------------------------------------------------------------------


class _Film(NamedTuple):
    """What is drawn (see `Drawn`), one word of pixels or bits after the other."""

    image: Float[Array, "pixels"]
    alone: Bool[Array, "pixels"] | None
    overlapping: UInt32[Array, "words"] | None
    layers: Float[Array, "words"] | None
    corners: Corners | None
    winding: Float[Array, ""] | None

    @staticmethod
    def empty(asked: Asked) -> "_Film":
        """Return a film on which nothing is."""
        number = max(asked.film.H * words_in_row(asked.film.W), LEAST)
        real = asked.film.eye.dtype
        zeros = jnp.zeros(number * WORD, real)
        alone = jnp.zeros(number * WORD, bool) if asked.keep else None
        if not asked.resolves:
            return _Film(zeros, alone, None, None, None, None)
        winding = None if asked.deep is None else jnp.zeros((), real)
        bits, layers = jnp.zeros(number, jnp.uint32), jnp.zeros(number, real)
        return _Film(zeros, alone, bits, layers, Corners.empty(number, real), winding)

    def whole(self, W: int, H: int) -> Drawn:
        """Return the film as rows."""
        words, (image, alone, bits, layers, corners, winding) = words_in_row(W), self
        pixels = lambda x: x[: H * words * WORD].reshape(H, -1)[:, :W]
        by_word = lambda x: x[: H * words].reshape(H, words)
        alone = None if alone is None else pixels(alone)
        if bits is None or layers is None:
            return Drawn(pixels(image), alone, None, None, None, None)
        return Drawn(pixels(image), alone, by_word(bits), by_word(layers), corners, winding)

    def with_word(self, pixels: Pixels, at: Int[Array, ""]) -> "_Film":
        """Return the film with the image of a word from a pixel on."""
        put = lambda x, new: jax.lax.dynamic_update_slice(x, new, (at,))
        alone = None if self.alone is None else put(self.alone, pixels.alone)
        return self._replace(image=put(self.image, pixels.image), alone=alone)

    def with_bits(
        self,
        pixels: Pixels,
        layers: Float[Array, "32"],
        corner: Float[Array, "32"],
        word: Int[Array, ""],
        deep: float,
    ) -> "_Film":
        """Return the film with a word's overlapping pixels."""
        if self.overlapping is None or self.layers is None or self.corners is None:
            return self
        inside = pixels.overlapping
        bits = jnp.where(inside, jnp.uint32(1) << jnp.arange(WORD, dtype=jnp.uint32), 0)
        put = lambda x, new: jax.lax.dynamic_update_slice(
            x, jnp.sum(new).astype(x.dtype)[None], (word,)
        )
        winding = self.winding
        if winding is not None:
            winding = winding + jnp.sum(jnp.where(inside, pixels.winding - deep, 0))
        return self._replace(
            overlapping=put(self.overlapping, bits),
            layers=put(self.layers, jnp.where(inside, layers, 0)),
            corners=self.corners.with_word(word, corner, jnp.any(inside)),
            winding=winding,
        )


class _Word(NamedTuple):
    """How far a row is drawn: a word and how it stands with it (1: it is touched, 2: it is drawn);
    the winding number after what lies left of it, the mean and at the lower left corner."""

    stand: Int[Array, ""]
    mean: Float[Array, ""]
    corner: Float[Array, ""]
    band: _Band
    film: _Film


def _rows_drawn(
    judge: Callable, deep: float, W: int, H: int, band: _Band, film: _Film, base: Float[Array, ""]
) -> tuple[_Band, _Film]:
    """Return a band that is empty again, and the film with its rows."""
    words = words_in_row(W)

    def of_word(k, state: _Word, row):
        own, to = (row - band.bottom) * words + k, (H - 1 - row) * words + k
        state = state._replace(stand=state.band.touched[own])
        plain = judge(state.mean[None], state.corner[None], Sums.of(asked_for, 1, base.dtype))
        plain = jax.tree.map(lambda x: jnp.broadcast_to(x, (WORD,)), plain)
        state = state._replace(film=state.film.with_word(plain, to * WORD))
        some = partial(_word_drawn, judge, deep, own * WORD, to * WORD, row * words + k)
        state = jax.lax.while_loop(lambda s: s.stand == 1, some, state)
        # (Emptied after it is read: else it is copied.)
        empty = partial(_emptied, own)
        return jax.lax.while_loop(lambda s: s.stand == 2, empty, state)

    asked_for = band.sums.marks is not None

    def of_row(state):
        row, band, film = state
        start = _Word(jnp.int32(0), base, base, band, film)
        done = jax.lax.fori_loop(0, words, partial(of_word, row=row), start)
        return row + 1, done.band, done.film

    start = band.bottom, band, film
    return jax.lax.while_loop(lambda s: s[0] < band.top, of_row, start)[1:]


def _word_drawn(
    judge: Callable, deep: float, at: Array, to: Array, bits: Array, state: _Word
) -> _Word:
    """Return the state after a word that pieces are in: from the pixel `at` on in the band, `to` in
    the image; its `bits` are these words."""
    sums = state.band.sums
    cut = lambda x: jax.lax.dynamic_slice(x, (at,), (WORD,))
    deltas, mean = _running(sums.deltas, at, state.mean)
    jumps, corner = sums.jumps, mean
    if jumps is not None:
        jumps, corner = _running(jumps, at, state.corner)
    sums = sums._replace(deltas=deltas, jumps=jumps)
    here = jax.tree.map(cut, sums)
    winding = here.deltas
    corners = winding if jumps is None else here.jumps
    pixels = judge(winding, corners, here)
    film = state.film.with_word(pixels, to)
    if here.marks is not None:
        film = film.with_bits(pixels, here.marks.layers, corners, bits, deep)
        # Where no curve is, both are the same: but this one is exact.
        mean = jnp.where(here.marks.layers[-1] == 0, corner, mean)
    return _Word(jnp.int32(2), mean, corner, state.band._replace(sums=sums), film)


def _running(x: Float[Array, "N"], at: Array, before: Float[Array, ""]) -> tuple[Array, Array]:
    """Return an array with the running sums of a word from a place on; and the last of them."""

    def one(k, state):
        x, total = state
        total = total + x[at + k]
        return jax.lax.dynamic_update_slice(x, total[None], (at + k,)), total

    return jax.lax.fori_loop(0, WORD, one, (x, before))


def _emptied(own: Array, state: _Word) -> _Word:
    """Return the state with a word of the band that is empty."""
    zeros = lambda x: jnp.zeros(WORD, x.dtype)
    put = lambda x, new, at: jax.lax.dynamic_update_slice(x, new, (at,))
    sums = jax.tree.map(lambda x: put(x, zeros(x), own * WORD), state.band.sums)
    touched = put(state.band.touched, jnp.zeros(1, jnp.int32), own)
    return state._replace(stand=jnp.int32(0), band=state.band._replace(sums=sums, touched=touched))
