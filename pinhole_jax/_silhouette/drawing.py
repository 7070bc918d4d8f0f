"""Winding numbers of a film's pixels: sums over the pieces of contour in them and left of them.

A film that is not large is drawn at once. Of a large one, whose sums no cache would hold, the
pieces are listed first, and then the tiles that the contour may meet are drawn, one after the
other: the cost follows these and the outline, and the rest of the film is only written. Where there
are more pieces than can be listed, fewer rows are drawn at a time; a row of tiles that still holds
more gets its pieces from the curves, tile by tile.
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

#: A film of more pixels is large; about so wide are its tiles.
LARGE, TILE = 1 << 18, 256
#: So many pieces can be listed, and are added at a time.
LISTED, ADDED = 1 << 16, 1024
#: Pixels in a word of bits.
WORD = 32


class Drawn(NamedTuple):
    """A film, or a tile of it; None is what is not asked for.

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
    """Return whether a film is drawn in tiles."""
    return film.W * film.H > LARGE


def drawn(asked: Asked, box: Int[Array, "4"] | None) -> Drawn:
    """Return the film, of which the contour may meet this box: from which column and row, and up to
    which (None: any)."""
    film = asked.film
    if box is None or not is_large(film):
        whole = _Tile(film.W, film.H, *[jnp.int32(0)] * 4)
        return _tile_drawn(asked, whole, _summed(asked, whole, None))
    size = _tile_size(film)

    def more(state):
        rows, film_drawn = state
        # (Tiles at the film's top begin lower.)
        low = jnp.minimum(rows[0], film.H - size[1])
        found = _listed(asked, (low, rows[1]))
        complete = found.used <= LISTED
        ready = complete | (rows[1] - rows[0] <= size[1])
        part = jnp.stack([box[0], jnp.where(ready, rows[0], rows[1]), box[2], rows[1]])
        film_drawn = _tiles_drawn(asked, part, found, film_drawn)
        return _next_rows(rows, box[3], ready, found.used, size[1]), film_drawn

    tile = _Tile(*size, *[box[0]] * 4)
    like = jax.eval_shape(lambda: _tile_drawn(asked, tile, _Sums.empty(asked, tile)))
    image, words = (film.H, film.W), (film.H, words_in_row(film.W))
    zeros = lambda x, shape: jnp.zeros(shape, x.dtype)
    start = _each(zeros, like, (image, image, words, words, ()))
    # (Under `vmap` as many turns for all: else all that is drawn would be copied at each.)
    rows = jnp.stack([box[1], box[3]])
    unfinished = lambda state: largest((state[0][0] < box[3]).astype(jnp.int32)) > 0
    return jax.lax.while_loop(unfinished, more, (rows, start))[1]


def _next_rows(rows: Int[Array, "2"], end: Array, ready: Array, used: Array, h: int) -> Array:
    """Return the rows after these, if they are ready; else fewer of them, as pieces are listed."""
    number = rows[1] - rows[0]
    share = 0.8 * LISTED / jnp.maximum(used, 1).astype(jnp.float32)
    fewer = jnp.clip((share * number.astype(jnp.float32)).astype(jnp.int32), h, number)
    fewer = jnp.minimum(fewer, jnp.maximum(number - 1, h))
    return jnp.where(ready, jnp.stack([rows[1], end]), jnp.stack([rows[0], rows[0] + fewer]))


# --- tiles ---------------------------------------------------------------------------------------


class _Tile(NamedTuple):
    """A part of the film: its size, its first column and row, and from which on pixels are new."""

    W: int
    H: int
    left: Int[Array, ""]
    bottom: Int[Array, ""]
    new_left: Int[Array, ""]
    new_bottom: Int[Array, ""]


def _tile_size(film: FilmMap) -> tuple[int, int]:
    """Return columns and rows of a large film's tiles: the last one begins with a whole word."""
    W, H = film.W, film.H
    width = min(W, TILE * max(1, TILE // H) + W % WORD)
    return width, max(min(H, TILE * TILE // width), 1)


def _tiles_drawn(asked: Asked, box: Int[Array, "4"], found: "_Listed", start: Drawn) -> Drawn:
    """Return the film with the tiles of a box of it."""
    film, (w, h) = asked.film, _tile_size(asked.film)
    step = w // WORD * WORD if w < film.W else w
    first = box[0] // WORD * WORD if w < film.W else jnp.zeros_like(box[0])
    across, up = (
        jnp.maximum(-(-x // s), 0) for x, s in ((box[2] - first, step), (box[3] - box[1], h))
    )

    def more(k, film_drawn: Drawn):
        column, row = k % jnp.maximum(across, 1), k // jnp.maximum(across, 1)
        new_left, new_bottom = first + column * step, box[1] + row * h
        left = jnp.clip(new_left, 0, film.W - w)
        bottom = jnp.clip(new_bottom, 0, film.H - h)
        tile = _Tile(w, h, left, bottom, new_left, new_bottom)
        new, top = _tile_drawn(asked, tile, _summed(asked, tile, found)), film.H - h - bottom
        word = left // WORD
        at = (top, left), (top, left), (bottom, word), (bottom, word), ()
        # (Under `vmap` there may be fewer tiles than turns.)
        return _each(partial(_put, k < across * up), film_drawn, new, at)

    return jax.lax.fori_loop(0, largest(across * up), more, start)


def _put(there: Bool[Array, ""], old: Array, new: Array, at: tuple) -> Array:
    """Return a film with a tile of it, if that is there; a sum with one more."""
    if not at:
        return old + jnp.where(there, new, 0)
    known = jax.lax.dynamic_slice(old, at, new.shape)
    return jax.lax.dynamic_update_slice(old, jnp.where(there, new, known), at)


def _each(function: Callable, drawn: Drawn, *others: tuple) -> Drawn:
    """Return what a function makes of each thing that was asked for."""
    things = zip(drawn, *others, strict=True)
    return Drawn(*(None if x[0] is None else function(*x) for x in things))  # pyright: ignore


def _tile_drawn(asked: Asked, tile: _Tile, sums: "_Sums") -> Drawn:
    """Return a tile."""
    (W, H), base = tile[:2], asked.base.astype(asked.film.eye.dtype)
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
        depth = jnp.sum(
            jnp.where(_is_new(tile, asked.film.W), summed(winding - asked.deep).reshape(H, -1), 0)
        )
    up = lambda x: jnp.flip(x.reshape(H, -1), axis=0)
    return Drawn(image, alone, up(bits), up(summed(layers)), depth)


def _is_new(tile: _Tile, W: int) -> Bool[Array, "H words"]:
    """Return which words of a tile, from the top row down, are in no other that is drawn before,
    nor in the next one."""
    column = jnp.arange(words_in_row(tile.W), dtype=jnp.int32) * WORD
    row = jnp.arange(tile.H, dtype=jnp.int32)
    new = column >= tile.new_left - tile.left
    if tile.W < W:
        new &= (column + WORD <= tile.W) | (tile.new_left + tile.W // WORD * WORD >= W)
    return (tile.H - 1 - row >= tile.new_bottom - tile.bottom)[:, None] & new[None]


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
    """Of a tile's pixels, from the top row down: by how much the winding number's mean grows from
    pixel to pixel in a row, and if contours may overlap `marks`, and sums of `winding_jumps` (left
    of the pixel) and `drops`."""

    deltas: Float[Array, "N"]
    marks: Marks | None
    jumps: Float[Array, "N"] | None
    drops: Float[Array, "N"] | None

    @staticmethod
    def empty(asked: Asked, tile: _Tile) -> "_Sums":
        """Return the sums of nothing."""
        zeros = jnp.zeros(tile.W * tile.H, asked.film.eye.dtype)
        if not asked.resolves:
            return _Sums(zeros, None, None, None)
        return _Sums(zeros, Marks(zeros, zeros.astype(jnp.int32)), zeros, zeros)

    def add(self, more: _Adds, tile: _Tile) -> "_Sums":
        """Return the sums with more pieces; what lies left of the tile counts at its left side."""
        # (From the top row down, as images are: to turn a tile over takes longer than to draw it.)
        (W, H), row = tile[:2], tile.bottom + tile.H - 1 - more.row
        column = jnp.maximum(more.column - tile.left, -1)
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


def _summed(asked: Asked, tile: _Tile, found: "_Listed | None") -> _Sums:
    """Return the sums of a tile: over the pieces that are listed, if all are, else over curves."""
    add = lambda sums, pieces: sums.add(_Adds.of(pieces, asked.resolves), tile)
    sums, rows = _Sums.empty(asked, tile), (tile.bottom, tile.bottom + tile.H)
    if found is None:
        return _each_piece(asked, add, sums, rows, tile.H, jnp.array(True))
    complete = found.used <= LISTED
    sums = found.fold(lambda sums, more: sums.add(more, tile), sums, complete)
    return _each_piece(asked, add, sums, rows, tile.H, ~complete)


def _each_piece(
    asked: Asked,
    add: Callable[[Any, Pieces], Any],
    start: Any,
    rows: tuple,
    most: int,
    wanted: Array,
) -> Any:
    """Return `start` after `add(total, pieces)` over all pieces in some rows (`most` at most), if
    that is wanted."""
    bottom, top = rows

    def chunk(total, ids, curves):
        del ids
        return fold_pieces(monotone(curves), (asked.film.W, top, most), add, total, bottom)

    for part in asked.parts:
        block = jnp.int32(0), jnp.where(wanted, part.total, 0)
        start = fold_curves(part, chunk, start, part.size, block)
    return start


class _Listed(NamedTuple):
    """Pieces in some rows, `used` of them: there is room for `LISTED`."""

    adds: _Adds
    used: Int[Array, ""]

    def append(self, more: _Adds, valid: Bool[Array, "P"]) -> "_Listed":
        """Return these and more; the valid ones come first."""
        put = lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new, self.used, 0)
        adds = jax.tree.map(put, self.adds, more)
        return _Listed(adds, self.used + jnp.sum(valid, dtype=jnp.int32))

    def fold(self, add: Callable[[Any, _Adds], Any], start: Any, wanted: Array) -> Any:
        """Return `start` after `add(total, adds)` over all, some at a time, if that is wanted."""

        def body(state):
            first, total = state
            cut = lambda x: jax.lax.dynamic_slice_in_dim(x, first, ADDED)
            return first + ADDED, add(total, jax.tree.map(cut, self.adds))

        end = jnp.where(wanted, self.used, 0)
        return jax.lax.while_loop(lambda s: s[0] < end, body, (jnp.int32(0), start))[1]


def _listed(asked: Asked, rows: tuple[Array, Array]) -> _Listed:
    """Return the pieces in some rows."""

    def add(found: _Listed, pieces: Pieces):
        return found.append(_Adds.of(pieces, asked.resolves), pieces.valid)

    number, real = LISTED + ADDED, asked.film.eye.dtype
    whole, zeros = jnp.zeros(number, jnp.int32), jnp.zeros(number, real)
    nowhere = whole - 1
    more = (Marks(zeros, whole), zeros, zeros) if asked.resolves else (None, None, None)
    start = _Listed(_Adds(nowhere, whole, zeros, zeros, *more), jnp.int32(0))
    return _each_piece(asked, add, start, rows, asked.film.H, jnp.array(True))
