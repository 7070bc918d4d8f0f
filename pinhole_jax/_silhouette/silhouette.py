"""`silhouette`: the image of a scene's exact coverage, with its exact derivative."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._camera.camera import Camera, film_map
from .._camera.film import FilmMap
from .._native.library import is_available
from .._native.rasteriser import coverage
from .._numerics.backend import for_this_machine, is_for_cpus
from .._numerics.bitset import Selection, selection
from .._numerics.jitted import jitted
from .._numerics.later import later, on_each_device
from .._numerics.linear_map import linear_map
from .._numerics.one_kernel import by_machine, one_by_one
from .._numerics.tracing import collector_at_rest
from .._scene.scene import Mesh, Scene, Spheres, astype, check_view
from .asked import WORD, Asked, Corners, Drawn, words_in_row
from .boundary import Seen, pulled, pushed
from .contour import MeshContour
from .covered import (
    DEEP,
    LEAST_FACES,
    LEAST_SPHERES,
    Convex,
    faces_of,
    spheres_of,
    surely_covered,
    worth,
)
from .curve_sets import Found, edge_curves, find, joined, outline_curves
from .distorted import Cuts
from .drawing import drawn_in_vectors, is_large
from .overlaps import (
    Kept,
    Overlapping,
    Resolved,
    all_kept,
    fold_cells,
    fold_chosen,
    fold_in_turn,
    fold_side_by_side,
    nothing_kept,
    place_of,
)
from .parts import LEAST, CurveList, Part
from .piece_by_piece import drawn_piece_by_piece
from .surrounding import rows_seen, surrounding
from .sweep import Visible

CURVES_AT_A_TIME = 512
#: So many pixels that are surely covered are set at a time.
COVERED = 4096
#: To be exact takes no longer than to err by less than this.
LEAST_TOLERANCE = 5e-3


@collector_at_rest()
@for_this_machine()
def silhouette(
    camera: Camera, scene: Scene, overlaps: bool = True, tolerance: float = 0.0
) -> Float[Array, "H W"]:
    """Return the fraction of each pixel's square that the scene covers: (H, W), row 0 on top.

    Exact (box filter, no sampling, no blur) for any scene: the coverage of the union of all
    projected triangles and spheres, whether meshes are closed or open, wind consistently or not,
    overlap, reach through the plane of the eye or surround it. An eye inside a closed mesh or a
    sphere sees everything covered. The cost follows the occluding contour; only pixels where
    contours overlap pay for telling them apart. `overlaps=False` (static) says that no two parts of
    the contour meet in a pixel, as in every view of one convex body: then that code is not even
    compiled, and where it is not true arrays sum layers and clamp (the library does not). One
    sphere alone needs no telling. No size of coordinates makes it anything but a number in [0, 1];
    but which side of a face is seen is not known where its corners' distances from the eye differ
    by more than 1 / epsilon of the float type.

    The derivative, in forward and reverse mode, with respect to the camera, vertices, centers and
    radii is exact as well: the visible contour's normal velocity. Coverage is not differentiable
    where a face is seen edge-on, where contours coincide over a length, where one runs along a
    pixel's side, and where a sphere touches the eye; there it is the derivative of the contour as
    it is (of one of the coinciding pieces), which is a one-sided derivative, and it is finite. A
    contour along a pixel's side counts for the pixel above it or to its right.

    `tolerance` is for rough meshes and crowds: pixels in which contours overlap may err by that. A
    line sweeps such a pixel and stops 1 / `tolerance` times, at equal distances; what is covered
    along it there is exact, and stands for half a distance to either side. So a pixel errs by
    `tolerance` / 2 at most for each pixel that the outline seen in it goes along the line, there
    and back added up: by `tolerance` at most, unless it goes over the pixel more than twice. (In
    hostile views the worst pixel erred by 0.7 times `tolerance`, and 1.1 times at 1/2.) Of the
    derivative, what is visible of each piece of contour errs by the distance of two stops for each
    stretch: where all moves by a pixel, by 1.5 times `tolerance` in the worst pixel of a scan, and
    0.3 times in the mean. The compiled library, which draws on CPUs, is exact whatever the
    `tolerance`; without it, below 5e-3 to be exact takes no longer, and is what is done.

    ```python
    mask = pj.silhouette(camera, scene)  # (H, W), in [0, 1]
    moves = jax.jacfwd(lambda phi: pj.silhouette(camera.replace(phi=phi), scene))(camera.phi)
    ```
    """
    check_view(camera, scene)
    return _silhouette(camera, scene, overlaps, _stops(tolerance))


def _stops(tolerance: float) -> Int[Array, ""] | None:
    """Return how often a line stops that sweeps a pixel, None where it does at all that it meets.

    What it meets between two stops stands for half a distance to either side.
    """
    if not 0 <= tolerance < 1:
        raise ValueError(f"`tolerance` must be at least 0 (exact) and below 1, got {tolerance}")
    return None if tolerance < LEAST_TOLERANCE else jnp.int32(math.ceil(1 / tolerance))


@jitted
def _silhouette(
    camera: Camera, scene: Scene, overlaps: bool, stops: Int[Array, ""] | None = None
) -> Float[Array, "H W"]:
    scene = astype(scene, camera.e.dtype)
    film, spheres = film_map(camera), scene.spheres
    if spheres is not None and not spheres.radii.shape[0]:
        spheres = None
    mesh = scene.mesh
    if mesh is not None and not mesh.edge_faces.shape[0]:
        mesh = None
    if mesh is None and spheres is None:
        return jnp.zeros((camera.H, camera.W), camera.e.dtype)
    in_arrays = partial(_in_arrays, overlaps=overlaps, stops=stops)
    scene = Scene(mesh=mesh, spheres=spheres)
    if not is_available():
        return in_arrays(film, scene)
    if is_for_cpus():
        return coverage(film, scene)
    return jax.lax.platform_dependent(film, scene, cpu=coverage, default=in_arrays)


def in_arrays(film: FilmMap, scene: Scene) -> Float[Array, "H W"]:
    """The exact image by vectors of pieces."""
    return _in_arrays(film, scene, True, None)


def _in_arrays(
    film: FilmMap, scene: Scene, overlaps: bool, stops: Int[Array, ""] | None
) -> Float[Array, "H W"]:
    """The same by vectors of pieces: on accelerators, and where there is no compiled library."""
    mesh, spheres = scene.mesh, scene.spheres
    alone = mesh is None and spheres is not None and spheres.radii.shape[0] == 1
    overlap = () if overlaps and not alone else None
    given = _Given(jax.lax.stop_gradient(scene), overlap, stops)
    return _image(_Moving(film, None if mesh is None else mesh.vertices, spheres), given)


class _Moving(NamedTuple):
    """What can be differentiated."""

    film: FilmMap
    vertices: Float[Array, "V 3"] | None
    spheres: Spheres | None


class _Given(NamedTuple):
    """What cannot: the scene as it is.

    `overlap` is None (and not an empty tuple: both have no leaves) if contours never overlap;
    `stops` is how often lines stop that sweep pixels where they do, None if that is exact.
    """

    scene: Scene
    overlap: tuple[()] | None
    stops: Int[Array, ""] | None


class _View(NamedTuple):
    """What a view of it is: which edges are contour (`MeshContour.of_view`), where outlines are
    cut, the number of layers left of the film.

    `rows` are those of the film that the contour may meet (None: the film is drawn at once).
    """

    contour: tuple | None
    arcs: Cuts | None
    base: Int[Array, ""]
    rows: Int[Array, "2"] | None

    @staticmethod
    def of(film: FilmMap, scene: Scene) -> "_View":
        """Return what a film sees of a scene."""
        contour, arcs = find(film, scene)
        of_view = None if contour is None else contour.of_view
        rows = rows_seen(film, scene) if is_large(film) else None
        return _View(of_view, arcs, surrounding(film, scene), rows)


class _Still(NamedTuple):
    """What is held where things move: the mesh's edges and faces (what else it has would be copied
    without `jit`), the view of it, and what is given beside the scene."""

    mesh: Mesh | None
    view: _View
    overlap: tuple[()] | None
    stops: Int[Array, ""] | None

    @staticmethod
    def of(given: _Given, view: _View) -> "_Still":
        """Return what is held of what is given, in a view of it."""
        mesh = None if view.contour is None else given.scene.mesh
        if mesh is not None:
            mesh = eqx.tree_at(lambda m: (m.vertices, m.planes, m.order), mesh, (None,) * 3)
        return _Still(mesh, view, given.overlap, given.stops)

    @property
    def found(self) -> Found:
        """Which edges are contour, and where outlines are cut."""
        if self.mesh is None or self.view.contour is None:
            return Found(None, self.view.arcs)
        return Found(MeshContour.of(self.mesh, self.view.contour), self.view.arcs)


class _Pixels(NamedTuple):
    """Which pixels one chain of contour crosses (as in the image), and which are overlapping, from
    the bottom row up, words of a row after each other; for each word how many layers the pieces in
    its overlapping pixels have; for each of these the winding number at its corner; for the
    derivative, what is visible in these."""

    alone: Bool[Array, "H W"] | None
    overlapping: Selection
    layers: Float[Array, "words"]
    corners: Corners
    kept: list[Kept]


def _parts(moving: _Moving, still: _Still) -> list[Part]:
    """Return the contour's curves by kind."""
    film, vertices, spheres = moving
    contour, arcs = still.found
    sets = []
    if contour is not None and vertices is not None:
        sets.append(edge_curves(film, vertices, contour))
    if spheres is not None:
        sets.append(outline_curves(film, spheres, arcs))
    if film.bend is not None and len(sets) == 2:
        sets = [joined(*sets)]  # under distortion arcs are straight parts, too
    return [
        Part(
            s.curves,
            s.homogeneous_of,
            s.total,
            min(CURVES_AT_A_TIME, s.most or CURVES_AT_A_TIME),
            s.most,
            s.together,
            s.in_turn,
            s.straight,
            film.eye.dtype,
        )
        for s in sets
    ]


def _things(moving: _Moving, still: _Still) -> list[Convex]:
    """Return what may cover many pixels, if the scene is large."""
    film, vertices, spheres = jax.lax.stop_gradient(moving)
    kinds = []
    if vertices is not None and still.mesh is not None and len(still.mesh.faces) >= LEAST_FACES:
        kinds.append(faces_of(film, vertices, still.mesh.faces))
    if spheres is not None and len(spheres.radii) >= LEAST_SPHERES:
        kinds.append(spheres_of(film, spheres))
    return kinds


@jax.custom_jvp
def _image(moving: _Moving, given: _Given) -> Float[Array, "H W"]:
    film = moving.film
    # (A program of the derivative has an image of its own: this one is not even traced there.)
    like = jax.ShapeDtypeStruct((film.H, film.W), film.eye.dtype)
    return later(_image_alone, like, moving, given)


@collector_at_rest()
@for_this_machine()
def _image_alone(moving: _Moving, given: _Given) -> Float[Array, "H W"]:
    return _resolve(moving, given, keep=False)[0]


@partial(_image.defjvp, symbolic_zeros=True)
@collector_at_rest()
@for_this_machine()
def _image_jvp(primals: Any, tangents: Any):
    """Return the image and its boundary integral for the leaves that move; others cost nothing."""
    moving, given = primals
    leaves, tree = jax.tree.flatten(moving)
    velocities = tree.flatten_up_to(tangents[0])
    moves = [not isinstance(t, SymbolicZero) for t in velocities]
    film: FilmMap = moving.film

    def rebuild(held: list, changing: list) -> _Moving:
        held, changing = held.copy(), changing.copy()
        return tree.unflatten([(changing if m else held).pop(0) for m in moves])

    def parts_of(residuals) -> Callable[[list], list[Part]]:
        held, _, still, _ = residuals
        return lambda changing: _parts(rebuild(held, changing), still)

    def seen(residuals) -> Seen:
        _, changing, still, pixels = residuals
        assert pixels.alone is not None
        parts = parts_of(residuals)(changing)
        crowd = partial(_fold_crowd, film, still, pixels, parts)
        return Seen(film.W, film.H, pixels.alone.reshape(-1), crowd)

    @for_this_machine()
    def forward(residuals, velocity):
        changing, ways = residuals[1], velocity[0].shape[-1]
        # (Of one pixel more than one: see `one_kernel`.)
        image = jnp.zeros((max(film.H * film.W, LEAST), ways), film.eye.dtype)
        image = pushed(parts_of(residuals), changing, velocity, seen(residuals), image)
        return image[: film.H * film.W].reshape(film.H, film.W, ways)

    @for_this_machine()
    def transpose(residuals, cotangent):
        weights = cotangent.reshape(film.H * film.W, -1)
        return pulled(parts_of(residuals), residuals[1], seen(residuals), weights)

    held = [x for x, m in zip(leaves, moves, strict=True) if not m]
    changing = [x for x, m in zip(leaves, moves, strict=True) if m]
    velocity = [t for t, m in zip(velocities, moves, strict=True) if m]
    image, (view, pixels) = _resolve(moving, given, keep=True)
    still = _Still.of(given, view)
    residuals = held, changing, still, pixels
    return image, linear_map(forward, transpose, residuals, velocity, image)


def _resolve(moving: _Moving, given: _Given, keep: bool) -> tuple[Float[Array, "H W"], Any]:
    """Return the image and, if asked for, the view and which pixels the contour crosses in which
    way.

    On a CPU one view after the other: of a thousand under `vmap`, what one takes is held once.
    """

    def drawn(moving: _Moving, given: _Given) -> tuple[Array, Any]:
        resolved = partial(_resolved, moving, given, keep)
        turn = partial(resolved, drawn_piece_by_piece, fold_in_turn)
        beside = partial(resolved, _drawn_in_vectors, fold_side_by_side)
        return by_machine(cpu=lambda: one_by_one(turn), elsewhere=beside)

    return on_each_device(drawn, moving, given)


def _drawn_in_vectors(asked: Asked, rows: Int[Array, "2"] | None) -> tuple[Drawn, None]:
    """Return the film, without lists of curves."""
    del rows
    return drawn_in_vectors(asked), None


def _resolved(
    moving: _Moving, given: _Given, keep: bool, draw: Callable, fold: Callable
) -> tuple[Float[Array, "H W"], tuple[_View, _Pixels] | None]:
    view = _View.of(moving.film, given.scene)
    image, pixels = _pixels(moving, _Still.of(given, view), keep, draw, fold)
    return image, (view, pixels) if keep else None


def _pixels(
    moving: _Moving, still: _Still, keep: bool, draw: Callable, fold: Callable
) -> tuple[Float[Array, "H W"], _Pixels]:
    """Return the image, and which pixels the contour crosses in which way."""
    film, parts, things = moving.film, _parts(moving, still), _things(moving, still)
    base, resolves = still.view.base, still.overlap is not None
    asked = Asked(film, parts, base, resolves, keep, DEEP if things else None)
    (image, alone, overlapping, layers, corners, depth), lists = draw(asked, still.view.rows)
    if overlapping is None or layers is None or corners is None:
        none, corners = jnp.zeros(0, image.dtype), Corners.empty(0, image.dtype)
        return image, _Pixels(alone, selection(jnp.zeros(0, jnp.uint32)), none, corners, [])
    image, overlapping, layers = (x.reshape(-1) for x in (image, overlapping, layers))
    if depth is not None:
        dear = worth(things, jnp.sum(layers), depth)
        image, overlapping = _without_covered(film, things, dear, image, overlapping)
    kept = [nothing_kept(part) for part in parts if keep]
    pixels = _Pixels(alone, selection(overlapping), layers, corners, kept)

    def add(total, resolved: Resolved):
        image, kept = total
        image = image.at[resolved.place].add(resolved.area, mode="drop")
        if not resolved.visible:
            return image, kept
        more = zip(kept, resolved.visible, strict=True)
        return image, [k.append(resolved.place, visible) for k, visible in more]

    crowd = _overlapping(film, pixels)
    args = parts, crowd, (film.W, film.H, base)
    image, kept = fold(*args, add, (image, kept), keep, still.stops, lists)
    return image.reshape(film.H, film.W), pixels._replace(kept=kept)


def _without_covered(
    film: FilmMap,
    things: list[Convex],
    worth: Bool[Array, ""],
    image: Float[Array, "pixels"],
    overlapping: UInt32[Array, "words"],
) -> tuple[Float[Array, "pixels"], UInt32[Array, "words"]]:
    """Return the image with those overlapping pixels that things cover wholly, and the others; both
    as they were if it is not `worth` it."""

    def once(state):
        worth, image, overlapping = state
        covered = surely_covered(film, things, worth, overlapping)
        chosen = selection(covered)
        bits = words_in_row(film.W) * WORD
        one = lambda image, index, there: image.at[
            jnp.where(there, place_of(index, bits, film.W, film.H), image.shape[0])
        ].set(1, mode="drop")
        image = fold_chosen(chosen, COVERED, one, image)
        return jnp.zeros_like(worth), image, overlapping & ~covered

    # (A condition would work out lists of covered pixels where it is not worth it, too.)
    return jax.lax.while_loop(lambda s: s[0], once, (worth, image, overlapping))[1:]


def _overlapping(film: FilmMap, pixels: _Pixels) -> Overlapping:
    (_, chosen, layers, corners, _), width = pixels, words_in_row(film.W) * WORD
    return Overlapping(chosen, layers, corners, chosen.total, width, film.W, film.H)


def _fold_crowd(
    film: FilmMap,
    still: _Still,
    pixels: _Pixels,
    parts: list[Part],
    add: Callable,
    start: Any,
    lists: list[CurveList] | None,
) -> Any:
    """Return `start` after `add(total, number, pixel, visible)` over what is visible where contours
    overlap (see `Crowd`)."""

    def crowd(total, place, visible: Visible, number: int):
        return add(total, number, place, visible)

    def again(total, resolved: Resolved):
        for number, visible in enumerate(resolved.visible):
            kept = all_kept(resolved.place, visible)
            total = kept.fold(partial(crowd, number=number), total)
        return total

    if still.overlap is None:
        return start
    complete = jnp.stack([kept.complete for kept in pixels.kept]).all()
    for number, kept in enumerate(pixels.kept):
        kept = kept._replace(used=jnp.where(complete, kept.used, 0))
        start = kept.fold(partial(crowd, number=number), start)
    overlapping = _overlapping(film, pixels)
    overlapping = overlapping._replace(total=jnp.where(complete, 0, overlapping.total))
    args = parts, overlapping, film.W, film.H, still.view.base
    return fold_cells(*args, again, start, True, still.stops, lists)
