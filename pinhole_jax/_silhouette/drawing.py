"""Winding numbers of a film's pixels: sums over the pieces of contour in them and left of them.

A film that is not large is drawn at once. Of a large one, whose sums no cache would hold, the
pieces are listed first, and then the bands of rows that the contour may meet are drawn, one after
the other: the cost follows these and the outline, and the rest of the film is only written. Where
there are more pieces than can be listed, as of a hedgehog, the film is drawn at once after all.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._camera.film import FilmMap
from .._numerics.bitset import words_of
from .._numerics.largest import largest
from .._numerics.running import running_sum
from .coverage import Pieces, monotone
from .marks import Marks, drops, marks, overlaps, winding_jumps
from .overlaps import Part, fold_curves, fold_pieces

#: A film of more pixels is large; so many, or one row, are drawn at a time. (A smooth mesh of 82k
#: faces, 2048 px: 37 ms in bands, 75 at once; 1024 px: 11 to 20, and 10 to 14. A scan: as long.)
LARGE, BAND = 1 << 21, 1 << 16
#: So many pieces can be listed, are listed at a time at most, and are added at a time.
LISTED, ADDED, BLOCK = 1 << 18, 1024, 256
#: Pixels in a word of bits.
WORD = 32


class Drawn(NamedTuple):
    """A film, or a band of it; None is what is not asked for.

    - `image`: the coverage, 0 where contours overlap.
    - `alone`: which pixels one chain of contour crosses, or none (both from the top row down).
    - `overlapping`: which must be resolved, as bits; each row has whole words, from the bottom up.
    - `layers`: of each word, the sum of the layers of the pieces in these.
    - `winding`: the sum of these pixels' winding numbers (each the mean), less `DEEP` each.
    """

    image: Float[Array, "H W"]
    alone: Bool[Array, "H W"] | None
    overlapping: UInt32[Array, "H words"] | None
    layers: Float[Array, "H words"] | None
    winding: Float[Array, ""] | None


class Asked(NamedTuple):
    """What is to be drawn: curves, on which there are `base` layers on the left; whether they may
    overlap (`resolves`); what derivatives need (`keep`); `winding` above this number, or None."""

    film: FilmMap
    parts: list[Part]
    base: Int[Array, ""]
    resolves: bool
    keep: bool
    deep: float | None


def words_in_row(W: int) -> int:
    """Return how many words of bits a row of the film has."""
    return -(-W // WORD)


def in_words(x: Array) -> Array:
    """Return rows of pixels (H, W) as rows of words (H words, `WORD`), filled up with 0."""
    return jnp.pad(x, ((0, 0), (0, -x.shape[1] % WORD))).reshape(-1, WORD)


def is_large(film: FilmMap) -> bool:
    """Return whether a film is drawn in bands."""
    return film.W * film.H > LARGE


def drawn(asked: Asked, rows: Int[Array, "2"] | None) -> Drawn:
    """Return the film: in bands, where the contour may meet these rows (from which on, and up to
    which), or at once (None)."""
    film = asked.film
    whole = _Band(film.H, jnp.int32(0), jnp.int32(0))
    at_once = lambda: _band_drawn(asked, whole, _from_curves(asked, whole))
    if rows is None:
        return at_once()
    found = _listed(asked)
    return jax.lax.cond(found.used <= LISTED, lambda: _in_bands(asked, rows, found), at_once)


# --- bands ---------------------------------------------------------------------------------------


class _Band(NamedTuple):
    """Rows of the film: how many, the first one, and from which on they are new."""

    H: int
    bottom: Int[Array, ""]
    new_bottom: Int[Array, ""]


def _height(film: FilmMap) -> int:
    """Return how many rows a large film's bands have."""
    return min(film.H, max(BAND // film.W, 1))


def _in_bands(asked: Asked, rows: Int[Array, "2"], found: "_Listed") -> Drawn:
    """Return the film, on which listed pieces are in these rows."""
    film, height = asked.film, _height(asked.film)
    number = jnp.maximum(-(-(rows[1] - rows[0]) // height), 0)
    sums = lambda band: found.fold(_Sums.empty(asked, band), band)

    def more(k, film_drawn: Drawn):
        new_bottom = rows[0] + k * height
        # (The last band at the film's top begins lower.)
        bottom = jnp.clip(new_bottom, 0, film.H - height)
        band = _Band(height, bottom, new_bottom)
        new, top = _band_drawn(asked, band, sums(band)), film.H - height - bottom
        at = top, top, bottom, bottom, None
        # (Under `vmap` there may be fewer bands than turns.)
        return _each(partial(_put, k < number), film_drawn, new, at)

    band = _Band(height, rows[0], rows[0])
    like = jax.eval_shape(lambda: _band_drawn(asked, band, _Sums.empty(asked, band)))
    image, words = (film.H, film.W), (film.H, words_in_row(film.W))
    zeros = lambda x, shape: jnp.zeros(shape, x.dtype)
    start = _each(zeros, like, (image, image, words, words, ()))
    return jax.lax.fori_loop(0, largest(number), more, start)


def _put(there: Bool[Array, ""], old: Array, new: Array, row: Array | None) -> Array:
    """Return a film with a band of it from a row on, if that is there; a sum with one more."""
    if row is None:
        return old + jnp.where(there, new, 0)
    known = jax.lax.dynamic_slice_in_dim(old, row, len(new))
    return jax.lax.dynamic_update_slice_in_dim(old, jnp.where(there, new, known), row, 0)


def _each(function: Callable, drawn: Drawn, *others: tuple) -> Drawn:
    """Return what a function makes of each thing that was asked for."""
    things = zip(drawn, *others, strict=True)
    return Drawn(*(None if x[0] is None else function(*x) for x in things))  # pyright: ignore


def _band_drawn(asked: Asked, band: _Band, sums: "_Sums") -> Drawn:
    """Return a band."""
    W, H, base = asked.film.W, band.H, asked.base.astype(asked.film.eye.dtype)
    row_sums = lambda x: running_sum(x.reshape(H, W))
    winding = row_sums(sums.deltas) + base
    overlapping = covered = jnp.zeros((H, W), bool)
    tie = 64 * jnp.finfo(winding.dtype).eps
    marked = layers = None
    if sums.marks is not None and sums.jumps is not None and sums.drops is not None:
        marked = jax.tree.map(lambda x: x.reshape(H, W), sums.marks)
        layers, corner = marked.layers, row_sums(sums.jumps) + base
        # Where no curve is, the number is known exactly; sums of areas err with the layers.
        winding = jnp.where(layers == 0, corner, winding)
        overlapping = overlaps(marked, winding)
        if asked.keep:
            # A contour along the pixel's side, of whose layers the mean does not tell which it
            # bounds.
            overlapping |= (layers > 0) & (jnp.abs(winding - 1) < tie)
        covered = corner - sums.drops.reshape(H, W) > 0.5
        overlapping &= ~covered
    image = jnp.where(covered, 1, jnp.where(overlapping, 0, jnp.clip(winding, 0, 1)))
    alone = ~overlapping & ~covered & (winding < 1 + tie) if asked.keep else None
    if layers is None:
        return Drawn(image, alone, None, None, None)
    bits = words_of(in_words(overlapping))
    # (From the bits: the compiler works `overlapping` out anew for each that reads it.)
    inside = bits[:, None] >> jnp.arange(WORD, dtype=jnp.uint32)[None] & 1 > 0
    summed = lambda x: jnp.sum(jnp.where(inside, in_words(x), 0), axis=1)
    depth = None
    if asked.deep is not None:
        is_new = H - 1 - jnp.arange(H, dtype=jnp.int32) >= band.new_bottom - band.bottom
        depth = summed(winding - asked.deep).reshape(H, -1)
        depth = jnp.sum(jnp.where(is_new[:, None], depth, 0))
    up = lambda x: jnp.flip(x.reshape(H, -1), axis=0)
    return Drawn(image, alone, up(bits), up(summed(layers)), depth)


# --- sums over pieces ----------------------------------------------------------------------------


class _Adds(NamedTuple):
    """What pieces add to the sums of their pixels (see `_Sums`), and where these are."""

    row: Int[Array, "P"]
    column: Int[Array, "P"]
    area: Float[Array, "P"]
    height: Float[Array, "P"]
    marks: Marks | None
    jump: Float[Array, "P"] | None
    drop: Float[Array, "P"] | None

    @staticmethod
    def of(pieces: Pieces, resolves: bool) -> "_Adds":
        """Return what pieces add; of no pixel where they are not valid."""
        row = jnp.where(pieces.valid, pieces.row, -1)
        where_and_what = row, pieces.column, pieces.area, pieces.height
        if not resolves:
            return _Adds(*where_and_what, None, None, None)
        return _Adds(*where_and_what, marks(pieces), winding_jumps(pieces), drops(pieces))


class _Sums(NamedTuple):
    """Of a band's pixels, from the top row down: by how much the winding number's mean grows from
    pixel to pixel in a row, and if contours may overlap `marks`, and sums of `winding_jumps` (left
    of the pixel) and `drops`."""

    deltas: Float[Array, "N"]
    marks: Marks | None
    jumps: Float[Array, "N"] | None
    drops: Float[Array, "N"] | None

    @staticmethod
    def empty(asked: Asked, band: _Band) -> "_Sums":
        """Return the sums of nothing."""
        zeros = jnp.zeros(asked.film.W * band.H, asked.film.eye.dtype)
        if not asked.resolves:
            return _Sums(zeros, None, None, None)
        return _Sums(zeros, Marks(zeros, zeros.astype(jnp.int32)), zeros, zeros)

    def add(self, more: _Adds, band: _Band) -> "_Sums":
        """Return the sums with more pieces; what lies left of the film counts at its left side."""
        # (From the top row down, as images are: to turn a band over takes longer than to draw it.)
        H, row, column = band.H, band.bottom + band.H - 1 - more.row, more.column
        W = self.deltas.shape[0] // H
        inside = (row >= 0) & (row < H)
        place = lambda k: jnp.where(inside & (k >= 0) & (k < W), row * W + k, H * W)
        own, after = jax.lax.optimization_barrier((place(column), place(column + 1)))
        rest = more.height - jnp.where(column < 0, 0, more.area)
        deltas = self.deltas.at[own].add(more.area, mode="drop")
        deltas = deltas.at[after].add(rest, mode="drop")
        if self.marks is None or self.jumps is None or self.drops is None:
            return _Sums(deltas, None, None, None)
        put = lambda sums, value: sums.at[own].add(value, mode="drop")
        jumps = self.jumps.at[after].add(more.jump, mode="drop")
        return _Sums(
            deltas, jax.tree.map(put, self.marks, more.marks), jumps, put(self.drops, more.drop)
        )


def _from_curves(asked: Asked, band: _Band) -> _Sums:
    """Return the sums of a band over the pieces of all curves."""
    add = lambda sums, pieces: sums.add(_Adds.of(pieces, asked.resolves), band)
    return _each_piece(asked, add, _Sums.empty(asked, band))


def _each_piece(asked: Asked, add: Callable[[Any, Pieces], Any], start: Any) -> Any:
    """Return `start` after `add(total, pieces)` over all pieces."""
    film = asked.film

    def chunk(total, ids, curves):
        del ids
        return fold_pieces(monotone(curves), (film.W, film.H, film.H), add, total)

    for part in asked.parts:
        start = fold_curves(part, chunk, start, part.size)
    return start


class _Listed(NamedTuple):
    """Pieces, `used` of them: there is room for `LISTED`."""

    adds: _Adds
    used: Int[Array, ""]

    def append(self, more: _Adds, valid: Bool[Array, "P"]) -> "_Listed":
        """Return these and more; the valid ones come first."""
        put = lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new, self.used, 0)
        adds = jax.tree.map(put, self.adds, more)
        return _Listed(adds, self.used + jnp.sum(valid, dtype=jnp.int32))

    def fold(self, start: _Sums, band: _Band) -> _Sums:
        """Return sums after those of all pieces in a band are added.

        Pieces are listed as curves come, neighbours together: most blocks of them have none there.
        """
        bottom, top = band.bottom, band.bottom + band.H
        row = self.adds.row.reshape(-1, BLOCK)
        known = jnp.arange(row.size, dtype=jnp.int32).reshape(row.shape) < self.used
        here = jnp.any(known & (row >= bottom) & (row < top), axis=1)
        order = jnp.cumsum(here, dtype=jnp.int32)
        place = jnp.where(here, order - 1, len(row))
        number = jnp.arange(len(row), dtype=jnp.int32)
        blocks = jnp.zeros(len(row), jnp.int32).at[place].set(number, mode="drop")

        def body(k, sums):
            cut = lambda x: jax.lax.dynamic_slice_in_dim(x, blocks[k] * BLOCK, BLOCK)
            some = jax.tree.map(cut, self.adds)
            # (Under `vmap` there may be fewer blocks than turns.)
            return sums.add(some._replace(row=jnp.where(k < order[-1], some.row, -1)), band)

        return jax.lax.fori_loop(0, largest(order[-1]), body, start)


def _listed(asked: Asked) -> _Listed:
    """Return all pieces, as far as there is room."""

    def add(found: _Listed, pieces: Pieces):
        return found.append(_Adds.of(pieces, asked.resolves), pieces.valid)

    number, real = -(-(LISTED + ADDED) // BLOCK) * BLOCK, asked.film.eye.dtype
    whole, zeros = jnp.zeros(number, jnp.int32), jnp.zeros(number, real)
    more = (Marks(zeros, whole), zeros, zeros) if asked.resolves else (None, None, None)
    start = _Listed(_Adds(whole - 1, whole, zeros, zeros, *more), jnp.int32(0))
    return _each_piece(asked, add, start)
