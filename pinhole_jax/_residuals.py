"""Coverage minus target, only at the pixels that a contour touches.

Pieces of the contour are sorted by pixel. A running sum of their heights gives the coverage of each
touched pixel and of the runs of untouched pixels between them, whose cost is a difference of the
target's running sums. The work does not depend on the number of pixels, so one compiled program
serves every level and every image.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._camera import Camera, FilmMap, film_map
from ._contour import (
    ARCS_PER_SPHERE,
    edge_segments,
    mesh_contour,
    nth,
    rank_in,
    select,
    sphere_arcs,
    surrounding,
)
from ._coverage import monotone, piece_counts, split
from ._curves import Arcs, Curves, Segments, moved, piece_flux, placed
from ._scene import Scene
from ._target import Level, Pyramid, level_slice
from ._union import Crowded, Part, Resolved, fold_cells, marks, overlaps

MAX_ROWS = 1 << 14


class Capacity(NamedTuple):
    """Static sizes: contour edges of the mesh, and pieces of edges and of arcs."""

    edges: int
    pieces: int
    arc_pieces: int


class Touched(NamedTuple):
    """The pixels that the contour touches, in raster order; unused slots have `cell` past the end.

    `coverage` is differentiable; `covered_after` tells whether the run of untouched pixels that
    follows is covered.
    """

    cell: Int[Array, "P"]
    inside: Bool[Array, "P"]
    coverage: Float[Array, "P"]
    covered_after: Bool[Array, "P"]


class Sums(NamedTuple):
    """Weighted sums over all pixels: squared residual, min and max of coverage and target, weight.

    `touched` counts the pixels with weight that the contour touches, `touched_squares` is theirs.
    """

    squares: Float[Array, ""]
    overlap: Float[Array, ""]
    union: Float[Array, ""]
    weight: Float[Array, ""]
    touched: Float[Array, ""]
    touched_squares: Float[Array, ""]


class Load(NamedTuple):
    """How much of each capacity a view needs; a lower bound once `edges` is over its capacity."""

    edges: Int[Array, ""]
    pieces: Int[Array, ""]
    arc_pieces: Int[Array, ""]

    def fits(self, capacity: Capacity) -> Bool[Array, ""]:
        """Return whether every capacity suffices."""
        return jnp.all(jnp.stack(self) <= jnp.array(capacity, jnp.int32))


def residuals(
    camera: Camera, scene: Scene, pyramid: Pyramid, level: Level, capacity: Capacity
) -> tuple[tuple[Float[Array, "P"], Float[Array, ""]], Sums, Load]:
    """Return the weighted residuals at touched pixels, the rest's root sum of squares, sums, load.

    The sum of all squares is the weighted squared distance of the image from the target. The rest
    is constant in the camera to first order. Where a capacity is too small all is NaN, so that a
    solver does not step there.
    """
    touched, load = touch(camera, scene, level, capacity)
    end = level.H * (level.W + 2)
    here = level_slice(pyramid, level, touched.cell)
    weight = jnp.where(touched.inside, here.weight, 0)
    difference = jnp.sqrt(weight) * (touched.coverage - here.target)

    # Runs of untouched pixels: before the first slot, and after each.
    first = jnp.zeros(1, jnp.int32)
    begin = level_slice(pyramid, level, jnp.minimum(jnp.append(first, touched.cell + 1), end))
    until = level_slice(pyramid, level, jnp.append(touched.cell, jnp.atleast_1d(end)))
    covered = jnp.append(jnp.zeros(1, bool), touched.covered_after)
    run = jax.tree.map(lambda a, b: b - a, begin, until)
    rest = jnp.sum(jnp.where(covered, run.full, run.empty))

    coverage = jax.lax.stop_gradient(touched.coverage)
    covered_weight = jnp.sum(jnp.where(covered, run.weights, 0)) + jnp.sum(weight * coverage)
    overlap = jnp.sum(jnp.where(covered, run.masses, 0)) + jnp.sum(
        weight * jnp.minimum(coverage, here.target)
    )
    ends = level_slice(pyramid, level, jnp.stack([jnp.zeros_like(end), end]))
    mass, total = (x[1] - x[0] for x in (ends.masses, ends.weights))
    held = jax.lax.stop_gradient(difference)
    touched_squares = jnp.sum(held * held)
    sums = Sums(
        squares=touched_squares + rest,
        overlap=overlap,
        union=covered_weight + mass - overlap,
        weight=total,
        touched=jnp.sum(jnp.where(weight > 0, 1, 0)).astype(total.dtype),
        touched_squares=touched_squares,
    )
    ok = jnp.where(load.fits(capacity), 1, jnp.nan).astype(total.dtype)
    return (difference * ok, jnp.sqrt(jnp.maximum(rest, 0)) * ok), sums, load


class _Sorted(NamedTuple):
    """All pieces, by pixel; `change` is a function whose derivative is that of a piece's area."""

    cell: Int[Array, "P"]
    height: Float[Array, "P"]
    area: Float[Array, "P"]
    marks: Float[Array, "P 6"]
    change: Float[Array, "P"]


def touch(camera: Camera, scene: Scene, level: Level, capacity: Capacity) -> tuple[Touched, Load]:
    """Return the touched pixels of a level, and what they take of the capacities."""
    film = film_map(camera)
    kinds, totals = _curves(film, scene, level, capacity), {}
    end = level.H * (level.W + 2)
    found = []
    for part, size in kinds:
        curves = part.curves(jnp.arange(part.size, dtype=jnp.int32))
        m = jax.lax.stop_gradient(monotone(curves))
        upto = jnp.cumsum(piece_counts(m, level.W, level.H))
        totals[type(curves)] = (part.count, upto[-1].astype(jnp.int32))
        slots = jnp.arange(size, dtype=jnp.int32)
        pieces = split(m, upto, slots, level.W, level.H, MAX_ROWS)
        cell = jnp.where(pieces.valid, pieces.row * (level.W + 2) + pieces.column + 1, end)
        own = jax.tree.map(lambda x: x[pieces.curve], curves)  # noqa: B023
        held = jax.lax.stop_gradient(own)
        rate = piece_flux(held, pieces.start, pieces.end) * -pieces.jump[:, None, None]
        inside = pieces.valid & (pieces.column >= 0) & (pieces.column < level.W)
        change = moved(own, jnp.where(inside[:, None, None], rate, 0))
        found.append(_Sorted(cell, pieces.height, pieces.area, marks(pieces), change))
    none = (jnp.int32(0), jnp.int32(0))
    (edges, edge_pieces), (_, arc_pieces) = (totals.get(k, none) for k in (Segments, Arcs))
    together = jax.tree.map(lambda *x: jnp.concatenate(x), *found)
    base = surrounding(film, scene)
    touched = _by_pixel(together, [part for part, _ in kinds], base, level)
    return touched, Load(edges, edge_pieces, arc_pieces)


def _curves(
    film: FilmMap, scene: Scene, level: Level, capacity: Capacity
) -> list[tuple[Part, int]]:
    """Return a level's curves by kind, worked out once, with the room for their pieces."""
    kinds: list[tuple[Curves, Array, int]] = []
    if scene.mesh is not None and scene.mesh.edge_faces.shape[0]:
        contour = mesh_contour(film, scene.mesh)
        ids = jnp.arange(capacity.edges, dtype=jnp.int32)
        segments = edge_segments(film, scene.mesh.vertices, contour, ids)
        kinds.append((segments, contour.count, capacity.pieces))
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        ids = jnp.arange(ARCS_PER_SPHERE * scene.spheres.radii.shape[0], dtype=jnp.int32)
        arcs = sphere_arcs(film, scene.spheres, ids)
        kinds.append((arcs, jnp.int32(ids.shape[0]), capacity.arc_pieces))
    parts = []
    for curves, count, room in kinds:
        curves = placed(curves, level.scale)
        take = lambda ids, curves=curves: jax.tree.map(lambda x: x[ids], curves)
        parts.append((Part(take, count, curves.weight.shape[0]), room))
    return parts


def _by_pixel(pieces: _Sorted, parts: list[Part], base: Array, level: Level) -> Touched:
    """Return what the pieces add up to in each pixel, and in crowded ones the union's cover."""
    P = pieces.cell.shape[0]
    end = level.H * (level.W + 2)
    order = jnp.argsort(pieces.cell)
    cell, height, area, marked, change = (x[order] for x in pieces)
    new = jnp.append(jnp.ones(1, bool), cell[1:] != cell[:-1])
    slot = jnp.cumsum(new) - 1
    after = jnp.cumsum(height) + base.astype(height.dtype)
    before = jnp.where(new, after - height, 0)

    def gather(x):
        return jnp.zeros((P, *x.shape[1:]), x.dtype).at[slot].add(x)

    raw = gather(before + area)
    last = jnp.append(cell[1:] != cell[:-1], jnp.ones(1, bool))
    winding_after = gather(jnp.where(last, after, 0))
    cells = jnp.full(P, end, cell.dtype).at[slot].min(cell)
    column = cells % (level.W + 2)
    inside = (cells < end) & (column > 0) & (column <= level.W)
    crowded = inside & overlaps(gather(marked), jax.lax.stop_gradient(raw))
    alone = (raw > 0) & (raw < 1) & ~crowded
    value, growth = _resolve(cells, crowded, parts, base, level)
    growth = jnp.where(alone, gather(change), growth)
    coverage = jnp.where(crowded, value, jnp.clip(raw, 0, 1))
    coverage = jax.lax.stop_gradient(coverage) + growth - jax.lax.stop_gradient(growth)
    return Touched(cells, inside, coverage, winding_after > 0.5)


def _resolve(cells: Array, crowded: Array, parts: list[Part], base: Array, level: Level):
    """Return the crowded pixels' coverage, and a function whose derivative is its own; else 0."""
    chosen = select(crowded)
    last = cells.shape[0] - 1

    def cell(rank):
        slot = jnp.minimum(nth(chosen, rank), last)
        row = jax.lax.div(cells[slot], level.W + 2)
        return row, cells[slot] - row * (level.W + 2) - 1, slot

    def rank(row, column):
        wanted = row * (level.W + 2) + column + 1
        slot = jnp.minimum(jnp.searchsorted(cells, wanted), last)
        return jnp.where(cells[slot] == wanted, rank_in(chosen, slot), -1)

    def add(total, resolved: Resolved):
        area, growth = total
        for part, visible in zip(parts, resolved.visible, strict=True):
            change = jnp.sum(moved(part.curves(visible.curve), visible.flux), axis=1)
            growth = growth.at[resolved.place].add(change, mode="drop")
        return area.at[resolved.place].add(resolved.area, mode="drop"), growth

    zeros = jnp.zeros(cells.shape[0], parts[0].curves(jnp.zeros(1, jnp.int32)).weight.dtype)
    film = (level.W, level.H, MAX_ROWS)
    crowd = Crowded(chosen.total, cell, rank)
    return fold_cells(parts, crowd, *film, base, add, (zeros, zeros), flux=True)
