"""Winding numbers of a film's pixels: sums over the pieces of contour in them and left of them.

On a CPU a compiled loop goes from piece to piece (`piece_by_piece.py`). On other machines pieces
are added up as vectors, and the passes over the film after it are vectors, too.
"""

import jax
import jax.numpy as jnp

from .._camera.film import FilmMap
from .._numerics.bitset import words_of
from .._numerics.running import running_sum
from .asked import WORD, Asked, Corners, Drawn, Sums, in_words, judged
from .coverage import Pieces, monotone
from .marks import drops, marks, winding_jumps
from .overlaps import fold_pieces
from .parts import LEAST, fold_curves

#: Of a film of more pixels only the rows are looked at in which the scene may be seen.
LARGE = 1 << 18


def is_large(film: FilmMap) -> bool:
    """Return whether it is worth to know where on the film the scene may be seen."""
    return film.W * film.H > LARGE


def drawn_in_vectors(asked: Asked) -> Drawn:
    """Return the film, of vectors of pieces."""
    W, H, sums = asked.film.W, asked.film.H, _sums(asked)
    base = asked.base.astype(asked.film.eye.dtype)
    sums = jax.tree.map(lambda x: x.reshape(H, W), sums)
    corner = winding = running_sum(sums.deltas) + base
    if sums.jumps is not None:
        corner = running_sum(sums.jumps) + base
    pixels = judged(winding, corner, sums, asked.keep)
    alone = pixels.alone if asked.keep else None
    if sums.marks is None:
        return Drawn(pixels.image, alone, None, None, None, None)
    bits = words_of(in_words(pixels.overlapping))
    # (From the bits: the compiler works `overlapping` out anew for each that reads it.)
    inside = bits[:, None] >> jnp.arange(WORD, dtype=jnp.uint32)[None] & 1 > 0
    summed = lambda x: jnp.sum(jnp.where(inside, in_words(x), 0), axis=1)
    depth = None if asked.deep is None else jnp.sum(summed(pixels.winding - asked.deep))
    up = lambda x: jnp.flip(x.reshape(H, -1), axis=0)
    layers = summed(sums.marks.layers)
    # (Pixels that are resolved side by side do not ask.)
    none = Corners.empty(max(len(bits), LEAST), base.dtype)
    corners = none._replace(used=jnp.int32(none.table.shape[0]))
    return Drawn(pixels.image, alone, up(bits), up(layers), corners, depth)


def _sums(asked: Asked) -> Sums:
    """Return the sums over the pieces of all curves, from the film's top row down."""
    film = asked.film
    add = lambda sums, pieces: _with_pieces(film, sums, pieces)

    def chunk(sums, ids, curves):
        del ids
        return fold_pieces(monotone(curves), (film.W, film.H, film.H), add, sums)

    sums = Sums.of(asked.resolves, film.W * film.H, film.eye.dtype)
    for part in asked.parts:
        sums = fold_curves(part, chunk, sums, part.size)
    return sums


def _with_pieces(film: FilmMap, sums: Sums, pieces: Pieces) -> Sums:
    """Return sums with more pieces; what lies left of the film counts at its left side."""
    W, H, column, row = film.W, film.H, pieces.column, film.H - 1 - pieces.row
    place = lambda k: jnp.where(pieces.valid & (k >= 0) & (k < W), row * W + k, H * W)
    own, after = jax.lax.optimization_barrier((place(column), place(column + 1)))
    put = lambda total, at, value: total.at[at].add(value, mode="drop")
    rest = pieces.height - jnp.where(column < 0, 0, pieces.area)
    deltas = put(put(sums.deltas, own, pieces.area), after, rest)
    if sums.marks is None or sums.jumps is None or sums.drops is None:
        return Sums(deltas, None, None, None)
    here = lambda total, value: put(total, own, value)
    jumps = put(sums.jumps, after, winding_jumps(pieces))
    of_pixel = jax.tree.map(here, sums.marks, marks(pieces))
    return Sums(deltas, of_pixel, jumps, here(sums.drops, drops(pieces)))
