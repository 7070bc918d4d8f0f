"""Pixels that curves cross, swept batch by batch: their coverage, and what is seen in them.

Pixels with few pieces come first, so that those side by side take as many steps.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._numerics.batches import Total
from .contour import Contour
from .pieces import Arcs, Monotone, PieceKeys, Pieces, pieces_at
from .pixels import Pixels, fold_film
from .sweep import Lines, sweep

#: Pieces side by side; where a pixel has more, for each possible curve one, but no more than these.
ROOM, MOST = 1 << 12, 1 << 20


class VisiblePieces(NamedTuple):
    """Stretches of curves beside the background, each in a pixel (past the last: none).

    - `extent`: the signed length (px) along y if the curve is steep, else along x.
    - `moment`: its first moment (px^2).
    - `flux`: the area's derivative by an arc's conic (px^2).
    """

    pixel: Int[Array, "N"]
    part: Int[Array, "N"]
    extent: Float[Array, "N"]
    moment: Float[Array, "N"]
    flux: Float[Array, "N 3 3"] | None


class PixelCoverage(NamedTuple):
    """Pixels (past the last: none), their coverage, and the visible pieces in them, if wanted."""

    pixel: Int[Array, "P"]
    area: Float[Array, "P"]
    seen: VisiblePieces | None


def fold_swept(
    curves: Contour,
    pixels: Pixels,
    film: tuple[int, int],
    add: Callable[[Total, PixelCoverage], Total],
    start: Total,
    seen: bool,
) -> Total:
    """`start` after `add(total, swept)` over all pixels that have pieces, on a film of W x H.

    With `seen` there are their visible pieces, too.
    """
    order, number = jnp.argsort(pixels.number).astype(jnp.int32), len(pixels.number)
    upto = jnp.cumsum(pixels.number[order])
    rank = jnp.zeros_like(order).at[order].set(jnp.arange(number, dtype=jnp.int32))
    after = lambda pieces: jnp.searchsorted(upto, pieces, side="right").astype(jnp.int32)

    def batch(room: int, state: tuple[Array, Total]) -> tuple[Array, Total]:
        first, total = state
        begin, end = after(first), after(first + room)
        slot = jnp.arange(room, dtype=jnp.int32)
        pixel = jnp.where(begin + slot < end, order.at[begin + slot].get(mode="clip"), number)
        corner = pixels.corner.at[pixel].get(mode="clip")

        def among(places: PieceKeys) -> Array:
            own = rank.at[places.pixel(film)].get(mode="fill", fill_value=number)
            return jnp.where((own >= begin) & (own < end), own - begin, room)

        owner, places = _listed(curves, film, among, room)
        return upto[end - 1], add(total, _swept(curves, film, owner, places, pixel, corner, seen))

    def fits(room: int, state: tuple[Array, Total]) -> Array:
        first, _ = state
        return (first < upto[-1]) & (upto.at[after(first)].get(mode="clip") - first <= room)

    most = min(1 << (curves.number - 1).bit_length(), MOST)
    state = jnp.int32(0), start
    for room in sorted({min(ROOM, most), most}):
        state = jax.lax.while_loop(partial(fits, room), partial(batch, room), state)
    return state[1]


def _listed(
    curves: Contour, film: tuple[int, int], among: Callable[[PieceKeys], Array], room: int
) -> tuple[Int[Array, "N"], PieceKeys]:
    """The pieces of a batch of pixels, and the number there of their pixel; `room`: none."""
    whole = jnp.zeros(room, jnp.int32)
    empty = whole + room, PieceKeys(whole, whole, whole)

    def add(state, _, places, there):
        used, listed = state
        owner = among(places)
        there &= owner < room
        upto = used + jnp.cumsum(there, dtype=jnp.int32)
        slot = jnp.where(there, upto - 1, room)
        put = lambda old, new: old.at[slot].set(new, mode="drop")
        return upto[-1], jax.tree.map(put, listed, (owner, places))

    return fold_film(curves, film, add, (jnp.int32(0), empty))[1]


def _swept(
    curves: Contour,
    film: tuple[int, int],
    owner: Int[Array, "N"],
    places: PieceKeys,
    pixel: Int[Array, "P"],
    corner: Float[Array, "P"],
    seen: bool,
) -> PixelCoverage:
    """Pixels, from pieces that each have an `owner` among them."""
    m, P = curves.monotone(places.part), len(corner)
    pieces, begin = pieces_at(m, places, film[0]), places.corner(corner.dtype)
    arcs = conics = None
    if m.arcs is not None:
        conics = m.arcs.conic
        xy, z = conics[..., :2], conics[..., 2:]
        arcs = Arcs(jnp.concatenate([xy - begin[:, None] * z, z], axis=-1), m.arcs.there)
    if not seen:
        return PixelCoverage(
            pixel, sweep(_along_x(owner, m, pieces, arcs), corner, None).area, None
        )

    # The same pixels once more, for steep pieces: by a sweep along y.
    after = lambda k: jnp.where(owner < P, owner + k * P, 2 * P)
    twice = lambda *x: jax.tree.map(lambda *x: jnp.concatenate(x), *x)
    lines = twice(_along_x(after(0), m, pieces, arcs), _along_y(after(1), m, pieces, arcs))
    both = sweep(lines, twice(corner, corner), twice(conics, conics))
    steep, (width, height) = m.steep, (pieces.high - pieces.low).T
    if arcs is not None:
        steep = jnp.where(arcs.there, height > jnp.abs(width), steep)
    pick = lambda x, y: jnp.where(steep.reshape(-1, *(1,) * (x.ndim - 1)), y, x)
    extent, moment, flux = jax.tree.map(lambda x: pick(*jnp.split(x, 2)), both[1:])
    moment += extent * pick(*begin.T)
    own = pixel.at[owner].get(mode="fill", fill_value=film[0] * film[1])
    return PixelCoverage(
        pixel, both.area[:P], VisiblePieces(own, places.part, extent, moment, flux)
    )


def _along_x(owner: Array, m: Monotone, pieces: Pieces, arcs: Arcs | None) -> Lines:
    """Pieces for a sweep line that moves to the right."""
    (x0, y0), (x1, y1) = pieces.low.T, pieces.high.T
    right = x1 >= x0
    up = jnp.where(right, -m.jump, m.jump)
    u0, u1 = jnp.minimum(x0, x1), jnp.maximum(x0, x1)
    v0, v1 = jnp.where(right, y0, y1), jnp.where(right, y1, y0)
    # Layers just above a piece on the row's bottom are counted without it.
    lies = jnp.where(pieces.on_bottom, up, 0)
    halts = (x0, jnp.where(pieces.bottom, m.jump, 0)), (u0, -lies), (u1, lies)
    return Lines(owner, u0, v0, u1, v1, up, halts, m.rising * m.rightward, arcs)


def _along_y(owner: Array, m: Monotone, pieces: Pieces, arcs: Arcs | None) -> Lines:
    """Pieces for a sweep line that moves up."""
    (x0, y0), (x1, y1) = pieces.low.T, pieces.high.T
    if arcs is not None:
        arcs = arcs._replace(conic=arcs.conic[..., jnp.array([1, 0, 2])])
    halt = jnp.where(pieces.left_at_end, y1, y0), pieces.left
    none = y0, jnp.zeros_like(y0)
    return Lines(owner, y0, x0, y1, x1, m.jump, (halt, none, none), m.rising, arcs)
