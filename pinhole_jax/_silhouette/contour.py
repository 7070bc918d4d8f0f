"""What a mask sees of a scene: the occluding contour, as curves on the film.

A closed mesh is seen as its front-facing triangles; they end where a front- meets a back-facing
one. An open mesh shows both sides of each triangle, and its borders end it too. A sphere is seen
as a conic. Every curve is cut into parts that are monotone in x and in y, which is all that the
rasteriser asks of a curve.

Direction: the covered side lies on the left of a curve (counter-clockwise around what it bounds).
A scene may surround the eye: then its curves leave towards infinity, and `surrounding` tells how
many layers lie there.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._camera.camera import FilmMap
from .._numerics.bitset import Selection, bit, nth, select, selection, words_of
from .._numerics.safe import (
    binary_inverse,
    binary_scale,
    dot,
    norm,
    normalize,
    safe_divide,
    safe_sqrt,
)
from .._scene.scene import (
    CLUSTER,
    Clusters,
    Mesh,
    Scene,
    Spheres,
    faces_eye,
    front_facing,
    planes_are_current,
    undecided,
    vertex_box,
)
from .curves import Arcs, Segments, cut_circle
from .distorted import Cuts, along, arc_part_ends, arc_parts, bending, cuts, following, seen_through

#: Layers that cover everything, whatever else there is.
EVERYWHERE = 1 << 20
#: Clusters of edges looked at together.
CLUSTERS = 256


class MeshContour(NamedTuple):
    """The contour edges of a mesh; `segments` ids for `edge_segments`.

    Under distortion edges are cut into parts (`cuts`), whose ids come before those of what lies
    left of the film. `positive` has a bit for each edge, set where it bounds more cover on its left
    than on its right; `second` is None for a closed mesh, else the edges' second faces.
    """

    edge_vertices: Int[Array, "E 2"]
    second: Int[Array, "E"] | None
    positive: UInt32[Array, "words"]
    chosen: Selection
    segments: Int[Array, ""]
    cuts: Cuts | None = None

    def weight(self, edge: Int[Array, "*K"]) -> Int[Array, "*K"]:
        """Return how many layers of cover contour edges bound on their left less on their right."""
        sign = jnp.where(bit(self.positive, edge), 1, -1)
        if self.second is None:
            return sign
        return jnp.where(self.second[edge] < 0, sign, 2 * sign)


def mesh_contour(film: FilmMap, mesh: Mesh) -> MeshContour:
    """Return which edges are contour, and how many segments they can be seen as."""
    film, mesh = jax.lax.stop_gradient((film, mesh))
    words, positive = contour_bits(mesh, film.eye)
    # Without the barrier the compiler works these out anew in each loop that reads some.
    words, positive = jax.lax.optimization_barrier((words, positive))
    contour = _contour(mesh, words, positive)
    left = jnp.where(reaches_left(film, mesh), contour.segments, 0)
    if film.bend is None:
        return contour._replace(segments=contour.segments + left)
    bent, edges = bending(film), mesh.edge_faces.shape[0]

    def number(rank):
        return bent.parts(_ideal_segments(film, mesh.vertices, contour, rank, rank < 0), film.px)

    parts = cuts(number, contour.segments, edges)
    return contour._replace(segments=parts.total + left, cuts=parts)


def _contour(mesh: Mesh, words: Array, positive: Array) -> MeshContour:
    """Return the edges of `contour_bits`, each seen as one segment."""
    chosen = selection(words)
    second = None if mesh.closed else mesh.edge_faces[:, 1]
    return MeshContour(mesh.edge_vertices, second, positive, chosen, chosen.total)


def contour_bits(
    mesh: Mesh, e: Float[Array, "3"]
) -> tuple[UInt32[Array, "words"], UInt32[Array, "words"]]:
    """Return which edges are on the contour, and which bound more cover on their left, as bits.

    A closed mesh counts front-facing triangles only; any other mesh counts every triangle, from
    whichever side it is seen. Whole clusters of edges whose faces all show the same side are passed
    over.
    """
    clusters = mesh.planes.clusters

    def plain():
        front = front_facing(mesh, e)
        first, second = mesh.edge_faces[:, 0], mesh.edge_faces[:, 1]
        weight = _weight(mesh, front[first], front[jnp.maximum(second, 0)], second)
        return words_of(weight != 0), words_of(weight > 0)

    if clusters is None:
        return plain()
    current = planes_are_current(mesh)
    none = jnp.zeros(-(-mesh.edge_faces.shape[0] // CLUSTER), jnp.uint32)
    words, positive = jax.lax.cond(current, lambda: (none, none), plain)
    return _culled(mesh, clusters, current, e, words, positive)


def contour_weights(mesh: Mesh, e: Float[Array, "3"]) -> Int[Array, "E"]:
    """Return for each edge how many layers of cover it bounds on its left less on its right, 0 for
    one that is not on the contour."""
    words, positive = contour_bits(mesh, e)
    edge = jnp.arange(mesh.edge_faces.shape[0], dtype=jnp.int32)
    return jnp.where(bit(words, edge), _contour(mesh, words, positive).weight(edge), 0)


def _culled(
    mesh: Mesh, clusters: Clusters, current: Array, e: Array, words: Array, positive: Array
):
    """Return the bits with those of the clusters that need to be looked at, if these are current.

    (As a branch of a condition this loop would have its arguments copied.)
    """
    E = mesh.edge_faces.shape[0]
    look = select(undecided(clusters, e) & current)

    def body(state):
        rank, words, positive = state
        some = rank + jnp.arange(CLUSTERS, dtype=jnp.int32)
        cluster = jnp.where(some < look.total, nth(look, some), words.shape[0])
        edge = cluster[:, None] * CLUSTER + jnp.arange(CLUSTER, dtype=jnp.int32)[None]
        faces = mesh.edge_faces[jnp.minimum(edge, E - 1)]
        second = faces[..., 1]
        # One list of faces: the same rounding on both sides of an edge.
        both = jnp.stack([faces[..., 0], jnp.maximum(second, 0)])
        plane = jax.lax.optimization_barrier(clusters.planes[both])
        normal, corner = ([plane[..., k + i] for i in range(3)] for k in (0, 3))
        front = faces_eye(normal, corner, e)
        weight = jnp.where(edge < E, _weight(mesh, front[0], front[1], second), 0)
        words = words.at[cluster].set(words_of(weight != 0), mode="drop")
        return rank + CLUSTERS, words, positive.at[cluster].set(words_of(weight > 0), mode="drop")

    start = (jnp.int32(0), words, positive)
    return jax.lax.while_loop(lambda s: s[0] < look.total, body, start)[1:]


def _weight(mesh: Mesh, first, second, second_face) -> Int[Array, "*E"]:
    """Return the edges' weights from whether their two faces show their front."""
    first, second = first.astype(jnp.int8), second.astype(jnp.int8)
    if mesh.closed:
        return first - second
    return 2 * first - 1 - jnp.where(second_face < 0, 0, 2 * second - 1)


def edge_lifts(
    film: FilmMap, vertices: Float[Array, "V 3"], contour: MeshContour, ids: Int[Array, "K"]
) -> Float[Array, "K 2 3"]:
    """Return the ends of contour edges as homogeneous film points, differentiably.

    Under distortion those of the edges' parts, and what they move with is their images.
    """
    rank, beside, *part = _place(contour, ids)
    lift = _edge_ends(film, vertices, contour, _edge(contour, rank))
    if not part:
        return lift
    held = jax.lax.stop_gradient((film, vertices))
    ideal = _ideal_segments(*held, contour, rank, beside)
    return seen_through(film, following(lift, along(ideal, *part)))


def _edge_ends(
    film: FilmMap, vertices: Float[Array, "V 3"], contour: MeshContour, edge: Int[Array, "K"]
) -> Float[Array, "K 2 3"]:
    """Return the ends of edges as homogeneous film points on the ideal film.

    Times a power of 2 for each end: products of them neither overflow nor vanish.
    """
    lifts = _film_points(film, vertices[contour.edge_vertices[edge]])
    return lifts * binary_inverse(jnp.max(jnp.abs(lifts), axis=-1))[..., None]


def _film_points(film: FilmMap, points: Float[Array, "*K 3"]) -> Float[Array, "*K 3"]:
    """Return homogeneous film points that are no larger than the points: none overflows."""
    unit = binary_scale(film.matrix)
    where = lambda f: (f.matrix, f.base)
    return eqx.tree_at(where, film, [x * unit for x in where(film)])(points)


def _place(contour: MeshContour, ids: Int[Array, "K"]) -> tuple[Array, ...]:
    """Return which contour edge each id stands for, and whether for what of it lies left of the
    film; under distortion also the part of the edge, and how many it has."""
    if contour.cuts is None:
        total = contour.chosen.total
        return jnp.where(ids >= total, ids - total, ids), ids >= total
    inner = contour.cuts.total
    beside = ids >= inner
    rank, part, parts = contour.cuts.find(ids)
    one = jnp.ones_like(ids)
    return (
        jnp.where(beside, ids - inner, rank),
        beside,
        jnp.where(beside, 0, part),
        jnp.where(beside, one, parts),
    )


def _edge(contour: MeshContour, rank: Int[Array, "*K"]) -> Int[Array, "*K"]:
    return jnp.minimum(nth(contour.chosen, rank), contour.edge_vertices.shape[0] - 1)


def edge_segments(
    film: FilmMap, vertices: Float[Array, "V 3"], contour: MeshContour, ids: Int[Array, "K"]
) -> Segments:
    """Return contour edges in and near the film, then what of them lies left of it; then nothing.

    The second half is there only if something may lie on the left. Under distortion edges are cut
    into parts, as which they are seen.
    """
    rank, beside, *part = _place(contour, ids)
    segments = _ideal_segments(film, vertices, contour, rank, beside)
    weight = jnp.where(ids < contour.segments, segments.weight, 0)
    if part:
        ends = seen_through(film, along(segments, *part))[..., :2]
        segments = Segments(ends[:, 0], ends[:, 1], weight)
    return jax.lax.optimization_barrier(segments._replace(weight=weight))


def _ideal_segments(
    film: FilmMap, vertices: Array, contour: MeshContour, rank: Array, beside: Array
) -> Segments:
    """Return contour edges, or what of them lies left of the film, on the ideal film."""
    edge = _edge(contour, rank)
    weight, lift = contour.weight(edge), _edge_ends(film, vertices, contour, edge)
    # Without the barriers the compiler repeats the gathers in each of the clip's many consumers.
    lift, weight = jax.lax.optimization_barrier((lift, weight))
    return clipped(lift, weight, beside, film.bounds)


def clipped(
    lift: Float[Array, "K 2 3"],
    weight: Int[Array, "K"],
    beside: Bool[Array, "K"],
    bounds: list[Array],
) -> Segments:
    """Return edges as segments on the film, cut off at bounds (left, right, low, high) outside it.

    Edges are clipped before the division by depth, so those that pass the eye or end behind it lose
    no accuracy. What lies right of the film shows nowhere in it and is left out; what lies left of
    it still bounds the rows: where `beside`, that is returned, as an upright segment on the left.
    A cut end lies at exactly its bound. An edge that passes through the eye's x axis leaves for
    infinity at the top (`surrounding` decides alike).
    """
    left, right, low, high = bounds
    first = jnp.array([[True, False]])
    is_low, is_high = (f > 0 for f in _rows_outside(lift, low, high))
    t_low, t_high = (_crossing(f)[:, None] for f in _rows_outside(lift, low, high))
    later, sooner = jnp.maximum(t_low, t_high), jnp.minimum(t_low, t_high)
    both = jnp.where(first, later, sooner)
    t = jnp.where(is_low & is_high, both, jnp.where(is_low, t_low, t_high))
    t = jnp.where(is_low | is_high, t, jnp.where(first, 0, 1))
    at_top = is_high & (~is_low | (t == t_high))
    spot = lift[:, :1] + t[..., None] * (lift[:, 1:] - lift[:, :1])
    spot = jnp.where((is_low | is_high)[..., None], spot, lift)
    x, y, z = jnp.moveaxis(spot, -1, 0)
    height = jnp.where(at_top, high, jnp.where(is_low, low, safe_divide(y, z)))
    none = jnp.all(is_low, axis=1) | jnp.all(is_high, axis=1) | (t[:, 0] > t[:, 1])
    weight = jnp.where(none | jnp.all(lift[..., 2] <= 0, axis=1), 0, weight).astype(lift.dtype)

    is_left, is_right = left * z - x > 0, x - right * z > 0
    y_left, y_right = (_height_of_crossing(f, y, z, height) for f in (left * z - x, x - right * z))
    inner_x = jnp.where(is_left, left, jnp.where(is_right, right, safe_divide(x, z)))
    inner_y = jnp.where(is_left, y_left, jnp.where(is_right, y_right, height))
    outer_y = jnp.where(is_left, height, y_left)
    beyond = jnp.all(is_left, axis=1) | jnp.all(is_right, axis=1)
    shown = jnp.where(beside, jnp.any(is_left, axis=1), ~beyond)
    ends = jnp.stack(
        [
            jnp.where(beside[:, None], left, inner_x),
            jnp.where(beside[:, None], outer_y, inner_y),
        ],
        axis=-1,
    )
    return Segments(ends[:, 0], ends[:, 1], jnp.where(shown, weight, 0))


def _rows_outside(lift: Float[Array, "K 2 3"], low: Array, high: Array) -> list:
    """Return by how much the ends are below and above the rows, times depth."""
    y, z = lift[..., 1], lift[..., 2]
    return [low * z - y, y - high * z]


def _crossing(f: Float[Array, "K 2"]) -> Float[Array, "K"]:
    """Return where along an edge a value given at its ends is 0."""
    return safe_divide(f[:, 0], f[:, 0] - f[:, 1])


def _height_of_crossing(beyond, y, z, height) -> Float[Array, "K 1"]:
    """Return the height at which an edge crosses an upright bound, between its ends' heights."""
    t = jnp.clip(_crossing(beyond), 0, 1)
    y, z = (p[:, 0] + t * (p[:, 1] - p[:, 0]) for p in (y, z))
    return jnp.clip(safe_divide(y, z), jnp.min(height, axis=1), jnp.max(height, axis=1))[:, None]


ARCS_PER_SPHERE = 6


def sphere_frames(film: FilmMap, spheres: Spheres, ids: Int[Array, "K"]) -> Float[Array, "K 3 3"]:
    """Return the frames of the spheres' outlines (see `Arcs`), differentiably; 6 ids to a sphere.

    Rays touch a sphere (centre c from the eye, radius r) on a circle, in the directions
    `c t / |c|^2 + (r / |c|) (e1 w_1 + e2 w_2)` of unit length, with t the tangent's length and e1,
    e2 perpendicular to c. Their film points are a conic.
    """
    sphere = jax.lax.div(ids, jnp.int32(ARCS_PER_SPHERE))
    centre = spheres.centers[sphere] - film.eye[None]
    distance, radius = norm(centre), spheres.radii[sphere]
    distance = jnp.where(jax.lax.stop_gradient(distance > radius), distance, 2 * radius)
    sine = radius / distance
    cosine = safe_sqrt((distance - radius) / distance * (1 + sine))
    axis = centre / distance[:, None]
    least = jax.lax.stop_gradient(jnp.argmin(jnp.abs(axis), axis=1))
    aside = jax.nn.one_hot(least, 3, dtype=axis.dtype)
    e1 = normalize(aside - axis * dot(aside, axis)[:, None])
    e2 = jnp.cross(e1, axis)  # counter-clockwise as the eye sees it
    # Of the centre counts its place beside the view point, as for a mesh's vertices.
    middle = _film_points(film, spheres.centers[sphere]) / distance[:, None]
    middle = middle * cosine[:, None] / binary_scale(film.matrix)
    around = sine[:, None, None] * jnp.stack([e1, e2], axis=1)
    around = film.turn(*jnp.moveaxis(around, -1, 0))
    return jnp.concatenate([middle[:, None], around], axis=1)


def sphere_arcs(film: FilmMap, spheres: Spheres, ids: Int[Array, "K"]) -> Arcs:
    """Return parts of the spheres' outlines: id 6 s + k is the k-th monotone arc of sphere s.

    The conic is cut where it is level or upright, and where it meets the plane through the eye;
    what is behind is left out, and so is a sphere that holds the eye.
    """
    frame = sphere_frames(film, spheres, ids)
    sphere = jax.lax.div(ids, jnp.int32(ARCS_PER_SPHERE))
    part = ids - sphere * ARCS_PER_SPHERE
    start, end = (
        jnp.take_along_axis(w, part[None, :, None], axis=0)[0] for w in _monotone_stretches(frame)
    )
    middle = _middle(start, end)
    z = dot(frame[..., 2], jnp.concatenate([jnp.ones_like(middle[:, :1]), middle], axis=1))
    outside = norm(spheres.centers[sphere] - film.eye[None]) > spheres.radii[sphere]
    shown = outside & (z > 0) & jnp.any(start != end, axis=-1)
    return Arcs(frame, start, end, shown.astype(frame.dtype))


def arc_cuts(film: FilmMap, spheres: Spheres) -> Cuts:
    """Return into how many parts each arc of `sphere_arcs` is to be cut under distortion."""
    film, spheres = jax.lax.stop_gradient((film, spheres))
    number = ARCS_PER_SPHERE * spheres.radii.shape[0]
    return cuts(lambda ids: arc_parts(film, sphere_arcs(film, spheres, ids)), number, number)


def arc_part_lifts(
    film: FilmMap, spheres: Spheres, parts: Cuts, ids: Int[Array, "K"]
) -> Float[Array, "K 2 3"]:
    """Return the ends of the arcs' parts as what their images move with, differentiably."""
    arc, *part = parts.find(ids)
    arcs = sphere_arcs(*jax.lax.stop_gradient((film, spheres)), arc)
    frame = sphere_frames(film, spheres, arc)
    return seen_through(film, arc_part_ends(film, arcs, frame, *part))


def arc_part_segments(
    film: FilmMap, spheres: Spheres, parts: Cuts, ids: Int[Array, "K"]
) -> Segments:
    """Return the arcs' parts, as which they are seen under distortion; then nothing."""
    weight = sphere_arcs(film, spheres, parts.find(ids)[0]).weight
    ends = arc_part_lifts(film, spheres, parts, ids)[..., :2]
    return Segments(ends[:, 0], ends[:, 1], jnp.where(ids < parts.total, weight, 0))


def _monotone_stretches(frame: Float[Array, "S 3 3"]):
    """Return the ends (6, S, 2) of the arcs between points where the conic turns or is cut."""
    p = jnp.moveaxis(frame, (1, 2), (0, 1))  # p[k][i]: row k, component i of all spheres
    levels = [p[:, 2]]
    for i in (0, 1):  # where the derivative of x (of y) by the angle vanishes
        minor = lambda k, m, i=i: p[k][i] * p[m][2] - p[m][i] * p[k][2]
        levels.append(jnp.stack([minor(2, 1), minor(2, 0), minor(0, 1)]))
    cuts, exists = [], []
    for level in levels:
        reach = jnp.sqrt(level[1] ** 2 + level[2] ** 2)
        for growing in (1.0, -1.0):
            cuts.append(cut_circle(jnp.moveaxis(level, 0, -1), jnp.full_like(reach, growing)))
            exists.append(jnp.abs(level[0]) < reach)
    # The first cut counts in any case: at the point nearest to infinity, if none is there. Cuts
    # that do not exist repeat it.
    exists[0] = jnp.ones_like(exists[0])
    cuts = jnp.where(jnp.stack(exists)[..., None], jnp.stack(cuts), cuts[0][None])
    angle = jnp.arctan2(cuts[..., 1], cuts[..., 0])
    order = jnp.argsort(angle, axis=0)
    start = jnp.take_along_axis(cuts, order[..., None], axis=0)
    return start, jnp.roll(start, -1, axis=0)


def _middle(start: Float[Array, "*K 2"], end: Float[Array, "*K 2"]) -> Float[Array, "*K 2"]:
    """Return the unit vector half way from start to end, counter-clockwise."""
    chord = end - start
    across = normalize(jnp.stack([chord[..., 1], -chord[..., 0]], axis=-1))
    return across


def surrounding(film: FilmMap, scene: Scene) -> Int[Array, ""]:
    """Return how many layers lie far to the left of the film, where no curve is.

    Not 0 only where the scene reaches through the plane of the eye; `EVERYWHERE` and more if the
    eye is within a closed mesh or a sphere.
    """
    layers = jnp.int32(0)
    film, scene = jax.lax.stop_gradient((film, scene))
    if scene.mesh is not None and scene.mesh.faces.shape[0]:
        mesh = scene.mesh
        layers = layers + jax.lax.cond(
            jnp.any(_corners(film, mesh)[:, 2] <= 0),
            lambda: _layers_on_the_left(mesh, film).astype(jnp.int32),
            lambda: jnp.int32(0),
        )
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        centre, radius = scene.spheres.centers - film.eye[None], scene.spheres.radii
        distance = norm(centre)
        tangent = safe_sqrt(distance - radius) * safe_sqrt(distance + radius)
        forward, up = film.matrix[2], film.matrix[1]
        left = normalize(jnp.cross(up, forward))
        beside = (dot(centre, left[None]) >= tangent) & (distance > radius)
        within = EVERYWHERE * jnp.sum(distance <= radius, dtype=jnp.int32)
        layers = layers + jnp.sum(beside, dtype=jnp.int32) + within
    return layers


def reaches_left(film: FilmMap, mesh: Mesh) -> Bool[Array, ""]:
    """Return whether anything may lie left of what contours are cut off at."""
    x, _, z = jnp.moveaxis(_corners(film, mesh), -1, 0)
    return jnp.any(x < film.bounds[0] * z)


def _corners(film: FilmMap, mesh: Mesh) -> Float[Array, "8 3"]:
    """Return the corners of the vertices' bounding box as homogeneous film points."""
    bounds = vertex_box(mesh)
    which = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    return _film_points(film, jnp.stack([bounds[which[:, k], k] for k in range(3)], axis=-1))


def _layers_on_the_left(mesh: Mesh, film: FilmMap) -> Int[Array, ""]:
    """Return how many layers the ray along -x from the eye meets, by signed crossings.

    The ray is thought to lie a little below y = 0, and much less in front of z = 0, so that it
    never meets an edge.
    """
    points = _film_points(film, mesh.vertices)
    points = points * binary_inverse(jnp.max(jnp.abs(points), axis=1))[:, None]

    def around(k, sums):
        toward, signs = sums
        first, second, third = (
            jax.lax.dynamic_index_in_dim(mesh.faces, (k + j) % 3, 1, keepdims=False)
            for j in range(3)
        )
        value, sign = _side(points, first, second)
        return toward + points[third, 0] * value, signs + sign

    none = jnp.zeros(mesh.faces.shape[0], points.dtype)
    toward, signs = jax.lax.fori_loop(0, 3, around, (none, none.astype(jnp.int32)))
    met = ((signs == 3) & (toward < 0)) | ((signs == -3) & (toward > 0))
    orientation = jnp.where(met, -jnp.sign(signs), 0)
    front = front_facing(mesh, film.eye)
    if not mesh.closed:
        return jnp.sum(jnp.where(front, orientation, -orientation))
    inside = jnp.sum(orientation) != 0
    return jnp.sum(jnp.where(front, orientation, 0)) + jnp.where(inside, EVERYWHERE, 0)


def _side(points: Float[Array, "V 3"], first: Int[Array, "F"], second: Int[Array, "F"]):
    """Return on which side of the edge between two vertices, seen along x, the ray passes: value
    and sign.

    The same for both faces that share the edge, but for the sign.
    """
    swap = first > second
    a, b = points[jnp.minimum(first, second)], points[jnp.maximum(first, second)]
    # Two rounded products are compared: their difference might be contracted, and unlike 0.
    left, right = a[:, 1] * b[:, 2], b[:, 1] * a[:, 2]
    tie = jnp.where(a[:, 2] != b[:, 2], b[:, 2] - a[:, 2], b[:, 1] - a[:, 1])
    sign = jnp.where(left != right, jnp.where(left > right, 1, -1), jnp.sign(tie).astype(jnp.int32))
    value = left - right
    return jnp.where(swap, -value, value), jnp.where(swap, -sign, sign)
