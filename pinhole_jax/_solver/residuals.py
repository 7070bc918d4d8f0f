"""Coverage minus target, only at the pixels that a contour touches.

Pieces of the contour are sorted by pixel. A running sum of their heights gives the coverage of each
touched pixel and of the runs of untouched pixels between them, whose cost is a difference of the
target's running sums. The work does not depend on the number of pixels, so one compiled program
serves every level and every image.

Where contours overlap within a pixel, its layers are added up and clamped on coarse levels: these
only lead to finer ones. On the finest level such a pixel shows the union's coverage, as the image
does. One that holds more pieces than are swept is left out there.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._camera.camera import Camera, film_at_once, film_map, lens_holds
from .._camera.film import Bend, FilmMap, FilmPart
from .._mask.pyramid import Level, Pyramid
from .._native import rasteriser as native
from .._native.library import is_available
from .._numerics.bitset import in_order
from .._numerics.one_kernel import by_machine
from .._scene.scene import Scene
from .._silhouette.curve_sets import edge_curves, find, outline_curves
from .._silhouette.curves import Curves, Segments, piece_flux, placed
from .._silhouette.marks import Marks, overlaps
from .._silhouette.surrounding import surrounding
from .._silhouette.sweep import ARC, Visible
from .by_pixel import Steps, by_pixel
from .cutting import Cut, cut
from .growth import Bounds, growing
from .overlapping import Overlapping, Part, most_pieces, resolved, whole
from .runs import Seen, summed


class Capacity(NamedTuple):
    """Static sizes: contour edges of the mesh (their parts, under distortion), pieces of edges and
    of arcs, and parts of arcs (under distortion)."""

    edges: int
    pieces: int
    arc_pieces: int
    arcs: int = 1


class Touched(NamedTuple):
    """The pixels that the contour touches, in raster order; unused slots have `cell` past the end.

    `coverage` is differentiable, and exact where `known`, but for what lines sweep (see
    `overlapping`); `covered_after` tells whether the untouched pixels that follow in the row are
    covered, `covered_before` whether those before are.
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
    pixel is left out or beside the window; and the level that they are of."""

    level: Level
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
    camera: Camera,
    scene: Scene,
    pyramid: Pyramid,
    level: Level,
    capacity: Capacity,
    film: FilmMap | None = None,
) -> tuple[tuple[Float[Array, "P"], Float[Array, ""]], Sums, Load, Pixels]:
    """Return the weighted residuals at touched pixels, the rest's root sum of squares, sums, load,
    and these pixels.

    The sum of all squares is the weighted squared distance of the image from the target, but for
    pixels where contours overlap. The rest
    is constant in the camera to first order. Where a capacity is too small, or a lens folds within
    what is looked at, all is NaN, so that a solver does not step there. `film` is the camera's
    `film_of` the level, where that is known.
    """
    touched, load = touch(camera, scene, level, capacity, film)
    seen = Seen(*jax.lax.stop_gradient(touched[:5]))
    target, weight, parts = summed(pyramid, level, seen, touched.covered_before)
    difference = jnp.sqrt(weight) * (touched.coverage - target)
    sums = Sums(
        squares=parts.squares + parts.rest,
        overlap=parts.overlap,
        union=parts.covered + parts.mass - parts.overlap,
        weight=parts.weight,
        touched=parts.touched,
        touched_squares=parts.touched_squares,
        off=parts.off,
    )
    ok = load.fits(capacity) & lens_holds(camera, _part(level))
    ok = jnp.where(ok, 1, jnp.nan).astype(difference.dtype)
    sums = sums._replace(squares=sums.squares * ok)
    sides = touched.covered_after, touched.covered_before
    pixels = Pixels(level, touched.cell, seen.coverage, weight, *sides)
    return (difference * ok, jnp.sqrt(jnp.maximum(parts.rest, 0)) * ok), sums, load, pixels


def _part(level: Level) -> FilmPart:
    """Return a level's window in film heights."""
    scale = jnp.asarray(level.scale)
    left, bottom = jnp.asarray(level.origin) / scale
    W, H = (jnp.asarray(x, scale.dtype) / scale for x in (level.W, level.H))
    return FilmPart(left, left + W, bottom, bottom + H, scale)


def film_of(camera: Camera, level: Level) -> FilmMap:
    """Return a camera as a map to a level's window."""
    return film_map(camera).looking_at(_part(level))


def touch(
    camera: Camera,
    scene: Scene,
    level: Level,
    capacity: Capacity,
    film: FilmMap | None = None,
) -> tuple[Touched, Load]:
    """Return the touched pixels of a level, and what they take of the capacities."""
    if film is None:
        film = film_at_once(camera).looking_at(_part(level))
    in_arrays = partial(_in_arrays, capacity=capacity)
    if not is_available():
        return in_arrays(film, scene, level)
    return by_machine(
        film, scene, level, cpu=partial(_native, capacity=capacity), elsewhere=in_arrays
    )


def _native(film: FilmMap, scene: Scene, level: Level, capacity: Capacity) -> tuple[Touched, Load]:
    size, mesh = jnp.stack([level.W, level.H]), scene.mesh
    of_mesh = mesh is not None and mesh.edge_faces.shape[0] > 0
    of_spheres = scene.spheres is not None and scene.spheres.radii.shape[0] > 0
    room = capacity.pieces * of_mesh + capacity.arc_pieces * of_spheres
    cell, coverage, after, before, number = native.touch(_on_level(film, level), scene, size, room)
    column, none = cell % (level.W + 2), jnp.zeros_like(number)
    inside = (column > 0) & (column <= level.W)
    touched = Touched(cell, inside, jnp.ones_like(inside), coverage, after, before)
    return touched, Load(none, number, none, none) if of_mesh else Load(none, none, number, none)


def _on_level(film: FilmMap, level: Level) -> FilmMap:
    """Return a map to the level's window, in its pixels."""
    scale, origin = jnp.asarray(level.scale), jnp.asarray(level.origin)
    placed = lambda xyz: jnp.concatenate(
        [xyz[:2] * scale - origin.reshape(2, *(1,) * (xyz.ndim - 1)) * xyz[2:], xyz[2:]]
    )
    bend = film.bend
    if bend is not None:
        bend = Bend(bend.distortion, bend.trusted, bend.focal * scale, bend.centre * scale - origin)
    return FilmMap(
        film.eye, film.view, placed(film.matrix), placed(film.base), film.W, film.H, bend
    )


def _in_arrays(
    film: FilmMap, scene: Scene, level: Level, capacity: Capacity
) -> tuple[Touched, Load]:
    totals, found, of_curves, parts = {}, [], [], []
    for kind, curves, homogeneous, (count, needed), size in _curves(film, scene, capacity):
        curves = jax.lax.stop_gradient(placed(curves, level.scale, level.origin / level.scale))
        xy, z = homogeneous[..., :2], homogeneous[..., 2:]
        xy = xy * level.scale - level.origin[None, None] * z
        homogeneous = jnp.concatenate([xy, z], axis=-1)
        pieces, number = cut(curves, count, size, level.W, level.H)
        totals[kind] = (needed, number)
        found.append((pieces.steps, pieces.swept))
        own = jax.lax.stop_gradient(homogeneous)[pieces.curve]
        of_curves.append((homogeneous, pieces.curve))
        parts.append(Part(_shown(curves, pieces, own), own))
    none = (jnp.int32(0), jnp.int32(0))
    (edges, edge_pieces), (arcs, arc_pieces) = (totals.get(k, none) for k in ("edges", "arcs"))
    # (`swept` is what a sweep asks of them; columns of their own: put together, each would be
    # worked out for all the others.)
    steps, swept = jax.tree.map(lambda *x: jnp.concatenate(x), *found)
    base = surrounding(film, scene)
    alone = scene.spheres is not None and scene.spheres.radii.shape[0] == 1 and len(parts) == 1
    convex = alone and "arcs" in totals  # one sphere overlaps nothing
    touched = _by_pixel(steps, swept, base, level, of_curves, parts, convex)
    return touched, Load(edges, edge_pieces, arc_pieces, arcs)


def _shown(curves: Curves, pieces: Cut, homogeneous: Float[Array, "P n 3"]) -> Float[Array, "P k"]:
    """Return what is visible of pieces that are alone in their pixels (see `Visible`)."""
    jump, ends = pieces.steps.jump, jnp.stack(pieces.ends, axis=-1)
    if isinstance(curves, Segments):
        return whole(ends, jump)
    # (An unused slot is no piece of any curve.)
    flux = piece_flux(jax.lax.stop_gradient(homogeneous), curves, ends[:, :2], ends[:, 2:])
    return (-jump[:, None, None] * flux).reshape(-1, ARC)


def _curves(
    film: FilmMap, scene: Scene, capacity: Capacity
) -> list[tuple[str, Curves, Array, tuple[Array, Array], int]]:
    """Return the curves by kind, their points, how many there are and how many of these need room,
    and the capacity for their pieces."""
    mesh, spheres = scene.mesh, scene.spheres
    found = find(film, scene)
    kinds: list[tuple[str, Curves, Array, tuple[Array, Array], int]] = []
    if mesh is not None and found.contour is not None:
        edges = edge_curves(film, mesh.vertices, found.contour)
        ids = jnp.arange(capacity.edges, dtype=jnp.int32)
        drawn = edges.curves(ids), edges.homogeneous_of(ids)
        kinds.append(("edges", *drawn, (edges.total, edges.total), capacity.pieces))
    if spheres is not None and spheres.radii.shape[0]:
        arcs = outline_curves(film, spheres, found.arcs)
        ids = jnp.arange(arcs.most or capacity.arcs, dtype=jnp.int32)
        drawn = arcs.curves(ids), arcs.homogeneous_of(ids)
        number = arcs.total, jnp.int32(0) if arcs.most else arcs.total
        kinds.append(("arcs", *drawn, number, capacity.arc_pieces))
    return kinds


def _by_pixel(
    steps: Steps,
    swept: tuple[Float[Array, "P"], ...],
    base: Int[Array, ""],
    level: Level,
    of_curves: list[tuple[Float[Array, "_ _ 3"], Int[Array, "_"]]],
    parts: list[Part],
    convex: bool,
) -> Touched:
    """Return what the pieces add up to in each pixel; `of_curves` are those of each part's curves,
    with which of these each piece is of, and `convex` says that none overlap."""
    P, real = steps.cell.shape[0], steps.height.dtype
    end, width = level.H * (level.W + 2), level.W + 2
    order = in_order(steps.cell)
    totals = by_pixel(steps, order, base.astype(real), width, end)
    cells, winding, layers = totals.cell, totals.winding, totals.layers
    marked, column = Marks(layers, totals.counters), cells % width
    inside = (cells < end) & (column > 0) & (column <= level.W)
    # A contour along the pixel's side: the mean does not tell which of its layers that bounds.
    tie = 64 * jnp.finfo(winding.dtype).eps
    shared = overlaps(marked, winding) | ((layers > 0) & (jnp.abs(winding - 1) < tie))
    shared &= inside & level.resolved
    shared &= not convex
    straight = all(part.visible.shape[-1] != ARC for part in parts)
    chosen = shared & (totals.number <= most_pieces(P, straight))
    origin = jnp.stack([column - 1, cells // width], axis=-1).astype(real)
    areas, visible = winding, [part.visible for part in parts]
    if not convex:
        overlapping = Overlapping(chosen, totals.first, totals.number, origin, totals.corner)
        areas, visible = resolved(overlapping, swept, order, parts)
    flux = [
        Visible(jnp.zeros(len(seen), jnp.int32), seen).flux(part.homogeneous)
        for seen, part in zip(visible, parts, strict=True)
    ]
    moves, bounds, begin = inside & (chosen | (winding < 1)), [], 0
    for (_, curve), rate in zip(of_curves, flux, strict=True):
        bounds.append(Bounds(curve, rate, totals.slot[begin : begin + len(curve)]))
        begin += len(curve)
    growth = growing([points for points, _ in of_curves], bounds, moves)
    coverage = jnp.where(chosen, areas, jnp.clip(winding, 0, 1)) + growth
    known = ~shared | chosen
    return Touched(cells, inside, known, coverage, totals.after > 0.5, base > 0)
