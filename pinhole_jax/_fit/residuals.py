"""Coverage minus target, only at the pixels that a contour touches.

Pieces of the contour are sorted by pixel. A running sum of their heights gives the coverage of each
touched pixel and of the runs of untouched pixels between them, whose cost is a difference of the
target's running sums. The work does not depend on the number of pixels, so one compiled program
serves every level and every image.

Pixels where contours overlap are not resolved: they are few, and a fit is several times faster for
it. They are clamped, or at a `strict` level left out: then what the others say is exact, but the
sum of squares jumps where a pixel comes or goes, so that is for the end of a fit to an exact mask.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._camera.camera import Camera, film_map, lens_holds
from .._camera.film import FilmMap, FilmPart
from .._numerics.running import running_sum
from .._scene.scene import Scene
from .._silhouette.coverage import monotone, piece_counts, split
from .._silhouette.curve_sets import edge_curves, find, outline_curves
from .._silhouette.curves import Curves, moved, piece_flux, placed
from .._silhouette.marks import Marks, chain_layers, inward, marks, overlaps
from .._silhouette.surrounding import surrounding
from .target import Level, Pyramid, level_slice

MAX_ROWS = 1 << 14
#: A pixel that is covered, or uncovered, but for less than this shows no outline.
HIDDEN = 1e-4


class Capacity(NamedTuple):
    """Static sizes: contour edges of the mesh (their parts, under distortion), pieces of edges and
    of arcs, and parts of arcs (under distortion)."""

    edges: int
    pieces: int
    arc_pieces: int
    arcs: int = 1


class Touched(NamedTuple):
    """The pixels that the contour touches, in raster order; unused slots have `cell` past the end.

    `coverage` is differentiable, and exact where `known`; `covered_after` tells whether the
    untouched pixels that follow in the row are covered, `covered_before` whether those before are.
    """

    cell: Int[Array, "P"]
    inside: Bool[Array, "P"]
    known: Bool[Array, "P"]
    coverage: Float[Array, "P"]
    covered_after: Bool[Array, "P"]
    covered_before: Bool[Array, ""]


class Sums(NamedTuple):
    """Weighted sums over all pixels but those left out: squared residual, min and max of coverage
    and target, weight.

    `touched` counts the pixels with weight that the outline crosses, where the background is seen
    beside the object (not contours within it), `touched_squares` is theirs; `off` counts those with
    a residual that the mask's kind does not explain.
    """

    squares: Float[Array, ""]
    overlap: Float[Array, ""]
    union: Float[Array, ""]
    weight: Float[Array, ""]
    touched: Float[Array, ""]
    touched_squares: Float[Array, ""]
    off: Float[Array, ""]


class Pixels(NamedTuple):
    """The touched pixels of a view, in raster order (see `Touched`), with their weights: 0 where a
    pixel is left out or beside the window."""

    cell: Int[Array, "P"]
    coverage: Float[Array, "P"]
    weight: Float[Array, "P"]
    covered_after: Bool[Array, "P"]
    covered_before: Bool[Array, ""]


class Load(NamedTuple):
    """How much of each capacity a view needs; a lower bound once `edges` is over its capacity."""

    edges: Int[Array, ""]
    pieces: Int[Array, ""]
    arc_pieces: Int[Array, ""]
    arcs: Int[Array, ""]

    def fits(self, capacity: Capacity) -> Bool[Array, ""]:
        """Return whether every capacity suffices."""
        return jnp.all(jnp.stack(self) <= jnp.array(capacity, jnp.int32))


def residuals(
    camera: Camera, scene: Scene, pyramid: Pyramid, level: Level, capacity: Capacity
) -> tuple[tuple[Float[Array, "P"], Float[Array, ""]], Sums, Load, Pixels]:
    """Return the weighted residuals at touched pixels, the rest's root sum of squares, sums, load,
    and these pixels.

    The sum of all squares is the weighted squared distance of the image from the target, but for
    pixels where contours overlap. The rest
    is constant in the camera to first order. Where a capacity is too small, or a lens folds within
    what is looked at, all is NaN, so that a solver does not step there.
    """
    touched, load = touch(camera, scene, level, capacity)
    end = level.H * (level.W + 2)
    here = level_slice(pyramid, level, touched.cell)
    weight = jnp.where(touched.inside & touched.known, here.weight, 0)
    difference = jnp.sqrt(weight) * (touched.coverage - here.target)

    # Runs of untouched pixels: after each slot up to the row's end, then up to the next slot.
    begin = jnp.minimum(jnp.append(jnp.int32(-1), touched.cell) + 1, end)
    until = jnp.append(touched.cell, end)
    row_end = jnp.minimum(_row_start(level, begin + level.W + 1), until)
    limits = level_slice(pyramid, level, jnp.stack([begin, row_end, until]))
    run = jax.tree.map(lambda x: x[1:] - x[:-1], limits)
    before = jnp.broadcast_to(touched.covered_before, until.shape)
    covered = jnp.stack([jnp.append(before[:1], touched.covered_after), before])
    rest = jnp.sum(jnp.where(covered, run.full, run.empty))

    coverage = jax.lax.stop_gradient(touched.coverage)
    covered_weight = jnp.sum(jnp.where(covered, run.weights, 0)) + jnp.sum(weight * coverage)
    overlap = jnp.sum(jnp.where(covered, run.masses, 0)) + jnp.sum(
        weight * jnp.minimum(coverage, here.target)
    )
    ends = level_slice(pyramid, level, jnp.stack([jnp.zeros_like(end), end]))
    out = jnp.where(touched.inside & ~touched.known, here.weight, 0)
    mass = ends.masses[1] - ends.masses[0] - jnp.sum(out * here.target)
    total = ends.weights[1] - ends.weights[0] - jnp.sum(out)
    held = jax.lax.stop_gradient(difference)
    outline = (weight > 0) & (coverage > HIDDEN) & (coverage < 1 - HIDDEN)
    sums = Sums(
        squares=jnp.sum(held * held) + rest,
        overlap=overlap,
        union=covered_weight + mass - overlap,
        weight=total,
        touched=jnp.sum(jnp.where(outline, 1, 0)).astype(total.dtype),
        touched_squares=jnp.sum(jnp.where(outline, held * held, 0)),
        off=jnp.sum(outline & (jnp.abs(held) > level.explained)).astype(total.dtype),
    )
    ok = load.fits(capacity) & lens_holds(camera, _part(level))
    ok = jnp.where(ok, 1, jnp.nan).astype(total.dtype)
    pixels = Pixels(touched.cell, coverage, weight, touched.covered_after, touched.covered_before)
    return (difference * ok, jnp.sqrt(jnp.maximum(rest, 0)) * ok), sums, load, pixels


def _row_start(level: Level, cell: Int[Array, "P"]) -> Int[Array, "P"]:
    """Return the first cell of the row that a cell is in."""
    return cell - cell % (level.W + 2)


def _part(level: Level) -> FilmPart:
    """Return a level's window in film heights."""
    scale = jnp.asarray(level.scale)
    left, bottom = jnp.asarray(level.origin) / scale
    W, H = (jnp.asarray(x, scale.dtype) / scale for x in (level.W, level.H))
    return FilmPart(left, left + W, bottom, bottom + H, scale)


class _Sorted(NamedTuple):
    """All pieces, by pixel; `change` is a function whose derivative is that of a piece's area.

    `inward` is positive where the pixel's centre is on the side of more layers.
    """

    cell: Int[Array, "P"]
    height: Float[Array, "P"]
    area: Float[Array, "P"]
    marks: Marks
    change: Float[Array, "P"]
    inward: Float[Array, "P"]


def touch(camera: Camera, scene: Scene, level: Level, capacity: Capacity) -> tuple[Touched, Load]:
    """Return the touched pixels of a level, and what they take of the capacities."""
    film = film_map(camera).looking_at(_part(level))
    end, totals, found = level.H * (level.W + 2), {}, []
    for kind, curves, lift, count, size in _curves(film, scene, capacity):
        curves = jax.lax.stop_gradient(placed(curves, level.scale, level.origin / level.scale))
        xy, z = lift[..., :2], lift[..., 2:]
        xy = xy * level.scale - level.origin[None, None] * z
        lift = jnp.concatenate([xy, z], axis=-1)
        m = monotone(curves)
        upto = running_sum(piece_counts(m, level.W, level.H))
        totals[kind] = (count, upto[-1].astype(jnp.int32))
        slots = jnp.arange(size, dtype=jnp.int32)
        pieces = split(m, upto, slots, level.W, level.H, MAX_ROWS)
        cell = jnp.where(pieces.valid, pieces.row * (level.W + 2) + pieces.column + 1, end)
        own = lift[pieces.curve]
        rate = piece_flux(jax.lax.stop_gradient(own), curves, pieces.start, pieces.end)
        inside = pieces.valid & (pieces.column >= 0) & (pieces.column < level.W)
        rate = jnp.where(inside[:, None, None], -pieces.jump[:, None, None] * rate, 0)
        sizes = pieces.height, pieces.area, marks(pieces)
        found.append(_Sorted(cell, *sizes, moved(own, rate), inward(pieces)))
    none = (jnp.int32(0), jnp.int32(0))
    (edges, edge_pieces), (arcs, arc_pieces) = (totals.get(k, none) for k in ("edges", "arcs"))
    together = jax.tree.map(lambda *x: jnp.concatenate(x), *found)
    base = surrounding(film, scene)
    return _by_pixel(together, base, level), Load(edges, edge_pieces, arc_pieces, arcs)


def _curves(
    film: FilmMap, scene: Scene, capacity: Capacity
) -> list[tuple[str, Curves, Array, Array, int]]:
    """Return the curves by kind, their lifts, how many need room, and the room for their pieces."""
    mesh, spheres = scene.mesh, scene.spheres
    found = find(film, scene)
    kinds: list[tuple[str, Curves, Array, Array, int]] = []
    if mesh is not None and found.contour is not None:
        edges = edge_curves(film, mesh.vertices, found.contour)
        ids = jnp.arange(capacity.edges, dtype=jnp.int32)
        drawn = edges.curves(ids), edges.lifts(ids)
        kinds.append(("edges", *drawn, edges.total, capacity.pieces))
    if spheres is not None and spheres.radii.shape[0]:
        arcs = outline_curves(film, spheres, found.arcs)
        ids = jnp.arange(arcs.most or capacity.arcs, dtype=jnp.int32)
        needed = jnp.int32(0) if arcs.most else arcs.total
        kinds.append(("arcs", arcs.curves(ids), arcs.lifts(ids), needed, capacity.arc_pieces))
    return kinds


def _by_pixel(pieces: _Sorted, base: Int[Array, ""], level: Level) -> Touched:
    """Return what the pieces add up to in each pixel."""
    P = pieces.cell.shape[0]
    end = level.H * (level.W + 2)
    order = jnp.argsort(pieces.cell)
    cell, height, area, marked, change, inner = jax.tree.map(lambda x: x[order], pieces)
    new = jnp.append(jnp.ones(1, bool), cell[1:] != cell[:-1])
    slot = running_sum(new.astype(jnp.int32)) - 1
    # Curves right of the film are left out: each row is summed up by itself.
    start, running = _row_start(level, cell), running_sum(height)
    of_row = jax.lax.cummax(jnp.where(start > jnp.append(-1, start[:-1]), jnp.arange(P), 0))
    after = running - (running - height)[of_row] + base.astype(height.dtype)
    before = jnp.where(new, after - height, 0)
    last = jnp.append(cell[1:] != cell[:-1], jnp.ones(1, bool))

    def gather(x):
        return jnp.zeros((P, *x.shape[1:]), x.dtype).at[slot].add(x)

    winding, marked = gather(before + area), jax.tree.map(gather, marked)
    winding_after = gather(jnp.where(last, after, 0))
    cells = jnp.full(P, end, cell.dtype).at[slot].min(cell)
    column = cells % (level.W + 2)
    inside = (cells < end) & (column > 0) & (column <= level.W)
    # A chain that bounds two layers (a fold of an open mesh) has 0 and 2 of them on its sides for
    # certain if any part of the pixel, or of its left or right side, has less than 1.
    least = jnp.minimum(winding, jnp.minimum(gather(before), winding_after))
    fold = (chain_layers(marked) == 2) & ((least < 1) | ~level.strict)
    known = ~overlaps(marked, winding) | fold | ~level.strict
    share = jnp.where(fold, winding / 2, winding)
    # A contour along the pixel's side bounds its first layer, or a second one beside it.
    tie = 64 * jnp.finfo(share.dtype).eps
    below_one = jnp.where(jnp.abs(share - 1) < tie, gather(inner) > 0, share < 1)
    moves = known & below_one
    growth = jnp.where(moves, gather(change) / jnp.where(fold, 2, 1), 0)
    coverage = jnp.clip(share, 0, 1) + growth - jax.lax.stop_gradient(growth)
    return Touched(cells, inside, known, coverage, winding_after > 0.5, base > 0)
