"""The boundary integral: how what is seen of a contour carries motion from scene and camera to an
image, and back.

What a piece adds to a pixel is linear in its curve's homogeneous points. So these are
differentiated some curves at a time, for all directions of motion together. In pixels that one
chain of contour crosses, a compiled loop goes from piece to piece then, on a CPU (on other machines
they are vectors): each adds some numbers for each direction (`shares`). What is visible where
contours overlap is handed over (`Crowd`). On the way back that is added to a table first, which has
room for this many curves (`BLOCK`); of more, one block after the other is worked off.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.one_kernel import on_cpu, put
from .coverage import Monotone, Pieces, end_flux, shares, taken
from .overlaps import fold_pieces
from .parts import Ordered, Part, fold_curves
from .piece_by_piece import walked
from .sweep import Visible

#: Curves in a table.
BLOCK = 1 << 13

#: `build(changing)` gives the parts of the contour.
Build = Callable[[list], list[Part]]
#: `crowd(add, start)` gives `start` after `add(total, number, pixel, visible)` over all that is
#: visible where contours overlap, of the part with a number.
Crowd = Callable[[Callable[[Any, int, Array, Visible], Any], Any], Any]


class Seen(NamedTuple):
    """A film of W x H pixels: in those that are `alone` all pieces are seen, else what `crowd`
    tells."""

    W: int
    H: int
    alone: Bool[Array, "pixels"]
    crowd: Crowd


def pushed(
    build: Build, changing: list, velocity: list, seen: Seen, image: Float[Array, "pixels ways"]
) -> Float[Array, "pixels ways"]:
    """Return the image with what the visible contour changes where things move with velocities,
    each along the last axis of what moves."""

    def moved(number, ids):
        homogeneous = lambda changing: build(changing)[number].homogeneous_of(ids)
        move = lambda velocity: jax.jvp(homogeneous, (changing,), (velocity,))
        return jax.vmap(move, -1, (None, -1))(velocity)

    def crowd(image, number, pixel, visible: Visible):
        points, rate = moved(number, visible.curve)
        change = _product(visible.flux(points)[:, None], rate)[:, 0]
        return image.at[pixel].add(change, mode="drop")

    for number, part in enumerate(build(changing)):

        def chunk(image, ids, curves, number=number, part=part):
            points, rate = moved(number, jnp.minimum(ids, part.total - 1))
            curves = Ordered.of(curves)
            return _ordinary_pushed(seen, curves, _flux(curves.monotone, points, rate), image)

        image = fold_curves(part, chunk, image, part.size)
    return seen.crowd(crowd, image)


def pulled(build: Build, changing: list, seen: Seen, weights: Float[Array, "pixels ways"]) -> list:
    """Return by how much the sums of the pixels' areas, each times its weight, grow with what
    changes: along the last axis for each way to weigh."""
    parts, ways = build(changing), weights.shape[-1]

    def block(first, total):
        def crowd(tables, number, pixel, visible: Visible):
            points = parts[number].homogeneous_of(visible.curve)
            weight = weights.at[pixel].get(mode="fill", fill_value=0)
            share = visible.flux(points)[..., None] * weight[:, None, None]
            row = jnp.where(visible.curve < first, BLOCK, visible.curve - first)
            table = tables[number].at[row].add(share, mode="drop")
            return [*tables[:number], table, *tables[number + 1 :]]

        tables = seen.crowd(crowd, [_table(part, ways) for part in parts])
        for number, (part, table) in enumerate(zip(parts, tables, strict=True)):

            def chunk(total, ids, curves, number=number, part=part, table=table):
                own = jnp.minimum(ids, part.total - 1)
                homogeneous = lambda changing: build(changing)[number].homogeneous_of(own)
                points, pull = jax.vjp(homogeneous, changing)
                curves = Ordered.of(curves)
                share = _ordinary_pulled(seen, curves, weights)
                share = _flux_back(curves.monotone, points, share)
                share += jax.lax.dynamic_slice_in_dim(table, ids[0] - first, part.size)
                return jax.tree.map(jnp.add, total, jax.vmap(pull, -1, -1)(share)[0])

            total = fold_curves(part, chunk, total, part.size, (first, first + BLOCK))
        return total

    nothing = jax.tree.map(lambda x: jnp.zeros((*x.shape, ways), x.dtype), changing)
    return _each_block(parts, block, nothing)


def _table(part: Part, ways: int) -> Float[Array, "rows n 3 ways"]:
    """Return a row of zeros for each curve of a block, in whole chunks."""
    rows = -(-min(BLOCK, part.most or BLOCK) // part.size) * part.size
    return jnp.zeros((rows, *part.homogeneous.shape[1:], ways), part.dtype)


def _each_block(parts: list[Part], block: Callable[[Array, Any], Any], start: Any) -> Any:
    most = jnp.max(jnp.stack([part.total for part in parts]))

    def body(state):
        first, total = state
        return first + BLOCK, block(first, total)

    return jax.lax.while_loop(lambda s: s[0] < most, body, (jnp.int32(0), start))[1]


def _flux(
    m: Monotone, points: Float[Array, "K n 3"], rate: Float[Array, "K n 3 ways"]
) -> Float[Array, "K m ways"]:
    """Return what pieces have `shares` of, where the curves' homogeneous points move so."""
    if points.shape[1] == 3:
        return rate.reshape(*rate.shape[:1], -1, rate.shape[-1])
    return _product(end_flux(m, points), rate)


def _product(flux: Float[Array, "K m n 3"], rate: Float[Array, "K n 3 ways"]) -> Array:
    """Return what areas gain (K, m, ways) where points move so."""
    # Else the compiler works each out anew for each number of the product.
    flux, rate = jax.lax.optimization_barrier((flux, rate))
    rate = rate[:, None]
    each = [
        flux[..., i, j, None] * rate[:, :, i, j] for i in range(flux.shape[2]) for j in range(3)
    ]
    return jnp.asarray(sum(each))


def _flux_back(
    m: Monotone, points: Float[Array, "K n 3"], shared: Float[Array, "K m ways"]
) -> Float[Array, "K n 3 ways"]:
    """Return what `_flux` is made of, where what it returns counts so much."""
    if points.shape[1] == 3:
        return shared.reshape(*points.shape, -1)
    return jnp.sum(end_flux(m, points)[..., None] * shared[:, :, None, None], axis=1)


# --- ordinary pixels -----------------------------------------------------------------------------


def _ordinary_pushed(
    seen: Seen, curves: Ordered, flux: Float[Array, "K m ways"], image: Float[Array, "N ways"]
) -> Float[Array, "N ways"]:
    """Return the image with the pieces of curves in pixels that one chain of contour crosses."""
    W, H, alone, _ = seen

    def one(curves, flux, alone, image):
        def add(image, k, share, pixel):
            change = jnp.sum(share[:, None] * flux[k], axis=0)
            return put(image, image[pixel] + change, pixel)

        return _one_by_one(W, H, curves, alone, add, image)

    def vectors(curves, flux, alone, image):
        def add(image, k, share, pixel):
            change = jnp.sum(share[..., None] * flux[k], axis=1)
            return image.at[pixel].add(change, mode="drop")

        return _in_vectors(W, H, curves, alone, add, image)

    return on_cpu(one, curves, flux, alone, image, elsewhere=vectors)


def _ordinary_pulled(
    seen: Seen, curves: Ordered, weights: Float[Array, "pixels ways"]
) -> Float[Array, "K m ways"]:
    """Return what the weights of such pixels say of that which pieces have `shares` of."""
    W, H, alone, _ = seen

    def one(curves, flux, alone, weights):
        def add(flux, k, share, pixel):
            return put(flux, flux[k] + share[:, None] * weights[pixel][None], k)

        return _one_by_one(W, H, curves, alone, add, flux)

    def vectors(curves, flux, alone, weights):
        def add(flux, k, share, pixel):
            weight = weights.at[pixel].get(mode="fill", fill_value=0)
            return flux.at[k].add(share[..., None] * weight[:, None], mode="drop")

        return _in_vectors(W, H, curves, alone, add, flux)

    numbers = 2 if curves.frame is None else 9
    flux = jnp.zeros((curves.rising.shape[0], numbers, weights.shape[-1]), weights.dtype)
    return on_cpu(one, curves, flux, alone, weights, elsewhere=vectors)


def _one_by_one(W: int, H: int, curves: Ordered, alone: Array, add: Callable, start: Any) -> Any:
    """Return `start` after `add(total, curve, shares, pixel)` over such pieces, one by one."""

    def of_piece(total, k, m: Monotone, piece: Pieces):
        there, pixel = _place(W, H, piece)
        share = -piece.jump * shares(m, piece.start, piece.end)

        def one(state):
            return jnp.array(False), add(state[1], k, share, pixel)

        # (A condition would copy the arrays.)
        state = there & alone[pixel], total
        return jax.lax.while_loop(lambda s: s[0], one, state)[1]

    number = jnp.int32(curves.rising.shape[0])
    return walked((W, H), curves, number, (0, H), of_piece, start)


def _in_vectors(W: int, H: int, curves: Ordered, alone: Array, add: Callable, start: Any) -> Any:
    """Return the same of vectors of pieces; those elsewhere are past the end."""
    m = curves.monotone

    def some(total, pieces: Pieces):
        there, pixel = _place(W, H, pieces)
        seen = pieces.valid & there & alone[pixel]
        share = shares(taken(m, pieces.curve), pieces.start, pieces.end)
        share = jnp.where(seen, -pieces.jump, 0)[:, None] * share
        return add(total, pieces.curve, share, jnp.where(seen, pixel, H * W))

    return fold_pieces(m, (W, H, H), some, start)


def _place(W: int, H: int, pieces: Pieces) -> tuple[Bool[Array, "*P"], Int[Array, "*P"]]:
    """Return which pieces are on the film, and in which of its pixels."""
    there = (pieces.column >= 0) & (pieces.column < W)
    row, column = (jnp.clip(x, 0, n - 1) for x, n in ((pieces.row, H), (pieces.column, W)))
    return there, (H - 1 - row) * W + column
