"""A film's pixels: coverage where one chain of contour crosses a pixel; others are crowded.

Layers at a pixel's lower left corner are counted, exactly; the areas of the pieces in it (Green's
theorem) give the difference of its mean. Where one chain of contour crosses it, that mean is the
coverage: it holds k layers and k + 1. Where more do, winding numbers add up and coverage does not.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.batches import Total, in_chunks
from .contour import Contour
from .pieces import Monotone, Pieces, fold_pieces

#: Curves in a chunk.
AT_A_TIME = 4096


class Pixels(NamedTuple):
    """A film's pixels, from the bottom row up, each row from the left.

    - `coverage`: 0 where it must be resolved.
    - `corner`: layers at the lower left corner.
    - `number`: pieces.
    - `alone`: the background is seen beside all of its pieces.
    - `crowded`: it must be resolved; None where contours never overlap.
    """

    coverage: Float[Array, "N"]
    corner: Float[Array, "N"]
    number: Int[Array, "N"]
    alone: Bool[Array, "N"]
    crowded: Bool[Array, "N"] | None


class _Sums(NamedTuple):
    """Sums over the pieces in pixels: `Pieces.gain` and `drop`, layers, and numbers of pieces.

    All pieces, those of more than one layer, and those that enter, rise, fall, go right and left.
    """

    gain: Array
    drop: Array
    layers: Array
    number: Array
    thick: Array
    entries: Array
    rise: Array
    fall: Array
    right: Array
    left: Array


def fold_film(
    curves: Contour,
    film: tuple[int, int],
    add: Callable[[Total, Monotone, Pieces], Total],
    start: Total,
) -> Total:
    """`start` after `add(total, curves, pieces)` over all pieces of a film of W x H pixels."""
    size = min(AT_A_TIME, curves.number)

    def chunk(total, first):
        ids = first + jnp.arange(size, dtype=jnp.int32)
        return fold_pieces(ids, curves.monotone(ids), film, add, total)

    return in_chunks(chunk, start, size, curves.upto[-1])


def place(film: tuple[int, int], pieces: Pieces) -> Int[Array, "P"]:
    """The pixels of pieces; past the last for pieces in none."""
    W, H = film
    inside = pieces.valid & (pieces.column >= 0) & (pieces.column < W)
    return jnp.where(inside, pieces.row * W + pieces.column, W * H)


def drawn(curves: Contour, film: tuple[int, int], base: Int[Array, ""], overlaps: bool) -> Pixels:
    """A film's pixels; `base` layers lie far to the left. Without `overlaps` none is crowded."""
    W, H = film
    real = curves.tail.dtype

    def add(total, m, pieces):
        sums, jumps = total
        sums = sums.at[place(film, pieces)].add(_marks(m, pieces), mode="drop")
        row = jnp.where(pieces.bottom, pieces.row, H)
        return sums, jumps.at[row, pieces.column + 1].add(pieces.jump, mode="drop")

    start = jnp.zeros((W * H, len(_Sums._fields)), real), jnp.zeros((H, W + 2), real)
    sums, jumps = fold_film(curves, film, add, start)
    corner = base.astype(real) + jnp.cumsum(jumps, axis=1)[:, :W].reshape(-1)
    return _verdict(_Sums(*sums.T), corner, overlaps)


def _marks(m: Monotone, pieces: Pieces) -> Float[Array, "P 10"]:
    """What each piece adds to its pixel's `_Sums`."""
    tiny = 8 * jnp.finfo(pieces.jump.dtype).eps
    right, up = (-pieces.jump[:, None] * (pieces.high - pieces.low)).T
    sums = _Sums(
        jnp.where(pieces.valid, pieces.gain(m), 0),
        pieces.drop,
        jnp.abs(pieces.jump),
        pieces.valid,
        jnp.abs(pieces.jump) > 1,
        pieces.enters,
        up > tiny,
        up < -tiny,
        right > tiny,
        right < -tiny,
    )
    return jnp.stack([x.astype(pieces.jump.dtype) for x in sums], axis=1)


def _verdict(sums: _Sums, corner: Float[Array, "N"], overlaps: bool) -> Pixels:
    """The pixels by their pieces' sums; crowded ones are left to be resolved."""
    tie = 64 * jnp.finfo(corner.dtype).eps
    mean, number = corner + sums.gain, sums.number.astype(jnp.int32)
    coverage = jnp.clip(mean, 0, 1)
    if not overlaps:
        return Pixels(coverage, corner, number, mean < 1 + tie, None)
    covered = (corner - sums.drop > 0.5) | (mean > sums.layers + 0.5)
    straight = (sums.rise == 0) | (sums.fall == 0) | (sums.right == 0) | (sums.left == 0)
    chain = straight & (sums.entries == 1) & (sums.thick == 0) & (jnp.abs(mean - 1) > tie)
    crowded = (number > 0) & ~covered & ~chain
    alone = chain & ~covered & (mean < 1)
    coverage = jnp.where(covered, 1, jnp.where(crowded, 0, coverage))
    return Pixels(coverage, corner, number, alone, crowded)
