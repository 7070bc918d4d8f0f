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

from ._camera import Camera
from ._contour import Arcs, Segments, contour_weights, mesh_segments, nth, select, sphere_arcs
from ._coverage import Curves, flux, monotone, piece_counts, split
from ._scene import Scene
from ._target import Level, Pyramid, level_slice

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


def touch(camera: Camera, scene: Scene, level: Level, capacity: Capacity) -> tuple[Touched, Load]:
    """Return the touched pixels of a level, and what they take of the capacities."""
    parts, edges = [], jnp.int32(0)
    if scene.mesh is not None and scene.mesh.edge_faces.shape[0]:
        segments, edges = _contour_segments(camera, scene, capacity.edges)
        parts.append((_on(level, segments), capacity.pieces))
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        arcs = _on(level, sphere_arcs(camera, scene.spheres))
        parts.append((arcs, capacity.arc_pieces))

    end = level.H * (level.W + 2)
    cells, heights, areas, changes, totals = [], [], [], [], {}
    for curves, size in parts:
        m = jax.lax.stop_gradient(monotone(curves))
        upto = jnp.cumsum(piece_counts(m, level.W, level.H))
        totals[type(curves)] = upto[-1].astype(jnp.int32)
        slots = jnp.arange(size, dtype=jnp.int32)
        pieces = split(m, upto, slots, level.W, level.H, MAX_ROWS)
        cell = pieces.row * (level.W + 2) + pieces.column + 1
        cells.append(jnp.where(pieces.valid, cell, end))
        heights.append(pieces.height)
        areas.append(pieces.area)
        own = jax.tree.map(lambda x: x[pieces.curve], curves)  # noqa: B023
        changes.append(flux(own, pieces, level.W))
    zero = jnp.int32(0)
    load = Load(edges, totals.get(Segments, zero), totals.get(Arcs, zero))
    cell, height, area, change = map(jnp.concatenate, (cells, heights, areas, changes))
    return _by_pixel(cell, height, area, change, level), load


def _contour_segments(camera: Camera, scene: Scene, size: int) -> tuple[Segments, Int[Array, ""]]:
    """Return the contour edges in `size` slots, and how many there are."""
    assert scene.mesh is not None
    weights = contour_weights(scene.mesh, camera.e)
    chosen = select(weights != 0)
    rank = jnp.arange(size, dtype=jnp.int32)
    edge = jnp.minimum(nth(chosen, rank), weights.shape[0] - 1)
    weight = jnp.where(rank < chosen.total, weights[edge], 0)
    segments = mesh_segments(camera, scene.mesh.vertices, scene.mesh.edge_vertices[edge], weight)
    return segments, chosen.total


def _on(level: Level, curves: Curves) -> Curves:
    """Return curves in a level's pixels."""
    if isinstance(curves, Arcs):
        return curves._replace(centre=curves.centre * level.scale, shape=curves.shape * level.scale)
    return curves._replace(a=curves.a * level.scale, b=curves.b * level.scale)


def _by_pixel(cell, height, area, change, level: Level) -> Touched:
    """Return what the pieces add up to in each pixel.

    `change` is a function whose derivative is that of the piece's area; its value cancels.
    """
    P = cell.shape[0]
    end = level.H * (level.W + 2)
    order = jnp.argsort(cell)
    cell, height, area, change = (x[order] for x in (cell, height, area, change))
    new = jnp.append(jnp.ones(1, bool), cell[1:] != cell[:-1])
    slot = jnp.cumsum(new) - 1
    after = jnp.cumsum(height)
    before = jnp.where(new, after - height, 0)

    def gather(x):
        return jnp.zeros(P, x.dtype).at[slot].add(x)

    raw = gather(before + area)
    change = gather(change)
    moves = (raw > 0) & (raw < 1)
    coverage = jnp.clip(raw, 0, 1) + jnp.where(moves, change - jax.lax.stop_gradient(change), 0)
    last = jnp.append(cell[1:] != cell[:-1], jnp.ones(1, bool))
    winding_after = gather(jnp.where(last, after, 0))
    cells = jnp.full(P, end, cell.dtype).at[slot].min(cell)
    column = cells % (level.W + 2)
    inside = (cells < end) & (column > 0) & (column <= level.W)
    return Touched(cells, inside, coverage, winding_after > 0.5)
