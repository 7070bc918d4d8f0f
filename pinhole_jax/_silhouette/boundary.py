"""The boundary integral: how what is seen of a contour carries motion from scene and camera to an
image, and back.

What a piece adds to a pixel is linear in its curve's homogeneous points. So these are
differentiated once, in one loop, and written to a table; a visible piece reads its row of it (or
adds to it). The table has room for this many curves (`BLOCK`); of more, one block after the other
is worked off.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .overlaps import Part

#: Curves in a table (whole chunks), and how many are differentiated together.
BLOCK, DIFFERENTIATED = 1 << 13, 512

#: `build(changing)` gives the parts of the contour.
Build = Callable[[list], list[Part]]
#: `fold(parts, add, start, (first, end))` gives `start` after `add(total, number, pixel, curve,
#: flux)` over all that is visible of curves with such ids (and perhaps of others).
Fold = Callable[[list[Part], Callable, Any, tuple[Array, Array]], Any]


def pushed(
    build: Build, changing: list, velocity: list, fold: Fold, put: Callable, image: Array
) -> Array:
    """Return the image after `put(image, pixel, change)` of what the visible contour changes where
    things move with a velocity."""
    parts = build(changing)

    def block(first, image):
        tables = []
        for number, part in enumerate(parts):

            def rates(table, row, ids, number=number):
                homogeneous = lambda changing: build(changing)[number].homogeneous_of(ids)
                rate = jax.jvp(homogeneous, (changing,), (velocity,))[1]
                return jax.lax.dynamic_update_slice_in_dim(table, rate, row, 0)

            tables.append(_each_chunk(part, first, rates, _table(part)))

        def add(image, number, pixel, curve, flux):
            rate = tables[number].at[_row(curve, first)].get(mode="fill", fill_value=0)
            return put(image, pixel, jnp.sum(flux * rate, axis=(-2, -1)))

        return fold(parts, add, image, (first, first + BLOCK))

    return _each_block(parts, block, image)


def pulled(build: Build, changing: list, fold: Fold, weigh: Callable) -> list:
    """Return by how much the sum of the pixels' areas, each times its `weigh(pixel)`, grows with
    what changes."""
    parts = build(changing)

    def block(first, total):
        def add(tables, number, pixel, curve, flux):
            share = weigh(pixel)[:, None, None] * flux
            more = tables[number].at[_row(curve, first)].add(share, mode="drop")
            return [*tables[:number], more, *tables[number + 1 :]]

        tables = [_table(part) for part in parts]
        tables = fold(parts, add, tables, (first, first + BLOCK))
        for number, (part, table) in enumerate(zip(parts, tables, strict=True)):

            def back(total, row, ids, number=number, table=table):
                homogeneous = lambda changing: build(changing)[number].homogeneous_of(ids)
                share = jax.lax.dynamic_slice_in_dim(table, row, DIFFERENTIATED)
                _, pull = jax.vjp(homogeneous, changing)
                return jax.tree.map(jnp.add, total, pull(share)[0])

            total = _each_chunk(part, first, back, total)
        return total

    return _each_block(parts, block, jax.tree.map(jnp.zeros_like, changing))


def _capacity(part: Part) -> int:
    """Return how many rows a part's table has: whole chunks."""
    chunks = -(-min(BLOCK, part.most or BLOCK) // DIFFERENTIATED)
    return chunks * DIFFERENTIATED


def _table(part: Part) -> Float[Array, "rows n 3"]:
    return jnp.zeros((_capacity(part), *part.homogeneous.shape[1:]), part.dtype)


def _row(curve: Int[Array, "P"], first: Int[Array, ""]) -> Int[Array, "P"]:
    """Return a curve's row in the table of a block; past the end for curves before it."""
    return jnp.where(curve < first, BLOCK, curve - first)


def _each_chunk(part: Part, first: Array, add: Callable[[Any, Array, Array], Any], start: Any):
    """Return `start` after `add(total, row, ids)` over the curves of a block, from whose first row
    on; past the last of all it is repeated."""
    end = jnp.minimum(part.total, first + _capacity(part)) - first

    def body(state):
        row, total = state
        ids = first + row + jnp.arange(DIFFERENTIATED, dtype=jnp.int32)
        return row + DIFFERENTIATED, add(total, row, jnp.minimum(ids, part.total - 1))

    return jax.lax.while_loop(lambda s: s[0] < end, body, (jnp.int32(0), start))[1]


def _each_block(parts: list[Part], block: Callable[[Array, Any], Any], start: Any) -> Any:
    most = jnp.max(jnp.stack([part.total for part in parts]))

    def body(state):
        first, total = state
        return first + BLOCK, block(first, total)

    return jax.lax.while_loop(lambda s: s[0] < most, body, (jnp.int32(0), start))[1]
