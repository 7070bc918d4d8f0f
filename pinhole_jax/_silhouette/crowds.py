"""Coverage of a union, in pixels where contours overlap.

The pieces of some crowded pixels are listed, pixel by pixel, and equal ones merged. A cell (first a
pixel) that its pieces cannot uncover is covered; one with few pieces is swept; any other is cut
into smaller ones, depth first, so that memory is bounded. Nearly all of these are covered whatever
their pieces do. At the last cut the corner speaks for a cell of 2^-24 px.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.batches import in_chunks
from .._numerics.running import running_sum
from .contour import Contour
from .pieces import Arcs, Monotone, Pieces, in_row, piece_in, rows_met
from .pixels import Pixels, fold_film, place
from .sweep import Lines, swept

#: Cells with at most `FEW` pieces are swept, `SWEPT` at a time; so many are looked at together.
FEW, SWEPT, CELLS = 24, 64, 1024
#: A cell is cut into `CUT` x `CUT`, so often at most.
CUT, DEPTH = 4, {"float32": 4, "float64": 12}
#: At least and at most so many pieces are listed, some for each curve that there may be.
LEAST_ROOM, ROOM, PIECES_A_CURVE = 1 << 12, 1 << 20, 2


class Seen(NamedTuple):
    """Stretches of curves that the background is seen beside, each in a pixel (past the last:
    none): the length along y if the curve is steep, else along x (`extent`, px, signed), and its
    first `moment` (px^2); how the area grows with an arc's conic (px^2)."""

    pixel: Int[Array, "N"]
    curve: Int[Array, "N"]
    extent: Float[Array, "N"]
    moment: Float[Array, "N"]
    flux: Float[Array, "N 3 3"] | None


class Resolved(NamedTuple):
    """Cells: their pixel (past the last: none), by how much of it more is covered, and what is seen
    there, if that was asked for and anything is."""

    pixel: Int[Array, "C"]
    area: Float[Array, "C"]
    seen: Seen | None


class _Listed(NamedTuple):
    """Pieces, pixel by pixel: their curve's number, ends, `jump`, and facts as bits (`_kinds`)."""

    pixel: Int[Array, "N"]
    curve: Int[Array, "N"]
    ends: tuple[Array, ...]
    jump: Float[Array, "N"]
    kind: Int[Array, "N"]

    def bit(self, k: int) -> Bool[Array, "N"]:
        """Which have a fact of `_kinds`."""
        return (self.kind >> k & 1) > 0

    @property
    def arc(self) -> Bool[Array, "N"]:
        """Which are parts of arcs."""
        return self.bit(0)


class _Cells(NamedTuple):
    """Cells: the place of their pixel in a batch, how often that is cut, and where in it they are,
    in units of a cell."""

    pixel: Int[Array, "C"]
    level: Int[Array, "C"]
    row: Int[Array, "C"]
    column: Int[Array, "C"]


Add = Callable[[Any, Resolved], Any]


def resolved(
    curves: Contour, film: tuple[int, int], pixels: Pixels, add: Add, start: Any, seen: bool
) -> Any:
    """`start` after `add(total, resolved)` over all crowded pixels of a film of W x H; with `seen`
    also of what the background is seen beside."""
    if pixels.crowded is None:
        return start
    number = jnp.where(pixels.crowded, pixels.number, 0)
    upto = running_sum(number)
    room = LEAST_ROOM
    while room < min(PIECES_A_CURVE * curves.number, ROOM):
        room *= 2

    def batch(state):
        first, total = state
        begins = (number > 0) & (upto - number >= first)
        fits = begins & (upto <= first + room)
        end = jnp.max(jnp.where(fits, upto, first))
        # (One pixel at least.)
        end = jnp.where(end > first, end, jnp.min(jnp.where(begins, upto, upto[-1])))
        chosen = begins & (upto <= end)
        listed = _merged(_listed(curves, film, chosen, room))
        return end, _worked_off(curves, film, pixels, chosen, listed, add, total, seen)

    return jax.lax.while_loop(lambda s: s[0] < upto[-1], batch, (jnp.int32(0), start))[1]


# --- lists ----------------------------------------------------------------------------------------


def _listed(
    curves: Contour, film: tuple[int, int], chosen: Bool[Array, "pixels"], room: int
) -> _Listed:
    """The pieces in chosen pixels, in the order in which they are found."""
    whole, real = jnp.zeros(room, jnp.int32), jnp.zeros(room, curves.tail.dtype)
    nowhere = film[0] * film[1]
    empty = _Listed(whole + nowhere, whole, (real,) * 4, real, whole)

    def add(state, m, pieces: Pieces):
        used, listed = state
        pixel = place(film, pieces)
        there = (pixel < nowhere) & chosen[jnp.minimum(pixel, nowhere - 1)]
        upto = used + running_sum(there.astype(jnp.int32))
        slot = jnp.where(there, upto - 1, room)
        ends = (*pieces.low.T, *pieces.high.T)
        more = _Listed(pixel, pieces.curve, ends, pieces.jump, _kinds(m, pieces))
        put = lambda old, new: old.at[slot].set(new, mode="drop")
        return upto[-1], jax.tree.map(put, listed, more)

    return fold_film(curves, film, add, (jnp.int32(0), empty))[1]


def _kinds(m: Monotone, pieces: Pieces) -> Int[Array, "P"]:
    """Facts that equal pieces share, as bits."""
    arc = jnp.zeros(pieces.jump.shape, bool) if m.arcs is None else m.arcs.there
    left = pieces.left != 0
    facts = arc, left, left & pieces.left_at_end, pieces.bottom, pieces.on_bottom
    return jnp.asarray(sum(fact.astype(jnp.int32) << k for k, fact in enumerate(facts)))


def _merged(listed: _Listed) -> _Listed:
    """Pieces pixel by pixel, equal ones as one; such as cancel each other are left out."""
    nowhere, number = jnp.max(listed.pixel), len(listed.pixel)
    keys = listed.pixel, listed.kind, *listed.ends
    *keys, curve, jump = jax.lax.sort((*keys, listed.curve, listed.jump), num_keys=len(keys))
    first = jnp.concatenate([jnp.ones(1, bool), _differ(keys)])
    group = running_sum(first.astype(jnp.int32)) - 1
    jump = jnp.zeros(number, jump.dtype).at[group].add(jump)[group]
    stays = first & (jump != 0)
    slot = jnp.where(stays, running_sum(stays.astype(jnp.int32)) - 1, number)
    pixel, kind, *ends = keys
    put = lambda x: jnp.zeros_like(x).at[slot].set(x, mode="drop")
    last = jnp.full_like(pixel, nowhere).at[slot].set(pixel, mode="drop")
    return _Listed(last, put(curve), tuple(map(put, ends)), put(jump), put(kind))


def _differ(keys: list[Array]) -> Bool[Array, "N"]:
    """Which entries of lists differ from the ones before, but for the first."""
    return jnp.any(jnp.stack([x[1:] != x[:-1] for x in keys]), axis=0)


# --- cells ----------------------------------------------------------------------------------------


class _Batch(NamedTuple):
    """Pixels that are worked off: their `pixel` (past the last: none), layers at their corners, and
    where in the lists their pieces are."""

    curves: Contour
    W: int
    listed: _Listed
    pixel: Int[Array, "N"]
    corner: Float[Array, "N"]
    begin: Int[Array, "N"]
    number: Int[Array, "N"]
    nowhere: int


def _worked_off(
    curves: Contour,
    film: tuple[int, int],
    pixels: Pixels,
    chosen: Bool[Array, "pixels"],
    listed: _Listed,
    add: Add,
    start: Any,
    seen: bool,
) -> Any:
    """`start` after all chosen pixels, whose pieces are listed."""
    nowhere, room = len(chosen), len(listed.pixel)
    most, real = min(room, nowhere), curves.tail.dtype
    depth = DEPTH[jnp.dtype(real).name]
    pixel = jnp.nonzero(chosen, size=most, fill_value=nowhere)[0].astype(jnp.int32)
    find = lambda side: jnp.searchsorted(listed.pixel, pixel, side=side).astype(jnp.int32)
    begin, corner = find("left"), pixels.corner[jnp.minimum(pixel, nowhere - 1)]
    number, total = find("right") - begin, jnp.sum(chosen, dtype=jnp.int32)
    batch = _Batch(curves, film[0], listed, pixel, corner, begin, number, nowhere)
    size = (depth + 1) * CELLS * CUT**2
    rank = jnp.arange(CELLS, dtype=jnp.int32)

    def step(state):
        next_, height, stack, sums = state
        # The last cells of the stack; if there is none, the next pixels.
        on_stack = height > 0
        slot = jnp.where(on_stack, height - 1 - rank, next_ + rank)
        there = (slot >= 0) & (on_stack | (slot < total))
        slot = jnp.clip(slot, 0, jnp.where(on_stack, size, most) - 1)
        whole = _Cells(slot, *(jnp.zeros_like(slot),) * 3)
        cells = jax.tree.map(lambda x, y: jnp.where(on_stack, x[slot], y), stack, whole)
        needed = running_sum(jnp.where(there, number[cells.pixel], 0))
        there &= (needed <= room) | (rank == 0)
        taken = jnp.sum(there, dtype=jnp.int32)
        next_, height = (
            next_ + jnp.where(on_stack, 0, taken),
            height - jnp.where(on_stack, taken, 0),
        )
        cut, sums = _looked_at(batch, cells, there, depth, add, sums, seen)
        stack = _with_parts(stack, height, cells, cut)
        return next_, height + CUT**2 * jnp.sum(cut, dtype=jnp.int32), stack, sums

    stack = _Cells(*(jnp.zeros(size, jnp.int32),) * 4)
    more = lambda s: (s[0] < total) | (s[1] > 0)
    return jax.lax.while_loop(more, step, (jnp.int32(0), jnp.int32(0), stack, start))[-1]


def _with_parts(stack: _Cells, height: Array, cells: _Cells, cut: Bool[Array, "C"]) -> _Cells:
    """A stack of this height with the parts of cells that are cut on top."""
    slot = height + CUT**2 * (running_sum(cut.astype(jnp.int32)) - 1)
    slot = jnp.where(cut, slot, len(stack.pixel))[:, None]
    part = jnp.arange(CUT**2, dtype=jnp.int32)[None]
    pixel, level, row, column = (x[:, None] for x in cells)
    own = CUT * row + part // CUT, CUT * column + part % CUT
    parts = jnp.broadcast_arrays(pixel, level + 1, *own)
    put = lambda x, new: x.at[slot + part].set(new, mode="drop")
    return _Cells(*map(put, stack, parts))


class _InCells(NamedTuple):
    """Pieces as they are in cells (`jump` is 0 of what is not), the cell's number, arcs in units of
    a cell from its corner, and how layers change from a pixel's corner to the cell's."""

    cell: Int[Array, "N"]
    pieces: Pieces
    arcs: Arcs | None
    change: Float[Array, "N"]


def _looked_at(
    batch: _Batch,
    cells: _Cells,
    there: Bool[Array, "C"],
    depth: int,
    add: Add,
    total: Any,
    seen: bool,
) -> tuple[Bool[Array, "C"], Any]:
    """Which of the cells that are there must be cut, and the total with all others."""
    real = batch.corner.dtype
    number = jnp.where(there, batch.number[cells.pixel], 0)
    found = _in_cells(batch, cells, number)
    inside = found.pieces.jump != 0
    sums = jnp.stack([found.pieces.drop, inside.astype(real), found.change], axis=1)
    drop, number, change = jnp.zeros((CELLS, 3), real).at[found.cell].add(sums, mode="drop").T
    corner = batch.corner[cells.pixel] + change
    few = number <= FEW
    known = (corner - drop > 0.5) | (number == 0) | ((cells.level >= depth) & ~few)
    pixel = jnp.where(there & known, batch.pixel[cells.pixel], batch.nowhere)
    area = jnp.where(corner > 0.5, 1 / _scale(cells.level, real) ** 2, 0)
    total = add(total, Resolved(pixel, area, None))

    # Of each cell that is swept, its pieces in a row of a table.
    upto = running_sum(inside.astype(jnp.int32))
    before = jnp.cumsum(number.astype(jnp.int32)) - number.astype(jnp.int32)
    at = found.cell * FEW + upto - 1 - before[jnp.minimum(found.cell, CELLS - 1)]
    sweeps = there & ~known & few
    at = jnp.where(inside & sweeps[jnp.minimum(found.cell, CELLS - 1)], at, CELLS * FEW)
    slots = jnp.arange(len(at), dtype=jnp.int32)
    table = jnp.full(CELLS * FEW, -1, jnp.int32).at[at].set(slots, mode="drop").reshape(-1, FEW)
    order = jnp.nonzero(sweeps, size=CELLS, fill_value=CELLS)[0].astype(jnp.int32)

    def some(total, first):
        chosen = jax.lax.dynamic_slice_in_dim(order, first, SWEPT)
        own = jnp.minimum(chosen, CELLS - 1)
        places = jnp.where((chosen < CELLS)[:, None], table[own], -1)
        here = jax.tree.map(lambda x: x[own], cells)
        return add(total, _swept(batch, here, corner[own], found, places, seen))

    return there & ~known & ~few, in_chunks(some, total, SWEPT, jnp.sum(sweeps, dtype=jnp.int32))


def _scale(level: Int[Array, "*C"], real: Any) -> Float[Array, "*C"]:
    """How many cells are side by side in a pixel."""
    return jnp.asarray(CUT, real) ** level.astype(real)


def _in_cells(batch: _Batch, cells: _Cells, number: Int[Array, "C"]) -> _InCells:
    """The pieces of the cells' pixels, `number` for each cell, as they are in the cells."""
    listed, upto = batch.listed, running_sum(number)
    slot = jnp.arange(len(listed.pixel), dtype=jnp.int32)
    cell = jnp.searchsorted(upto, slot, side="right").astype(jnp.int32)
    there, own = slot < upto[-1], jnp.minimum(cell, CELLS - 1)
    here = jax.tree.map(lambda x: x[own], cells)
    place_ = batch.begin[here.pixel] + slot - (upto - number)[own]
    piece = jax.tree.map(lambda x: x[jnp.where(there, place_, 0)], listed)
    scale = _scale(here.level, batch.corner.dtype)
    low, high = (
        jnp.stack(ends, axis=-1) * scale[:, None] for ends in (piece.ends[:2], piece.ends[2:])
    )
    curve = batch.curves.monotone(piece.curve)
    m = Monotone(low, high, curve.rising, jnp.where(there, piece.jump, 0), None)
    if curve.arcs is not None:
        conic = _placed(curve.arcs.conic, _corner(batch, here), scale)
        m = m._replace(arcs=Arcs(conic, piece.arc))
    return _cut(m, piece, here, jnp.where(there, cell, CELLS))


def _corner(batch: _Batch, cells: _Cells) -> Float[Array, "C 2"]:
    """The lower left corners of cells' pixels."""
    row, column = jnp.divmod(batch.pixel[cells.pixel], batch.W)
    return jnp.stack([column, row], axis=-1).astype(batch.corner.dtype)


def _placed(frame: Float[Array, "*C 3 3"], origin: Array, scale: Array) -> Float[Array, "*C 3 3"]:
    """Conics in pixels `scale` times as small, from an origin."""
    xy, z = frame[..., :2], frame[..., 2:]
    xy = (xy - origin[..., None, :] * z) * scale[..., None, None]
    return jnp.concatenate([xy, z], axis=-1)


def _cut(m: Monotone, piece: _Listed, cells: _Cells, cell: Int[Array, "N"]) -> _InCells:
    """What of pieces (in units of the cells) is in cells.

    What a piece does on its pixel's sides is as it was found there, not anew.
    """
    row, column, n = cells.row, cells.column, CUT**cells.level
    left, left_at_end, bottom, on_bottom = (piece.bit(k) for k in (1, 2, 3, 4))
    first, end = rows_met(m, n)
    own = in_row(m, row, (0, n - 1))
    inside = (first <= row) & (row < end)
    between = (jnp.minimum(own.first, own.last) <= column) & (
        column <= jnp.maximum(own.first, own.last)
    )
    found = piece_in(m, own, row, column, piece.curve, inside & between)

    # Where the pixel's left side and the row's bottom are crossed.
    row_of_left = jnp.where(left_at_end, end - 1, first)
    aside = jnp.where(left, jnp.where(left_at_end, m.jump, -m.jump), 0)
    real = row.astype(m.low.dtype)
    starts = inside & (m.low[:, 1] <= real) & (real < m.high[:, 1])
    crosses = jnp.where(row == 0, bottom, starts)
    change = jnp.where(row_of_left < row, aside, 0)
    change += jnp.where(crosses & (own.first < column), m.jump, 0)

    at_left, own_left = column == 0, jnp.where(row_of_left == row, aside, 0)
    found = found._replace(
        left=jnp.where(found.valid, jnp.where(at_left, own_left, found.left), 0),
        left_at_end=jnp.where(at_left, left_at_end, found.left_at_end),
        bottom=crosses & (own.first == column) & found.valid,
        on_bottom=jnp.where(row == 0, on_bottom, found.on_bottom),
    )
    arcs = m.arcs
    if arcs is not None:
        arcs = Arcs(_placed(arcs.conic, found.corner, jnp.ones_like(real)), arcs.there)
    return _InCells(cell, found, arcs, change)


# --- sweeps ---------------------------------------------------------------------------------------


def _swept(
    batch: _Batch,
    cells: _Cells,
    corner: Float[Array, "C"],
    found: _InCells,
    places: Int[Array, "C M"],
    seen: bool,
) -> Resolved:
    """Cells with the pieces at these places (-1: none), resolved; those without pieces are none."""
    _, pieces, arcs, _ = jax.tree.map(lambda x: x[jnp.maximum(places, 0)], found)
    there, scale = places >= 0, _scale(cells.level, corner.dtype)
    pieces = pieces._replace(
        curve=jnp.where(there, pieces.curve, 0),
        jump=jnp.where(there, pieces.jump, 0),
        left=jnp.where(there, pieces.left, 0),
        bottom=pieces.bottom & there,
    )
    own = batch.curves.monotone(pieces.curve.reshape(-1))
    own = jax.tree.map(lambda x: x.reshape(*places.shape, *x.shape[1:]), own)
    pixel = jnp.where(jnp.any(there, axis=1), batch.pixel[cells.pixel], batch.nowhere)
    lines = _along_x(pieces, arcs, own.rising * own.rightward)
    if not seen:
        return Resolved(pixel, swept(lines, corner, None).area / scale**2, None)

    both = lambda a, b: jax.tree.map(lambda *x: jnp.concatenate(x), a, b)
    lines = both(lines, _along_y(pieces, arcs, own.rising))
    conics = None if own.arcs is None else both(own.arcs.conic, own.arcs.conic)
    sweeps = swept(lines, both(corner, corner), conics)
    flat, upright = (jax.tree.map(lambda x, k=k: jnp.split(x, 2)[k], sweeps) for k in (0, 1))
    # Steep ones by the sweep along y.
    steep, way = own.steep, pieces.high - pieces.low
    if arcs is not None:
        steep = jnp.where(arcs.there, way[..., 1] > jnp.abs(way[..., 0]), steep)
    pick = lambda a, b: jnp.where(steep.reshape(*steep.shape, *(1,) * (a.ndim - 2)), b, a)
    extent, moment, flux = jax.tree.map(pick, flat[1:], upright[1:])
    begin = _corner(batch, cells)[:, None] + pieces.corner / scale[:, None, None]
    extent, moment = extent / scale[:, None], moment / scale[:, None] ** 2
    moment += extent * pick(begin[..., 0], begin[..., 1])
    pixels = jnp.broadcast_to(pixel[:, None], places.shape)
    some = Seen(pixels, pieces.curve, extent, moment, flux)
    some = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), some)
    return Resolved(pixel, flat.area / scale**2, some)


def _along_x(pieces: Pieces, arcs: Arcs | None, grows: Array) -> Lines:
    """Pieces as a line sweeps them that moves to the right."""
    (x0, y0), (x1, y1) = (jnp.moveaxis(p, -1, 0) for p in (pieces.low, pieces.high))
    right, up = x1 >= x0, pieces.up
    u0, u1 = jnp.minimum(x0, x1), jnp.maximum(x0, x1)
    v0, v1 = jnp.where(right, y0, y1), jnp.where(right, y1, y0)
    enters = jnp.where(pieces.bottom, pieces.jump, 0)
    # What lies just above a piece on the row's bottom is counted without it.
    lies = jnp.where(pieces.on_bottom, up, 0)
    halt, step = (jnp.concatenate(x, axis=1) for x in ((x0, u0, u1), (enters, -lies, lies)))
    return Lines(u0, v0, u1, v1, up, halt, step, grows, arcs)


def _along_y(pieces: Pieces, arcs: Arcs | None, grows: Array) -> Lines:
    """Pieces as a line sweeps them that moves up."""
    (x0, y0), (x1, y1) = (jnp.moveaxis(p, -1, 0) for p in (pieces.low, pieces.high))
    if arcs is not None:
        arcs = arcs._replace(conic=arcs.conic[..., jnp.array([1, 0, 2])])
    # (As many halts as the other sweep has: both are one.)
    halt = jnp.tile(pieces.left_y, (1, 3))
    step = jnp.pad(pieces.left, ((0, 0), (0, 2 * pieces.left.shape[1])))
    return Lines(y0, x0, y1, x1, pieces.jump, halt, step, grows, arcs)
