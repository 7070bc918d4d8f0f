"""Sums over all pixels of a level, of which a contour touches a few.

Runs of untouched pixels lie between the touched ones: after each up to its row's end, then up to
the next one. Their cost is a difference of the target's running sums. On a CPU one run follows the
other, in a single kernel; elsewhere they are looked at side by side.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._mask.pyramid import Level, Pyramid, cells_of
from .._numerics.one_kernel import on_cpu

#: A pixel that is covered, or uncovered, but for less than this shows no outline.
HIDDEN = 1e-4


class Seen(NamedTuple):
    """Touched pixels in raster order, unused slots last: their cells, whether they count (within
    the window, and their coverage known), what is covered, and whether what follows in the row
    is."""

    cell: Int[Array, "*P"]
    inside: Bool[Array, "*P"]
    known: Bool[Array, "*P"]
    coverage: Float[Array, "*P"]
    covered_after: Bool[Array, "*P"]


class Parts(NamedTuple):
    """What touched pixels and runs add up to (see `Sums`); of runs `rest`, the squares, alone."""

    rest: Float[Array, "*P"]
    squares: Float[Array, "*P"]
    overlap: Float[Array, "*P"]
    covered: Float[Array, "*P"]
    mass: Float[Array, "*P"]
    weight: Float[Array, "*P"]
    touched: Float[Array, "*P"]
    touched_squares: Float[Array, "*P"]
    off: Float[Array, "*P"]


def summed(
    pyramid: Pyramid, level: Level, seen: Seen, covered_before: Bool[Array, ""]
) -> tuple[Float[Array, "P"], Float[Array, "P"], Parts]:
    """Return target and weight (0 where a pixel does not count) of touched pixels, and the sums
    over all of the level; `covered_before` says whether rows begin covered."""
    none = jnp.zeros_like(seen.coverage)
    given = pyramid, level, seen, covered_before, none, none
    return on_cpu(_in_turn, *given, elsewhere=_side_by_side)


def _in_turn(pyramid, level, seen, covered_before, target, weight):
    P, end = len(seen.cell), level.H * (level.W + 2)

    def one(state):
        k, before, covered, target, weight, sums, lost = state
        here = jax.tree.map(lambda x: x[jnp.minimum(k, P - 1)], seen)
        here = here._replace(cell=jnp.where(k < P, here.cell, end))
        here_target, here_weight, parts = _at(
            pyramid, level, here, (before, covered), covered_before
        )
        # (Kahan's sum: what each addition loses is added to the next.)
        more = jnp.stack(parts) - lost
        total = sums + more
        lost = (total - sums) - more
        place = jnp.minimum(k, P - 1)
        put = lambda x, new: jax.lax.dynamic_update_slice(
            x, jnp.where(k < P, new, x[place])[None], (place,)
        )
        target, weight = put(target, here_target), put(weight, here_weight)
        return k + 1, here.cell, here.covered_after, target, weight, total, lost

    zero = jnp.zeros(len(Parts._fields), target.dtype)
    start = jnp.int32(0), jnp.int32(-1), covered_before, target, weight, zero, zero
    goes_on = lambda state: (state[0] <= P) & (state[1] < end)
    *_, target, weight, sums, _ = jax.lax.while_loop(goes_on, one, start)
    return target, weight, _with_all(Parts(*sums), pyramid, level)


def _side_by_side(pyramid, level, seen, covered_before, target, weight):
    end = level.H * (level.W + 2)
    last = Seen(end, jnp.array(False), jnp.array(True), jnp.zeros((), target.dtype), covered_before)
    every = jax.tree.map(lambda x, one: jnp.append(x, one), seen, last)
    before = jnp.append(jnp.int32(-1), seen.cell), jnp.append(covered_before, seen.covered_after)
    at = lambda seen, before: _at(pyramid, level, seen, before, covered_before)
    target, weight, parts = jax.vmap(at)(every, before)
    parts = Parts(*(jnp.sum(x) for x in parts))
    return target[:-1], weight[:-1], _with_all(parts, pyramid, level)


def _with_all(parts: Parts, pyramid: Pyramid, level: Level) -> Parts:
    """Return the sums with all pixels' weights and masses, of which those left out are known."""
    first, end = (cells_of(pyramid, level, jnp.int32(k)) for k in (0, level.H * (level.W + 2)))
    mass, weight = end.masses - first.masses, end.weights - first.weights
    return parts._replace(mass=mass - parts.mass, weight=weight - parts.weight)


def _at(
    pyramid: Pyramid,
    level: Level,
    seen: Seen,
    before: tuple[Int[Array, ""], Bool[Array, ""]],
    covered_before: Bool[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""], Parts]:
    """Return a touched pixel's target and weight, and what it and the run before it add: `before`
    are the cell of the touched one before, and whether what follows that in its row is covered."""
    end = level.H * (level.W + 2)
    begin = jnp.minimum(before[0] + 1, end)
    row_end = jnp.minimum(_row_start(level, begin + level.W + 1), seen.cell)
    limits = [cells_of(pyramid, level, cell) for cell in (begin, row_end, seen.cell)]
    runs = [(before[1], limits[0], limits[1]), (covered_before, limits[1], limits[2])]
    over = lambda of: functools.reduce(
        jnp.add, [jnp.where(covered, *of(a, b)) for covered, a, b in runs]
    )
    rest = over(lambda a, b: (b.full - a.full, b.empty - a.empty))
    run_weight = over(lambda a, b: (b.weights - a.weights, 0))
    run_mass = over(lambda a, b: (b.masses - a.masses, 0))

    target, all_weight = limits[2].target, jnp.where(seen.inside, limits[2].weight, 0)
    weight, out = (jnp.where(which, all_weight, 0) for which in (seen.known, ~seen.known))
    square = weight * (seen.coverage - target) ** 2
    shown = (seen.coverage > HIDDEN) & (seen.coverage < 1 - HIDDEN) & (weight > 0)
    number = lambda which: jnp.where(which, 1, 0).astype(target.dtype)
    return (
        target,
        weight,
        Parts(
            rest=rest,
            squares=square,
            overlap=run_mass + weight * jnp.minimum(seen.coverage, target),
            covered=run_weight + weight * seen.coverage,
            mass=out * target,
            weight=out,
            touched=number(shown),
            touched_squares=jnp.where(shown, square, 0),
            off=number(shown & (jnp.sqrt(square) > level.explained)),
        ),
    )


def _row_start(level: Level, cell: Int[Array, "*P"]) -> Int[Array, "*P"]:
    """Return the first cell of the row that a cell is in."""
    return cell - cell % (level.W + 2)
