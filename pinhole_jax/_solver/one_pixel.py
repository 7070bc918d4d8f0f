"""A line sweeps pixels in which straight contours overlap, on a CPU: one after the other, in a
single kernel.

The line halts, and what is seen of the pieces there counts, as in `sweep`, which sweeps cells side
by side: those take as long as the one with the most pieces, and some eighty kernels. Here pieces
stay in order from one halt to the next.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.one_kernel import opened, put
from .._numerics.safe import safe_divide
from .._silhouette.sweep import Cells, Lines, along_x, along_y


class Seen(NamedTuple):
    """A pixel's covered area; of each of all pieces, which are straight, the visible length and its
    first moment (see `Visible`)."""

    area: Float[Array, ""]
    length: Float[Array, "P"]
    moment: Float[Array, "P"]


class Pixel(NamedTuple):
    """A pixel that is swept: `row(k)` are the numbers of its k-th piece (see `Cells`), and
    `place(k)` is where among all pieces it is; how many there are; the winding number at the
    pixel's lower left corner."""

    row: Callable[[Array], Array]
    place: Callable[[Array], Array]
    number: Int[Array, ""]
    corner: Float[Array, ""]


class Listed(NamedTuple):
    """The pieces of a pixel as a line sweeps them: from (u0, v0) to u1, v growing by `slope`; the
    layers met there; their numbers in the order in which they `begin`."""

    u0: Float[Array, "M"]
    v0: Float[Array, "M"]
    u1: Float[Array, "M"]
    slope: Float[Array, "M"]
    jump: Float[Array, "M"]
    begin: Int[Array, "M"]

    def height(self, k: Array, u: Array) -> Array:
        """Return how high a piece is at an abscissa."""
        return self.v0[k] + (u - self.u0[k]) * self.slope[k]


class Room(NamedTuple):
    """Room for a pixel: its pieces; where along the border the number of layers changes, in order,
    and by how much; where the line halts, in order; the pieces that it meets, in order; what of
    each piece was seen so far."""

    pieces: Listed
    border: Float[Array, "2*M"]
    step: Float[Array, "2*M"]
    halts: Float[Array, "K"]
    met: Int[Array, "M"]
    height: Float[Array, "M"]
    length: Float[Array, "M"]
    moment: Float[Array, "M"]

    @classmethod
    def of(cls, most: int, dtype: Any) -> "Room":
        """Return room for so many pieces."""
        real, whole = jnp.zeros(most, dtype), jnp.zeros(most, jnp.int32)
        both = jnp.zeros(2 * most, dtype)
        halts = jnp.zeros(2 * most + most * (most - 1) // 2, dtype)
        pieces = Listed(real, real, real, real, real, whole)
        return cls(pieces, both, both, halts, whole, real, real, real)


def loop(number: Array, body: Callable[[Array, Any], Any], state: Any) -> Any:
    """Return the state after `body(k, state)` for each k below a number."""
    step = lambda s: (s[0] + 1, body(*s))
    return jax.lax.while_loop(lambda s: s[0] < number, step, (jnp.int32(0), state))[1]


def swept(pixel: Pixel, seen: Seen, room: Room) -> tuple[Seen, Room]:
    """Return the area of a pixel, and `seen` with what is seen of its pieces."""
    on_side = lambda k, twice: twice | (pixel.row(k)[0] == pixel.row(k)[2])
    twice = loop(pixel.number, on_side, jnp.array(False))

    def line(up, seen, room):
        room, borders = _listed(pixel, up, room)
        area, shows, room = _sweep(pixel, borders, room)
        return _with_parts(pixel, up, seen._replace(area=area), room), room, shows

    return both_ways(pixel, jnp.array(False), twice, line, seen, room)


def both_ways(
    pixel: Pixel,
    up: Bool[Array, ""],
    twice: Bool[Array, ""],
    line: Callable[[Array, Seen, Any], tuple[Seen, Any, Array]],
    seen: Seen,
    room: Any,
) -> tuple[Seen, Any]:
    """Return `seen` and room after a line that moves `up` or to the right, and one the other way.

    `line(up, seen, room)` returns them, and whether it saw anything but cover. What is seen of flat
    pieces is told by a line that moves to the right, of steep ones by one that moves up; the first
    tells the area. Where it sees nothing but cover the second is left out, but for pixels that ask
    for it: a piece on the pixel's side, all of which is covered, may be seen by that one alone.
    """
    nothing = lambda k, s: tuple(put(x, 0, pixel.place(k)) for x in s)
    length, moment = loop(pixel.number, nothing, (seen.length, seen.moment))

    def turn(state):
        number, _, before, room = state
        seen, room, shows = line(up ^ (number == 1), before, room)
        area = jnp.where(number == 0, seen.area, before.area)
        return number + 1, shows, seen._replace(area=area), room

    goes_on = lambda s: (s[0] == 0) | ((s[0] == 1) & (s[1] | twice))
    start = jnp.int32(0), jnp.array(True), Seen(seen.area, length, moment), room
    return jax.lax.while_loop(goes_on, turn, start)[2:]


def _listed(pixel: Pixel, up: Bool[Array, ""], room: Room) -> tuple[Room, Array]:
    """Return room with a pixel's pieces as a line sweeps them, `up` or to the right, and how often
    the number of layers changes along the border."""

    def one(k, state):
        pieces, border, step, borders = state
        cell = Cells(pixel.row(k)[None, None], jnp.zeros((1, 1, 2), jnp.int32))
        line = either(up, along_y(cell), along_x(cell))
        u0, v0, u1, v1, jump = (x[0, 0] for x in line[:5])
        own = {"u0": u0, "v0": v0, "u1": u1, "slope": safe_divide(v1 - v0, u1 - u0), "jump": jump}
        own = {name: put(getattr(pieces, name), x, k) for name, x in own.items()}
        pieces = pieces._replace(**own)
        pieces = pieces._replace(begin=_with_begin(pieces, k))
        for halt, change in zip(line.halt[0], line.step[0], strict=True):
            further = lambda _, s, halt=halt, change=change: _with_step(s, halt, change)
            some = (change != 0).astype(jnp.int32)
            border, step, borders = loop(some, further, (border, step, borders))
        return pieces, border, step, borders

    start = room.pieces, room.border, room.step, jnp.int32(0)
    pieces, border, step, borders = loop(pixel.number, one, start)
    zero = lambda k, s: tuple(put(x, 0, k) for x in s)
    length, moment = loop(pixel.number, zero, (room.length, room.moment))
    room = room._replace(pieces=pieces, border=border, step=step)
    return room._replace(length=length, moment=moment), borders


def either(which: Array, a: Lines, b: Lines) -> Lines:
    """Return what a line moves across this way, or that way."""
    return jax.tree.map(lambda x, y: jnp.where(which, x, y), a, b)


def _with_begin(pieces: Listed, k: Array) -> Array:
    """Return the numbers of listed pieces with one more, after those that begin no later."""
    later = lambda i, begin: pieces.u0[begin[i]] > pieces.u0[k]
    place, begin = opened(k, later, pieces.begin)
    return put(begin, k, place)


def _with_step(
    state: tuple[Array, Array, Array], halt: Array, change: Array
) -> tuple[Array, Array, Array]:
    """Return where along the border layers change, in order, by how much, and how often, with one
    more."""
    border, step, number = state
    later = lambda k, border, _: border[k] > halt
    place, border, step = opened(number, later, border, step)
    return put(border, halt, place), put(step, change, place), number + 1


def _with_halt(halts: Array, number: Array, halt: Array) -> Array:
    """Return halts in order with one more."""
    place, halts = opened(number, lambda k, halts: halts[k] > halt, halts)
    return put(halts, halt, place)


def _halts(number: Array, pieces: Listed, halts: Array) -> tuple[Array, Array]:
    """Return where pieces begin, end or cross, in order, and how many of these there are."""

    def of_piece(rank, state):
        halts, count = state
        i = pieces.begin[rank]
        halts = _with_halt(halts, count, pieces.u0[i])
        halts = _with_halt(halts, count + 1, pieces.u1[i])

        def of_pair(state):
            other, halts, count = state
            u, crosses = _crossing(pieces, i, pieces.begin[other])
            more = lambda _, s: (_with_halt(s[0], s[1], u), s[1] + 1)
            return other + 1, *loop(crosses.astype(jnp.int32), more, (halts, count))

        def overlap(state):
            other = pieces.begin[jnp.minimum(state[0], number - 1)]
            return (state[0] < number) & (pieces.u0[other] < pieces.u1[i])

        return jax.lax.while_loop(overlap, of_pair, (rank + 1, halts, count + 2))[1:]

    return loop(number, of_piece, (halts, jnp.int32(0)))


def _crossing(pieces: Listed, i: Array, j: Array) -> tuple[Array, Array]:
    """Return where two pieces cross, and whether they do."""
    low = jnp.maximum(pieces.u0[i], pieces.u0[j])
    high = jnp.minimum(pieces.u1[i], pieces.u1[j])
    before, after = (pieces.height(i, u) - pieces.height(j, u) for u in (low, high))
    crosses = (low < high) & ((before < 0) != (after < 0))
    return low + (high - low) * safe_divide(before, before - after), crosses


class _Line(NamedTuple):
    """Where the line is, how many halts are behind it, how many changes along the border, the
    layers there, and how many pieces are behind it; how many it meets; the area so far; whether
    there was anything but cover."""

    u: Float[Array, ""]
    halts: Int[Array, ""]
    borders: Int[Array, ""]
    first: Float[Array, ""]
    begun: Int[Array, ""]
    number: Int[Array, ""]
    area: Float[Array, ""]
    shows: Bool[Array, ""]


def _sweep(pixel: Pixel, borders: Array, room: Room) -> tuple[Array, Array, Room]:
    """Return the covered area, whether anything else is seen than cover, and room with what of each
    piece is seen."""
    halts, count = _halts(pixel.number, room.pieces, room.halts)

    def passed(state):
        k, u = state
        return (k < count) & (halts[jnp.minimum(k, count - 1)] <= u)

    def one(state):
        line, *lists = state
        further = jax.lax.while_loop(passed, lambda s: (s[0] + 1, s[1]), (line.halts, line.u))[0]
        halt = jnp.where(further < count, halts[jnp.minimum(further, jnp.maximum(count - 1, 0))], 1)
        after = jnp.minimum(halt, 1)
        line = line._replace(halts=further)
        return _stretch(pixel, borders, room, after, line, *lists)

    zero, none = 0 * pixel.corner, jnp.int32(0)
    start = _Line(zero, none, none, pixel.corner, none, none, zero, jnp.array(False))
    lists = room.met, room.height, room.length, room.moment
    line, *lists = jax.lax.while_loop(lambda s: s[0].u < 1, one, (start, *lists))
    room = room._replace(
        halts=halts, **dict(zip(("met", "height", "length", "moment"), lists, strict=True))
    )
    return jnp.where(line.shows, jnp.clip(line.area, 0, 1), 1), line.shows, room


def _stretch(pixel, borders, room, after, line, met, height, length, moment):
    """Return the line at the next halt, and what it met and saw on the way."""
    middle, width = (line.u + after) / 2, after - line.u
    passed, first = _along_border(room, borders, middle, line)
    begun, number, met, height = _met(pixel, room.pieces, middle, line, met, height)

    def see(i, state):
        below, *shown = state
        k = met[i]
        above = below + room.pieces.jump[k]
        change = covers(above) - covers(below)

        def add(_, shown):
            area, _, length, moment = shown
            share = change * width
            length = put(length, length[k] + share, k)
            moment = put(moment, moment[k] + share * middle, k)
            return area - height[i] * share, jnp.array(True), length, moment

        return above, *loop((change != 0).astype(jnp.int32), add, tuple(shown))

    start = first, line.area, line.shows, length, moment
    top, area, shows, length, moment = loop(number, see, start)
    covered = covers(top)
    shows |= covered < 1
    area = area + covered * width
    line = _Line(after, line.halts, passed, first, begun, number, area, shows)
    return line, met, height, length, moment


def _along_border(room: Room, borders: Array, middle: Array, line: _Line) -> tuple[Array, Array]:
    """Return how many changes along the border are behind a line, and the layers there."""

    def behind(state):
        return (state[0] < borders) & (room.border[jnp.minimum(state[0], borders - 1)] < middle)

    further = lambda s: (s[0] + 1, s[1] + room.step[s[0]])
    return jax.lax.while_loop(behind, further, (line.borders, line.first))


def _met(pixel, pieces, middle, line, met, height):
    """Return how many pieces have begun, and those that the line meets from below, with their
    heights: of equal ones the first in the list is the lower."""

    def enter(state):
        begun, number, met = state
        return begun + 1, number + 1, put(met, pieces.begin[begun], number)

    def begins(state):
        k = pieces.begin[jnp.minimum(state[0], pixel.number - 1)]
        return (state[0] < pixel.number) & (pieces.u0[k] <= middle)

    begun, number, met = jax.lax.while_loop(begins, enter, (line.begun, line.number, met))

    def keep(i, state):
        count, met, height = state
        piece = met[i]
        v = pieces.height(piece, middle)
        there = middle < pieces.u1[piece]

        def above(state):
            place, met, height = state
            last = jnp.maximum(place - 1, 0)
            tie = (height[last] == v) & (met[last] > piece)
            return there & (place > 0) & ((height[last] > v) | tie)

        def shift(state):
            place, met, height = state
            return place - 1, *(put(x, x[place - 1], place) for x in (met, height))

        place, met, height = jax.lax.while_loop(above, shift, (count, met, height))
        return count + there.astype(jnp.int32), put(met, piece, place), put(height, v, place)

    count, met, height = loop(number, keep, (jnp.int32(0), met, height))
    return begun, count, met, height


def covers(layers: Array) -> Array:
    """Return 1 where there are layers, else 0."""
    return (layers > 0.5).astype(layers.dtype)


def _with_parts(pixel: Pixel, up: Array, seen: Seen, room: Room) -> Seen:
    """Return what is seen, with what a line that moves this way tells of pieces: of the steep ones
    one that moves up."""

    def one(k, state):
        length, moment = state
        row, place = pixel.row(k), pixel.place(k)
        steep = jnp.abs(row[3] - row[1]) > jnp.abs(row[2] - row[0])
        u0, u1 = (jnp.where(up, row[i + 1], row[i]) for i in (0, 2))
        whole, own = room.length[k], steep == up
        first = safe_divide(room.moment[k] - whole * u0, u1 - u0)
        length = put(length, jnp.where(own, whole, length[place]), place)
        return length, put(moment, jnp.where(own, first, moment[place]), place)

    length, moment = loop(pixel.number, one, (seen.length, seen.moment))
    return Seen(seen.area, length, moment)
