"""Union coverage of a fit's pixels in which contours overlap, and which pieces bound it.

Winding numbers add up where parts of a scene overlap, coverage does not: where two half covered
layers coincide, a pixel is half covered, not whole. A fit has the pieces of its pixels side by
side, so such a pixel is swept as it is. One of a rough mesh that holds many is swept by a line that
stops a few times. Where all curves are straight, a CPU sweeps one pixel after the other, in a
single kernel (`one_pixel`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.batches import in_chunks
from .._numerics.one_kernel import on_cpu, put
from .._silhouette.hidden import all_hidden
from .._silhouette.sweep import STRAIGHT, Cells, sweep
from .at_stops import STOPS, Stops, stopping
from .one_pixel import Pixel, Room, Seen, loop, swept

#: This many pixels are swept together.
TOGETHER = 64
#: This many pieces a pixel may hold. (Of some 430 to 1250 pixels of a smooth mesh's outline more
#: are in none at 5k faces and 256 px, in 3 at 82k, in 10 at 328k, and in 21 at 328k and 512 px.)
MOST = 16
#: Buffers for this many pieces are those of rough meshes, most of whose overlapping pixels are
#: covered.
LARGE = 1 << 13
#: There a pixel with more, up to so many, is swept by a line that stops a few times. (Of a scan of
#: 82k faces more than 16 are in 240 to 470 pixels, 60 to 190 of which show an outline; more than 64
#: in 24 at most, 4 of these.)
CROWDED = 64

#: Where the numbers of a straight piece say its visible length and that's first moment.
LENGTH, MOMENT = 5, 6


class Part(NamedTuple):
    """The pieces of one kind: what of each bounds the union (see `Visible`), and their curves'
    homogeneous points."""

    visible: Float[Array, "P numbers"]
    homogeneous: Float[Array, "P n 3"]


def whole(ends: Float[Array, "P 4"], jump: Float[Array, "P"]) -> Float[Array, "P numbers"]:
    """Return straight pieces with these ends (x, y, x, y) that are visible throughout (see
    `Visible`)."""
    dx, dy = ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1]
    steep = jnp.abs(dy) > jnp.abs(dx)
    length = jump * jnp.where(steep, dy, -dx)
    rest = jnp.stack([steep.astype(dx.dtype), length, length / 2], axis=-1)
    return jnp.concatenate([ends, rest], axis=-1)


class Overlapping(NamedTuple):
    """Pixels, some `chosen` to be resolved: the first of a pixel's pieces, and their
    number; its lower left corner (px), and the winding number there."""

    chosen: Bool[Array, "P"]
    first: Int[Array, "P"]
    number: Int[Array, "P"]
    origin: Float[Array, "P 2"]
    corner: Float[Array, "P"]


def most_pieces(P: int, straight: bool) -> int:
    """Return how many pieces a pixel may hold that is resolved, in buffers for P of them."""
    return CROWDED if P >= LARGE and straight else MOST


def resolved(
    overlapping: Overlapping,
    piece: tuple[Float[Array, "P"], ...],
    order: Int[Array, "P"],
    parts: list[Part],
) -> tuple[Float[Array, "P"], list[Float[Array, "_ _"]]]:
    """Return the chosen pixels' covered areas, and what is visible of all pieces.

    `piece` holds the pieces of the parts, one after the other, column by column (see `Cells`);
    `order` says which of them come, pixel by pixel.
    """
    given, straight = (overlapping, piece, order), _all_straight(parts)
    if not straight:
        return _side_by_side(*given, parts)

    def columns(visible):
        whole = jnp.concatenate(visible)
        return whole[:, LENGTH], whole[:, MOMENT]

    def elsewhere(overlapping, piece, order, seen, parts, room):
        del seen, room
        areas, visible = _side_by_side(overlapping, piece, order, parts)
        return areas, *columns(visible)

    P, real = len(order), overlapping.corner.dtype
    seen = jnp.zeros(P, real), *columns([part.visible for part in parts])
    room: tuple[Any, ...] = (Room.of(MOST, real),)
    if (most := most_pieces(P, straight)) > MOST:
        room = *room, Stops.of(most, real)
    areas, *seen = on_cpu(_in_turn, *given, seen, parts, room, elsewhere=elsewhere)
    visible, begin = [], 0
    for part in parts:
        own = [x[begin : begin + len(part.visible), None] for x in seen]
        visible.append(jnp.concatenate([part.visible[:, :LENGTH], *own], axis=1))
        begin += len(part.visible)
    return areas, visible


def _all_straight(parts: list[Part]) -> bool:
    return all(part.visible.shape[-1] == STRAIGHT for part in parts)


def _in_turn(overlapping: Overlapping, piece, order, seen, parts, room):
    """Return the areas, and all pieces' visible lengths and their first moments."""
    del parts
    P = len(order)

    def one(state):
        slot, areas, length, moment, room = state
        first, number = overlapping.first[slot], overlapping.number[slot]
        place = lambda k: order[first + k]
        row = lambda k: jnp.stack([x[place(k)] for x in piece])
        pixel = Pixel(row, place, number, overlapping.corner[slot])

        def by(way):
            def sweep_it(_, state):
                areas, length, moment, room = state
                nothing = Seen(jnp.zeros((), areas.dtype), length, moment)
                seen, room = way(pixel, nothing, room)
                return put(areas, seen.area, slot), seen.length, seen.moment, room

            return sweep_it

        chosen, few = overlapping.chosen[slot], number <= MOST
        state, rooms = (areas, length, moment), []
        ways = ((swept, few), (stopping, ~few))[: len(room)]
        for (way, own), its in zip(ways, room, strict=True):
            once = (chosen & own).astype(jnp.int32)
            *state, its = loop(once, by(way), (*state, its))
            rooms.append(its)
        return slot + 1, *state, tuple(rooms)

    goes_on = lambda s: (s[0] < P) & (overlapping.number[jnp.minimum(s[0], P - 1)] > 0)
    return jax.lax.while_loop(goes_on, one, (jnp.int32(0), *seen, room))[1:4]


def _side_by_side(
    overlapping: Overlapping,
    piece: tuple[Float[Array, "P"], ...],
    order: Int[Array, "P"],
    parts: list[Part],
) -> tuple[Float[Array, "P"], list[Float[Array, "_ _"]]]:
    """Return what `resolved` does, of pixels some at a time."""
    P = len(order)
    sizes = [len(part.homogeneous) for part in parts]
    begins = [sum(sizes[:k]) for k in range(len(parts))]
    frames = [
        None if part.visible.shape[-1] == STRAIGHT else lambda ids, part=part: part.homogeneous[ids]
        for part in parts
    ]

    def some(slot, there, most=MOST):
        """Return the pieces of some pixels."""
        place = jnp.arange(most, dtype=jnp.int32)[None]
        own = there[:, None] & (place < overlapping.number[slot][:, None])
        source = order[jnp.minimum(overlapping.first[slot][:, None] + place, P - 1)]
        kind = sum((source >= begin).astype(jnp.int32) for begin in begins[1:])
        kind = jnp.where(own, kind, -1)
        ids = source - jnp.asarray(begins, jnp.int32)[kind]
        columns = [jnp.where(own, column[source], 0) for column in piece]
        return Cells(jnp.stack(columns, axis=-1), jnp.stack([kind, ids], axis=-1))

    def with_parts(visible, cells, parts):
        """Return what is visible, with parts of some pixels' pieces."""
        kind, ids = jnp.moveaxis(cells.owner, -1, 0)
        return [
            old.at[jnp.where(kind == k, ids, size)].set(new, mode="drop")
            for k, (old, new, size) in enumerate(zip(visible, parts, sizes, strict=True))
        ]

    def look(state, slot, there):
        chosen, areas, visible = state
        cells = some(slot, there)
        hidden = there & all_hidden(cells, overlapping.corner[slot])
        slot = jnp.where(hidden, slot, P)
        inside = Cells(cells.piece, jnp.where(hidden[:, None, None], cells.owner, -1))
        nothing = [jnp.zeros((), part.visible.dtype) for part in parts]
        chosen = chosen.at[slot].set(False, mode="drop")
        areas = areas.at[slot].set(1, mode="drop")
        return chosen, areas, with_parts(visible, inside, nothing)

    def resolve(state, slot, there, most=MOST, stops=None):
        areas, visible = state
        cells = some(slot, there, most)
        scale = jnp.ones((), overlapping.corner.dtype)
        area, seen = sweep(
            cells, overlapping.corner[slot], frames, scale, overlapping.origin[slot], True, stops
        )
        areas = areas.at[jnp.where(there, slot, P)].set(area, mode="drop")
        return areas, with_parts(visible, cells, [new.part for new in seen])

    number, chosen = overlapping.number, overlapping.chosen
    start = jnp.zeros(P, overlapping.corner.dtype), [part.visible for part in parts]
    slots, total = _by_number(chosen, number)
    if most_pieces(P, frames == [None]) == MOST:
        return _fold((slots, total), resolve, start)

    few = chosen & (number <= MOST)
    upto = jnp.sum(few, dtype=jnp.int32)
    few, *state = _fold((slots, upto), look, (few, *start))
    state = _fold(_by_number(few, number), resolve, tuple(state))
    crowd = partial(resolve, most=CROWDED, stops=jnp.int32(STOPS))
    return _fold((slots, total), crowd, state, upto)


def _by_number(chosen: Bool[Array, "P"], number: Int[Array, "P"]) -> tuple[Array, Array]:
    """Return the pixels (P,), the chosen ones first, and how many these are. Those with few pieces
    come first: what is swept together takes as long as the one with the most."""
    P = len(number)
    key = jnp.where(chosen, number, CROWDED + 1).astype(jnp.int32)
    ranked = jax.lax.sort(key * P + jnp.arange(P, dtype=jnp.int32), is_stable=False)
    return ranked % P, jnp.sum(chosen, dtype=jnp.int32)


def _fold(
    among: tuple[Array, Array],
    add: Callable[[Any, Array, Array], Any],
    start: Any,
    first: Array | int = 0,
) -> Any:
    """Return `start` after `add(state, slot, there)` over the first of some pixels, some at a
    time, from the one number `first` on."""
    slots, total = among

    def chunk(state, rank):
        turn = rank + jnp.arange(TOGETHER, dtype=jnp.int32)
        slot = slots[jnp.minimum(turn, len(slots) - 1)]
        return add(state, slot, turn < total)

    return in_chunks(chunk, start, TOGETHER, total, jnp.int32(first))
