"""Pixels in which contours overlap, one after the other, on a CPU.

XLA's CPU compiler makes a kernel of each of two loops: one lists the pieces of contour in these
pixels, the other sweeps the pixels.

A line sweeps a pixel (see `sweep.py`). It halts where a piece begins or ends, or crosses another:
that is found when the later of the two begins, by a look at all that the line cuts there. Between
two halts what it cuts is put in order, which it nearly is, from the halt before.

A pixel with more than `MANY` pieces is a film of its own, of `CUT` x `CUT` cells, on which all
curves are looked at again. No loop is without end: a line's next halt is past the last one, at one
of so many places as pieces and crossings give; what is no number is left out.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._numerics.bitset import Selection, any_bit, count_below, rank_in
from .._numerics.bounds import least, most, within
from .._numerics.one_kernel import one_kernel, opened, put
from .._numerics.safe import safe_divide
from .coverage import InRow, Monotone, Pieces, Rows, column_of, in_pixel, in_row, rows_of, taken
from .curves import Segments, arc_flux, cut_circle, film_at, nodes, unit_at
from .marks import drops, winding_jumps
from .parts import LEAST, Ordered
from .sweep import sweepable

#: So many pieces of a cell are swept; so many crossings may be ahead of a line.
MANY, AHEAD = 384, 2048
#: A cell with more is cut into `CUT` x `CUT`.
CUT = 16
#: A piece that equals a new one is looked for at so many places of a table at most.
LOOKS = 64
#: Rows of pixels in a tile: a word of bits, which tell the columns that cells are in.
TILE = 4


class Where(NamedTuple):
    """Cells of a film: the curves' film `scale` times as large, from `origin` (px of the film).

    `chosen` are its cells' places, rows of `width` bits, if it is the whole one; else all are. Of
    these the ones from number `first` on are listed, `number` of them, in the rows from `bottom` up
    to `top`; `tiles` tell where these are, if it is the whole one. It has W columns and H rows. The
    winding numbers at their corners are known, or (`jumps` 1) added up.
    """

    scale: Float[Array, ""]
    origin: Float[Array, "2"]
    whole: Int[Array, ""]
    words: Array
    before: Int[Array, "words"]
    total: Int[Array, ""]
    jumps: Int[Array, ""]
    tiles: UInt32[Array, "tiles"]
    width: Int[Array, ""]
    first: Int[Array, ""]
    number: Int[Array, ""]
    bottom: Int[Array, ""]
    top: Int[Array, ""]
    W: Int[Array, ""]
    H: Int[Array, ""]

    @property
    def _chosen(self) -> Selection:
        return Selection(self.words, self.before, self.total)

    def cell(self, row: Int[Array, ""], column: Int[Array, ""]) -> Int[Array, ""]:
        """Return a cell's number among those that are listed, negative or too large for others."""
        rank = rank_in(self._chosen, jnp.where(self.whole > 0, row * self.width + column, 0))
        own = jnp.where(rank < 0, -1, rank - self.first)
        return jnp.where(self.whole > 0, own, row * CUT + column)

    def before_column(self, row: Int[Array, ""], column: Int[Array, ""]) -> Int[Array, ""]:
        """Return how many of those that are listed come before a place (negative: so many before
        the first)."""
        index = jnp.where(self.whole > 0, row * self.width + column, 0)
        inside = count_below(self._chosen, jnp.minimum(index, len(self.words) * 32 - 1))
        upto = jnp.where(index >= len(self.words) * 32, self.total, inside)
        return jnp.where(self.whole > 0, upto - self.first, row * CUT + column)

    def may_meet(self, m: Monotone, rows: Rows) -> Bool[Array, ""]:
        """Return whether a curve may meet cells that are listed, in these rows: of a short one the
        tiles tell."""
        ends = (column_of(x, self.W) for x in (m.low[0], m.high[0]))
        low, high = rows.first // TILE, (rows.first + rows.number - 1) // TILE
        long = (self.whole == 0) | (high - low > 1)
        left, right = self._between(*ends)
        return (
            long
            | self._any(self.tiles, low, left, right)
            | self._any(self.tiles, high, left, right)
        )

    def may_meet_in(self, own: InRow) -> Bool[Array, ""]:
        """Return whether a curve may meet cells in a row."""
        return (self.whole == 0) | self._any(self.words, own.row, *self._between(own.c0, own.c1))

    def _between(self, first: Int[Array, ""], last: Int[Array, ""]) -> tuple[Array, Array]:
        """Return the leftmost and the rightmost column of a curve, on the film."""
        inside = lambda x: jnp.clip(x, 0, self.W - 1)
        return inside(jnp.minimum(first, last)), inside(jnp.maximum(first, last))

    def _any(self, words: Array, row: Array, left: Array, right: Array) -> Bool[Array, ""]:
        """Return whether a row of words has bits from one column up to another, or reaches over
        more than two words there."""
        return any_bit(words, row * (self.width >> 5), left, right)


def tiles_of(width: int, H: int) -> int:
    """Return how many tiles there are on a film of H rows of so many bits."""
    return max(-(-H // TILE) * (width // 32), LEAST)


def with_pixel(tiles: UInt32[Array, "tiles"], width: int, row: Array, column: Array) -> Array:
    """Return tiles with a pixel."""
    tile = (row // TILE) * (width // 32) + (column >> 5)
    return put(tiles, tiles[tile] | (jnp.uint32(1) << (column & 31).astype(jnp.uint32)), tile)


# --- lists ---------------------------------------------------------------------------------------


class Listed(NamedTuple):
    """The pieces of cells, each cell's as a chain.

    - `piece`: what a sweep asks of a piece (see `Cells`), and an arc's frame.
    - `code`: its curve (times 2, plus its part's number); `after`: the next of its cell (-1: none).
    - `cell`: a piece's cell; `table`: pieces (plus 1) at places that they themselves tell.
    - `head`: of each cell, its first piece; `number`: how many it has.
    - `jump`, `drop`: of each cell, sums of `winding_jumps` before it in its row (0 where corners
      are known), and of `drops`.
    - `used`: how many pieces there are, with those that there is no room for.
    """

    piece: Float[Array, "N numbers"]
    code: Int[Array, "N"]
    after: Int[Array, "N"]
    cell: Int[Array, "N"]
    table: Int[Array, "T"]
    head: Int[Array, "C"]
    number: Int[Array, "C"]
    jump: Float[Array, "C"]
    drop: Float[Array, "C"]
    used: Int[Array, ""]

    @staticmethod
    def empty(pieces: int, cells: int, arcs: bool, dtype: Any) -> "Listed":
        """Return room for as many pieces (a power of 2) in as many cells."""
        whole = lambda n, value: jnp.full(n, value, jnp.int32)
        real = jnp.zeros(cells, dtype)
        table = jnp.zeros((pieces, 15 if arcs else 6), dtype)
        zeros = whole(pieces, 0)
        owners = zeros, zeros, zeros, whole(2 * pieces, 0)
        return Listed(table, *owners, whole(cells, -1), whole(cells, 0), real, real, jnp.int32(0))

    def append(
        self, where: Where, part: int, curves: Ordered, first: Int[Array, ""], number: Array
    ) -> "Listed":
        """Return these with the pieces of the first so many curves of a list, of a part's: from id
        `first` on."""
        return one_kernel(partial(_appended, part))(where, curves, first, number, self)


def _appended(
    part: int, where: Where, curves: Ordered, first: Array, number: Array, listed: Listed
) -> Listed:
    def of_curve(k, listed):
        m = taken(curves, k).placed(where.scale, where.origin)
        rows = rows_of(m, where.top, where.bottom)
        met = (m.curves.weight != 0) & ((where.jumps > 0) | where.may_meet(m, rows))
        code = 2 * (first + k) + part

        def of_row(state):
            row, listed = state
            own = in_row(m, row, where.W, where.H)
            listed = _with_jump(where, m, own, listed)

            def of_pixel(state):
                along, listed = state
                column = own.column(along)
                inside = (column >= 0) & (column < where.W)
                cell = where.cell(row, jnp.clip(column, 0, where.W - 1))
                there = inside & (cell >= 0) & (cell < where.number)
                fill = partial(_in_cell, where, m, own, along, code)
                start = jnp.where(there, cell, -1), listed
                return along + 1, jax.lax.while_loop(lambda s: s[0] >= 0, fill, start)[1]

            further = jnp.where(where.may_meet_in(own), own.further, -1)
            start = jnp.int32(0), listed
            return row + 1, jax.lax.while_loop(lambda s: s[0] <= further, of_pixel, start)[1]

        end = rows.first + jnp.where(met, rows.number, 0)
        return jax.lax.while_loop(lambda s: s[0] < end, of_row, (rows.first, listed))[1]

    return jax.lax.fori_loop(0, number, of_curve, listed)


def _with_jump(where: Where, m: Monotone, own: InRow, listed: Listed) -> Listed:
    """Return lists with what a curve does to the winding number along the bottom of a row, if that
    is added up."""

    def fill(state):
        _, listed = state
        # (Of its pieces in a row the first is asked: see `winding_jumps`.)
        piece = in_pixel(m, own, jnp.int32(0), jnp.int32(0), jnp.array(True), where.W)
        later = jnp.maximum(where.before_column(own.row, own.c0 + 1), 0)
        end = jnp.minimum(where.before_column(own.row + 1, jnp.int32(0)), where.number)
        jump = jnp.where(later < end, winding_jumps(piece), 0)
        at = jnp.minimum(later, jnp.maximum(where.number - 1, 0))
        return jnp.int32(0), listed._replace(jump=put(listed.jump, listed.jump[at] + jump, at))

    adds = jnp.where(own.c0 + 1 < where.W, where.jumps, 0)
    return jax.lax.while_loop(lambda s: s[0] > 0, fill, (adds, listed))[1]


def _in_cell(
    where: Where, m: Monotone, own: InRow, along: Array, code: Array, state: tuple
) -> tuple:
    """Return lists with a piece in a cell; one that equals it takes its jump."""
    cell, listed = state
    piece = in_pixel(m, own, along, code, jnp.array(True), where.W)
    row = jnp.stack(_row_of(piece, m, listed.piece.shape[1]))
    old, place, head = _equal(cell, row, piece.curve, listed)
    fresh, room = old < 0, listed.used < len(listed.code)
    new = fresh & room
    slot = jnp.where(fresh, jnp.minimum(listed.used, len(listed.code) - 1), old)
    whole = jnp.where(fresh, row, _row(listed.piece, slot))
    jump = whole[5] + jnp.where(fresh, 0, row[5])
    whole = jnp.where(jnp.arange(len(row)) == 5, jump, whole)
    whole = jnp.where(fresh & ~room, _row(listed.piece, slot), whole)
    one = fresh.astype(jnp.int32)
    return jnp.int32(-1), listed._replace(
        piece=put(listed.piece, whole, slot),
        code=put(listed.code, jnp.where(new, piece.curve, listed.code[slot]), slot),
        after=put(listed.after, jnp.where(new, head, listed.after[slot]), slot),
        cell=put(listed.cell, jnp.where(new, cell, listed.cell[slot]), slot),
        table=put(listed.table, slot + 1, place),
        head=put(listed.head, jnp.where(new, slot, head), cell),
        number=put(listed.number, listed.number[cell] + one, cell),
        drop=put(listed.drop, listed.drop[cell] + drops(piece), cell),
        used=listed.used + one,
    )


def _row_of(piece: Pieces, m: Monotone, numbers: int) -> list[Array]:
    row = list(sweepable(piece))
    if numbers == len(row):
        return row
    zero = jnp.zeros_like(row[0])
    if isinstance(m.curves, Segments):
        return [*row, *[zero] * (numbers - len(row))]
    column, height = piece.column.astype(zero.dtype), piece.row.astype(zero.dtype)
    for x, y, z in (m.curves.frame[k] for k in range(3)):
        row += [x - column * z, y - height * z, z]
    return row


def _equal(cell: Array, row: Array, code: Array, listed: Listed) -> tuple[Array, Array, Array]:
    """Return the piece of a cell that equals another, -1 if none is found; its place in the table,
    or that of the other; and the cell's first piece (read within the loop: else what it is read
    from is copied)."""
    arcs, last = listed.piece.shape[1] > 6, len(listed.table) - 1

    def one(state):
        place, looks, _, _, _ = state
        slot = listed.table[place] - 1
        at = jnp.maximum(slot, 0)
        own = _row(listed.piece, at)
        other = listed.cell[at] != cell
        if arcs:
            other |= (listed.code[at] ^ code) & 1 != 0
        for k in range(5):
            other |= own[k] != row[k]
        ends = (slot < 0) | ~other | (looks >= LOOKS)
        following = jnp.where(ends, place, (place + 1) & last)
        return following, looks + 1, ends, jnp.where(other, -1, slot), listed.head[cell]

    zero = jnp.int32(0)
    start = _place(cell, row) & last, zero, jnp.array(False), zero - 1, zero - 1
    place, _, _, slot, head = jax.lax.while_loop(lambda s: ~s[2], one, start)
    return slot, place, head


def _place(cell: Array, row: Array) -> Int[Array, ""]:
    """Return a number that a cell and a piece's ends tell, well mixed (Fibonacci hashing)."""
    mixed = cell.astype(jnp.uint32)
    for end in (row[k] for k in range(4)):
        bits = jax.lax.bitcast_convert_type(end.astype(jnp.float32), jnp.uint32)
        mixed = (mixed ^ bits) * jnp.uint32(0x9E3779B1)
        mixed = mixed ^ (mixed >> 15)
    return (mixed >> 1).astype(jnp.int32)


# --- cells ---------------------------------------------------------------------------------------


class At(NamedTuple):
    """Where cells are: the pixel's `place`, and the cell's corner (px)."""

    place: Int[Array, "*C"]
    x: Float[Array, "*C"]
    y: Float[Array, "*C"]


class Swept(NamedTuple):
    """Cells that were swept.

    - `area`: of each, what is covered (px^2); 0 where there are too many pieces.
    - `crowded`: the cells with too many, `left` of them.
    - `seen`, `code`, `place`: what is visible of pieces (see `Visible`), `shown` of them.
    - `fits`: how many of the cells there was room for; if not for all, none was swept.
    """

    area: Float[Array, "C"]
    crowded: Int[Array, "C"]
    left: Int[Array, ""]
    seen: Float[Array, "N numbers"] | None
    code: Int[Array, "N"] | None
    place: Int[Array, "N"] | None
    shown: Int[Array, ""] | None
    fits: Int[Array, ""]


class _Room(NamedTuple):
    """What a cell is swept in: rows.

    - `line`: pieces: u0, v0, u1, v1, dv / du, jump, slot, whether it is steep (see `Lines`); then
      of arcs: frame, cone, sense (see `_curved`).
    - `begins`: where they begin, in order, and their rows in `line`.
    - `met`: those that the line cuts, as rows of `line`: in the order of the last halt.
    - `order`: the same from below: v, and the row in `line`. (Two lists: what is read and written
      over in one loop is copied.)
    - `border`: where along the border v = 0 the number of layers changes, in order, and by how
      much.
    - `ahead`: where pieces cross that are cut, the next place last.
    - `seen`: of each line the visible length and its first moment, and an arc's flux.
    """

    line: Float[Array, "M numbers"]
    begins: Float[Array, "M 2"]
    met: Int[Array, "M"]
    order: Float[Array, "M 2"]
    border: Float[Array, "M 2"]
    ahead: Float[Array, "K"] | None
    seen: Float[Array, "M numbers"] | None


class Manner(NamedTuple):
    """How cells are swept (static): which part is arcs (None: none is), whether the visible parts
    are told, and whether the line stops at equal distances."""

    arcs: int | None
    flux: bool
    stops: bool


def swept(
    manner: Manner,
    listed: Listed,
    where: Where,
    row: Int[Array, "C"],
    at: At,
    corner: Float[Array, "C"],
    base: Float[Array, ""],
    last: Array,
    stops: Int[Array, ""] | None,
) -> Swept:
    """Return what the cells are covered, and what is visible in them. There are `base` layers left
    of each row (of pixels the winding number at the `corner` is known); cells are no longer cut if
    they are the `last` ones."""
    (C,), (N, _), dtype = row.shape, listed.piece.shape, listed.piece.dtype
    zeros, whole = (lambda *shape: jnp.zeros(shape, dtype)), lambda n: jnp.zeros(n, jnp.int32)
    M, arcs, flux = MANY + 2, manner.arcs is not None, manner.flux
    room = _Room(
        zeros(M, 21 if arcs else 8),
        zeros(M, 2),
        whole(M),
        zeros(M, 2),
        zeros(2 * M, 2),
        None if manner.stops else zeros(AHEAD + 2),
        zeros(M, 11 if arcs else 2) if flux else None,
    )
    seen = (zeros(N, 9 if arcs else 7), whole(N), whole(N)) if flux else (None,) * 3
    filled = zeros(C), whole(C), *seen
    pick = where.number, where.whole, where.scale, where.jumps
    # (The compiler aborts over what a kernel does not read.)
    places = row, at if flux else None, corner
    kernel = one_kernel(partial(_swept, manner))
    return kernel(listed, pick, places, jnp.broadcast_to(base, 2), last, stops, filled, room)


def _swept(manner: Manner, listed, pick, places, base, last, stops, filled, room) -> Swept:
    number, whole, scale, jumps = pick
    rows, at, corners = places
    area, crowded, seen, code, place = filled
    zero, base = jnp.int32(0), base[0]
    full = listed.used > listed.piece.shape[0]
    fits = jax.lax.while_loop(
        lambda s: (s[0] < number) & (s[1] + listed.number[s[0]] <= listed.piece.shape[0]),
        lambda s: (s[0] + 1, s[1] + listed.number[s[0]]),
        (zero, zero),
    )[0]
    fits = jnp.where(full & (whole > 0) & (number > 1), jnp.maximum(fits, 1), number)
    nothing = Swept(area, crowded, zero, seen, code, place, zero if manner.flux else None, fits)

    def one(state):
        c, row, corner, swept, room = state
        corner = jnp.where(rows[c] == row, corner, base) + listed.jump[c]
        corner = jnp.where(jumps > 0, corner, corners[c])
        own = listed.number[c]
        known = (corner - listed.drop[c] > 0.5) | (own == 0)
        many = ~known & ((own > MANY) | full)
        area = jnp.where(corner > 0.5, 1, 0).astype(corner.dtype)
        asks = ~known & ~many
        own_place = jax.tree.map(lambda x: x[c], at)
        cell = _Cell(listed, listed.head[c], corner, scale, own_place)
        area, lost, swept, room = _cell(manner, cell, asks, area, stops, swept, room)
        left = (many | lost) & ~(last > 0)
        swept = swept._replace(
            area=put(swept.area, jnp.where(left, 0, area) / (scale * scale), c),
            crowded=put(swept.crowded, c, swept.left),
            left=swept.left + left.astype(jnp.int32),
        )
        return c + 1, rows[c], corner, swept, room

    end = jnp.where(fits < number, 0, number)
    start = zero, jnp.int32(-1), base, nothing, room
    return jax.lax.while_loop(lambda s: s[0] < end, one, start)[3]


class _Cell(NamedTuple):
    """A cell: its chain's first piece, the number of layers at its corner, its scale, and where it
    is."""

    listed: Listed
    head: Int[Array, ""]
    corner: Float[Array, ""]
    scale: Float[Array, ""]
    at: At | None


def _cell(manner: Manner, cell: _Cell, asks, area, stops, swept: Swept, room: _Room):
    """Return the area of a cell (as it is given, if it does not ask for a sweep), whether crossings
    were lost, and what is visible.

    One way is to the right; another, up, tells what is visible of steep pieces, if anything is.
    """
    steep = jnp.bool_(False)
    if manner.stops:
        steep = _reaches_up(cell, asks)

    def way(state):
        up, _, area, lost, swept, room = state
        lines, borders, steepness, room = _lines(manner, cell, up > 0, room)
        line = _swept_line(manner, cell, up, lines, borders, stops, room)
        own = jnp.clip(line.area, 0, 1)
        room = line.room
        if manner.flux:
            swept = _shown(manner, cell, lines, up, swept, room)
        if manner.stops:
            area = jnp.where((up > 0) == steep, own, area)
            more = jnp.bool_(manner.flux)
        else:
            area = jnp.where(up > 0, area, own)
            more = steepness > jnp.where(line.shows | (own < 1), 0, 1)
            more &= manner.flux
        return up + 1, more, area, lost | (line.lost > 0), swept, room

    first = jnp.where(steep, 1, 0) if manner.stops and not manner.flux else jnp.int32(0)
    start = first.astype(jnp.int32), asks, area, jnp.bool_(False), swept, room
    return jax.lax.while_loop(lambda s: (s[0] < 2) & s[1], way, start)[2:]


def _reaches_up(cell: _Cell, asks: Array) -> Array:
    """Return whether a cell's pieces, taken together, reach further along y than along x."""

    def one(state):
        slot, reach = state
        x0, y0, x1, y1 = (cell.listed.piece[slot, k] for k in range(4))
        return cell.listed.after[slot], reach + jnp.abs(y1 - y0) - jnp.abs(x1 - x0)

    start = jnp.where(asks, cell.head, -1), jnp.zeros_like(cell.corner)
    return jax.lax.while_loop(lambda s: s[0] >= 0, one, start)[1] > 0


def _lines(manner: Manner, cell: _Cell, up: Array, room: _Room):
    """Return how many pieces of a cell there are, put in order of where they begin as a line meets
    them that moves to the right (or up), how many borders, and whether a piece is steep (1), or one
    that lies on the cell's side (2)."""
    listed = cell.listed

    def one(state):
        slot, n, m, steepness, room = state
        piece = _row(listed.piece, slot)
        x0, y0, x1, y1, passes, jump = (piece[k] for k in range(6))
        steep = jnp.abs(y1 - y0) > jnp.abs(x1 - x0)
        right, level = x1 >= x0, passes == 0
        # (See `along_x` and `along_y`.)
        low = jnp.where(level | ((y0 == 0) & (passes == 2)), jump, 0)
        high = jnp.where(level, -jump, 0)
        low_up = jnp.where((x0 == 0) & ((y0 > 0) | (passes == 1)), -jump, 0)
        high_up = jnp.where((x1 == 0) & (passes > 0), jump, 0)
        either = lambda a, b, c: jnp.where(up, a, jnp.where(right, b, c))
        u0, v0 = either(y0, x0, x1), either(x0, y0, y1)
        u1, v1 = either(y1, x1, x0), either(x1, y1, y0)
        slope = safe_divide(v1 - v0, u1 - u0)
        sign = either(jump, -jump, jump)
        real = lambda x: x.astype(u0.dtype)
        line = [u0, v0, u1, v1, slope, sign, real(slot), real(steep)]
        if manner.arcs is not None:
            line += _curved(piece, sign, up, (listed.code[slot] & 1) == manner.arcs)
        # What is no number is left out.
        there = (jump != 0) & jnp.isfinite(u0 + v0 + u1 + v1 + jump)
        # (One that is not there is written where the next is.)
        lines = put(room.line, jnp.stack(line), n)
        begins = _with_place(room.begins, n, u0, real(n), there)
        border = room.border
        ends = [(x0, y0, low, low_up), (x1, y1, high, high_up)]
        for halt, step in ((jnp.where(up, y, x), jnp.where(up, b, a)) for x, y, a, b in ends):
            changes = (step != 0) & there
            border = _with_place(border, m, halt, step, changes)
            m = m + _one(changes)
        seen = room.seen
        if seen is not None:
            seen = put(seen, jnp.zeros(seen.shape[1], seen.dtype), n)
        room = room._replace(line=lines, begins=begins, border=border, seen=seen)
        # What lies on the cell's side is visible if what is beside the cell is not covered.
        on_side = (x0 == x1) & ((x0 <= 0) | (x0 >= 1))
        steepness = jnp.maximum(steepness, jnp.where(steep & there, 1 + _one(on_side), 0))
        return listed.after[slot], n + _one(there), m, steepness, room

    zero = jnp.int32(0)
    start = cell.head, zero, zero, zero, room
    return jax.lax.while_loop(lambda s: s[0] >= 0, one, start)[1:]


def _with_place(places: Array, number: Array, u: Array, value: Array, there: Array) -> Array:
    """Return so many places along a line and their values, in order, with one more if it is
    `there`."""
    later = lambda k, places: _row(places, k)[0] > u
    at, places = opened(jnp.where(there, number, 0), later, places, read=_row)
    return put(places, jnp.stack([u, value]), jnp.where(there, at, number))


# --- a line --------------------------------------------------------------------------------------


class _Line(NamedTuple):
    """Where a line is in a cell.

    - `u`: where it halts; `end`: where the next of the pieces that it cuts ends.
    - `begun`, `cuts`, `ahead`: how many pieces have begun, are cut, and crossings lie ahead.
    - `passed`, `first`: how many changes along the border it has passed, and the number of layers
      there.
    - `area`: what was covered so far; `lost`: how many crossings there was no room for; `shows`:
      whether a piece was visible.
    """

    u: Float[Array, ""]
    end: Float[Array, ""]
    begun: Int[Array, ""]
    cuts: Int[Array, ""]
    ahead: Int[Array, ""]
    passed: Int[Array, ""]
    first: Float[Array, ""]
    area: Float[Array, ""]
    lost: Int[Array, ""]
    shows: Bool[Array, ""]
    room: _Room


def _swept_line(manner, cell: _Cell, up, lines, borders, stops, room: _Room) -> _Line:
    """Return the line at the end of its way."""
    zero, none = jnp.zeros_like(cell.corner), jnp.int32(0)
    begun, border = (none, none, none), (none, cell.corner)
    line = _Line(zero, zero + 1, *begun, *border, zero, none, jnp.bool_(False), room)
    turn = jnp.where(up > 0, -1, 1).astype(zero.dtype)
    halt = partial(_halted, manner, turn, lines, borders, stops)
    return jax.lax.while_loop(lambda s: s.u < 1, halt, line)


def _halted(manner: Manner, turn, lines, borders, stops, line: _Line) -> _Line:
    """Return the line where it halts next."""
    one = jnp.ones_like(line.u)
    if manner.stops:
        until = least(line.u + one / stops.astype(one.dtype), one)
        reach = (line.u + until) / 2
        line = _begun(manner, lines, reach, line)
    else:
        reach = line.u
        line = _begun(manner, lines, reach, line)
        comes = jnp.where(line.begun < lines, _row(line.room.begins, line.begun)[0], one)
        comes = least(comes, jnp.where(line.ahead > 0, _next_crossing(line), one))
        until = least(comes, least(line.end, one))
    line = _in_order(manner, reach, (line.u + until) / 2, line)
    line = _at_border(reach, borders, line)
    line = _covered(manner, turn, until, line)._replace(u=until)
    if manner.stops:
        return line
    passed = lambda k: (k > 0) & (_next_crossing(line._replace(ahead=k)) <= until)
    return line._replace(ahead=jax.lax.while_loop(passed, lambda k: k - 1, line.ahead))


def _next_crossing(line: _Line) -> Float[Array, ""]:
    """Return where the next crossing ahead is, if there is one."""
    places = line.room.ahead
    assert places is not None
    return _row(places, jnp.maximum(line.ahead - 1, 0))


def _at_border(reach, borders, line: _Line) -> _Line:
    """Return the line with the number of layers at the border v = 0 from where it halts."""
    border = line.room.border
    passed, first = jax.lax.while_loop(
        lambda s: (s[0] < borders) & (_row(border, s[0])[0] <= reach),
        lambda s: (s[0] + 1, s[1] + _row(border, s[0])[1]),
        (line.passed, line.first),
    )
    return line._replace(passed=passed, first=first)


def _begun(manner: Manner, lines, reach, line: _Line) -> _Line:
    """Return the line with the pieces that begin where it halts, and where these cross others."""

    def one(line: _Line):
        number = _row(line.room.begins, line.begun)[1].astype(jnp.int32)
        own = _row(line.room.line, number)
        there, slot = own[2] > reach, line.cuts
        if not manner.stops:
            line, slot = _crossed(manner, own, there, line)
        return line._replace(
            begun=line.begun + 1,
            cuts=line.cuts + _one(there),
            end=jnp.where(there, least(line.end, own[2]), line.end),
            room=line.room._replace(met=put(line.room.met, number, slot)),
        )

    more = lambda s: (s.begun < lines) & (_row(s.room.begins, s.begun)[0] <= reach)
    return jax.lax.while_loop(more, one, line)


def _crossed(manner: Manner, own: Array, there: Array, line: _Line) -> tuple[_Line, Array]:
    """Return the line with the places ahead where a piece crosses those that are cut; and how many
    these are (counted, so that the next is not put among them before: else they are copied)."""
    table, met = line.room.line, line.room.met

    def one(state):
        k, ahead, lost, places = state
        other = _row(table, _row(met, k))
        for u in _crossings(manner, own, other):
            ahead, lost, places = _with_crossing(there & (u > line.u), u, ahead, lost, places)
        return k + 1, ahead, lost, places

    start = jnp.int32(0), line.ahead, line.lost, line.room.ahead
    k, ahead, lost, places = jax.lax.while_loop(lambda s: s[0] < line.cuts, one, start)
    return line._replace(ahead=ahead, lost=lost, room=line.room._replace(ahead=places)), k


def _with_crossing(there, u, ahead, lost, places):
    """Return the crossings ahead with one more, the next place last."""
    fits = there & (ahead < AHEAD)

    def fill(state):
        _, ahead, places = state
        at, places = opened(ahead, lambda k, places: places[k] < u, places)
        return jnp.bool_(False), ahead + 1, put(places, u, at)

    before = ahead
    _, ahead, places = jax.lax.while_loop(lambda s: s[0], fill, (fits, ahead, places))
    return ahead, jnp.where(there & (before >= AHEAD), 1, lost), places


def _crossings(manner: Manner, own: Array, other: Array) -> list[Array]:
    """Return where two pieces may cross, 0 for nowhere."""
    low, high = most(own[0], other[0]), least(own[2], other[2])
    gap = lambda u: own[1] + (u - own[0]) * own[4] - (other[1] + (u - other[0]) * other[4])
    before, after = gap(low), gap(high)
    cross = (low < high) & ((before < 0) != (after < 0))
    if manner.arcs is not None:
        cross &= (own[20] == 0) & (other[20] == 0)
    u = jnp.where(cross, low + (high - low) * safe_divide(before, before - after), 0)
    if manner.arcs is None:
        return [u]
    return [u, *_arc_crossings(own, other, low, high)]


def _in_order(manner: Manner, reach, middle, line: _Line) -> _Line:
    """Return the line without the pieces that end where it halts, the others in order as they are
    in the middle of what comes."""
    table, met = line.room.line, line.room.met

    def one(state):
        k, cuts, order = state
        number = _row(met, k)
        own = _row(table, number)
        v = _height(manner, own, middle)
        there = own[2] > reach
        later = lambda k, order: _row(order, k)[0] > v
        place, order = opened(jnp.where(there, cuts, 0), later, order, read=_row)
        # (One that ends is written where the next is.)
        row = jnp.stack([v, number.astype(v.dtype)])
        return k + 1, cuts + _one(there), put(order, row, jnp.where(there, place, cuts))

    zero = jnp.int32(0)
    start = zero, zero, line.room.order
    _, cuts, order = jax.lax.while_loop(lambda s: s[0] < line.cuts, one, start)
    return line._replace(cuts=cuts, room=line.room._replace(order=order))


def _height(manner: Manner, own: Array, u: Array) -> Array:
    """Return a piece's v at an abscissa; at the nearer end where it is beyond one."""
    u0, v0, v1 = (own[k] for k in (0, 1, 3))
    v = within(v0 + (u - u0) * own[4], least(v0, v1), most(v0, v1))
    if manner.arcs is None:
        return v
    frame = own[8:17].reshape(3, 3)
    true = film_at(frame, unit_at(frame, 0, u, own[20]))[1]
    return jnp.where(own[20] != 0, within(true, least(v0, v1), most(v0, v1)), v)


def _covered(manner: Manner, turn, until, line: _Line) -> _Line:
    """Return the line with what is covered up to where it halts next, and what was visible."""
    width, middle = until - line.u, (line.u + until) / 2
    cover = lambda layers: (layers > 0.5).astype(width.dtype)

    def one(state):
        k, below, area, end, shows, met, seen = state
        v, number = (_row(line.room.order, k)[j] for j in range(2))
        number = number.astype(jnp.int32)
        own = _row(line.room.line, number)
        change = cover(below + own[5]) - cover(below)
        under, gain = v * width, [change * width, change * width * middle]
        if manner.arcs is not None:
            under, more = _under(manner, own, change, turn, line.u, until, under)
            gain += more
        area = area - under * change
        end = jnp.where(own[2] > until, least(end, own[2]), end)
        if seen is not None:
            seen = put(seen, _row(seen, number) + jnp.stack(gain[: seen.shape[1]]), number)
        met = put(met, number, k)
        return k + 1, below + own[5], area, end, shows | (change != 0), met, seen

    start = jnp.int32(0), line.first, jnp.zeros_like(width), jnp.ones_like(width)
    start = *start, line.shows, line.room.met, line.room.seen
    loop = jax.lax.while_loop(lambda s: s[0] < line.cuts, one, start)
    _, top, area, end, shows, met, seen = loop
    room = line.room._replace(met=met, seen=seen)
    area = line.area + area + cover(top) * width
    return line._replace(area=area, end=end, shows=shows, room=room)


def _shown(manner, cell: _Cell, lines, up, swept: Swept, room: _Room) -> Swept:
    """Return what is visible with the pieces that are swept this way."""
    assert swept.seen is not None
    assert room.seen is not None
    all_seen, at = room.seen, cell.at
    assert at is not None

    def one(state):
        k, shown, seen, code, places = state
        own = _row(room.line, k)
        slot = own[6].astype(jnp.int32)
        length = _row(all_seen, k)
        there = jnp.any(length != 0) & ((own[7] > 0) == (up > 0))
        piece = _row(cell.listed.piece, slot)
        row = _visible(manner, cell.scale, at, piece, own, length, up)
        # (One that is not there is written where the next is.)
        end = jnp.minimum(shown, len(code) - 1)
        keep = lambda x, new: jnp.where(there, new, _row(x, end))
        return (
            k + 1,
            shown + _one(there),
            put(seen, keep(seen, row), end),
            put(code, keep(code, cell.listed.code[slot]), end),
            put(places, keep(places, at.place), end),
        )

    start = jnp.int32(0), swept.shown, swept.seen, swept.code, swept.place
    _, shown, seen, code, places = jax.lax.while_loop(lambda s: s[0] < lines, one, start)
    return swept._replace(shown=shown, seen=seen, code=code, place=places)


def _visible(manner, scale, at: At, piece: Array, own: Array, length: Array, up) -> Array:
    """Return what is visible of a piece (see `Visible`)."""
    x0, y0, x1, y1 = (piece[k] for k in range(4))
    corner = (at.x, at.y) * 2
    ends = [c + v / scale for v, c in zip((x0, y0, x1, y1), corner, strict=True)]
    # The moment is from the piece's own first end, whichever the line met first.
    u0, u1 = (jnp.where(up > 0, y, x) for x, y in ((x0, y0), (x1, y1)))
    moment = safe_divide(length[1] - length[0] * u0, u1 - u0)
    row = [*ends, own[7], length[0] / scale, moment / scale]
    if manner.arcs is None:
        return jnp.stack(row)
    straight = jnp.stack([*row, own[7] * 0, own[7] * 0])
    return jnp.where(own[20] != 0, _unplaced(scale, at, length[2:11], up), straight)


# --- arcs ----------------------------------------------------------------------------------------


def _curved(piece: Array, jump: Array, up: Array, arc: Array) -> list[Array]:
    """Return of an arc its frame with rows (u, v, 1), its cone, whose product with a unit ray is 1,
    and its sense: 1 where u grows along it, -1 where it falls, 0 for what is straight."""
    rows = [[piece[6 + 3 * k + i] for i in range(3)] for k in range(3)]
    rows = [[jnp.where(up, y, x), jnp.where(up, x, y), z] for x, y, z in rows]
    (a, b, c), (d, e, f) = rows[1], rows[2]
    across = [b * f - c * e, c * d - a * f, a * e - b * d]
    size = across[0] * rows[0][0] + across[1] * rows[0][1] + across[2] * rows[0][2]
    cone = [safe_divide(x, size) for x in across]
    # Going up in v, cover begins (jump > 0) at an arc that runs along u, if u, v are turned so.
    grows = jnp.where((jump > 0) != up, 1, -1)
    return [*(x for row in rows for x in row), *cone, jnp.where(arc, grows, 0).astype(jump.dtype)]


def _arc_crossings(own: Array, other: Array, low: Array, high: Array) -> list[Array]:
    """Return the u at which pieces may cross of which one is an arc; others without harm, or 0.

    An arc meets a line where the line cuts its circle, and another arc on a line as well: both
    cones hold the rays whose products with the two axes are in the cosines' ratio.
    """
    arc = jnp.where(own[20] != 0, own, other)
    rest = jnp.where(own[20] != 0, other, own)
    u0, v0, u1, v1 = (rest[k] for k in range(4))
    line = [v0 - v1, u1 - u0, u0 * v1 - u1 * v0]
    met = [jnp.where(rest[20] != 0, arc[17 + k] - rest[17 + k], line[k]) for k in range(3)]
    frame = arc[8:17].reshape(3, 3)
    level = jnp.stack([sum(met[k] * frame[i, k] for k in range(3)) for i in range(3)])
    found = []
    for growing in (1.0, -1.0):
        w = cut_circle(level, jnp.asarray(growing, level.dtype))
        u = film_at(frame, w)[0]
        found.append(jnp.where((arc[20] != 0) & (u > low) & (u < high), u, 0))
    return found


def _under(manner: Manner, own, change, turn, begin, until, under):
    """Return the area under a piece between two halts, and what an arc's flux gains there."""

    def one(state):
        frame = own[8:17].reshape(3, 3)
        w0, w1 = (unit_at(frame, 0, u, own[20]) for u in (begin, until))
        _, under, flux = state
        if not manner.stops:
            q = nodes(frame, w0, w1)
            under = jnp.sum(q.weight * q.point[..., 1] * q.slope[..., 0])
        if manner.flux:
            # An arc has its covered side on its left wherever it is visible.
            flux = own[20] * turn * arc_flux(frame, w0, w1).reshape(-1)
        return jnp.bool_(False), under, flux

    visible = (own[20] != 0) & (change != 0) & (until > begin)
    start = visible, under, jnp.zeros(9, own.dtype)
    _, under, flux = jax.lax.while_loop(lambda s: s[0], one, start)
    return under, [flux[k] for k in range(9)]


def _unplaced(scale, at: At, flux: Float[Array, "9"], up: Array) -> Float[Array, "9"]:
    """Return the derivative of px^2 by a frame in px, from that of a cell by its own frame."""
    row = []
    for k in range(3):
        u, v, z = (flux[3 * k + i] for i in range(3))
        x, y = jnp.where(up > 0, v, u) / scale, jnp.where(up > 0, u, v) / scale
        row += [x, y, z / (scale * scale) - x * at.x - y * at.y]
    return jnp.stack(row)


def _one(there: Array) -> Array:
    return there.astype(jnp.int32)


def _row(x: Array, k: Int[Array, ""]) -> Array:
    """Return a row of a table, or a number of a list."""
    return jax.lax.dynamic_index_in_dim(x, k, keepdims=False)
