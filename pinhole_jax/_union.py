"""Coverage of a union, where contours overlap within a pixel.

Winding numbers add up where things overlap, coverage does not. A pixel that one chain of contour
crosses holds k layers and k+1, and the clamped sum is right. Any other pixel is resolved here: a
line sweeps it, halting where a piece begins, ends or crosses another, and between two halts the
pieces keep their order, so what is covered is a row of trapezoids (with arcs for sides). Which
pieces bound it, and over what part of their length, is all that the derivative needs.

The sweep compares areas, never asks whether two pieces touch: pieces that coincide, end on one
another or have no length put halts too close to matter, and nothing else. Pieces that are equal are
merged. A cell with more than `MOST` pieces is cut into smaller cells, depth first, so that memory
is bounded; at the last cut (`LAST_CUT`) the corner speaks for a cell of 1/65536 px.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._coverage import Monotone, Pieces, at_row, monotone, piece_counts, split
from ._curves import Curves, placed
from ._sweep import MOST, Cells, Visible, empty_cells, insert, sweep

CELLS = 512
CUT = 4
PARENTS = CELLS // CUT**2
LAST_CUT = {"float32": 4, "float64": 8}
PIECES = 4096


class Part(NamedTuple):
    """Curves of one kind: `curves(ids)` for ids below `total`; `size` is a static chunk of them.

    `lifts(ids)` is what the curves move with, differentiably.
    """

    curves: Callable[[Int[Array, "K"]], Curves]
    lifts: Callable[[Int[Array, "K"]], Float[Array, "K n 3"]]
    total: Int[Array, ""]
    size: int


class Crowded(NamedTuple):
    """Pixels to be resolved, `total` of them.

    `cell(rank)` gives row (from the bottom), column and place of the rank-th; `rank(row, column)`
    the rank of a pixel, -1 for others.
    """

    total: Int[Array, ""]
    cell: Callable[[Int[Array, "K"]], tuple[Array, Array, Array]]
    rank: Callable[[Int[Array, "K"], Int[Array, "K"]], Int[Array, "K"]]


class Resolved(NamedTuple):
    """Some cells: the pixel's `place`, the `area` that they add to it (px^2), what is visible."""

    place: Int[Array, "C"]
    area: Float[Array, "C"]
    visible: list[Visible]


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
        slot = count[level] + jnp.cumsum(crowd, dtype=jnp.int32) - 1
        slot = jnp.where(crowd, slot, CELLS)
        return _Stack(
            self.origin.at[level, slot].set(batch.origin, mode="drop"),
            self.place.at[level, slot].set(batch.place, mode="drop"),
            count.at[level].add(jnp.sum(crowd, dtype=jnp.int32)),
        )


class Marks(NamedTuple):
    """What tells a pixel that one chain of contour crosses from one where contours overlap.

    Sums over the pixel's pieces: how many there are, how many may come in from other pixels, their
    layers, and their extents without and with sign.
    """

    pieces: Float[Array, "*N"]
    entries: Float[Array, "*N"]
    layers: Float[Array, "*N"]
    height: Float[Array, "*N"]
    up: Float[Array, "*N"]
    width: Float[Array, "*N"]
    right: Float[Array, "*N"]


MARKS = len(Marks._fields)


def marks(pieces: Pieces) -> Float[Array, "P 7"]:
    """Return what each piece adds to its pixel's marks."""
    layers = jnp.abs(pieces.jump)
    dx, dy = jnp.moveaxis(pieces.end - pieces.start, -1, 0)
    up, right = -pieces.jump * dy, -pieces.jump * dx
    flags = [x.astype(layers.dtype) for x in (pieces.valid, pieces.valid & pieces.enters)]
    return jnp.stack([*flags, layers, jnp.abs(up), up, jnp.abs(right), right], axis=-1)


def chain_layers(marks: Float[Array, "*N 7"]) -> Float[Array, "*N"]:
    """Return how many layers a pixel's contour bounds if it is one chain that never turns back.

    0 where it may be anything else: then parts of the pixel may be uncovered and others covered
    more than once.
    """
    m = Marks(*jnp.moveaxis(marks, -1, 0))
    tiny = 8 * jnp.finfo(marks.dtype).eps
    straight = (m.height - jnp.abs(m.up) <= tiny * (1 + m.height)) | (
        m.width - jnp.abs(m.right) <= tiny * (1 + m.width)
    )
    chain = (m.entries == 1) & straight
    layers = jnp.where(m.layers == m.pieces, 1, jnp.where(m.layers == 2 * m.pieces, 2, 0))
    return jnp.where(chain, layers, 0).astype(marks.dtype)


def overlaps(marks: Float[Array, "*N 7"], winding: Float[Array, "*N"]) -> Bool[Array, "*N"]:
    """Return which pixels must be resolved: not crossed by one chain of one layer, and with so few
    layers (`winding`, the mean) that the pieces in them might take all away."""
    layers = marks[..., Marks._fields.index("layers")]
    return (layers > 0) & (chain_layers(marks) != 1) & (winding <= layers)


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
    dtype = jax.eval_shape(parts[0].curves, jnp.zeros(1, jnp.int32)).weight.dtype
    depth = LAST_CUT[jnp.dtype(dtype).name]

    def body(state):
        first, stack, total = state
        level = stack.deepest()
        batch = _batch(crowded, first, stack, level, (W, H, max_H))
        cells, corner = empty_cells(CELLS, dtype), base.astype(dtype)
        for number, part in enumerate(parts):
            cells, turns = _fill(cells, number, part, crowded, first, batch)
            corner = corner + turns
        lifts = [part.lifts for part in parts]
        area, visible = sweep(cells, corner, lifts, batch.scale, batch.origin, flux)
        used, last = batch.place >= 0, level == depth
        crowd = (cells.total > MOST) & used
        # Where there are too many pieces even in the last cell, its corner speaks for it.
        area = jnp.where(crowd, jnp.where(last, jnp.clip(corner, 0, 1), 0), area)
        size = 1 / (batch.scale * batch.scale)
        keep = (used & ~crowd)[:, None, None, None]
        visible = [v._replace(flux=jnp.where(keep, v.flux, 0)) for v in visible]
        place = jnp.where(used, batch.place, jnp.iinfo(jnp.int32).max)
        total = add(total, Resolved(place, area * size, visible))
        stack = stack.push(crowd & ~last, jnp.minimum(level + 1, depth), batch)
        return jnp.where(level == 0, first + CELLS, first), stack, total

    zeros = jnp.zeros((depth + 1, CELLS), dtype)
    counts = jnp.zeros(depth + 1, jnp.int32)
    stack = _Stack(jnp.stack([zeros, zeros], axis=-1), zeros.astype(jnp.int32), counts)
    more = lambda state: (state[0] < crowded.total) | jnp.any(state[1].height > 0)
    return jax.lax.while_loop(more, body, (jnp.int32(0), stack, start))[2]


class _Batch(NamedTuple):
    """Cells that are resolved together, and the small films on which their pieces are found.

    At level 0 the cells are pixels of the one film; else each film is a cell that is cut.
    """

    level: Int[Array, ""]
    scale: Float[Array, ""]
    films: Float[Array, "F 2"]
    film: tuple[Any, Any, int]
    origin: Float[Array, "C 2"]
    place: Int[Array, "C"]


def _batch(crowded: Crowded, first: Array, stack: _Stack, level: Array, film: tuple) -> _Batch:
    """Return the next cells: of the deepest level that has any, else the next pixels."""
    W, H, max_H = film
    dtype = stack.origin.dtype
    at_pixels = level == 0
    rank = first + jnp.arange(CELLS, dtype=jnp.int32)
    row, column, place = crowded.cell(jnp.clip(rank, 0, jnp.maximum(crowded.total - 1, 0)))
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
    )


# --- which pieces lie in which cell --------------------------------------------------------------


def fold_curves(part: Part, add: Callable[[Any, Array, Curves], Any], start: Any, size: int) -> Any:
    """Return `start` after `add(total, ids, curves)` over all curves, `size` at a time."""

    def body(state):
        first, total = state
        ids = first + jnp.arange(size, dtype=jnp.int32)
        curves = jax.lax.stop_gradient(part.curves(jnp.minimum(ids, part.total - 1)))
        weight = jnp.where(ids < part.total, curves.weight, 0)
        return first + size, add(total, ids, curves._replace(weight=weight))

    return jax.lax.while_loop(lambda s: s[0] < part.total, body, (jnp.int32(0), start))[1]


def fold_pieces(
    curves: Curves, W: Any, H: Any, max_H: int, add: Callable[[Any, Pieces], Any], start: Any
) -> Any:
    """Return `start` after `add(total, pieces)` over all pieces of some curves."""
    m = monotone(curves)
    upto = jnp.cumsum(piece_counts(m, W, H))

    def body(state):
        slot, total = state
        slots = slot + jnp.arange(PIECES, dtype=jnp.int32)
        return slot + PIECES, add(total, split(m, upto, slots, W, H, max_H))

    return jax.lax.while_loop(lambda s: s[0] < upto[-1], body, (jnp.int32(0), start))[1]


def _fill(
    cells: Cells, number: int, part: Part, crowded: Crowded, first: Array, batch: _Batch
) -> tuple[Cells, Float[Array, "C"]]:
    """Return the cells with a part's pieces, and what it adds to the corners' winding numbers."""
    at_pixels = batch.level == 0
    size = -(-part.size // PARENTS) * PARENTS
    per_film = jnp.where(at_pixels, jnp.int32(size), jnp.int32(size // PARENTS))
    W, H, max_H = batch.film
    pair = jnp.arange(size, dtype=jnp.int32)

    def body(state):
        start, cells, corner = state
        ids = start + jax.lax.rem(pair, per_film)
        curves = jax.lax.stop_gradient(part.curves(jnp.minimum(ids, part.total - 1)))
        curves = curves._replace(weight=jnp.where(ids < part.total, curves.weight, 0))
        curves = placed(curves, batch.scale, batch.films[jax.lax.div(pair, per_film)])

        def add(cells, pieces: Pieces):
            inside = pieces.valid & (pieces.column >= 0) & (pieces.column < W)
            row, column = (jnp.where(inside, x, 0) for x in (pieces.row, pieces.column))
            rank = crowded.rank(row, column)
            pixel = jnp.where((rank >= first) & (rank < first + CELLS), rank - first, CELLS)
            child = (jax.lax.div(pieces.curve, per_film) * CUT + row) * CUT + column
            cell = jnp.where(inside, jnp.where(at_pixels, pixel, child), CELLS)
            return insert(cells, cell, pieces, ids[pieces.curve], number)

        corner = corner + jax.lax.cond(at_pixels, _pixel_turns, _child_turns, curves, batch.origin)
        return start + per_film, fold_pieces(curves, W, H, max_H, add, cells), corner

    state = (jnp.int32(0), cells, jnp.zeros(CELLS, batch.origin.dtype))
    return jax.lax.while_loop(lambda s: s[0] < part.total, body, state)[1:]


def _pixel_turns(curves: Curves, corners: Float[Array, "C 2"]) -> Float[Array, "C"]:
    """Return what curves add to the winding numbers just left of and above points."""
    m = monotone(curves)

    def at(point):
        jump, x = _crossing(m, point[1])
        return jnp.sum(jnp.where(x < point[0], jump, 0))

    return jax.vmap(at)(corners)


def _child_turns(curves: Curves, corners: Float[Array, "C 2"]) -> Float[Array, "C"]:
    """Return the same for the children's corners; `curves` are those of each film in turn."""
    lines = jnp.arange(CUT, dtype=corners.dtype)
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
