"""Coverage of a union, in pixels where contours overlap.

The pieces of crowded pixels are listed pixel by pixel, batch by batch, and equal ones merged. A
cell, at first a pixel, is covered if its pieces cannot uncover it; it is swept if they are few; and
else it is cut into smaller cells, depth first, so that memory is bounded. Nearly all of these are
covered whatever their pieces do. At the last cut the corner decides for a cell of 2^-24 px.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.batches import Total, in_chunks
from .contour import Contour
from .pieces import Arcs, Monotone, Pieces, in_row, piece_in, rows_met
from .pixels import Pixels, fold_film, place
from .sweep import Lines, sweep

#: Cells with at most `FEW` pieces are swept, `SWEPT` at a time; `CELLS` are examined together.
FEW, SWEPT, CELLS = 24, 64, 1024
#: A cell is cut into `CUT` x `CUT` smaller ones, at most `DEPTH` times.
CUT, DEPTH = 4, {"float32": 4, "float64": 12}
#: The least and the largest number of pieces in a list, and their number for each possible curve.
LEAST_ROOM, ROOM, PIECES_A_CURVE = 1 << 12, 1 << 20, 2


class VisiblePieces(NamedTuple):
    """Stretches of curves beside the background, each in a pixel (past the last: none).

    - `extent`: the signed length (px) along y if the curve is steep, else along x.
    - `moment`: its first moment (px^2).
    - `flux`: the area's derivative by an arc's conic (px^2).
    """

    pixel: Int[Array, "N"]
    curve: Int[Array, "N"]
    extent: Float[Array, "N"]
    moment: Float[Array, "N"]
    flux: Float[Array, "N 3 3"] | None


class CellCoverage(NamedTuple):
    """Cells: their pixel (past the last: none), their share of its coverage, and the visible
    pieces in them, if wanted."""

    pixel: Int[Array, "C"]
    area: Float[Array, "C"]
    seen: VisiblePieces | None


class _PieceList(NamedTuple):
    """Pieces, pixel by pixel: their curve's number, ends, `jump`, and flags as bits (`_flags`)."""

    pixel: Int[Array, "N"]
    curve: Int[Array, "N"]
    ends: tuple[Array, ...]
    jump: Float[Array, "N"]
    kind: Int[Array, "N"]

    def flag(self, k: int) -> Bool[Array, "N"]:
        """The k-th flag of `_flags`."""
        return (self.kind >> k & 1) > 0


class _Cells(NamedTuple):
    """Cells: their pixel's place in a batch, number of cuts, and row and column in the pixel."""

    pixel: Int[Array, "C"]
    level: Int[Array, "C"]
    row: Int[Array, "C"]
    column: Int[Array, "C"]


Add = Callable[[Total, CellCoverage], Total]


def fold_crowded(
    curves: Contour,
    film: tuple[int, int],
    pixels: Pixels,
    add: Add[Total],
    start: Total,
    seen: bool,
) -> Total:
    """`start` after `add(total, cells)` over all crowded pixels of a film of W x H.

    With `seen`, cells have their visible pieces.
    """
    if pixels.crowded is None:
        return start
    number = jnp.where(pixels.crowded, pixels.number, 0)
    upto = jax.lax.cumsum(number)
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
        listed = _merge(_list_pieces(curves, film, chosen, room))
        return end, _fold_batch(curves, film, pixels, chosen, listed, add, total, seen)

    return jax.lax.while_loop(lambda s: s[0] < upto[-1], batch, (jnp.int32(0), start))[1]


# --- lists ----------------------------------------------------------------------------------------


def _list_pieces(
    curves: Contour, film: tuple[int, int], chosen: Bool[Array, "pixels"], room: int
) -> _PieceList:
    """The pieces in chosen pixels, in no order."""
    whole, real = jnp.zeros(room, jnp.int32), jnp.zeros(room, curves.tail.dtype)
    nowhere = film[0] * film[1]
    empty = _PieceList(whole + nowhere, whole, (real,) * 4, real, whole)

    def add(state, m, pieces: Pieces):
        used, listed = state
        pixel = place(film, pieces)
        there = (pixel < nowhere) & chosen[jnp.minimum(pixel, nowhere - 1)]
        upto = used + jax.lax.cumsum(there.astype(jnp.int32))
        slot = jnp.where(there, upto - 1, room)
        ends = (*pieces.low.T, *pieces.high.T)
        more = _PieceList(pixel, pieces.curve, ends, pieces.jump, _flags(m, pieces))
        put = lambda old, new: old.at[slot].set(new, mode="drop")
        return upto[-1], jax.tree.map(put, listed, more)

    return fold_film(curves, film, add, (jnp.int32(0), empty))[1]


def _flags(m: Monotone, pieces: Pieces) -> Int[Array, "P"]:
    """Bits that equal pieces share: arc, crosses the left side, at its end, bottom, on bottom."""
    arc = jnp.zeros(pieces.jump.shape, bool) if m.arcs is None else m.arcs.there
    left = pieces.left != 0
    flags = arc, left, left & pieces.left_at_end, pieces.bottom, pieces.on_bottom
    return jnp.asarray(sum(flag.astype(jnp.int32) << k for k, flag in enumerate(flags)))


def _merge(listed: _PieceList) -> _PieceList:
    """Pieces pixel by pixel, equal ones merged; those that cancel each other are removed."""
    nowhere, number = jnp.max(listed.pixel), len(listed.pixel)
    keys = listed.pixel, listed.kind, *listed.ends
    *keys, curve, jump = jax.lax.sort((*keys, listed.curve, listed.jump), num_keys=len(keys))
    first = jnp.concatenate([jnp.ones(1, bool), _differ(keys)])
    group = jax.lax.cumsum(first.astype(jnp.int32)) - 1
    jump = jnp.zeros(number, jump.dtype).at[group].add(jump)[group]
    stays = first & (jump != 0)
    slot = jnp.where(stays, jax.lax.cumsum(stays.astype(jnp.int32)) - 1, number)
    pixel, kind, *ends = keys
    put = lambda x: jnp.zeros_like(x).at[slot].set(x, mode="drop")
    last = jnp.full_like(pixel, nowhere).at[slot].set(pixel, mode="drop")
    return _PieceList(last, put(curve), tuple(map(put, ends)), put(jump), put(kind))


def _differ(keys: list[Array]) -> Bool[Array, "N"]:
    """True for entries that differ from the ones before, without the first."""
    return jnp.any(jnp.stack([x[1:] != x[:-1] for x in keys]), axis=0)


# --- cells ----------------------------------------------------------------------------------------


class _Batch(NamedTuple):
    """Pixels of a batch (past the last: none), their layers at the corner, and the begin and number
    of their pieces in the list; `add`, `seen` as in `fold_crowded`."""

    curves: Contour
    W: int
    listed: _PieceList
    pixel: Int[Array, "N"]
    corner: Float[Array, "N"]
    begin: Int[Array, "N"]
    number: Int[Array, "N"]
    nowhere: int
    depth: int
    add: Callable
    seen: bool


def _fold_batch(
    curves: Contour,
    film: tuple[int, int],
    pixels: Pixels,
    chosen: Bool[Array, "pixels"],
    listed: _PieceList,
    add: Add[Total],
    start: Total,
    seen: bool,
) -> Total:
    """`start` after all chosen pixels, whose pieces are in the list."""
    nowhere, room = len(chosen), len(listed.pixel)
    most, real = min(room, nowhere), curves.tail.dtype
    depth = DEPTH[jnp.dtype(real).name]
    pixel = jnp.nonzero(chosen, size=most, fill_value=nowhere)[0].astype(jnp.int32)
    find = lambda side: jnp.searchsorted(listed.pixel, pixel, side=side).astype(jnp.int32)
    begin, corner = find("left"), pixels.corner[jnp.minimum(pixel, nowhere - 1)]
    number, total = find("right") - begin, jnp.sum(chosen, dtype=jnp.int32)
    spans, rest = (pixel, corner, begin, number), (nowhere, depth, add, seen)
    batch = _Batch(curves, film[0], listed, *spans, *rest)
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
        needed = jax.lax.cumsum(jnp.where(there, number[cells.pixel], 0))
        there &= (needed <= room) | (rank == 0)
        taken = jnp.sum(there, dtype=jnp.int32)
        next_, height = (
            next_ + jnp.where(on_stack, 0, taken),
            height - jnp.where(on_stack, taken, 0),
        )
        cut, sums = _fold_cells(batch, cells, there, sums)
        stack = _with_parts(stack, height, cells, cut)
        return next_, height + CUT**2 * jnp.sum(cut, dtype=jnp.int32), stack, sums

    stack = _Cells(*(jnp.zeros(size, jnp.int32),) * 4)
    more = lambda s: (s[0] < total) | (s[1] > 0)
    return jax.lax.while_loop(more, step, (jnp.int32(0), jnp.int32(0), stack, start))[-1]


def _with_parts(stack: _Cells, height: Array, cells: _Cells, cut: Bool[Array, "C"]) -> _Cells:
    """A stack of some height with the parts of cut cells on top."""
    slot = height + CUT**2 * (jax.lax.cumsum(cut.astype(jnp.int32)) - 1)
    slot = jnp.where(cut, slot, len(stack.pixel))[:, None]
    part = jnp.arange(CUT**2, dtype=jnp.int32)[None]
    pixel, level, row, column = (x[:, None] for x in cells)
    own = CUT * row + part // CUT, CUT * column + part % CUT
    parts = jnp.broadcast_arrays(pixel, level + 1, *own)
    put = lambda x, new: x.at[slot + part].set(new, mode="drop")
    return _Cells(*map(put, stack, parts))


class _InCells(NamedTuple):
    """Pieces in cells (`jump` is 0 of others), the cell's number, arcs in units of a cell from its
    corner, and the change of layers from the pixel's corner to the cell's."""

    cell: Int[Array, "N"]
    pieces: Pieces
    arcs: Arcs | None
    change: Float[Array, "N"]


def _fold_cells(
    batch: _Batch, cells: _Cells, there: Bool[Array, "C"], total: Total
) -> tuple[Bool[Array, "C"], Total]:
    """True for cells, of those that are there, that must be cut; and the total with all others."""
    real = batch.corner.dtype
    number = jnp.where(there, batch.number[cells.pixel], 0)
    found = _in_cells(batch, cells, number)
    inside = found.pieces.jump != 0
    sums = jnp.stack([found.pieces.drop, inside.astype(real), found.change], axis=1)
    drop, number, change = jnp.zeros((CELLS, 3), real).at[found.cell].add(sums, mode="drop").T
    corner = batch.corner[cells.pixel] + change
    few = number <= FEW
    known = (corner - drop > 0.5) | (number == 0) | ((cells.level >= batch.depth) & ~few)
    pixel = jnp.where(there & known, batch.pixel[cells.pixel], batch.nowhere)
    area = jnp.where(corner > 0.5, 1 / _scale(cells.level, real) ** 2, 0)
    total = batch.add(total, CellCoverage(pixel, area, None))

    # A table with a row of pieces for each cell to be swept.
    upto = jax.lax.cumsum(inside.astype(jnp.int32))
    before = jnp.cumsum(number.astype(jnp.int32)) - number.astype(jnp.int32)
    at = found.cell * FEW + upto - 1 - before[jnp.minimum(found.cell, CELLS - 1)]
    sweeps = there & ~known & few
    at = jnp.where(inside & sweeps[jnp.minimum(found.cell, CELLS - 1)], at, CELLS * FEW)
    slots = jnp.arange(len(at), dtype=jnp.int32)
    table = jnp.full(CELLS * FEW, -1, jnp.int32).at[at].set(slots, mode="drop").reshape(-1, FEW)
    order = jnp.nonzero(sweeps, size=CELLS, fill_value=CELLS)[0].astype(jnp.int32)

    def chunk(total, first):
        chosen = jax.lax.dynamic_slice_in_dim(order, first, SWEPT)
        own = jnp.minimum(chosen, CELLS - 1)
        places = jnp.where((chosen < CELLS)[:, None], table[own], -1)
        here = jax.tree.map(lambda x: x[own], cells)
        return batch.add(total, _sweep_cells(batch, here, corner[own], found, places))

    return there & ~known & ~few, in_chunks(chunk, total, SWEPT, jnp.sum(sweeps, dtype=jnp.int32))


def _scale(level: Int[Array, "*C"], real: jnp.dtype) -> Float[Array, "*C"]:
    """The number of cells along a pixel's side."""
    return jnp.asarray(CUT, real) ** level.astype(real)


def _in_cells(batch: _Batch, cells: _Cells, number: Int[Array, "C"]) -> _InCells:
    """The pieces of each cell's pixel, cut to the cell: `number` (C,) for each."""
    listed, upto = batch.listed, jax.lax.cumsum(number)
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
        m = m._replace(arcs=Arcs(conic, piece.flag(0)))
    return _cut(m, piece, here, jnp.where(there, cell, CELLS))


def _corner(batch: _Batch, cells: _Cells) -> Float[Array, "C 2"]:
    """The lower left corners of cells' pixels."""
    row, column = jnp.divmod(batch.pixel[cells.pixel], batch.W)
    return jnp.stack([column, row], axis=-1).astype(batch.corner.dtype)


def _placed(frame: Float[Array, "*C 3 3"], origin: Array, scale: Array) -> Float[Array, "*C 3 3"]:
    """Conics from another origin, in pixels `scale` times as small."""
    xy, z = frame[..., :2], frame[..., 2:]
    xy = (xy - origin[..., None, :] * z) * scale[..., None, None]
    return jnp.concatenate([xy, z], axis=-1)


def _cut(m: Monotone, piece: _PieceList, cells: _Cells, cell: Int[Array, "N"]) -> _InCells:
    """The parts of pieces, in units of the cells, that are in cells.

    On its pixel's sides a piece keeps its flags: they are not found again.
    """
    row, column, n = cells.row, cells.column, CUT**cells.level
    left, left_at_end, bottom, on_bottom = (piece.flag(k) for k in (1, 2, 3, 4))
    first, end = rows_met(m, n)
    own = in_row(m, row, (0, n - 1))
    inside = (first <= row) & (row < end)
    between = (jnp.minimum(own.first, own.last) <= column) & (
        column <= jnp.maximum(own.first, own.last)
    )
    found = piece_in(m, own, row, column, piece.curve, inside & between)

    # Crossings of the pixel's left side and of the row's bottom.
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


def _sweep_cells(
    batch: _Batch,
    cells: _Cells,
    corner: Float[Array, "C"],
    found: _InCells,
    places: Int[Array, "C M"],
) -> CellCoverage:
    """Coverage of cells by the pieces at `places` (-1: no piece); cells without pieces go
    nowhere."""
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
    conics = None if own.arcs is None or not batch.seen else own.arcs.conic
    flat = sweep(_along_x(pieces, arcs, own.rising * own.rightward), corner, conics)
    if not batch.seen:
        return CellCoverage(pixel, flat.area / scale**2, None)

    # Steep ones by the sweep along y.
    upright = sweep(_along_y(pieces, arcs, own.rising), corner, conics)
    steep, way = own.steep, pieces.high - pieces.low
    if arcs is not None:
        steep = jnp.where(arcs.there, way[..., 1] > jnp.abs(way[..., 0]), steep)
    pick = lambda a, b: jnp.where(steep.reshape(*steep.shape, *(1,) * (a.ndim - 2)), b, a)
    extent, moment, flux = jax.tree.map(pick, flat[1:], upright[1:])
    begin = _corner(batch, cells)[:, None] + pieces.corner / scale[:, None, None]
    extent, moment = extent / scale[:, None], moment / scale[:, None] ** 2
    moment += extent * pick(begin[..., 0], begin[..., 1])
    pixels = jnp.broadcast_to(pixel[:, None], places.shape)
    visible = VisiblePieces(pixels, pieces.curve, extent, moment, flux)
    visible = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), visible)
    return CellCoverage(pixel, flat.area / scale**2, visible)


def _along_x(pieces: Pieces, arcs: Arcs | None, grows: Array) -> Lines:
    """Pieces for a sweep line that moves to the right."""
    (x0, y0), (x1, y1) = (jnp.moveaxis(p, -1, 0) for p in (pieces.low, pieces.high))
    right, up = x1 >= x0, pieces.up
    u0, u1 = jnp.minimum(x0, x1), jnp.maximum(x0, x1)
    v0, v1 = jnp.where(right, y0, y1), jnp.where(right, y1, y0)
    enters = jnp.where(pieces.bottom, pieces.jump, 0)
    # Layers just above a piece on the row's bottom are counted without it.
    lies = jnp.where(pieces.on_bottom, up, 0)
    halt, step = (jnp.concatenate(x, axis=1) for x in ((x0, u0, u1), (enters, -lies, lies)))
    return Lines(u0, v0, u1, v1, up, halt, step, grows, arcs)


def _along_y(pieces: Pieces, arcs: Arcs | None, grows: Array) -> Lines:
    """Pieces for a sweep line that moves up."""
    (x0, y0), (x1, y1) = (jnp.moveaxis(p, -1, 0) for p in (pieces.low, pieces.high))
    if arcs is not None:
        arcs = arcs._replace(conic=arcs.conic[..., jnp.array([1, 0, 2])])
    return Lines(y0, x0, y1, x1, pieces.jump, pieces.left_y, pieces.left, grows, arcs)
