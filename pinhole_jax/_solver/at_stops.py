"""A line sweeps pixels that hold many straight pieces, on a CPU, and stops a few times, at equal
distances: what it meets there stands for its surroundings.

All stops at once: what is below a piece is asked of each other piece, which is 32 numbers that are
worked out side by side. To keep pieces in order from one stop to the next took twice as long.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.one_kernel import put
from .._numerics.safe import safe_divide
from .._silhouette.sweep import Cells, along_x, along_y
from .one_pixel import Pixel, Seen, both_ways, covers, either, loop

#: The line stops this many times. (The worst pixel of a scan errs by 2e-4.)
STOPS = 32
#: So many pieces are gone through at a time.
AT_A_TIME = 4


class Stops(NamedTuple):
    """Room for a pixel: how high each piece is where the line stops, infinite where it is not cut,
    and how many layers more are above it. (Above the last piece some rows are cut nowhere.)"""

    height: Float[Array, "M S"]
    jump: Float[Array, "M"]

    @classmethod
    def of(cls, most: int, dtype: jnp.dtype) -> "Stops":
        """Return room for so many pieces."""
        most += AT_A_TIME
        return cls(jnp.zeros((most, STOPS), dtype), jnp.zeros(most, dtype))


class _Layers(NamedTuple):
    """How many layers there are at each stop below all pieces, and above them."""

    below: Float[Array, "S"]
    above: Float[Array, "S"]


def stopping(pixel: Pixel, seen: Seen, room: Stops) -> tuple[Seen, Stops]:
    """Return the area of a pixel, and `seen` with what is seen of its pieces.

    The first line moves across the pieces, most of which are steep or are not.
    """
    none = jnp.zeros((), seen.length.dtype)
    start = none, none, jnp.array(False)
    across, along, twice = loop(pixel.number, lambda k, s: _reach(pixel, k, s), start)

    def line(up, seen, room):
        room, layers = _listed(pixel, up, room)
        seen, shows = _seen(pixel, up, room, layers, seen)
        return seen, room, shows

    return both_ways(pixel, across < along, twice, line, seen, room)


def _reach(pixel: Pixel, k: Array, reach: tuple[Array, ...]) -> tuple[Array, ...]:
    """Return how far pieces reach along x and along y, and whether one runs along either, with one
    more of them."""
    row = pixel.row(k)
    dx, dy = (jnp.abs(row[i + 2] - row[i]) for i in (0, 1))
    return reach[0] + dx, reach[1] + dy, reach[2] | (dx == 0) | (dy == 0)


def _places(dtype: jnp.dtype) -> Float[Array, "S"]:
    """Return where the line stops."""
    return (jnp.arange(STOPS, dtype=dtype) + 0.5) / STOPS


def _listed(pixel: Pixel, up: Bool[Array, ""], room: Stops) -> tuple[Stops, _Layers]:
    """Return room with a pixel's pieces, where a line moves `up` or to the right."""
    stop = _places(room.height.dtype)
    nowhere = jnp.full(STOPS, jnp.inf, stop.dtype)

    def one(k, state):
        room, layers = state
        cell = Cells(pixel.row(k)[None, None], jnp.zeros((1, 1, 2), jnp.int32))
        line = either(up, along_y(cell), along_x(cell))
        u0, v0, u1, v1, jump = (x[0, 0] for x in line[:5])
        # (What begins or ends just at a stop is of what comes, on the border as well.)
        there = (u0 <= stop) & (stop < u1)
        height = jnp.where(there, v0 + (stop - u0) * safe_divide(v1 - v0, u1 - u0), jnp.inf)
        met = layers.below
        for halt, change in zip(line.halt[0], line.step[0], strict=True):
            met = met + jnp.where(halt <= stop, change, 0)
        above = layers.above + (met - layers.below) + jnp.where(there, jump, 0)
        return Stops(put(room.height, height, k), put(room.jump, jump, k)), _Layers(met, above)

    def end(k, room):
        k = pixel.number + k
        return Stops(put(room.height, nowhere, k), put(room.jump, 0, k))

    corner = jnp.full(STOPS, 1, stop.dtype) * pixel.corner
    room, layers = loop(pixel.number, one, (room, _Layers(corner, corner)))
    return loop(jnp.int32(AT_A_TIME - 1), end, room), layers


def _seen(pixel: Pixel, up: Array, room: Stops, layers: _Layers, seen: Seen) -> tuple[Seen, Array]:
    """Return the covered area, and the lengths and moments of all pieces, with what such a line
    tells of the pixel's: of the steep ones one that moves up; and whether it saw anything but
    cover."""
    stop, apart = _places(room.height.dtype), 1 / STOPS

    def one(k, state):
        own, jump = room.height[k], room.jump[k]
        below = _below(k, own, pixel.number, room, layers.below)
        change = jnp.where(own < jnp.inf, covers(below + jump) - covers(below), 0)

        def add(_, state):
            area, _, length, moment = state
            row, place = pixel.row(k), pixel.place(k)
            steep = jnp.abs(row[3] - row[1]) > jnp.abs(row[2] - row[0])
            u0, u1 = (jnp.where(up, row[i + 1], row[i]) for i in (0, 2))
            whole = jnp.sum(change) * apart
            first = safe_divide(jnp.sum(change * stop) * apart - whole * u0, u1 - u0)
            length = put(length, jnp.where(steep == up, whole, length[place]), place)
            moment = put(moment, jnp.where(steep == up, first, moment[place]), place)
            cut_off = jnp.sum(jnp.where(change != 0, own * change, 0)) * apart
            return area - cut_off, jnp.array(True), length, moment

        return loop(jnp.any(change != 0).astype(jnp.int32), add, state)

    covered = covers(layers.above)
    start = jnp.sum(covered) * apart, jnp.any(covered < 1), seen.length, seen.moment
    area, shows, length, moment = loop(pixel.number, one, start)
    return Seen(jnp.where(shows, jnp.clip(area, 0, 1), 1), length, moment), shows


def _below(
    k: Int[Array, ""],
    own: Float[Array, "S"],
    number: Int[Array, ""],
    room: Stops,
    layers: Float[Array, "S"],
) -> Float[Array, "S"]:
    """Return how many layers there are below a piece: of equally high ones the first in the list is
    the lower."""

    def some(n, layers):
        for j in (AT_A_TIME * n + i for i in range(AT_A_TIME)):
            other = room.height[j]
            lower = (other < own) | ((other == own) & (j < k))
            layers = layers + jnp.where(lower, room.jump[j], 0)
        return layers

    return loop((number + AT_A_TIME - 1) // AT_A_TIME, some, layers)
