"""Coverage of a union, where contours overlap within a pixel.

Winding numbers add up where things overlap, coverage does not. A pixel that one chain of contour
crosses holds k layers and k+1, and the clamped sum is right. Any other pixel is resolved here: a
line sweeps it, halting where a piece begins, ends or crosses another, and between two halts the
pieces keep their order, so what is covered is a row of trapezoids (with arcs for sides). Which
pieces bound it, and over what part of their length, is all that the derivative needs.

The sweep compares areas, never asks whether two pieces touch: pieces that coincide, end on one
another or have no length put halts too close to matter, and nothing else. Equal pieces are merged.

On a CPU pixels are resolved one after the other, by compiled loops (`in_turn.py`). On other
machines many are at once: pieces are listed cell by cell, and cells that hold a few (up to `WIDE`)
are swept together, in large scenes but for those whose pieces are all hidden (`hidden.py`). A pixel
with more than can be swept is cut into smaller cells, either way. Nearly all of these are covered
whatever their pieces do, and are passed over; those with too many are cut again, depth first, so
that memory is bounded. At the last cut (`LAST_CUT`, `LAST_FILM`) the corner speaks for a cell of
1/65536 px.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._numerics.batches import in_chunks
from .._numerics.bitset import Selection, count_below, count_upto, nth, rank_in, select
from .._numerics.one_kernel import by_machine, one_by_one, one_kernel, put
from .._numerics.running import running_sum
from . import in_turn
from .asked import Corners
from .coverage import Monotone, Pieces, monotone, piece_counts, split
from .curves import placed
from .hidden import all_hidden
from .marks import drops, winding_jumps
from .parts import CurveList, Part
from .sweep import ARC, STRAIGHT, Cells, Visible, sweep, sweepable

#: This many pieces a cell holds at most that are swept together, and how many such cells are swept
#: together, and looked at for whether all of their pieces are hidden.
NARROW, WIDE = 8, 24
SWEPT = {NARROW: 128, WIDE: 32}
#: The same where lines stop at equal distances.
CROWDED = 64
SWEPT_BY_STOPS = {NARROW: 128, WIDE: 64, CROWDED: 32}
#: A cell is cut into `CUT` x `CUT`.
CUT = 4
LAST_CUT = {"float32": 4, "float64": 8}
PIECES = 1024
#: At least and at most this many pieces can be listed, one for this many curves that there may be.
LEAST_CAPACITY, CAPACITY, CURVES_A_PIECE = 1 << 13, 1 << 15, 2
#: Where there may be more pieces than this, cells are looked for whose pieces are all hidden.
HIDDEN_FROM = LEAST_CAPACITY
#: One after the other: at most so many pieces are listed, so many for each cell; and so often a
#: cell is cut.
IN_TURN, PIECES_A_CELL = 1 << 16, 4
LAST_FILM = {"float32": 2, "float64": 4}
#: Visible pieces kept for the derivative (where there are more, cells are resolved again).
KEPT = 1 << 12
KEPT_AT_A_TIME = 512
#: The place of what is in no pixel.
NOWHERE = np.iinfo(np.int32).max


class Overlapping(NamedTuple):
    """Pixels to be resolved, `total` of them, row by row from the bottom, from left to right.

    `chosen` are their places, rows of `width` bits of a film of W x H pixels; `layers` how many
    layers the pieces in each word's pixels have; `corners` the winding numbers at the pixels'.
    """

    chosen: Selection
    layers: Float[Array, "words"]
    corners: Corners
    total: Int[Array, ""]
    width: int
    W: int
    H: int

    def cell(self, number: Int[Array, "K"]) -> tuple[Array, Array, Array, Array]:
        """Return row (from the bottom), column and place of pixels, and about how many layers
        their pieces have."""
        index = nth(self.chosen, number)
        word = index >> 5
        # (Those of a word share its layers.)
        shared = jax.lax.population_count(self.chosen.words[word]).astype(self.layers.dtype)
        room = jnp.ceil(self.layers[word] / jnp.maximum(shared, 1))
        room = jnp.minimum(room, np.iinfo(np.int32).max // 2).astype(jnp.int32)
        row, column = _row_and_column(index, self.width)
        return row, column, place_of(index, self.width, self.W, self.H), room

    def rank(self, row: Int[Array, "K"], column: Int[Array, "K"]) -> Int[Array, "K"]:
        """Return the numbers of pixels, -1 for others."""
        return rank_in(self.chosen, row * self.width + column)

    def below(self, row: Int[Array, "K"], column: Int[Array, "K"]) -> Int[Array, "K"]:
        """Return how many come before pixels."""
        return count_below(self.chosen, row * self.width + column)


def _row_and_column(index: Int[Array, "*K"], width: int) -> tuple[Array, Array]:
    """Return row (from the bottom) and column of bits, so many to a row."""
    row = jax.lax.div(index, jnp.int32(width))
    return row, index - row * width


def place_of(index: Int[Array, "*K"], width: int, W: int, H: int) -> Int[Array, "*K"]:
    """Return where the pixels of bits are in an image of W x H pixels."""
    row, column = _row_and_column(index, width)
    return (H - 1 - row) * W + column


class Resolved(NamedTuple):
    """Some cells: the pixel's `place`, the `area` that they add to it (px^2), and of each part what
    is visible, if that was asked for and anything may be."""

    place: Int[Array, "C"]
    area: Float[Array, "C"]
    visible: list[Visible]


class Kept(NamedTuple):
    """The visible pieces of one part in overlapping pixels, for the derivative: their places,
    curves and parts. If more than there is room for are `used`, they are not complete."""

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

        def chunk(total, first):
            cut = lambda x: jax.lax.dynamic_slice_in_dim(x, first, KEPT_AT_A_TIME)
            return add(total, *jax.tree.map(cut, (self.place, self.visible)))

        return in_chunks(chunk, start, KEPT_AT_A_TIME, self.used)


def nothing_kept(part: Part) -> Kept:
    """Return room for the visible pieces of a part."""
    numbers, dtype = (STRAIGHT if part.straight else ARC), part.dtype
    nowhere = jnp.full(KEPT, NOWHERE, jnp.int32)
    visible = Visible(jnp.zeros(KEPT, jnp.int32), jnp.zeros((KEPT, numbers), dtype))
    return Kept(nowhere, visible, jnp.int32(0))


def all_kept(place: Int[Array, "C"], visible: Visible) -> Kept:
    """Return all pieces of cells at `place`, visible or not, up to the last that is anywhere."""
    place = jnp.broadcast_to(place[:, None], visible.curve.shape).reshape(-1)
    capacity = -place.shape[0] % KEPT_AT_A_TIME
    upto = jnp.arange(1, place.shape[0] + 1, dtype=jnp.int32)
    used = jnp.max(jnp.where(place == NOWHERE, 0, upto))
    flat = Visible(visible.curve.reshape(-1), visible.part.reshape(-1, visible.part.shape[-1]))
    more = lambda x: jnp.pad(x, [(0, capacity)] + [(0, 0)] * (x.ndim - 1))
    return Kept(
        jnp.pad(place, (0, capacity), constant_values=NOWHERE), jax.tree.map(more, flat), used
    )


class _Sizes(NamedTuple):
    """How many cells a batch has and how many pieces are found at a time; how many can be listed,
    level by level."""

    cells: int
    pieces: int
    capacities: list[int]

    @property
    def films(self) -> int:
        """How many cells are cut together."""
        return self.cells // CUT**2

    @staticmethod
    def of(parts: list[Part], depth: int) -> "_Sizes":
        """Return what suits a scene: large buffers take time even where they stay empty."""
        most = sum(part.most or CURVES_A_PIECE * CAPACITY for part in parts)
        capacity = LEAST_CAPACITY
        while capacity < min(most // CURVES_A_PIECE, CAPACITY):
            capacity *= 2
        cells, pieces = min(max(capacity // 16, 256), 2048), min(max(capacity // 8, 512), PIECES)
        # Few cells are cut twice.
        return _Sizes(
            cells,
            pieces,
            [capacity, capacity, *[max(capacity // 8, 32)] * (depth - 1)][: depth + 1],
        )


class _Stack(NamedTuple):
    """Cells still to be cut, by depth: the lower left corner (px), the pixel's place, the winding
    number at the corner, and where in the lists its pieces are (`begin` -1: there was no room for
    them)."""

    origin: Float[Array, "L C 2"]
    place: Int[Array, "L C"]
    corner: Float[Array, "L C"]
    begin: Int[Array, "L C"]
    number: Int[Array, "L C"]
    height: Int[Array, "L"]

    @staticmethod
    def empty(sizes: _Sizes, dtype: Any) -> "_Stack":
        """Return a stack without cells."""
        depth = len(sizes.capacities) - 1
        levels = (depth + 1, sizes.cells)
        whole, real = jnp.zeros(levels, jnp.int32), jnp.zeros(levels, dtype)
        origin = jnp.zeros((*levels, 2), dtype)
        return _Stack(origin, whole, real, whole, whole, jnp.zeros(depth + 1, jnp.int32))

    def deepest(self) -> Int[Array, ""]:
        """Return the deepest level that holds cells, 0 if none does."""
        levels = jnp.arange(self.height.shape[0], dtype=jnp.int32)
        return jnp.max(jnp.where(self.height > 0, levels, 0))

    def push(self, which: Bool[Array, "C"], level: Int[Array, ""], cells: "_Cells") -> "_Stack":
        """Return the stack with some cells on top of a level that is empty."""
        slot = jnp.where(which, running_sum(which.astype(jnp.int32)) - 1, which.shape[0])
        put = lambda old, new: old.at[level, slot].set(new, mode="drop")
        return _Stack(
            put(self.origin, cells.origin),
            put(self.place, cells.place),
            put(self.corner, cells.corner),
            put(self.begin, jnp.where(cells.fits, cells.begin, -1)),
            put(self.number, cells.number),
            self.height.at[level].add(jnp.sum(which, dtype=jnp.int32)),
        )


class _Lists(NamedTuple):
    """The pieces of cells, cell by cell (see `Cells`), each with its curve (times 2, plus its
    part's number) and its cell's stamp. Those of a batch stay until the next one of its level.

    `table` finds a piece by a hash of its cell and ends: equal ones are merged.
    """

    piece: Float[Array, "N 6"]
    curve: Int[Array, "N"]
    stamp: Int[Array, "N"]
    table: Int[Array, "T"]

    @staticmethod
    def empty(sizes: _Sizes, dtype: Any) -> "_Lists":
        """Return lists without pieces."""
        N = sum(sizes.capacities)
        whole = lambda n: jnp.zeros(n, jnp.int32)
        return _Lists(jnp.zeros((N, 6), dtype), whole(N), whole(N) - 1, whole(2 * N))


class _Batch(NamedTuple):
    """Cells that are resolved together: pixels of the one film (level 0), or the parts of some
    cells that are cut, each a small film of its own.

    `W`, `bottom` and `top` are what is looked at of the films, `scale` the number of their pixels
    in a pixel. `begin` and `number` tell where in the lists the pieces of each film are (`begin`
    -1: all curves are looked at). `corner` is the winding number at each cell's film's lower left
    corner, `row` the cell's in the film. The lists of the cells have `capacity` from `listed` on.
    `stamp` is the first cell's.
    """

    level: Int[Array, ""]
    scale: Float[Array, ""]
    films: Float[Array, "F 2"]
    begin: Int[Array, "F"]
    number: Int[Array, "F"]
    W: Int[Array, ""]
    bottom: Int[Array, ""]
    top: Int[Array, ""]
    max_H: int
    first: Int[Array, ""]
    origin: Float[Array, "C 2"]
    place: Int[Array, "C"]
    corner: Float[Array, "C"]
    row: Int[Array, "C"]
    listed: Int[Array, ""]
    capacity: Int[Array, ""]
    stamp: Int[Array, ""]
    sizes: _Sizes


class _Sums(NamedTuple):
    """What the pieces of cells add up to: `layers`, `drops`, and by how much the winding number
    changes along a film's left side up to a row (`side`, at the row's first cell), and from there
    along the row's bottom (`jump`)."""

    layers: Float[Array, "C"]
    drop: Float[Array, "C"]
    side: Float[Array, "C"]
    jump: Float[Array, "C"]


class _Cells(NamedTuple):
    """A batch's cells: which of them hold pieces that may be seen (`open`), where in the lists
    these begin, whether there is room for them, and how many there are."""

    origin: Float[Array, "C 2"]
    place: Int[Array, "C"]
    corner: Float[Array, "C"]
    open: Bool[Array, "C"]
    begin: Int[Array, "C"]
    fits: Bool[Array, "C"]
    number: Int[Array, "C"]


def fold_cells(
    parts: list[Part],
    overlapping: Overlapping,
    W: Any,
    max_H: int,
    base: Int[Array, ""],
    add: Callable[[Any, Resolved], Any],
    start: Any,
    flux: bool,
    stops: Int[Array, ""] | None = None,
    lists: list[CurveList] | None = None,
) -> Any:
    """Return `start` after `add(total, resolved)` over all overlapping pixels, however many.

    `base` is the number of layers left of the film. With `flux` the visible parts are worked out.
    With `stops` lines sweep a pixel that stop this many times, at equal distances (see `sweep`).
    `lists` are of the parts' curves, if there are such.
    """
    film = W, max_H, base

    def turn(start):
        # (As many pieces at a time as are kept: what is done with these is one kernel then.)
        more = lists, KEPT
        return fold_in_turn(parts, overlapping, film, add, start, flux, stops, *more)

    def beside(start):
        return fold_side_by_side(parts, overlapping, film, add, start, flux, stops)

    return by_machine(start, cpu=turn, elsewhere=beside)


# --- one after the other -------------------------------------------------------------------------


class _Films(NamedTuple):
    """Cells that are films of their own, the last one first: how far they are cut, the pixel's
    place, the corner (px); `height` of them."""

    level: Int[Array, "K"]
    place: Int[Array, "K"]
    x: Float[Array, "K"]
    y: Float[Array, "K"]
    height: Int[Array, ""]

    @staticmethod
    def empty(number: int, dtype: Any) -> "_Films":
        """Return room for so many."""
        whole, real = jnp.zeros(number, jnp.int32), jnp.zeros(number, dtype)
        return _Films(whole, whole, real, real, jnp.int32(0))


def fold_in_turn(
    parts: list[Part],
    overlapping: Overlapping,
    film: tuple[Any, int, Int[Array, ""]],
    add: Callable[[Any, Resolved], Any],
    start: Any,
    flux: bool,
    stops: Int[Array, ""] | None,
    lists: list[CurveList] | None = None,
    shown_at_a_time: int = KEPT_AT_A_TIME,
) -> Any:
    """Return what `fold_cells` does, one pixel after the other; `lists` of the parts' curves, if
    there are such; what is visible is handed over some pieces at a time."""
    dtype, depth = parts[0].dtype, LAST_FILM[jnp.dtype(parts[0].dtype).name]
    room = LEAST_CAPACITY
    while room < min(sum(part.most or IN_TURN for part in parts), IN_TURN):
        room *= 2
    number = max(room // PIECES_A_CELL, in_turn.CUT**2)
    arcs = next((k for k, part in enumerate(parts) if not part.straight), None)
    manner = in_turn.Manner(arcs, flux, stops is not None)
    has_all = lists is not None

    def body(state):
        turn, cells, lists, total = state

        def resolved():
            found = _next_cells(overlapping, film[:2], turn, cells, tiles)
            where, listed, again = found.where(overlapping, turn.first), empty, []
            for number, (part, known) in enumerate(zip(parts, lists, strict=True)):
                more = lambda listed, curves, first, count, number=number: listed.append(
                    where, number, curves, first, count
                )
                listed, known = known.fold(part, more, listed, has_all)
                again.append(known)
            last = (found.level >= depth).astype(jnp.int32)
            base = film[2].astype(dtype)
            row, at, corner = found.cells
            swept = in_turn.swept(
                manner, listed, where, row, at, corner, base, last, stops_of(found)
            )
            after = one_kernel(partial(_after, room // 2))(turn, found, swept, listed.used)
            return swept, after, found.cells, again

        swept, turn, cells, lists = one_by_one(resolved)
        total = add(total, Resolved(cells.at.place, swept.area, []))
        if flux:
            total = _fold_shown(parts, swept, shown_at_a_time, add, total)
        return turn, cells, lists, total

    def stops_of(found: _Next) -> Array | None:
        return None if stops is None else -(-stops // jnp.int32(in_turn.CUT) ** found.level)

    more = lambda state: (state[0].first < overlapping.total) | (state[0].films.height > 0)
    empty = in_turn.Listed.empty(room, number, arcs is not None, dtype)
    films = _Films.empty(number + depth * in_turn.CUT**2, dtype)
    lists = [CurveList.empty(part) for part in parts] if lists is None else lists
    turn, cells = _Turn(jnp.int32(0), jnp.int32(number), films), _CellsAt.empty(number, dtype)
    tiles = jnp.zeros(in_turn.tiles_of(overlapping.width, overlapping.H), jnp.uint32)
    return jax.lax.while_loop(more, body, (turn, cells, lists, start))[-1]


class _Turn(NamedTuple):
    """Whose turn it is: the pixels from the `first` on, at most `limit` of them, but before them
    the last of the films."""

    first: Int[Array, ""]
    limit: Int[Array, ""]
    films: _Films


class _CellsAt(NamedTuple):
    """Rows of cells, and where they are; those past the last one are `NOWHERE`. Of pixels the
    winding number at the `corner`."""

    row: Int[Array, "C"]
    at: in_turn.At
    corner: Float[Array, "C"]

    @staticmethod
    def empty(number: int, dtype: Any) -> "_CellsAt":
        """Return room for so many."""
        whole, real = jnp.zeros(number, jnp.int32), jnp.zeros(number, dtype)
        return _CellsAt(whole, in_turn.At(whole, real, real), real)


class _Next(NamedTuple):
    """The next cells: those of a film, or (`whole`) pixels; how far they are cut, and as in
    `in_turn.Where`."""

    cells: _CellsAt
    tiles: UInt32[Array, "tiles"]
    level: Int[Array, ""]
    scale: Float[Array, ""]
    origin: Float[Array, "2"]
    whole: Int[Array, ""]
    number: Int[Array, ""]
    bottom: Int[Array, ""]
    top: Int[Array, ""]
    W: Int[Array, ""]
    H: Int[Array, ""]

    def where(self, overlapping: Overlapping, first: Int[Array, ""]) -> in_turn.Where:
        """Return these cells of a film, if they are pixels from the `first` on."""
        return in_turn.Where(
            self.scale,
            self.origin,
            self.whole,
            *overlapping.chosen,
            jnp.where(overlapping.corners.known, 1 - self.whole, 1),
            self.tiles,
            jnp.int32(overlapping.width),
            first,
            self.number,
            self.bottom,
            self.top,
            self.W,
            self.H,
        )


def _next_cells(
    overlapping: Overlapping,
    film: tuple[Any, int],
    turn: _Turn,
    cells: _CellsAt,
    tiles: UInt32[Array, "tiles"],
) -> _Next:
    """Return the next cells, in the place of others, and which tiles they are in."""
    whole = overlapping.width, overlapping.W, overlapping.H
    size = tuple(jnp.int32(x) for x in film)
    kernel = one_kernel(partial(_cells_found, whole))
    chosen = overlapping.chosen._replace(total=overlapping.total)
    return kernel(chosen, overlapping.corners, size, turn, cells, tiles)


def _cells_found(
    whole_film: tuple[int, int, int],
    chosen: Selection,
    corners: Corners,
    size: tuple[Array, Array],
    turn: _Turn,
    cells: _CellsAt,
    tiles: UInt32[Array, "tiles"],
) -> _Next:
    """Return the next cells of a whole film (its row's bits, W, H) or of one that a cell is."""
    first, limit, films = turn
    width, W, H = whole_film
    whole, top, cut = films.height == 0, jnp.maximum(films.height - 1, 0), jnp.int32(in_turn.CUT)
    level, place = jnp.where(whole, 0, films.level[top]), films.place[top]
    x, y, dtype = films.x[top], films.y[top], films.x.dtype
    scale = jnp.asarray(in_turn.CUT, dtype) ** level.astype(dtype)
    number = jnp.where(whole, jnp.minimum(limit, chosen.total - first), cut * cut)

    def one(k, state):
        (rows, at, corner), tiles = state
        index = nth(chosen, (first + jnp.where(whole, k, 0))[None])[0]
        row, column = _row_and_column(index, width)
        own_row = jax.lax.div(k, cut)
        own_x, own_y = (v.astype(dtype) / scale for v in (k - own_row * cut, own_row))
        at = in_turn.At(
            put(at.place, jnp.where(whole, (H - 1 - row) * W + column, place), k),
            put(at.x, jnp.where(whole, column.astype(dtype), x + own_x), k),
            put(at.y, jnp.where(whole, row.astype(dtype), y + own_y), k),
        )
        cells = _CellsAt(
            put(rows, jnp.where(whole, row, own_row), k), at, put(corner, corners.at(index), k)
        )
        return cells, in_turn.with_pixel(tiles, width, row, column)

    cells, tiles = jax.lax.fori_loop(jnp.int32(0), number, one, (cells, tiles))
    last = jnp.int32(cells.row.shape[0])
    none = lambda k, place: put(place, NOWHERE, k)
    places = jax.lax.fori_loop(number, last, none, cells.at.place)
    cells = cells._replace(at=cells.at._replace(place=places))
    either = lambda a, b: jnp.where(whole, a, b).astype(jnp.int32)
    return _Next(
        cells,
        tiles,
        level,
        scale,
        jnp.where(whole, 0, jnp.stack([x, y])),
        whole.astype(jnp.int32),
        number,
        either(cells.row[0], 0),
        either(cells.row[jnp.maximum(number - 1, 0)] + 1, cut),
        *(either(x, cut) for x in size),
    )


def _after(
    half: int, turn: _Turn, found: _Next, swept: in_turn.Swept, used: Int[Array, ""]
) -> _Turn:
    """Return whose turn it is after some cells; those with too many pieces are films."""
    first, limit, films = turn
    whole, done, cells = found.whole > 0, swept.fits == found.number, found.cells
    most = cells.row.shape[0]
    height = jnp.where(whole, 0, films.height - 1)

    def push(k, films: _Films) -> _Films:
        slot, cell = height + k, swept.crowded[k]
        return films._replace(
            level=put(films.level, found.level + 1, slot),
            place=put(films.place, cells.at.place[cell], slot),
            x=put(films.x, cells.at.x[cell], slot),
            y=put(films.y, cells.at.y[cell], slot),
        )

    films = jax.lax.fori_loop(jnp.int32(0), swept.left, push, films)
    wider = jnp.where(used < half, jnp.minimum(2 * limit, most), limit)
    limit = jnp.where(whole, jnp.where(done, wider, swept.fits), limit)
    first = jnp.where(whole & done, first + found.number, first)
    return _Turn(first, limit, films._replace(height=height + swept.left))


def _fold_shown(
    parts: list[Part],
    swept: in_turn.Swept,
    at_a_time: int,
    add: Callable[[Any, Resolved], Any],
    start: Any,
) -> Any:
    """Return `start` after `add(total, resolved)` over what is visible, some pieces at a time."""
    seen, code, places, shown = swept.seen, swept.code, swept.place, swept.shown
    assert shown is not None
    assert seen is not None
    assert code is not None
    assert places is not None

    some = min(at_a_time, len(code))

    def chunk(total, first):
        cut = lambda x: jax.lax.dynamic_slice_in_dim(x, first, some)
        # (Where it reaches past the end, the slice begins earlier.)
        index = jnp.minimum(first, len(code) - some) + jnp.arange(some, dtype=jnp.int32)
        there = (index >= first) & (index < shown)
        own_code, row = cut(code), cut(seen)
        visible = []
        for number, part in enumerate(parts):
            own = (there & (own_code & 1 == number))[:, None]
            value = jnp.where(own, row[:, : STRAIGHT if part.straight else ARC], 0)
            visible.append(Visible((own_code >> 1)[:, None], value[:, None]))
        place = jnp.where(there, cut(places), NOWHERE)
        return add(total, Resolved(place, jnp.zeros(some, seen.dtype), visible))

    return in_chunks(chunk, start, some, shown)


# --- side by side --------------------------------------------------------------------------------


def fold_side_by_side(
    parts: list[Part],
    overlapping: Overlapping,
    film: tuple[Any, int, Int[Array, ""]],
    add: Callable[[Any, Resolved], Any],
    start: Any,
    flux: bool,
    stops: Int[Array, ""] | None,
    lists: list[CurveList] | None = None,
) -> Any:
    """Return what `fold_cells` does, of vectors of cells, which need no `lists` of curves."""
    del lists
    dtype = parts[0].dtype
    depth = LAST_CUT[jnp.dtype(dtype).name]
    frames = [None if part.straight else part.homogeneous_of for part in parts]
    sizes = _Sizes.of(parts, depth)
    swept_by = SWEPT if stops is None else SWEPT_BY_STOPS
    widest = max(swept_by)
    looks = stops is None and sizes.capacities[0] > HIDDEN_FROM

    def body(state):
        first, stamp, stack, found, lists, total = state
        level = stack.deepest()
        batch, taken, height = _batch(overlapping, first, stack, level, film, stamp, sizes)
        stack = stack._replace(height=stack.height.at[level].set(height))
        cells, found, lists = _listed(parts, overlapping, batch, found, lists)

        there, last = cells.place >= 0, level == depth
        if looks and all(part.straight for part in parts):
            cells = _without_hidden(cells, lists)
        cut = there & cells.open & (~cells.fits | (cells.number > widest)) & ~last
        swept = there & cells.open & cells.fits & (cells.number <= widest)
        # Where there are too many pieces even in the last cell, its corner speaks for it.
        known = there & ~cut & ~swept
        size = 1 / (batch.scale * batch.scale)
        area = jnp.where(known, size * (cells.corner > 0.5).astype(dtype), 0)
        total = add(total, Resolved(jnp.where(known, cells.place, NOWHERE), area, []))

        least = 0
        # (As far apart in parts of a pixel as in a whole one.)
        own_stops = None if stops is None else -(-stops // CUT**level)
        for most, number in swept_by.items():

            def some(total, cell, there, most=most):
                few = _first_pieces(cells, lists, cell, there, most)
                at = batch.scale, cells.origin[cell]
                area, visible = sweep(few, cells.corner[cell], frames, *at, flux, own_stops)
                visible = [
                    v._replace(part=jnp.where(there[:, None, None], v.part, 0)) for v in visible
                ]
                place = jnp.where(there, cells.place[cell], NOWHERE)
                return add(total, Resolved(place, area * size, visible))

            chosen = swept & (cells.number >= least) & (cells.number <= most)
            total = fold_chosen(select(chosen), number, some, total)
            least = most + 1
        stack = stack.push(cut, jnp.minimum(level + 1, depth), cells)
        return first + taken, stamp + sizes.cells, stack, found, lists, total

    more = lambda state: (state[0] < overlapping.total) | jnp.any(state[2].height > 0)
    zero = jnp.int32(0)
    nothing = tuple(kind.empty(sizes, dtype) for kind in (_Stack, _Found, _Lists))
    return jax.lax.while_loop(more, body, (zero, zero, *nothing, start))[-1]


def _first_pieces(cells: "_Cells", lists: _Lists, cell: Array, there: Array, most: int) -> Cells:
    """Return the first pieces of some cells, none where nothing is `there`."""
    slot = jnp.arange(most, dtype=jnp.int32)[None]
    inside = there[:, None] & (slot < cells.number[cell][:, None])
    index = jnp.where(inside, cells.begin[cell][:, None] + slot, 0)
    curve = lists.curve[index]
    piece = jnp.where(inside[..., None], lists.piece[index], 0)
    owner = jnp.where(inside, curve & 1, -1), curve >> 1
    return Cells(piece, jnp.stack(owner, axis=-1))


def _without_hidden(cells: "_Cells", lists: _Lists) -> "_Cells":
    """Return cells; those whose pieces are all hidden are no longer open."""
    least, open_ = 0, cells.open
    for most, number in SWEPT.items():

        def some(open_, cell, there, most=most):
            few = _first_pieces(cells, lists, cell, there, most)
            hidden = there & all_hidden(few, cells.corner[cell])
            return open_.at[jnp.where(hidden, cell, len(open_))].set(False, mode="drop")

        chosen = cells.open & cells.fits & (cells.place >= 0)
        chosen &= (cells.number > least) & (cells.number <= most)
        open_ = fold_chosen(select(chosen), number, some, open_)
        least = most
    return cells._replace(open=open_)


def _batch(
    overlapping: Overlapping,
    first: Array,
    stack: _Stack,
    level: Array,
    film: tuple,
    stamp: Array,
    sizes: _Sizes,
) -> tuple[_Batch, Array, Array]:
    """Return the next cells: parts of the deepest level's that has any, else the next pixels; how
    many pixels are taken, and how high the level's stack is without what is taken."""
    W, max_H, base = film
    dtype, capacity = stack.origin.dtype, jnp.asarray(sizes.capacities, jnp.int32)[level]
    at_pixels = level == 0
    rank = first + jnp.arange(sizes.cells, dtype=jnp.int32)
    last = jnp.maximum(overlapping.total - 1, 0)
    row, column, place, layers = overlapping.cell(jnp.clip(rank, 0, last))
    there = rank < overlapping.total
    upto = running_sum(jnp.where(there, jnp.minimum(layers, sizes.capacities[0] + 1), 0))
    # (The image's pieces may be rounded otherwise, and be others.)
    there &= (upto <= capacity - capacity // 8) | (rank == first)
    pixels = jnp.sum(there, dtype=jnp.int32)

    number_asked = jnp.arange(sizes.films, dtype=jnp.int32)
    slot = stack.height[level] - 1 - number_asked
    own = jnp.maximum(slot, 0)
    begin, number = stack.begin[level, own], stack.number[level, own]
    # As many as there is room for, whatever becomes of their pieces.
    needed = running_sum(jnp.where(begin < 0, capacity, jnp.minimum(number, capacity)))
    cut = (slot >= 0) & (((2 * CUT - 1) * needed <= capacity) | (number_asked == 0))
    parents = jnp.sum(cut, dtype=jnp.int32)

    scale = jnp.asarray(CUT, dtype) ** level.astype(dtype)
    parent = stack.origin[level, own]
    steps = np.stack(np.divmod(np.arange(CUT**2), CUT)[::-1], axis=-1)
    child = parent[:, None] + jnp.asarray(steps, dtype)[None] / scale
    each = lambda x: jnp.repeat(x, CUT**2)
    pixel = jnp.stack([column, row], axis=-1).astype(dtype)
    either = lambda a, b: jnp.where(at_pixels, a, b)
    used = jnp.where(there, row, row[0])
    batch = _Batch(
        level=level,
        scale=scale,
        films=either(0, parent),
        begin=either(-1, begin),
        number=either(0, jnp.where(cut, number, 0)),
        W=either(W, CUT),
        bottom=either(row[0], 0),
        top=either(jnp.max(used) + 1, CUT),
        max_H=max(max_H, CUT),
        first=first,
        origin=either(pixel, child.reshape(sizes.cells, 2)),
        place=either(
            jnp.where(there, place, -1), each(jnp.where(cut, stack.place[level, own], -1))
        ),
        corner=jnp.where(
            at_pixels | each(begin < 0), base.astype(dtype), each(stack.corner[level, own])
        ),
        row=row,
        listed=jnp.asarray(np.cumsum([0, *sizes.capacities[:-1]]), jnp.int32)[level],
        capacity=capacity,
        stamp=stamp,
        sizes=sizes,
    )
    height = jnp.where(at_pixels, 0, stack.height[level] - parents)
    return batch, jnp.where(at_pixels, pixels, 0), height


# --- which pieces lie in which cell --------------------------------------------------------------


def fold_pieces(
    m: Monotone,
    size: tuple[Any, Any, int],
    add: Callable[[Any, Pieces], Any],
    start: Any,
    bottom: Any = 0,
    number: int = PIECES,
) -> Any:
    """Return `start` after `add(total, pieces)` over all pieces of some curves, in the rows from
    `bottom` up to H, this many at a time; `size` is W, H and a static bound of H."""
    W, H, max_H = size
    upto = running_sum(piece_counts(m, W, H, bottom))

    def chunk(total, slot):
        slots = slot + jnp.arange(number, dtype=jnp.int32)
        return add(total, split(m, upto, slots, W, H, max_H, bottom))

    return in_chunks(chunk, start, number, upto[-1])


def fold_chosen(
    chosen: Selection, number: int, add: Callable[[Any, Array, Array], Any], start: Any
) -> Any:
    """Return `start` after `add(total, index, there)` over the chosen indices, `number` at a time.

    `there` is False for what fills up the last turn.
    """

    def chunk(total, rank):
        some = rank + jnp.arange(number, dtype=jnp.int32)
        there = some < chosen.total
        index = jnp.where(there, nth(chosen, jnp.minimum(some, chosen.total - 1)), 0)
        return add(total, index, there)

    return in_chunks(chunk, start, number, chosen.total)


class _Found(NamedTuple):
    """The pieces of a batch in the order in which they are found (see `_Lists`), with their cells:
    `used` of them; here are those that there is room for."""

    piece: tuple[Float[Array, "R"], ...]
    curve: Int[Array, "R"]
    cell: Int[Array, "R"]
    used: Int[Array, ""]

    @staticmethod
    def empty(sizes: _Sizes, dtype: Any) -> "_Found":
        """Return room for pieces."""
        capacity = max(sizes.capacities) + sizes.pieces
        whole = jnp.zeros(capacity, jnp.int32)
        return _Found((jnp.zeros(capacity, dtype),) * 6, whole, whole, jnp.int32(0))

    def append(
        self, cell: Int[Array, "P"], there: Bool[Array, "P"], pieces: Pieces, curve: Array
    ) -> "_Found":
        """Return these and more pieces, of those that are there."""
        upto = self.used + running_sum(there.astype(jnp.int32))
        slot = jnp.where(there, upto - 1, self.cell.shape[0])
        put = lambda old, new: old.at[slot].set(new, mode="drop")
        # Column by column: each column of a table of them would be worked out for all.
        piece = jax.tree.map(put, self.piece, sweepable(pieces))
        return _Found(piece, put(self.curve, curve), put(self.cell, cell), upto[-1])


def _listed(
    parts: list[Part], overlapping: Overlapping, batch: _Batch, found: _Found, lists: _Lists
) -> tuple[_Cells, _Found, _Lists]:
    """Return a batch's cells, and the lists with the pieces of those that have to be resolved.

    Of the parts of cells winding numbers and layers are added up first: most are covered whatever
    their pieces do, and are passed over.
    """
    none, sizes = jnp.zeros_like(batch.corner), batch.sizes
    sums, found = _Sums(none, none, none, none), found._replace(used=jnp.int32(0))
    for number, part in enumerate(parts):
        sums, found = _gone_through(number, part, overlapping, batch, lists, (sums, found))
    cells = _cells(batch, sums)
    cells = cells._replace(fits=cells.fits & (found.used <= batch.capacity))
    listed = cells.open & cells.fits & (cells.place >= 0)

    def some(state, first):
        cut = lambda x: jax.lax.dynamic_slice_in_dim(x, first, sizes.pieces)
        piece = jnp.stack([cut(x) for x in found.piece], axis=-1)
        curve, cell = cut(found.curve), cut(found.cell)
        place = first + jnp.arange(sizes.pieces, dtype=jnp.int32)
        cell = jnp.where(listed[cell] & (place < found.used), cell, sizes.cells)
        return _inserted(cells.begin, cell, piece, curve, batch.stamp, state)

    upto = jnp.where(found.used <= batch.capacity, found.used, 0)
    number, lists = in_chunks(some, (cells.number, lists), sizes.pieces, upto)
    return cells._replace(number=number), found, lists


def _cells(batch: _Batch, sums: _Sums) -> _Cells:
    """Return a batch's cells, before they have pieces."""
    side, jump = (x.reshape(-1, CUT, CUT) for x in (sums.side, sums.jump))
    # Of all curves those left of a row are known; else the way goes up the film's left side.
    whole = (batch.begin < 0)[:, None]
    left = jnp.where(whole, side[..., 0], jnp.cumsum(side[..., 0], axis=1))
    change = (left[..., None] + jnp.cumsum(jump, axis=2)).reshape(-1)
    # Pixels: along the bottom of each row.
    upto, index = running_sum(sums.jump), jnp.arange(batch.sizes.cells, dtype=jnp.int32)
    starts = jnp.append(True, batch.row[1:] != batch.row[:-1])
    start = jax.lax.cummax(jnp.where(starts, index, 0))
    at_pixels = batch.level == 0
    corner = batch.corner + jnp.where(at_pixels, upto - (upto - sums.jump)[start], change)
    covered = corner - sums.drop > 0.5
    most = (batch.capacity + 1).astype(sums.layers.dtype)
    layers = jnp.minimum(sums.layers, most).astype(jnp.int32)
    layers = jnp.where(covered, 0, layers)
    upto = running_sum(layers)
    begin, fits = batch.listed + upto - layers, upto <= batch.capacity
    none = jnp.zeros_like(layers)
    return _Cells(batch.origin, batch.place, corner, layers > 0, begin, fits, none)


class _Source(NamedTuple):
    """Curves that are cut into pieces: their films, their `code` (see `_Lists`), and for those that
    are pieces of a list whether they pass their cell's bottom (see `Cells`), else -1."""

    m: Monotone
    film: Int[Array, "K"]
    code: Int[Array, "K"]
    passes: Float[Array, "K"]


def _source(
    number: int, part: Part, batch: _Batch, lists: _Lists, upto: Array, slots: Array
) -> _Source:
    """Return what of a part is cut: the films' pieces number `slots`, or curves.

    Pieces keep their ends: so they agree with what is known of their film's corner.
    """
    film = jnp.minimum(count_upto(upto, slots), batch.sizes.films - 1)
    own = slots - jnp.where(film > 0, upto[film - 1], 0)
    whole = batch.begin[film] < 0
    index = jnp.where(whole, 0, batch.begin[film] + own)
    index = jnp.clip(index, 0, lists.curve.shape[0] - 1)
    code = jnp.where(whole, 2 * own + number, lists.curve[index])
    curves = part.curves(jnp.clip(code >> 1, 0, jnp.maximum(part.total - 1, 0)))
    inside = (slots < upto[-1]) & ((code & 1) == number)
    m = monotone(placed(jax.lax.stop_gradient(curves), batch.scale, batch.films[film]))

    piece = lists.piece[index]
    low, high = CUT * piece[:, :2], CUT * piece[:, 2:4]
    weight = jnp.where(whole, curves.weight, -m.rising * piece[:, 5])
    m = m._replace(
        low=jnp.where(whole[:, None], m.low, low),
        high=jnp.where(whole[:, None], m.high, high),
        curves=m.curves._replace(weight=jnp.where(inside, weight, 0)),
    )
    return _Source(m, film, code, jnp.where(whole, -1, piece[:, 4]))


def _gone_through(
    number: int,
    part: Part,
    overlapping: Overlapping,
    batch: _Batch,
    lists: _Lists,
    state: tuple[_Sums, _Found],
) -> tuple[_Sums, _Found]:
    """Return the sums and what is found, with a part's pieces."""
    none, sizes, at_pixels = batch.sizes.cells, batch.sizes, batch.level == 0
    films = jnp.arange(sizes.films, dtype=jnp.int32)
    whole = (films == 0) & (batch.begin < 0)
    upto = running_sum(jnp.where(whole, part.total, batch.number))

    def chunk(state, slot):
        sums, found = state
        slots = slot + jnp.arange(part.size, dtype=jnp.int32)
        source = _source(number, part, batch, lists, upto, slots)
        side = _side(source)
        row = (source.film[None] * CUT + side.row) * CUT
        at = jnp.where(side.row < CUT, row, none)
        sums = sums._replace(side=sums.side.at[at].add(side.step, mode="drop"))

        def add(state, pieces: Pieces):
            sums, found = state
            film, passes = source.film[pieces.curve], source.passes[pieces.curve]
            foot = (pieces.row == 0) & (passes >= 0)
            pieces = pieces._replace(
                passes=jnp.where(foot, passes > 0, pieces.passes),
                first=pieces.first & ~(foot & (passes < 2)),
            )
            inside = pieces.valid & (pieces.column >= 0) & (pieces.column < batch.W)
            row, column = (jnp.where(inside, x, 0) for x in (pieces.row, pieces.column))
            rank = overlapping.rank(row, column) - batch.first
            wanted = (rank >= 0) & (rank < none) & (batch.place[jnp.clip(rank, 0, none - 1)] >= 0)
            pixel = jnp.where(wanted, rank, none)
            child = (film * CUT + row) * CUT + column
            cell = jnp.where(inside, jnp.where(at_pixels, pixel, child), none)
            left = pieces.valid & (pieces.column < 0) & (passes < 0)
            beside = jnp.where(left & ~at_pixels, (film * CUT + pieces.row) * CUT, none)
            # In a row of pixels the next overlapping one.
            beyond = jnp.clip(pieces.column + 1, 0, batch.W - 1)
            later = overlapping.below(jnp.where(pieces.valid, pieces.row, 0), beyond) - batch.first
            there = pieces.valid & (pieces.column < batch.W - 1) & (later < none)
            later = jnp.clip(later, 0, none - 1)
            there &= batch.place[later] >= 0
            later = jnp.where(there & (batch.row[later] == pieces.row), later, none)
            next_cell = jnp.where(inside & (column < CUT - 1), cell + 1, none)
            after = jnp.where(at_pixels, later, next_cell)
            sums = _added(sums, cell, beside, after, pieces)
            return sums, found.append(cell, cell < none, pieces, source.code[pieces.curve])

        size = batch.W, batch.top, batch.max_H
        return fold_pieces(source.m, size, add, (sums, found), batch.bottom, sizes.pieces)

    return in_chunks(chunk, state, part.size, upto[-1])


class _Side(NamedTuple):
    """By how much the winding number changes where a piece meets its film's left side, and the
    first row whose bottom is above that."""

    row: Int[Array, "2 K"]
    step: Float[Array, "2 K"]


def _side(source: _Source) -> _Side:
    """Return where pieces come in on the left side of their film, and where they leave."""
    m = source.m
    jump = -m.rising * m.curves.weight
    comes_in = (m.low[:, 0] == 0) & ((m.low[:, 1] > 0) | (source.passes == 1))
    leaves = (m.high[:, 0] == 0) & (source.passes > 0)
    of_list = source.passes >= 0
    step = jnp.stack([jnp.where(comes_in & of_list, -jump, 0), jnp.where(leaves, jump, 0)])
    height = jnp.clip(jnp.ceil(jnp.stack([m.low[:, 1], m.high[:, 1]])), 1, CUT)
    return _Side(height.astype(jnp.int32), step)


def _added(
    sums: _Sums,
    cell: Int[Array, "P"],
    beside: Int[Array, "P"],
    after: Int[Array, "P"],
    pieces: Pieces,
) -> _Sums:
    """Return the sums with more pieces: in a cell, `beside` a row's first, before the one `after`;
    past the end they are dropped."""
    put = lambda total, at, value: total.at[at].add(value, mode="drop")
    jump = winding_jumps(pieces)
    return _Sums(
        put(sums.layers, cell, jnp.abs(pieces.jump)),
        put(sums.drop, cell, drops(pieces)),
        put(sums.side, beside, jump),
        put(sums.jump, after, jump),
    )


def _inserted(
    begin: Int[Array, "C"],
    cell: Int[Array, "P"],
    piece: Float[Array, "P 6"],
    code: Int[Array, "P"],
    stamp: Int[Array, ""],
    state: tuple[Array, _Lists],
) -> tuple[Array, _Lists]:
    """Return the cells' numbers of pieces, and the lists, with more pieces, equal ones merged;
    `cell` past the end drops one."""
    P, none = cell.shape[0], begin.shape[0]
    there = cell < none

    number, lists = state
    index = jnp.arange(P, dtype=jnp.int32)
    stamps = stamp + cell
    hashed = _hashed(piece, stamps)

    def equal(other, others, code_there, stamp_there):
        same = (stamp_there == stamps) & ((code_there & 1) == (code & 1))
        for field in range(5):
            same &= others[other, field] == piece[:, field]
        return same

    # Among these the first of equal ones leads.
    small = (hashed % (2 * P)).astype(jnp.int32)
    leader = jnp.full(2 * P, P, jnp.int32).at[jnp.where(there, small, 2 * P)].min(index)
    leader = jnp.minimum(leader[small], P - 1)
    led = there & (leader < index) & equal(leader, piece, code[leader], stamps[leader])
    jump = piece[:, 5].at[jnp.where(led, leader, P)].add(piece[:, 5], mode="drop")
    piece = piece.at[:, 5].set(jump)

    at = (hashed % lists.table.shape[0]).astype(jnp.int32)
    old = lists.table[at]
    known = equal(old, lists.piece, lists.curve[old], lists.stamp[old])
    known &= there & ~led
    N = lists.curve.shape[0]
    merged = lists.piece.at[jnp.where(known, old, N), 5].add(jump, mode="drop")

    fresh = there & ~led & ~known
    key = jax.lax.sort(jnp.where(fresh, cell, none) * P + index)
    place, source = key // P, key % P
    first = jnp.full(none + 1, P, jnp.int32).at[place].min(index)
    own = jnp.minimum(place, none - 1)
    slot = begin[own] + number[own] + index - first[place]
    slot = jnp.where(place < none, slot, N)
    set_ = lambda old, new: old.at[slot].set(new[source], mode="drop")
    table = lists.table.at[jnp.where(place < none, at[source], lists.table.shape[0])]
    lists = _Lists(
        set_(merged, piece),
        set_(lists.curve, code),
        set_(lists.stamp, stamps),
        table.set(slot, mode="drop"),
    )
    return number.at[place].add(1, mode="drop"), lists


def _hashed(piece: Float[Array, "P 6"], stamp: Int[Array, "P"]) -> UInt32[Array, "P"]:
    """Return a hash of a piece's ends and cell."""
    bits = jax.lax.bitcast_convert_type(piece[:, :4].astype(jnp.float32), jnp.uint32)
    total = stamp.astype(jnp.uint32) * jnp.uint32(0x9E3779B1)
    for k in range(4):
        total = (total ^ bits[:, k]) * jnp.uint32(0x85EBCA6B)
        total = total ^ (total >> 15)
    return total
