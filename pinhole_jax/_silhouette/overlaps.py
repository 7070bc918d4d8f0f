"""Coverage of a union, where contours overlap within a pixel.

Winding numbers add up where things overlap, coverage does not. A pixel that one chain of contour
crosses holds k layers and k+1, and the clamped sum is right. Any other pixel is resolved here: a
line sweeps it, halting where a piece begins, ends or crosses another, and between two halts the
pieces keep their order, so what is covered is a row of trapezoids (with arcs for sides). Which
pieces bound it, and over what part of their length, is all that the derivative needs.

The sweep compares areas, never asks whether two pieces touch: pieces that coincide, end on one
another or have no length put halts too close to matter, and nothing else. Pieces that are equal are
merged. Nearly all cells hold a few pieces (`NARROW`) and are swept together; those with more
(`WIDE`) are swept a few at a time. A cell with more still is cut into smaller cells, depth first,
so that memory is bounded; at the last cut (`LAST_CUT`) the corner speaks for a cell of 1/65536 px.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._numerics.bitset import listed
from .._numerics.running import running_sum
from .coverage import Monotone, Pieces, at_row, monotone, piece_counts, split
from .curves import Curves, ends, placed
from .sweep import ARC, NARROW, STRAIGHT, WIDE, Cells, Visible, empty_cells, insert, sweep

CELLS = 256
CUT = 4
PARENTS = CELLS // CUT**2
LAST_CUT = {"float32": 4, "float64": 8}
PIECES = 2048
INSERTED = 128
#: Visible pieces kept for the derivative (where there are more, cells are resolved again).
KEPT = 1 << 12
KEPT_AT_A_TIME = 512
#: The place of what is in no pixel.
NOWHERE = np.iinfo(np.int32).max
#: How many cells are swept together: of few pieces, and of more.
SWEPT = {NARROW: 128, WIDE: 8}


class Part(NamedTuple):
    """Curves of one kind: `curves(ids)` for ids below `total`; `size` is a static chunk of them.

    `lifts(ids)` is what the curves move with, differentiably. There are at most `most`, if known.
    """

    curves: Callable[[Int[Array, "K"]], Curves]
    lifts: Callable[[Int[Array, "K"]], Float[Array, "K n 3"]]
    total: Int[Array, ""]
    size: int
    most: int | None

    @property
    def straight(self) -> bool:
        """Whether its curves are segments, not arcs."""
        return self.lift.shape[-2] == 2

    @property
    def dtype(self) -> Any:
        """The float type."""
        return self.lift.dtype

    @property
    def lift(self) -> Any:
        """Shape (1, n, 3) and type of a curve's lift."""
        return jax.eval_shape(self.lifts, jnp.zeros(1, jnp.int32))


class Crowded(NamedTuple):
    """Pixels to be resolved, `total` of them.

    `cell(rank)` gives row (from the bottom), column and place of the rank-th, and the winding
    number at its lower left corner; `rank(row, column)` the rank of a pixel, -1 for others.
    """

    total: Int[Array, ""]
    cell: Callable[[Int[Array, "K"]], tuple[Array, Array, Array, Array]]
    rank: Callable[[Int[Array, "K"], Int[Array, "K"]], Int[Array, "K"]]


class Resolved(NamedTuple):
    """Some cells: the pixel's `place`, the `area` that they add to it (px^2), what is visible."""

    place: Int[Array, "C"]
    area: Float[Array, "C"]
    visible: list[Visible]


class Kept(NamedTuple):
    """The visible pieces of one part in crowded pixels, for the derivative: their places, curves
    and parts. If more than there is room for are `used`, they are not complete."""

    place: Int[Array, "N"]
    visible: Visible
    used: Int[Array, ""]

    @property
    def complete(self) -> Bool[Array, ""]:
        """Return whether all visible pieces are here."""
        return self.used <= self.place.shape[0]

    def append(self, place: Int[Array, "C"], more: Visible) -> "Kept":
        """Return these and those of cells at `place` that are visible."""
        seen = jnp.any(more.part != 0, axis=-1)
        upto = self.used + running_sum(seen.reshape(-1).astype(jnp.int32)).reshape(seen.shape)
        slot = jnp.where(seen, upto - 1, self.place.shape[0])
        put = lambda old, new: old.at[slot].set(new, mode="drop")
        place = jnp.broadcast_to(place[:, None], seen.shape)
        return Kept(put(self.place, place), jax.tree.map(put, self.visible, more), upto[-1, -1])

    def fold(self, add: Callable[[Any, Array, Visible], Any], start: Any) -> Any:
        """Return `start` after `add(total, place, visible)` over all `used`, some at a time."""

        def body(state):
            first, total = state
            cut = lambda x: jax.lax.dynamic_slice_in_dim(x, first, KEPT_AT_A_TIME)
            place, visible = jax.tree.map(cut, (self.place, self.visible))
            return first + KEPT_AT_A_TIME, add(total, place, visible)

        return jax.lax.while_loop(lambda s: s[0] < self.used, body, (jnp.int32(0), start))[1]


def nothing_kept(part: Part) -> Kept:
    """Return room for the visible pieces of a part."""
    numbers, dtype = (STRAIGHT if part.straight else ARC), part.dtype
    nowhere = jnp.full(KEPT, NOWHERE, jnp.int32)
    visible = Visible(jnp.zeros(KEPT, jnp.int32), jnp.zeros((KEPT, numbers), dtype))
    return Kept(nowhere, visible, jnp.int32(0))


def all_kept(place: Int[Array, "C"], visible: Visible) -> Kept:
    """Return all pieces of cells at `place`, visible or not."""
    place = jnp.broadcast_to(place[:, None], visible.curve.shape).reshape(-1)
    room = -place.shape[0] % KEPT_AT_A_TIME
    flat = Visible(visible.curve.reshape(-1), visible.part.reshape(-1, visible.part.shape[-1]))
    more = lambda x: jnp.pad(x, [(0, room)] + [(0, 0)] * (x.ndim - 1))
    used = jnp.int32(place.shape[0])
    return Kept(jnp.pad(place, (0, room), constant_values=NOWHERE), jax.tree.map(more, flat), used)


class _Stack(NamedTuple):
    """Cells still to be cut, by depth: the lower left corner (px) and the pixel's place."""

    origin: Float[Array, "L C 2"]
    place: Int[Array, "L C"]
    height: Int[Array, "L"]

    def deepest(self) -> Int[Array, ""]:
        """Return the deepest level that holds cells, 0 if none does."""
        levels = jnp.arange(self.height.shape[0], dtype=jnp.int32)
        return jnp.max(jnp.where(self.height > 0, levels, 0))

    def push(self, crowd: Bool[Array, "C"], level: Int[Array, ""], batch: "_Batch") -> "_Stack":
        """Return the stack less the cells just cut, with the crowded cells on top of a level."""
        left = jnp.maximum(self.height[batch.level] - PARENTS, 0)
        count = self.height.at[batch.level].set(left)
        slot = count[level] + running_sum(crowd.astype(jnp.int32)) - 1
        slot = jnp.where(crowd, slot, CELLS)
        return _Stack(
            self.origin.at[level, slot].set(batch.origin, mode="drop"),
            self.place.at[level, slot].set(batch.place, mode="drop"),
            count.at[level].add(jnp.sum(crowd, dtype=jnp.int32)),
        )


def fold_cells(
    parts: list[Part],
    crowded: Crowded,
    W: Any,
    H: Any,
    max_H: int,
    base: Int[Array, ""],
    add: Callable[[Any, Resolved], Any],
    start: Any,
    flux: bool,
) -> Any:
    """Return `start` after `add(total, resolved)` over all crowded pixels, however many.

    `base` is the number of layers left of the film. With `flux` the visible parts are worked out.
    """
    dtype = parts[0].dtype
    depth = LAST_CUT[jnp.dtype(dtype).name]
    frames = [None if part.straight else part.lifts for part in parts]

    def body(state):
        first, stack, total = state
        level = stack.deepest()
        batch = _batch(crowded, first, stack, level, (W, H, max_H), base)
        cells, corner = empty_cells(CELLS, dtype), batch.corner
        for number, part in enumerate(parts):
            cells, turns = _fill(cells, number, part, crowded, first, batch)
            corner = corner + turns
        used, last = batch.place >= 0, level == depth
        cut = used & (cells.total > WIDE) & ~last
        # Where there are too many pieces even in the last cell, its corner speaks for it.
        cells = cells._replace(total=jnp.where(cells.total > WIDE, 0, cells.total))
        swept = _Swept(cells, corner, batch.origin, jnp.where(used & ~cut, batch.place, -1))

        def resolve(total, swept: _Swept):
            at = batch.scale, swept.origin
            area, visible = sweep(swept.cells, swept.corner, frames, *at, flux)
            keep = (swept.place >= 0)[:, None, None]
            visible = [v._replace(part=jnp.where(keep, v.part, 0)) for v in visible]
            place = jnp.where(swept.place >= 0, swept.place, NOWHERE)
            return add(total, Resolved(place, area / (batch.scale * batch.scale), visible))

        total = swept.fold(resolve, total)
        stack = stack.push(cut, jnp.minimum(level + 1, depth), batch)
        return jnp.where(level == 0, first + CELLS, first), stack, total

    zeros = jnp.zeros((depth + 1, CELLS), dtype)
    counts = jnp.zeros(depth + 1, jnp.int32)
    stack = _Stack(jnp.stack([zeros, zeros], axis=-1), zeros.astype(jnp.int32), counts)
    more = lambda state: (state[0] < crowded.total) | jnp.any(state[1].height > 0)
    return jax.lax.while_loop(more, body, (jnp.int32(0), stack, start))[2]


class _Swept(NamedTuple):
    """Cells to be swept, the winding numbers at their corners, `place` -1 where there is none."""

    cells: Cells
    corner: Float[Array, "C"]
    origin: Float[Array, "C 2"]
    place: Int[Array, "C"]

    def fold(self, add: Callable[[Any, "_Swept"], Any], start: Any) -> Any:
        """Return `start` after `add(total, swept)` over the cells, those of few pieces first."""
        least = 0
        for most, number in SWEPT.items():

            def some(total, cell, there, most=most):
                place = jnp.where(there, self.place[cell], -1)
                piece, owner = self.cells.piece[cell, :most], self.cells.owner[cell, :most]
                cells = Cells(piece, owner, self.cells.total[cell])
                return add(total, _Swept(cells, self.corner[cell], self.origin[cell], place))

            total = self.cells.total
            chosen = (self.place >= 0) & (total >= least) & (total <= most)
            start = fold_chosen(chosen, number, some, start)
            least = most + 1
        return start


class _Batch(NamedTuple):
    """Cells that are resolved together, and the small films on which their pieces are found.

    At level 0 the cells are pixels of the one film; else each film is a cell that is cut. `corner`
    is what is known already of the winding numbers at the cells' corners.
    """

    level: Int[Array, ""]
    scale: Float[Array, ""]
    films: Float[Array, "F 2"]
    film: tuple[Any, Any, int]
    origin: Float[Array, "C 2"]
    place: Int[Array, "C"]
    corner: Float[Array, "C"]


def _batch(
    crowded: Crowded, first: Array, stack: _Stack, level: Array, film: tuple, base: Array
) -> _Batch:
    """Return the next cells: of the deepest level that has any, else the next pixels."""
    W, H, max_H = film
    dtype = stack.origin.dtype
    at_pixels = level == 0
    rank = first + jnp.arange(CELLS, dtype=jnp.int32)
    row, column, place, corner = crowded.cell(jnp.clip(rank, 0, jnp.maximum(crowded.total - 1, 0)))
    pixel = jnp.stack([column, row], axis=-1).astype(dtype)
    place = jnp.where(rank < crowded.total, place, -1)

    slot = stack.height[level] - PARENTS + jnp.arange(PARENTS, dtype=jnp.int32)
    parent_place = jnp.where(slot >= 0, stack.place[level, jnp.maximum(slot, 0)], -1)
    parent = stack.origin[level, jnp.maximum(slot, 0)]
    scale = jnp.asarray(CUT, dtype) ** level.astype(dtype)
    steps = np.stack(np.divmod(np.arange(CUT**2), CUT)[::-1], axis=-1)
    child = parent[:, None] + jnp.asarray(steps, dtype)[None] / scale
    return _Batch(
        level,
        scale,
        jnp.where(at_pixels, 0, parent),
        (jnp.where(at_pixels, W, CUT), jnp.where(at_pixels, H, CUT), max(max_H, CUT)),
        jnp.where(at_pixels, pixel, child.reshape(CELLS, 2)),
        jnp.where(at_pixels, place, jnp.repeat(parent_place, CUT**2)),
        jnp.where(at_pixels, corner, base.astype(dtype)),
    )


# --- which pieces lie in which cell --------------------------------------------------------------


def fold_curves(
    part: Part,
    add: Callable[[Any, Array, Curves], Any],
    start: Any,
    size: int,
    block: tuple[Any, Any] | None = None,
) -> Any:
    """Return `start` after `add(total, ids, curves)` over all curves, `size` at a time; or over a
    block of them, from its first id up to another, in whole chunks."""
    begin, end = (jnp.int32(0), part.total) if block is None else block
    end = jnp.minimum(part.total, end)

    def body(state):
        first, total = state
        ids = first + jnp.arange(size, dtype=jnp.int32)
        curves = jax.lax.stop_gradient(part.curves(jnp.minimum(ids, part.total - 1)))
        weight = jnp.where(ids < part.total, curves.weight, 0)
        return first + size, add(total, ids, curves._replace(weight=weight))

    return jax.lax.while_loop(lambda s: s[0] < end, body, (begin, start))[1]


def fold_pieces(
    curves: Curves, W: Any, H: Any, max_H: int, add: Callable[[Any, Pieces], Any], start: Any
) -> Any:
    """Return `start` after `add(total, pieces)` over all pieces of some curves."""
    m = monotone(curves)
    upto = running_sum(piece_counts(m, W, H))

    def body(state):
        slot, total = state
        slots = slot + jnp.arange(PIECES, dtype=jnp.int32)
        return slot + PIECES, add(total, split(m, upto, slots, W, H, max_H))

    return jax.lax.while_loop(lambda s: s[0] < upto[-1], body, (jnp.int32(0), start))[1]


def fold_chosen(
    which: Bool[Array, "K"], number: int, add: Callable[[Any, Array, Array], Any], start: Any
) -> Any:
    """Return `start` after `add(total, index, there)` over the chosen indices, `number` at a time.

    `there` is False for what fills up the last turn.
    """
    chosen = jax.lax.optimization_barrier(listed(which))

    def body(state):
        rank, total = state
        some = rank + jnp.arange(number, dtype=jnp.int32)
        return rank + number, add(total, chosen.at(some), some < chosen.total)

    return jax.lax.while_loop(lambda s: s[0] < chosen.total, body, (jnp.int32(0), start))[1]


def _fill(
    cells: Cells, number: int, part: Part, crowded: Crowded, first: Array, batch: _Batch
) -> tuple[Cells, Float[Array, "C"]]:
    """Return the cells with a part's pieces, and what it adds to the corners' winding numbers."""
    at_pixels = batch.level == 0
    size = -(-part.size // PARENTS) * PARENTS
    per_film = jnp.where(at_pixels, jnp.int32(size), jnp.int32(size // PARENTS))
    W, H, max_H = batch.film
    pair = jnp.arange(size, dtype=jnp.int32)
    film = jax.lax.div(pair, per_film)

    def chunk(state, ids, curves: Curves):
        near = listed((curves.weight != 0) & (at_pixels | _near(curves, batch)))

        def body(state):
            rank, (cells, corner) = state
            own = rank + pair - film * per_film
            one = near.at(own)
            some = jax.tree.map(lambda x: x[one], curves)
            some = some._replace(weight=jnp.where(own < near.total, some.weight, 0))
            some = placed(some, batch.scale, batch.films[film])

            def add(cells, pieces: Pieces):
                inside = pieces.valid & (pieces.column >= 0) & (pieces.column < W)
                row, column = (jnp.where(inside, x, 0) for x in (pieces.row, pieces.column))
                rank = crowded.rank(row, column)
                pixel = jnp.where((rank >= first) & (rank < first + CELLS), rank - first, CELLS)
                child = (film[pieces.curve] * CUT + row) * CUT + column
                cell = jnp.where(inside, jnp.where(at_pixels, pixel, child), CELLS)
                return _insert_all(cells, cell, pieces, ids[one], number)

            # Pixels know their corners.
            none = lambda: jnp.zeros_like(corner)
            corner = corner + jax.lax.cond(at_pixels, none, lambda: _child_turns(some))
            return rank + per_film, (fold_pieces(some, W, H, max_H, add, cells), corner)

        return jax.lax.while_loop(lambda s: s[0] < near.total, body, (jnp.int32(0), state))[1]

    return fold_curves(part, chunk, (cells, jnp.zeros_like(batch.corner)), size)


def _near(curves: Curves, batch: _Batch) -> Bool[Array, "K"]:
    """Return which curves are in or left of a film of the batch, or close to it (in px)."""
    start, end = ends(curves)
    low, high = jnp.minimum(start, end)[:, None], jnp.maximum(start, end)[:, 1:]
    margin = 0.5
    bottom = batch.films - margin
    top = batch.films + CUT / batch.scale + margin
    beside = (low[..., 1] <= top[None, :, 1]) & (high >= bottom[None, :, 1])
    return jnp.any(beside & (low[..., 0] <= top[None, :, 0]), axis=1)


def _insert_all(cells: Cells, cell: Int[Array, "P"], pieces: Pieces, ids: Array, part: int):
    """Return the cells with those pieces that have one, `INSERTED` at a time."""

    def some(cells, index, there):
        taken = jax.tree.map(lambda x: x[index], pieces)
        at = jnp.where(there, cell[index], CELLS)
        return insert(cells, at, taken, ids[taken.curve], part)

    return fold_chosen(cell < CELLS, INSERTED, some, cells)


def _child_turns(curves: Curves) -> Float[Array, "C"]:
    """Return what curves, those of each film in turn, add to the winding numbers just left of and
    above the children's corners."""
    lines = jnp.arange(CUT, dtype=curves.weight.dtype)
    m = monotone(curves)
    jump, x = jax.vmap(lambda y: _crossing(m, y))(lines)  # (CUT, curves)
    left = jnp.where(x[..., None] < lines[None, None], jump[..., None], 0)
    turns = jnp.sum(left.reshape(CUT, PARENTS, -1, CUT), axis=2)
    return jnp.moveaxis(turns, 1, 0).reshape(CELLS)


def _crossing(m: Monotone, y: Float[Array, ""]):
    """Return by how much the winding jumps where each curve crosses a height, and the abscissae."""
    crosses = (m.low[:, 1] <= y) & (y < m.high[:, 1])
    x, _ = at_row(m, jnp.broadcast_to(y, crosses.shape))
    return jnp.where(crosses, -m.rising * m.curves.weight, 0), x
