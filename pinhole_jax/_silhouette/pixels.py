"""A film's pixels: all pieces of curves in them, and the layers at their corners."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics.batches import Total, fold_groups
from .contour import Contour
from .pieces import Monotone, PieceKeys, in_row, pieces_at, rows_met

#: The curves, places and presence of some pieces, to be added to a total.
Add = Callable[[Total, Monotone, PieceKeys, Bool[Array, "P"]], Total]


class Pixels(NamedTuple):
    """A film's pixels, from the bottom row up, each row from the left.

    - `coverage`: of those that no piece of a curve can change; else 0.
    - `corner`: layers at the lower left corner.
    - `number`: pieces, of the others.
    """

    coverage: Float[Array, "N"]
    corner: Float[Array, "N"]
    number: Int[Array, "N"]


def fold_film(curves: Contour, film: tuple[int, int], add: Add[Total], start: Total) -> Total:
    """`start` after `add(total, curves, places, there)` over all pieces of a film of W x H."""
    W, H = film
    pick = lambda tree, at: jax.tree.map(lambda x: x[at], tree)

    def of_curves(total, _, part, there):
        m = curves.monotone(part)
        first, end = rows_met(m, H)

        def of_rows(total, k, rank, there):
            own, row = pick(m, k), first[k] + rank
            here = in_row(own, row, W)
            number = jnp.where(there, jnp.abs(here.last - here.first) + 1, 0)

            def of_pixels(total, n, rank, there):
                along = jnp.where(here.last[n] >= here.first[n], rank, -rank)
                places = PieceKeys(part[k[n]], row[n], here.first[n] + along)
                return add(total, pick(own, n), places, there)

            return fold_groups(number, of_pixels, total)

        return fold_groups(end - first, of_rows, total)

    return fold_groups(curves.upto[-1:], of_curves, start)


def pixels_of(curves: Contour, film: tuple[int, int], base: Int[Array, ""]) -> Pixels:
    """A film's pixels; `base` layers lie far to the left."""
    W, H = film
    real = curves.tail.dtype

    def add(total, m, places, there):
        number, layers, jumps = total
        pixel = jnp.where(there, places.pixel(film), W * H)
        bottom = there & pieces_at(m, places, W).bottom
        row = jnp.where(bottom, places.row, H)
        return (
            number.at[pixel].add(1, mode="drop"),
            layers.at[pixel].add(jnp.abs(m.jump), mode="drop"),
            jumps.at[row, places.column + 1].add(m.jump, mode="drop"),
        )

    none, real_none = jnp.zeros(W * H, jnp.int32), jnp.zeros(W * H, real)
    number, layers, jumps = fold_film(
        curves, film, add, (none, real_none, jnp.zeros((H, W + 2), real))
    )
    corner = base.astype(real) + jnp.cumsum(jumps, axis=1)[:, :W].reshape(-1)
    covered = corner - layers > 0.5
    return Pixels(covered.astype(real), corner, jnp.where(covered, 0, number))
