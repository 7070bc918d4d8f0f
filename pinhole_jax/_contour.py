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

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._camera import FilmMap
from ._curves import Arcs, Segments, cut_circle
from ._safe import dot, norm, normalize, safe_divide, safe_sqrt
from ._scene import Mesh, Scene, Spheres, front_facing

#: Layers that cover everything, whatever else there is.
EVERYWHERE = 1 << 20


def contour_weights(mesh: Mesh, e: Float[Array, "3"]) -> Int[Array, "E"]:
    """Return for each edge how many layers of cover it bounds on its left less on its right.

    0 for an edge that is not on the contour. A closed mesh counts front-facing triangles only; any
    other mesh counts every triangle, from whichever side it is seen.
    """
    front = front_facing(mesh, e).astype(jnp.int8)
    first, second = mesh.edge_faces[:, 0], mesh.edge_faces[:, 1]
    if mesh.closed:
        return front[first] - front[second]
    side = 2 * front - 1
    return side[first] - jnp.where(second < 0, 0, side[jnp.maximum(second, 0)])


class Selection(NamedTuple):
    """A set of edges as bits, 32 to a word, with the number of set bits before each word."""

    words: Array
    before: Int[Array, "words"]
    total: Int[Array, ""]


def select(mask: Bool[Array, "E"]) -> Selection:
    """Return the set of the mask's true entries, to be listed by `nth`.

    Counting bits in words is 10 times cheaper than `jnp.nonzero` over the edges of a large mesh.
    """
    padding = -mask.shape[0] % 32
    bits = jnp.pad(mask, (0, padding)).reshape(-1, 32).astype(jnp.uint32)
    words = jnp.sum(bits << jnp.arange(32, dtype=jnp.uint32)[None], axis=1, dtype=jnp.uint32)
    ones = jax.lax.population_count(words).astype(jnp.int32)
    upto = jnp.cumsum(ones)
    return Selection(words, upto - ones, upto[-1] if upto.shape[0] else jnp.int32(0))


def nth(selection: Selection, rank: Int[Array, "K"]) -> Int[Array, "K"]:
    """Return the indices of the set's entries number `rank`; an index within range past the end."""
    word = jnp.searchsorted(selection.before, rank, side="right").astype(jnp.int32) - 1
    word = jnp.maximum(word, 0)
    bits, rest = selection.words[word], (rank - selection.before[word]).astype(jnp.uint32)
    position = jnp.zeros_like(bits)
    for width in (16, 8, 4, 2, 1):  # binary search for the bit that `rest` set bits precede
        half = (bits >> position) & jnp.uint32((1 << width) - 1)
        ones = jax.lax.population_count(half)
        upper = rest >= ones
        rest = jnp.where(upper, rest - ones, rest)
        position = jnp.where(upper, position + jnp.uint32(width), position)
    return word * 32 + position.astype(jnp.int32)


class _Ends(NamedTuple):
    """The ends of what is left of segments: homogeneous film points, and their heights."""

    a: Float[Array, "K 3"]
    b: Float[Array, "K 3"]
    y_a: Float[Array, "K"]
    y_b: Float[Array, "K"]
    some: Bool[Array, "K"]


def rank_in(selection: Selection, index: Int[Array, "K"]) -> Int[Array, "K"]:
    """Return which number each index has in the set, -1 if it is not in it."""
    word, bit = index >> 5, (index & 31).astype(jnp.uint32)
    bits = selection.words[word]
    before = jax.lax.population_count(bits & ((jnp.uint32(1) << bit) - 1)).astype(jnp.int32)
    return jnp.where((bits >> bit) & 1 > 0, selection.before[word] + before, -1)


class MeshContour(NamedTuple):
    """The contour edges of a mesh; `count` ids for `edge_segments`."""

    edge_vertices: Int[Array, "E 2"]
    weights: Int[Array, "E"]
    chosen: Selection
    count: Int[Array, ""]


def mesh_contour(film: FilmMap, mesh: Mesh) -> MeshContour:
    """Return which edges are contour, and how many segments they can be seen as."""
    film, mesh = jax.lax.stop_gradient((film, mesh))
    weights = contour_weights(mesh, film.eye)
    chosen = select(weights != 0)
    count = chosen.total * jnp.where(reaches_left(film, mesh.vertices), 2, 1)
    return MeshContour(mesh.edge_vertices, weights, chosen, count)


def edge_segments(
    film: FilmMap, vertices: Float[Array, "V 3"], contour: MeshContour, ids: Int[Array, "K"]
) -> Segments:
    """Return contour edges in and near the film, then what of them lies left of it; then nothing.

    The second half is there only if something may lie on the left.
    """
    total = contour.chosen.total
    edge = nth(contour.chosen, jnp.where(ids >= total, ids - total, ids))
    edge = jnp.minimum(edge, contour.weights.shape[0] - 1)
    weight = jnp.where(ids < contour.count, contour.weights[edge], 0)
    return mesh_segments(film, vertices, contour.edge_vertices[edge], weight, ids >= total)


def mesh_segments(
    film: FilmMap,
    vertices: Float[Array, "V 3"],
    edges: Int[Array, "K 2"],
    weight: Int[Array, "K"],
    beside: Bool[Array, "K"],
) -> Segments:
    """Return the edges as segments on the film, cut off one film's size outside it.

    Edges are clipped before the division by depth, so those that pass the eye or end behind it lose
    no accuracy. What lies right of the film shows nowhere in it and is left out; what lies left of
    it still bounds the rows: where `beside`, that is returned, as an upright segment on the left.
    """
    left, right, low, high = -film.W, 2 * film.W, -film.H, 2 * film.H
    e = _between_rows(film(vertices[edges]), low, high)
    weight = jnp.where(e.some, weight, 0).astype(e.a.dtype)
    leftness = [left * p[:, 2] - p[:, 0] for p in (e.a, e.b)]
    rightness = [p[:, 0] - right * p[:, 2] for p in (e.a, e.b)]
    is_left, is_right = ([f > 0 for f in side] for side in (leftness, rightness))
    y_left, y_right = _height_of_crossing(e, leftness), _height_of_crossing(e, rightness)

    def inner(k, point, y):
        within = ~is_left[k] & ~is_right[k] & (point[:, 2] > 0)
        x = point[:, 0] / jnp.where(within, point[:, 2], 1)
        x = jnp.where(is_left[k], left, jnp.where(is_right[k], right, x))
        y = jnp.where(is_left[k], y_left, jnp.where(is_right[k], y_right, y))
        return jnp.stack([x, y], axis=-1)

    def upright(k, y):
        y = jnp.where(is_left[k], y, y_left)
        return jnp.stack([jnp.full_like(y, left), y], axis=-1)

    gone = (is_left[0] & is_left[1]) | (is_right[0] & is_right[1])
    inside = Segments(inner(0, e.a, e.y_a), inner(1, e.b, e.y_b), jnp.where(gone, 0, weight))
    some = is_left[0] | is_left[1]
    left_part = Segments(upright(0, e.y_a), upright(1, e.y_b), jnp.where(some, weight, 0))
    choose = lambda x, y: jnp.where(beside.reshape(-1, *(1,) * (x.ndim - 1)), x, y)
    return jax.tree.map(choose, left_part, inside)


def _between_rows(points: Float[Array, "K 2 3"], low: int, high: int) -> _Ends:
    """Return the part of each edge seen between two heights of the film; it is in front of the eye.

    A cut end lies at exactly that height. An edge that passes through the eye's x axis leaves for
    infinity at the top (`surrounding` decides alike).
    """
    a, b = points[:, 0], points[:, 1]
    below = [low * p[:, 2] - p[:, 1] for p in (a, b)]
    above = [p[:, 1] - high * p[:, 2] for p in (a, b)]
    at_bottom, at_top = _crossing(below), _crossing(above)
    cuts = [(jnp.where(f[0] > 0, t, 0), jnp.where(f[1] > 0, t, 1)) for f, t in
            ((below, at_bottom), (above, at_top))]
    t0, t1 = jnp.maximum(cuts[0][0], cuts[1][0]), jnp.minimum(cuts[0][1], cuts[1][1])
    gone = ((below[0] > 0) & (below[1] > 0)) | ((above[0] > 0) & (above[1] > 0)) | (t0 > t1)
    some = ~gone & ((a[:, 2] > 0) | (b[:, 2] > 0))

    def end(k, point, t, top_counts):
        low_cut, high_cut = below[k] > 0, above[k] > 0
        spot = jnp.where((low_cut | high_cut)[:, None], a + t[:, None] * (b - a), point)
        free = ~low_cut & ~high_cut & (point[:, 2] > 0)
        y = point[:, 1] / jnp.where(free, point[:, 2], 1)
        top = high_cut & (top_counts | ~low_cut)
        return spot, jnp.where(top, high, jnp.where(low_cut, low, y))

    spot_a, y_a = end(0, a, t0, cuts[1][0] >= cuts[0][0])
    spot_b, y_b = end(1, b, t1, cuts[1][1] <= cuts[0][1])
    return _Ends(spot_a, spot_b, y_a, y_b, jax.lax.stop_gradient(some))


def _crossing(f: list) -> Float[Array, "K"]:
    """Return where along an edge a value given at its ends is 0, if it changes sign."""
    crosses = (f[0] > 0) != (f[1] > 0)
    return safe_divide(jnp.where(crosses, f[0], 0), jnp.where(crosses, f[0] - f[1], 1))


def _height_of_crossing(e: _Ends, beyond: list) -> Float[Array, "K"]:
    """Return the height at which an edge crosses an upright bound, between its ends' heights."""
    t = _crossing(beyond)
    y, z = (e.a[:, k] + t * (e.b[:, k] - e.a[:, k]) for k in (1, 2))
    crosses = ((beyond[0] > 0) != (beyond[1] > 0)) & (z > 0)
    y = jnp.where(crosses, y / jnp.where(crosses, z, 1), e.y_a)
    return jnp.clip(y, jnp.minimum(e.y_a, e.y_b), jnp.maximum(e.y_a, e.y_b))


ARCS_PER_SPHERE = 6


def sphere_arcs(film: FilmMap, spheres: Spheres, ids: Int[Array, "K"]) -> Arcs:
    """Return parts of the spheres' outlines: id 6 s + k is the k-th monotone arc of sphere s.

    Rays touch a sphere (centre c from the eye, radius r) on a circle, in the directions
    `c t / |c|^2 + (r / |c|) (e1 w_1 + e2 w_2)` of unit length, with t the tangent's length and e1,
    e2 perpendicular to c. Their film points are a conic. It is cut where it is level or upright,
    and where it meets the plane through the eye; what is behind is left out.
    """
    sphere = jax.lax.div(ids, jnp.int32(ARCS_PER_SPHERE))
    part = ids - sphere * ARCS_PER_SPHERE
    centre = spheres.centers[sphere] - film.eye[None]
    distance, radius = norm(centre), spheres.radii[sphere]
    outside = jax.lax.stop_gradient(distance > radius)
    distance = jnp.where(outside, distance, 2 * radius)
    tangent = safe_sqrt((distance - radius) * (distance + radius))
    axis = centre / distance[:, None]
    least = jax.lax.stop_gradient(jnp.argmin(jnp.abs(axis), axis=1))
    aside = jax.nn.one_hot(least, 3, dtype=axis.dtype)
    e1 = normalize(aside - axis * dot(aside, axis)[:, None])
    e2 = jnp.cross(e1, axis)  # counter-clockwise as the eye sees it
    sine = (radius / distance)[:, None]
    rays = jnp.stack([axis * (tangent / distance)[:, None], sine * e1, sine * e2], axis=1)
    frame = film.turn(*jnp.moveaxis(rays, -1, 0))
    ends = _monotone_stretches(jax.lax.stop_gradient(frame))
    start, end = (
        jnp.take_along_axis(w, part[None, :, None], axis=0)[0] for w in ends
    )
    middle = _middle(start, end)
    z = dot(frame[..., 2], jnp.concatenate([jnp.ones_like(middle[:, :1]), middle], axis=1))
    shown = outside & (jax.lax.stop_gradient(z) > 0) & jnp.any(start != end, axis=-1)
    return Arcs(frame, start, end, shown.astype(frame.dtype))


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
            jnp.any(_corners(film, mesh.vertices)[:, 2] <= 0),
            lambda: _layers_on_the_left(mesh, film).astype(jnp.int32),
            lambda: jnp.int32(0),
        )
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        centre, radius = scene.spheres.centers - film.eye[None], scene.spheres.radii
        distance = norm(centre)
        tangent = safe_sqrt((distance - radius) * (distance + radius))
        forward, up = film.matrix[2], film.matrix[1]
        left = normalize(jnp.cross(up, forward))
        beside = (dot(centre, left[None]) >= tangent) & (distance > radius)
        within = EVERYWHERE * jnp.sum(distance <= radius, dtype=jnp.int32)
        layers = layers + jnp.sum(beside, dtype=jnp.int32) + within
    return layers


def reaches_left(film: FilmMap, vertices: Float[Array, "V 3"]) -> Bool[Array, ""]:
    """Return whether anything may lie left of the film by more than its width."""
    x, _, z = jnp.moveaxis(_corners(film, jax.lax.stop_gradient(vertices)), -1, 0)
    return jnp.any(x < -film.W * z)


def _corners(film: FilmMap, vertices: Float[Array, "V 3"]) -> Float[Array, "8 3"]:
    """Return the corners of the vertices' bounding box as homogeneous film points."""
    bounds = jnp.stack([jnp.min(vertices, axis=0), jnp.max(vertices, axis=0)])
    which = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(8, 3)
    return film(jnp.stack([bounds[which[:, k], k] for k in range(3)], axis=-1))


def _layers_on_the_left(mesh: Mesh, film: FilmMap) -> Int[Array, ""]:
    """Return how many layers the ray along -x from the eye meets, by signed crossings.

    The ray is thought to lie a little below y = 0, and much less in front of z = 0, so that it
    never meets an edge.
    """
    points = film(mesh.vertices)
    corner = [points[mesh.faces[:, k]] for k in range(3)]
    sides = [_side(corner[k], corner[(k + 1) % 3], mesh.faces, k) for k in range(3)]
    weights = [corner[(k + 2) % 3][:, 0] * sides[k][0] for k in range(3)]
    signs = [s[1] for s in sides]
    met = (signs[0] == signs[1]) & (signs[1] == signs[2]) & (signs[0] != 0)
    toward = weights[0] + weights[1] + weights[2]
    met &= jnp.where(signs[0] > 0, toward < 0, toward > 0)
    orientation = jnp.where(met, -signs[0], 0)
    front = front_facing(mesh, film.eye)
    if not mesh.closed:
        return jnp.sum(jnp.where(front, orientation, -orientation))
    inside = jnp.sum(orientation) != 0
    return jnp.sum(jnp.where(front, orientation, 0)) + jnp.where(inside, EVERYWHERE, 0)


def _side(a, b, faces: Int[Array, "F 3"], k: int):
    """Return on which side of the edge a b, seen along x, the ray passes: value and sign.

    The same for both faces that share the edge, but for the sign.
    """
    swap = faces[:, k] > faces[:, (k + 1) % 3]
    first = jnp.where(swap[:, None], b, a)
    second = jnp.where(swap[:, None], a, b)
    value = first[:, 1] * second[:, 2] - second[:, 1] * first[:, 2]
    tie = jnp.where(first[:, 2] != second[:, 2], second[:, 2] - first[:, 2], second[:, 1] - first[:, 1])
    sign = jnp.sign(jnp.where(value != 0, value, tie)).astype(jnp.int32)
    flip = jnp.where(swap, -1, 1)
    return jnp.where(swap, -value, value), sign * flip
