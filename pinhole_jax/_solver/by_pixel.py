"""What the pieces of a contour add up to in each pixel that they touch.

Pieces are taken in raster order. On a CPU one after the other, in a single kernel, so that a buffer
with more room than pieces costs nothing; elsewhere side by side.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._numerics.one_kernel import on_cpu, put
from .._numerics.running import running_sum


class Steps(NamedTuple):
    """Pieces: their pixels (`cell`), and what they add to these and beyond."""

    cell: Int[Array, "P"]
    height: Float[Array, "P"]
    area: Float[Array, "P"]
    turn: Float[Array, "P"]
    jump: Float[Array, "P"]
    counters: Int[Array, "P"]


class Totals(NamedTuple):
    """The pixels in raster order, unused slots last: their cells (the end's, if unused), where in
    the order their pieces begin, and how many these are; the winding number's mean in the pixel,
    the number right of it, and the one at its lower left corner; the sums of layers and of counters
    (see `Marks`); and, piece by piece, in which slot its pixel is (P: in none)."""

    cell: Int[Array, "P"]
    first: Int[Array, "P"]
    number: Int[Array, "P"]
    winding: Float[Array, "P"]
    after: Float[Array, "P"]
    corner: Float[Array, "P"]
    layers: Float[Array, "P"]
    counters: Int[Array, "P"]
    slot: Int[Array, "P"]


def by_pixel(
    steps: Steps,
    order: Int[Array, "P"],
    base: Float[Array, ""],
    width: Int[Array, ""],
    end: Int[Array, ""],
) -> Totals:
    """Return what pieces add up to, which are in raster `order`: rows of `width` cells, `base`
    layers on their left, no piece from the cell `end` on."""
    P = len(order)
    real, whole = jnp.zeros(P, steps.height.dtype), jnp.zeros(P, jnp.int32)
    none = Totals(whole + end, whole + P, whole, real, real, real, real, whole, whole + P)
    return on_cpu(_in_turn, steps, order, base, width, end, none, elsewhere=_side_by_side)


class _Here(NamedTuple):
    """The row and the slot of the last piece; the winding numbers right of it, along the pixels'
    middle and their bottom."""

    row: Int[Array, ""]
    slot: Int[Array, ""]
    after: Float[Array, ""]
    turned: Float[Array, ""]


def _in_turn(steps: Steps, order, base, width, end, none: Totals) -> Totals:
    P = len(order)

    def goes_on(state):
        k, _, _ = state
        return (k < P) & (steps.cell[order[jnp.minimum(k, P - 1)]] < end)

    def one(state):
        k, here, totals = state
        source = order[k]
        step = jax.tree.map(lambda x: x[source], steps)
        row = jax.lax.div(step.cell, width)
        last = jnp.maximum(here.slot, 0)
        same = (here.slot >= 0) & (totals.cell[last] == step.cell)
        slot = jnp.where(same, last, here.slot + 1)
        before = jnp.where(here.row == row, here.after, base)
        corner = jnp.where(here.row == row, here.turned, base)
        after, turned = before + step.height, corner + step.turn
        old = jax.tree.map(lambda x: x[slot], totals)
        new = Totals(
            cell=step.cell,
            first=jnp.where(same, old.first, k),
            number=old.number + 1,
            winding=jnp.where(same, old.winding, before) + step.area,
            after=after,
            corner=jnp.where(same, old.corner, corner),
            layers=old.layers + jnp.abs(step.jump),
            counters=old.counters + step.counters,
            slot=slot,
        )
        at = Totals._make([slot] * 8 + [source])
        return k + 1, _Here(row, slot, after, turned), jax.tree.map(put, totals, new, at)

    start = _Here(jnp.int32(-1), jnp.int32(-1), base, base)
    return jax.lax.while_loop(goes_on, one, (jnp.int32(0), start, none))[2]


def _side_by_side(steps: Steps, order, base, width, end, none: Totals) -> Totals:
    P = len(order)
    cell, height, area, turn, jump, counters = (x[order] for x in steps)
    changes = lambda x: jnp.append(True, x[1:] != x[:-1])
    number_of = lambda which: running_sum(which.astype(jnp.int32)) - 1
    new, new_row = changes(cell), changes(jax.lax.div(cell, width))
    slot, row = number_of(new), number_of(new_row)

    def within_row(steps):
        """Return the winding number before and after each piece's step."""
        running = running_sum(steps)
        upto = jnp.zeros_like(steps).at[row].add(jnp.where(new_row, running - steps, 0))[row]
        after = running - upto + base
        return jnp.where(new, after - steps, 0), after

    (before, after), (corner, _) = within_row(height), within_row(turn)
    beyond = jnp.where(jnp.append(new[1:], True), after, 0)
    slot = jnp.where(cell < end, slot, P)
    put = lambda to, x: to.at[slot].add(x, mode="drop")
    return Totals(
        cell=none.cell.at[slot].set(cell, mode="drop"),
        first=none.first.at[slot].min(jnp.arange(P, dtype=jnp.int32), mode="drop"),
        number=put(none.number, 1),
        winding=put(none.winding, before + area),
        after=put(none.after, beyond),
        corner=put(none.corner, corner),
        layers=put(none.layers, jnp.abs(jump)),
        counters=put(none.counters, counters),
        slot=none.slot.at[order].set(slot),
    )
