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
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.batches import in_chunks
from .._numerics.one_kernel import by_machine, on_cpu, put
from .coverage import Monotone, Pieces, end_flux, shares, taken
from .overlaps import fold_pieces
from .parts import CurveList, Ordered, Part, fold_curves
from .piece_by_piece import walked
from .sweep import Visible

#: Curves in a table.
BLOCK = 1 << 13

#: `build(changing)` gives the parts of the contour.
Build = Callable[[list], list[Part]]
#: `crowd(add, start, lists)` gives `start` after `add(total, number, pixel, visible)` over all that
#: is visible where contours overlap, of the part with a number; `lists` of the parts' curves, if
#: there are such.
Crowd = Callable[
    [Callable[[Any, int, Array, Visible], Any], Any, list[CurveList] | None],
    Any,
]


class Seen(NamedTuple):
    """A film of W x H pixels: in those that are `alone` all pieces are seen, else what `crowd`
    tells."""

    W: int
    H: int
    alone: Bool[Array, "pixels"]
    crowd: Crowd


class Some(NamedTuple):
    """So many curves of a list, from the `first` on."""

    curves: Ordered
    first: Int[Array, ""]
    number: Int[Array, ""]

    def cut(self, size: int) -> Ordered:
        """Return these curves alone, and what follows them up to a number."""
        cut = lambda x: jax.lax.dynamic_slice_in_dim(x, self.first, size)
        return jax.tree.map(cut, self.curves)


class _Found(NamedTuple):
    """The parts' curves: on a CPU listed once, for all that is asked of them; on other machines
    (None) found wherever they are asked for."""

    lists: list[CurveList] | None = None

    @staticmethod
    def listed(parts: list[Part]) -> "_Found":
        """Return lists with all curves that there is room for."""
        lists = [CurveList.empty(part) for part in parts]
        pairs = zip(parts, lists, strict=True)
        return _Found([x.listing(p, jnp.int32(0)) if x.has_room(p) else x for p, x in pairs])

    def fold(
        self,
        parts: list[Part],
        number: int,
        add: Callable[[Any, Array, Some], Any],
        start: Any,
        begin: Array,
        end: Array,
    ) -> Any:
        """Return `start` after `add(total, ids, some)` over a block of a part's curves, from an id
        up to another, some at a time."""
        part = parts[number]
        if self.lists is None:

            def chunk(total, ids, curves):
                some = Some(Ordered.of(curves), jnp.int32(0), jnp.int32(part.size))
                return add(total, ids, some)

            return fold_curves(part, chunk, start, part.size, (begin, end))

        known = self.lists[number]
        if not known.has_room(part):
            known = known.listing(part, begin - begin % known.room)

        def body(total, first):
            ids = first + jnp.arange(part.size, dtype=jnp.int32)
            number = jnp.minimum(end - first, part.size)
            some = Some(known.curves, first - known.begin, number)
            return add(total, ids, some)

        return in_chunks(body, start, part.size, jnp.minimum(part.total, end), begin)


def pushed(
    build: Build, changing: list, velocity: list, seen: Seen, image: Float[Array, "pixels ways"]
) -> Float[Array, "pixels ways"]:
    """Return the image with what the visible contour changes where things move with velocities,
    each along the last axis of what moves."""
    way = partial(_pushed, build, changing, velocity, seen, image)
    return by_machine(
        cpu=lambda: way(_Found.listed(build(changing))), elsewhere=lambda: way(_Found())
    )


def _pushed(
    build: Build,
    changing: list,
    velocity: list,
    seen: Seen,
    image: Float[Array, "pixels ways"],
    found: _Found,
) -> Float[Array, "pixels ways"]:
    parts = build(changing)

    def moved(number, ids):
        homogeneous = lambda changing: build(changing)[number].homogeneous_of(ids)
        move = lambda velocity: jax.jvp(homogeneous, (changing,), (velocity,))
        return jax.vmap(move, -1, (None, -1))(velocity)

    def crowd(image, number, pixel, visible: Visible):
        points, rate = moved(number, visible.curve)
        change = _product(visible.flux(points)[:, None], rate)[:, 0]
        return image.at[pixel].add(change, mode="drop")

    for number, part in enumerate(parts):

        def chunk(image, ids, some, number=number, part=part):
            points, rate = moved(number, jnp.minimum(ids, part.total - 1))
            flux = _flux(some.cut(part.size).monotone, points, rate)
            return _ordinary_pushed(seen, some, flux, image)

        image = found.fold(parts, number, chunk, image, jnp.int32(0), part.total)
    return seen.crowd(crowd, image, found.lists)


def pulled(build: Build, changing: list, seen: Seen, weights: Float[Array, "pixels ways"]) -> list:
    """Return by how much the sums of the pixels' areas, each times its weight, grow with what
    changes: along the last axis for each way to weigh."""
    way = partial(_pulled, build, changing, seen, weights)
    return by_machine(
        cpu=lambda: way(_Found.listed(build(changing))), elsewhere=lambda: way(_Found())
    )


def _pulled(
    build: Build,
    changing: list,
    seen: Seen,
    weights: Float[Array, "pixels ways"],
    found: _Found,
) -> list:
    parts, ways = build(changing), weights.shape[-1]

    def block(total, first):
        def crowd(tables, number, pixel, visible: Visible):
            points = parts[number].homogeneous_of(visible.curve)
            weight = weights.at[pixel].get(mode="fill", fill_value=0)
            share = visible.flux(points)[..., None] * weight[:, None, None]
            row = jnp.where(visible.curve < first, BLOCK, visible.curve - first)
            table = tables[number].at[row].add(share, mode="drop")
            return [*tables[:number], table, *tables[number + 1 :]]

        tables = seen.crowd(crowd, [_table(part, ways) for part in parts], found.lists)
        for number, (part, table) in enumerate(zip(parts, tables, strict=True)):

            def chunk(total, ids, some, number=number, part=part, table=table):
                own = jnp.minimum(ids, part.total - 1)
                homogeneous = lambda changing: build(changing)[number].homogeneous_of(own)
                points, pull = jax.vjp(homogeneous, changing)
                share = jax.lax.dynamic_slice_in_dim(table, ids[0] - first, part.size)
                share = _ordinary_pulled(seen, some, points, weights, share)
                return jax.tree.map(jnp.add, total, jax.vmap(pull, -1, -1)(share)[0])

            total = found.fold(parts, number, chunk, total, first, first + BLOCK)
        return total

    nothing = jax.tree.map(lambda x: jnp.zeros((*x.shape, ways), x.dtype), changing)
    most = jnp.max(jnp.stack([part.total for part in parts]))
    return in_chunks(block, nothing, BLOCK, most)


def _table(part: Part, ways: int) -> Float[Array, "rows n 3 ways"]:
    """Return a row of zeros for each curve of a block, in whole chunks."""
    rows = -(-min(BLOCK, part.most or BLOCK) // part.size) * part.size
    return jnp.zeros((rows, 2 if part.straight else 3, 3, ways), part.dtype)


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
    m: Monotone, points: Float[Array, "K 2 3"], shared: Float[Array, "K 2 ways"]
) -> Float[Array, "K 2 3 ways"]:
    """Return what `_flux` of straight curves is made of, where what it returns counts so much."""
    return jnp.sum(end_flux(m, points)[..., None] * shared[:, :, None, None], axis=1)


# --- ordinary pixels -----------------------------------------------------------------------------


def _ordinary_pushed(
    seen: Seen, some: Some, flux: Float[Array, "K m ways"], image: Float[Array, "N ways"]
) -> Float[Array, "N ways"]:
    """Return the image with the pieces of curves in pixels that one chain of contour crosses."""
    W, H, alone, _ = seen

    def one(some, flux, alone, image):
        def add(image, k, share, pixel):
            change = jnp.sum(share[:, None] * flux[k], axis=0)
            return put(image, image[pixel] + change, pixel)

        return _one_by_one(W, H, some, alone, add, image)

    def vectors(some, flux, alone, image):
        def add(image, k, share, pixel):
            change = jnp.sum(share[..., None] * flux[k], axis=1)
            return image.at[pixel].add(change, mode="drop")

        return _in_vectors(W, H, some, alone, add, image)

    return on_cpu(one, some, flux, alone, image, elsewhere=vectors)


def _ordinary_pulled(
    seen: Seen,
    some: Some,
    points: Float[Array, "K n 3"],
    weights: Float[Array, "pixels ways"],
    share: Float[Array, "K n 3 ways"],
) -> Float[Array, "K n 3 ways"]:
    """Return how much the curves' points count, with what the weights of such pixels say of the
    pieces there."""
    W, H, alone, _ = seen

    def one(some, alone, weights, flux):
        def add(flux, k, share, pixel):
            return put(flux, flux[k] + share[:, None] * weights[pixel][None], k)

        return _one_by_one(W, H, some, alone, add, flux)

    def with_points(some, points, alone, weights, flux, share):
        def back(k, share):
            own = taken(some.curves, (some.first + k)[None]).monotone
            more = _flux_back(own, points[k][None], flux[k][None])[0]
            return put(share, share[k] + more, k)

        flux = one(some, alone, weights, flux)
        # (What is filled is returned: else the compiler would have to find room for it.)
        return jax.lax.fori_loop(jnp.int32(0), some.number, back, share), flux

    def vectors(some, alone, weights, flux):
        def add(flux, k, share, pixel):
            weight = weights.at[pixel].get(mode="fill", fill_value=0)
            return flux.at[k].add(share[..., None] * weight[:, None], mode="drop")

        return _in_vectors(W, H, some, alone, add, flux)

    def vectors_with_points(some, points, alone, weights, flux, share):
        flux = vectors(some, alone, weights, flux)
        return share + _flux_back(some.curves.monotone, points, flux), flux

    arcs = some.curves.frame is not None
    flux = jnp.zeros((points.shape[0], 9 if arcs else 2, weights.shape[-1]), weights.dtype)
    if arcs:
        flux = on_cpu(one, some, alone, weights, flux, elsewhere=vectors)
        return share + flux.reshape(share.shape)
    args = some, points, alone, weights, flux, share
    return on_cpu(with_points, *args, elsewhere=vectors_with_points)[0]


def _one_by_one(W: int, H: int, some: Some, alone: Array, add: Callable, start: Any) -> Any:
    """Return `start` after `add(total, curve, shares, pixel)` over such pieces, one by one."""

    def of_piece(total, k, m: Monotone, piece: Pieces):
        there, pixel = _place(W, H, piece)
        share = -piece.jump * shares(m, piece.start, piece.end)

        def one(state):
            return jnp.array(False), add(state[1], k, share, pixel)

        # (A condition would copy the arrays.)
        state = there & alone[pixel], total
        return jax.lax.while_loop(lambda s: s[0], one, state)[1]

    return walked((W, H), some.curves, some.number, (0, H), of_piece, start, some.first)


def _in_vectors(W: int, H: int, some: Some, alone: Array, add: Callable, start: Any) -> Any:
    """Return the same of vectors of pieces, of all curves; those elsewhere are past the end."""
    m = some.curves.monotone

    def few(total, pieces: Pieces):
        there, pixel = _place(W, H, pieces)
        seen = pieces.valid & there & alone[pixel]
        share = shares(taken(m, pieces.curve), pieces.start, pieces.end)
        share = jnp.where(seen, -pieces.jump, 0)[:, None] * share
        return add(total, pieces.curve, share, jnp.where(seen, pixel, H * W))

    return fold_pieces(m, (W, H, H), few, start)


def _place(W: int, H: int, pieces: Pieces) -> tuple[Bool[Array, "*P"], Int[Array, "*P"]]:
    """Return which pieces are on the film, and in which of its pixels."""
    there = (pieces.column >= 0) & (pieces.column < W)
    row, column = (jnp.clip(x, 0, n - 1) for x, n in ((pieces.row, H), (pieces.column, W)))
    return there, (H - 1 - row) * W + column
