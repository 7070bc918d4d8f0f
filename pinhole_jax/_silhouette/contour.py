"""What a mask sees of a scene: the occluding contour, as curves on the film.

A closed mesh is seen as its front-facing triangles; they end where a front- meets a back-facing
one. An open mesh shows both sides of each triangle, and its borders end it too. A sphere is seen
as a conic. Every curve is cut into parts that are monotone in x and in y, which is all that the
rasteriser asks of a curve.

Direction: the covered side lies on the left of a curve (counter-clockwise around what it bounds).
A scene may surround the eye: then its curves leave towards infinity, and `surrounding` tells how
many layers lie there.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

from .._camera.film import FilmMap, film_points, scaled
from .._numerics.batches import in_chunks
from .._numerics.bitset import Selection, bit, following, nth, select, selection, words_of
from .._numerics.one_kernel import for_both, on_cpu, put, rows
from .._numerics.safe import binary_inverse, safe_divide
from .._scene.planes import CLUSTER, Clusters, faces_eye, in_front, planes_of, undecided
from .._scene.scene import Mesh, front_facing, is_closed, planes_are_current
from .clip import Homogeneous, clipped, cut_off
from .curves import Point, Segments
from .distorted import (
    Bending,
    Cuts,
    End,
    along,
    bending,
    bent_parts,
    cuts,
    fraction,
    moving_parts,
)
from .surrounding import reaches_left

#: Clusters of edges looked at together.
CLUSTERS = 256


class MeshContour(NamedTuple):
    """The contour edges of a mesh; `segments` ids for `edge_segments`.

    Under distortion edges are cut into parts (`cuts`), whose ids come before those of what lies
    left of the film. `positive` has a bit for each edge, set where it bounds more cover on its left
    than on its right; `second` is None for a closed mesh, else the edges' second faces; `closed`
    tells what the compiler does not know.
    """

    edge_vertices: Int[Array, "E 2"]
    second: Int[Array, "E"] | None
    closed: Bool[Array, ""] | None
    positive: UInt32[Array, "words"]
    chosen: Selection
    segments: Int[Array, ""]
    cuts: Cuts | None = None

    @staticmethod
    def of(mesh: Mesh, of_view: tuple) -> "MeshContour":
        """Return the contour edges of a mesh in a view: see `of_view`."""
        second = None if mesh.closed else mesh.edge_faces[:, 1]
        closed = is_closed(mesh) if mesh.closed is None else None
        return MeshContour(mesh.edge_vertices, second, closed, *of_view)

    @property
    def of_view(self) -> tuple:
        """What is of the view, and not of the mesh: `positive` and what follows."""
        return self[3:]

    def weight(self, edge: Int[Array, "*K"]) -> Int[Array, "*K"]:
        """Return how many layers of cover contour edges bound on their left less on their right."""
        sign = jnp.where(bit(self.positive, edge), 1, -1)
        if self.second is None:
            return sign
        alone = self.second[edge] < 0
        return jnp.where(alone if self.closed is None else self.closed | alone, sign, 2 * sign)


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
    held = film, mesh.vertices, contour, bending(film)
    parts = cuts(_parts_of, contour.segments, mesh.edge_faces.shape[0], *held)
    return contour._replace(segments=parts.total + left, cuts=parts)


def _parts_of(
    rank: Int[Array, ""], film: FilmMap, vertices: Array, contour: MeshContour, table: Bending
) -> Int[Array, ""]:
    """Return into how many parts a contour edge is to be cut."""
    return table.parts(
        film, *_Ideal.of(film, vertices, contour, _edge(contour, rank), rank < 0).cut_off
    )


def _contour(mesh: Mesh, words: Array, positive: Array) -> MeshContour:
    """Return the edges of `contour_bits`, each seen as one segment."""
    chosen = selection(words)
    return MeshContour.of(mesh, (positive, chosen, chosen.total))


def contour_bits(
    mesh: Mesh, e: Float[Array, "3"]
) -> tuple[UInt32[Array, "words"], UInt32[Array, "words"]]:
    """Return which edges are on the contour, and which bound more cover on their left, as bits.

    A closed mesh counts front-facing triangles only; any other mesh counts every triangle, from
    whichever side it is seen. Whole clusters of edges whose faces all show the same side are passed
    over.
    """
    clusters, current = mesh.planes.clusters, planes_are_current(mesh)

    def plain(front):
        first, second = mesh.edge_faces[:, 0], mesh.edge_faces[:, 1]
        found = _seen_as(front[first], front[jnp.maximum(second, 0)], second < 0)
        return words_of(found.contour), words_of(found.positive)

    if clusters is None:
        return plain(front_facing(mesh, e, current))
    none = jnp.zeros(-(-mesh.edge_faces.shape[0] // CLUSTER), jnp.uint32)
    anew = lambda: plain(in_front(planes_of(mesh.vertices, mesh.faces), e))
    words, positive = jax.lax.cond(current, lambda: (none, none), anew)
    return _culled(mesh, clusters, current, e, words, positive)


def contour_weights(mesh: Mesh, e: Float[Array, "3"]) -> Int[Array, "E"]:
    """Return for each edge how many layers of cover it bounds on its left less on its right, 0 for
    one that is not on the contour."""
    words, positive = contour_bits(mesh, e)
    edge = jnp.arange(mesh.edge_faces.shape[0], dtype=jnp.int32)
    return jnp.where(bit(words, edge), _contour(mesh, words, positive).weight(edge), 0)


def _culled(
    mesh: Mesh, clusters: Clusters, current: Array, e: Array, words: Array, positive: Array
) -> tuple[UInt32[Array, "words"], UInt32[Array, "words"]]:
    """Return the bits with those of the clusters that need to be looked at, if these are current.

    (As a branch of a condition this loop would have its arguments copied.)
    """
    look = undecided(clusters, e) & current
    arguments = look, clusters.planes, mesh.edge_faces, e, words, positive
    if words.shape[0] < 2:  # (see `one_kernel`)
        return _looked_at_beside(*arguments)
    return on_cpu(_looked_at, *arguments, elsewhere=_looked_at_beside)


def _looked_at(
    look: Bool[Array, "N"],
    planes: Float[Array, "F 6"],
    edge_faces: Int[Array, "E 2"],
    e: Float[Array, "3"],
    words: UInt32[Array, "N"],
    positive: UInt32[Array, "N"],
) -> tuple[UInt32[Array, "N"], UInt32[Array, "N"]]:
    """Return the bits with those of some clusters, edge by edge."""
    E = edge_faces.shape[0]

    def of_cluster(state):
        cluster, _, words, positive = state
        first = cluster * CLUSTER

        def of_side(turn, sides):
            # One loop: the same rounding on both sides of an edge.
            k, second = turn >> 1, (turn & 1) > 0
            face = edge_faces[jnp.minimum(first + k, E - 1), turn & 1]
            plane = [planes[jnp.maximum(face, 0), i] for i in range(6)]
            front, there = faces_eye(plane[:3], plane[3:], e), jnp.uint32(1) << k
            more = lambda bits, is_so: bits | jnp.where(is_so, there, 0)
            return (
                more(sides[0], ~second & front),
                more(sides[1], second & front),
                more(sides[2], second & (face < 0)),
            )

        none = jnp.uint32(0)
        sides = jax.lax.fori_loop(0, 2 * CLUSTER, of_side, (none,) * 3)
        past = jnp.clip(first + CLUSTER - E, 0, CLUSTER - 1).astype(jnp.uint32)
        inside = ~none >> past
        found = _seen_as(*sides)
        done = jnp.array(False)
        return (
            cluster,
            done,
            put(words, found.contour & inside, cluster),
            put(positive, found.positive & inside, cluster),
        )

    def one(cluster, state):
        state = cluster, look[cluster], *state
        return jax.lax.while_loop(lambda s: s[1], of_cluster, state)[2:]

    return jax.lax.fori_loop(0, look.shape[0], one, (words, positive))


def _looked_at_beside(
    look: Bool[Array, "N"],
    planes: Float[Array, "F 6"],
    edge_faces: Int[Array, "E 2"],
    e: Float[Array, "3"],
    words: UInt32[Array, "N"],
    positive: UInt32[Array, "N"],
) -> tuple[UInt32[Array, "N"], UInt32[Array, "N"]]:
    """Return the bits with those of some clusters, side by side."""
    E, chosen = edge_faces.shape[0], select(look)

    def chunk(state, rank):
        words, positive = state
        some = rank + jnp.arange(CLUSTERS, dtype=jnp.int32)
        cluster = jnp.where(some < chosen.total, nth(chosen, some), words.shape[0])
        edge = cluster[:, None] * CLUSTER + jnp.arange(CLUSTER, dtype=jnp.int32)[None]
        faces = edge_faces[jnp.minimum(edge, E - 1)]
        second = faces[..., 1]
        # One list of faces: the same rounding on both sides of an edge.
        both = jnp.stack([faces[..., 0], jnp.maximum(second, 0)])
        plane = jax.lax.optimization_barrier(planes[both])
        normal, corner = ([plane[..., k + i] for i in range(3)] for k in (0, 3))
        front = faces_eye(normal, corner, e)
        found = _seen_as(front[0], front[1], second < 0)
        into = lambda words, there: words.at[cluster].set(words_of((edge < E) & there), mode="drop")
        return into(words, found.contour), into(positive, found.positive)

    return in_chunks(chunk, (words, positive), CLUSTERS, chosen.total)


class _SeenAs(NamedTuple):
    """Whether edges are contour, and whether they bound more cover on their left."""

    contour: Any
    positive: Any


def _seen_as(first: Array, second: Array, border: Array) -> _SeenAs:
    """Return what edges are seen as, from whether their two faces show their front: of those at a
    border there is one. (Or of words of bits.)"""
    return _SeenAs(border | (first ^ second), first & (border | ~second))


def homogeneous_edges(
    film: FilmMap, vertices: Float[Array, "V 3"], contour: MeshContour, ids: Int[Array, "K"]
) -> Float[Array, "K 2 3"]:
    """Return the ends of contour edges as homogeneous film points, differentiably.

    Under distortion those of the edges' parts, and what they move with is their images.
    """
    if contour.cuts is None:
        return _edge_ends(film, vertices, contour, _edge(contour, _place(contour, ids)[0]))
    ends = jax.lax.optimization_barrier(rows(_vertices_of, ids, contour))
    points = film_points(film, vertices[ends])
    return moving_parts(_part, points, film, ids, vertices, contour)


def _vertices_of(id: Int[Array, ""], contour: MeshContour) -> list[Array]:
    edge = _edge(contour, _place(contour, id)[0])
    return [contour.edge_vertices[edge, k] for k in (0, 1)]


class _Ideal(NamedTuple):
    """A contour edge on the ideal film, or what of it lies left of the film: its ends as
    homogeneous points, how many times as large these are as those of `film_points`, and the
    `cut_off` of it."""

    first: Homogeneous
    last: Homogeneous
    scales: tuple[Array, Array]
    cut_off: tuple[tuple[Point, Point], Array]

    @staticmethod
    def of(
        film: FilmMap, vertices: Array, contour: MeshContour, edge: Array, beside: Array
    ) -> "_Ideal":
        """Return a contour edge."""
        to_film = scaled(film)

        def end(k):
            vertex = contour.edge_vertices[edge, k]
            x, y, z = to_film.at(*(vertices[vertex, i] for i in range(3)))
            size = functools.reduce(jnp.maximum, map(jnp.abs, (x, y, z)))
            scale = binary_inverse(size)
            return x * scale, y * scale, z * scale, scale

        (*first, scale), (*last, other) = for_both(end)
        ends = Homogeneous(*first), Homogeneous(*last)
        cut = cut_off(*ends, contour.weight(edge), beside, film.bounds)
        return _Ideal(*ends, (scale, other), cut)

    def shares(self, x: Array, y: Array) -> list[Array]:
        """Return how much a point of it moves with each end of `film_points`, over depth."""
        a, b = self.first, self.last
        steep = jnp.abs(a.y * b.z - a.z * b.y) > jnp.abs(a.z * b.x - a.x * b.z)
        past = [jnp.where(steep, p.y - y * p.z, p.x - x * p.z) for p in (a, b)]
        t = jnp.clip(safe_divide(past[0], past[0] - past[1]), 0, 1)
        z = a.z + t * (b.z - a.z)
        return [safe_divide(s, z) * scale for s, scale in zip((1 - t, t), self.scales, strict=True)]


def _part(
    id: Int[Array, ""], film: FilmMap, vertices: Array, contour: MeshContour
) -> Callable[[Array], End]:
    """Return the ends of a part of a contour edge, or of what of one lies left of the film."""
    rank, beside, part, parts = _place(contour, id)
    ideal = _Ideal.of(film, vertices, contour, _edge(contour, rank), beside)
    ends, weight = ideal.cut_off
    weight = jnp.where(id < contour.segments, weight, 0)

    def end(k):
        place = along(ends, fraction(part + k, parts, weight.dtype))
        return End(*place, ideal.shares(*place), weight)

    return end


def _edge_ends(
    film: FilmMap, vertices: Float[Array, "V 3"], contour: MeshContour, edge: Int[Array, "K"]
) -> Float[Array, "K 2 3"]:
    """Return the ends of edges as homogeneous film points on the ideal film.

    Times a power of 2 for each end: products of them neither overflow nor vanish.
    """
    # (Without the barrier the compiler finds the ends anew for each number of a derivative.)
    ends = jax.lax.optimization_barrier(contour.edge_vertices[edge])
    homogeneous = film_points(film, vertices[ends])
    return homogeneous * binary_inverse(jnp.max(jnp.abs(homogeneous), axis=-1))[..., None]


def _place(contour: MeshContour, ids: Int[Array, "*K"]) -> tuple[Array, ...]:
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
    into parts, the way they are seen.
    """
    if contour.cuts is not None:
        return bent_parts(_part, film, ids, vertices, contour)
    rank, beside = _place(contour, ids)
    edge = _edge(contour, rank)
    weight, homogeneous = contour.weight(edge), _edge_ends(film, vertices, contour, edge)
    # Without the barriers the compiler repeats the gathers in each of the clip's many consumers.
    homogeneous, weight = jax.lax.optimization_barrier((homogeneous, weight))
    segments = clipped(homogeneous, weight, beside, film.bounds)
    weight = jnp.where(ids < contour.segments, segments.weight, 0)
    return jax.lax.optimization_barrier(segments._replace(weight=weight))


def edge_before(contour: MeshContour, id: Int[Array, ""]) -> Int[Array, ""]:
    """Return the edge that comes before the one of an id, -1 if there is none."""
    rank = _place(contour, id)[0]
    return jnp.where(rank > 0, nth(contour.chosen, jnp.maximum(rank - 1, 0)), -1)


def next_edge(
    film: FilmMap,
    vertices: Float[Array, "V 3"],
    contour: MeshContour,
    id: Int[Array, ""],
    before: Int[Array, ""],
) -> tuple[Int[Array, ""], tuple[Point, Point], Array]:
    """Return the edge of an id, and the ends and the weight that `edge_segments` finds of it, no
    distortion; of it is known which edge comes `before`.

    In single numbers: of these the compiler makes a third of what it makes of vectors. And to look
    for each edge among all takes longer than all else, one after the other.
    """
    rank, beside = _place(contour, id)
    edge = following(contour.chosen, jnp.where(rank > 0, before, -1))
    edge = jnp.minimum(edge, contour.edge_vertices.shape[0] - 1)
    ends, weight = _Ideal.of(film, vertices, contour, edge, beside).cut_off
    return edge, ends, jnp.where(id < contour.segments, weight, 0)
