"""Spheres on the film: conics, cut into arcs that are monotone in x and in y."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._camera.film import FilmMap, film_points, scaled, turned
from .._native.rasteriser import ring_at
from .._numerics.one_kernel import rows
from .._numerics.safe import binary_scale, dot, length, norm, safe_divide
from .._scene.scene import Spheres
from .curves import Arcs, Frame, Point, Segments, cut_at, frame_of, homogeneous_at
from .distorted import Cuts, arc_part, arc_parts, arc_within, bent_parts, cuts, moving_parts

#: A conic has at most 4 points where it turns back in x or y, and 2 where it leaves for infinity.
ARCS_PER_SPHERE = 6


def sphere_frames(film: FilmMap, spheres: Spheres, ids: Int[Array, "K"]) -> Float[Array, "K 3 3"]:
    """Return the frames of the spheres' outlines (see `Arcs`), differentiably; 6 ids to a sphere.

    Rays touch a sphere (centre c from the eye, radius r) on a circle, in the directions
    `c t / |c|^2 + (r / |c|) (e1 w_1 + e2 w_2)` of unit length, with t the tangent's length and e1,
    e2 perpendicular to c. Their film points are a conic.
    """
    sphere = jax.lax.div(ids, jnp.int32(ARCS_PER_SPHERE))
    centre, radius = spheres.centers[sphere], spheres.radii[sphere]
    ring = _ring(jnp.concatenate([centre - film.eye[None], radius[:, None]], axis=1))
    middle = film_points(film, centre) * ring[:, :1] / binary_scale(film.matrix)
    around = turned(film.matrix, ring[:, 1:].reshape(-1, 2, 3))
    return jnp.concatenate([middle[:, None], around], axis=1)


def _frame(film: FilmMap, centre: Sequence[Array], radius: Array) -> Frame:
    """Return one of these frames, by components."""
    x, y, z = (c - film.eye[k] for k, c in enumerate(centre))
    ring = ring_at(x, y, z, radius)
    unit = binary_scale(film.matrix)
    # Of the centre counts its place beside the view point, as for a mesh's vertices.
    middle = tuple(x * ring[0] / unit for x in scaled(film).at(*centre))
    return middle, film.turn(*ring[1:4]), film.turn(*ring[4:])


@jax.custom_jvp
def _ring(seen: Float[Array, "K 4"]) -> Float[Array, "K 7"]:
    """Return what a frame is made of: see `ring_at`."""
    return jnp.stack(ring_at(*(seen[:, k] for k in range(4))), axis=1)


@_ring.defjvp
def _(primals: Any, tangents: Any):
    seen, moves = primals[0], tangents[0]
    ids = jnp.arange(seen.shape[0], dtype=jnp.int32)
    table = rows(_ring_row, ids, seen)
    slopes = table[:, 7:].reshape(-1, 7, 4)
    return table[:, :7], jnp.sum(slopes * moves[:, None], axis=-1)


def _ring_row(id: Int[Array, ""], seen: Float[Array, "K 4"]) -> list[Array]:
    """Return what `ring_at` does, and the derivatives of each of its numbers."""
    at, number = [seen[id, k] for k in range(4)], range(4)
    along = lambda k: [jnp.asarray(m == k, seen.dtype) for m in number]
    by = [jax.jvp(ring_at, at, along(k)) for k in number]
    return [*by[0][0], *(by[k][1][m] for m in range(7) for k in number)]


def sphere_arcs(film: FilmMap, spheres: Spheres, ids: Int[Array, "K"]) -> Arcs:
    """Return parts of the spheres' outlines: id 6 s + k is the k-th monotone arc of sphere s.

    The conic is cut where it is level or upright, and where it meets the plane through the eye;
    what is behind is left out, and so is a sphere that holds the eye.
    """
    sphere = jax.lax.div(ids, jnp.int32(ARCS_PER_SPHERE))
    part = ids - sphere * ARCS_PER_SPHERE
    frame = sphere_frames(film, spheres, ids)
    start, end = (
        jnp.take_along_axis(w, part[None, :, None], axis=0)[0] for w in _monotone_stretches(frame)
    )
    return _shown(film, spheres, sphere, frame, start, end)


def arcs_of_sphere(film: FilmMap, spheres: Spheres, ids: Int[Array, "6"]) -> Arcs:
    """Return the `sphere_arcs` of one sphere, from its first id: what they share is worked out
    once."""
    sphere = jax.lax.div(ids[:1], jnp.int32(ARCS_PER_SPHERE))
    frame = sphere_frames(film, spheres, ids[:1])
    start, end = (w[:, 0] for w in _monotone_stretches(frame))
    frame = jnp.broadcast_to(frame, (ARCS_PER_SPHERE, 3, 3))
    return _shown(film, spheres, sphere, frame, start, end)


def _shown(
    film: FilmMap,
    spheres: Spheres,
    sphere: Int[Array, "#K"],
    frame: Float[Array, "K 3 3"],
    start: Float[Array, "K 2"],
    end: Float[Array, "K 2"],
) -> Arcs:
    """Return parts of the spheres' outlines; what is not seen weighs nothing."""
    middle = _middle(start, end)
    z = dot(frame[..., 2], jnp.concatenate([jnp.ones_like(middle[:, :1]), middle], axis=1))
    outside = norm(spheres.centers[sphere] - film.eye[None]) > spheres.radii[sphere]
    shown = outside & (z > 0) & jnp.any(start != end, axis=-1)
    return Arcs(frame, start, end, shown.astype(frame.dtype))


def arc_cuts(film: FilmMap, spheres: Spheres) -> Cuts:
    """Return into how many parts each arc of `sphere_arcs` is to be cut under distortion."""
    number = ARCS_PER_SPHERE * spheres.radii.shape[0]
    ids = jnp.arange(number, dtype=jnp.int32)
    table = rows(_arc_row, ids, film, spheres)
    found = cuts(lambda k, table: table[k, -1].astype(jnp.int32), number, number, table)
    return found._replace(curves=table[:, :-1])


def _arc_row(id: Int[Array, ""], film: FilmMap, spheres: Spheres) -> list[Array]:
    """Return the numbers of an `Arc`, and into how many parts it is to be cut."""
    sphere = jax.lax.div(id, jnp.int32(ARCS_PER_SPHERE))
    part = id - sphere * ARCS_PER_SPHERE
    centre, radius = [spheres.centers[sphere, k] for k in range(3)], spheres.radii[sphere]
    from_eye = [c - film.eye[k] for k, c in enumerate(centre)]
    frame = _frame(film, centre, radius)
    points = _turning_points(frame)
    pick = lambda points, i: jax.lax.select_n(part, *(p[i] for p in points))
    start, end = (
        (pick(around, 0), pick(around, 1)) for around in (points, [*points[1:], points[0]])
    )
    middle = _middle_at(start, end)
    z = homogeneous_at(frame, middle)[2]
    differ = (start[0] != end[0]) | (start[1] != end[1])
    shown = (length(*from_eye) > radius) & (z > 0) & differ
    arc = arc_within(film, frame, start, end, shown.astype(radius.dtype))
    return [*arc.numbers, arc_parts(film, arc).astype(radius.dtype)]


def homogeneous_arc_parts(
    film: FilmMap, spheres: Spheres, parts: Cuts, ids: Int[Array, "K"]
) -> Float[Array, "K 2 3"]:
    """Return the ends of the arcs' parts as what their images move with, differentiably."""
    arc = rows(lambda id, parts: [parts.find(id)[0]], ids, parts)[:, 0]
    frame = sphere_frames(film, spheres, arc)
    return moving_parts(arc_part, frame, film, ids, parts)


def arc_part_segments(film: FilmMap, parts: Cuts, ids: Int[Array, "K"]) -> Segments:
    """Return the arcs' parts, the way they are seen under distortion; then nothing."""
    return bent_parts(arc_part, film, ids, parts)


def _monotone_stretches(frame: Float[Array, "S 3 3"]):
    """Return the ends (6, S, 2) of the arcs between points where the conic turns or is cut."""
    points = _turning_points(frame_of(frame))
    start = jnp.stack([jnp.stack(p, axis=-1) for p in points])
    return start, jnp.roll(start, -1, axis=0)


def _turning_points(frame: Frame) -> list[Point]:
    """Return the points where the conic turns or is cut, in order, by components."""
    levels = [[row[2] for row in frame]]
    for i in (0, 1):  # where the derivative of x (of y) by the angle vanishes
        minor = lambda k, m, i=i: frame[k][i] * frame[m][2] - frame[m][i] * frame[k][2]
        levels.append([minor(2, 1), minor(2, 0), minor(0, 1)])
    cuts: list[Point] = []
    for level in levels:
        exists = jnp.abs(level[0]) < jnp.sqrt(level[1] ** 2 + level[2] ** 2)
        for growing in (1.0, -1.0):
            cut = cut_at(level, growing)
            # The first cut counts in any case: at the point nearest to infinity, if none is there.
            # Cuts that do not exist repeat it.
            x, y = (jnp.where(exists, a, b) for a, b in zip(cut, (cuts or [cut])[0], strict=True))
            cuts.append((x, y))
    return _by_angle(cuts)


def _by_angle(points: list[Point]) -> list[Point]:
    """Return points in the order of their angles, by neighbours that change places: a sort would
    be a kernel of its own."""
    ordered = [[x, y, jnp.arctan2(y, x)] for x, y in points]
    for turn in range(len(points)):
        for k in range(turn % 2, len(points) - 1, 2):
            a, b = ordered[k : k + 2]
            either = partial(map, partial(jnp.where, a[2] > b[2]))
            ordered[k : k + 2] = [list(either(b, a)), list(either(a, b))]
    return [(x, y) for x, y, _ in ordered]


def _middle(start: Float[Array, "*K 2"], end: Float[Array, "*K 2"]) -> Float[Array, "*K 2"]:
    """Return the unit vector half way from start to end, counter-clockwise."""
    halves = _middle_at(*((w[..., 0], w[..., 1]) for w in (start, end)))
    return jnp.stack(halves, axis=-1)


def _middle_at(start: Point, end: Point) -> Point:
    """Return the same, by components."""
    x, y = end[1] - start[1], start[0] - end[0]
    size = length(x, y)
    return safe_divide(x, size), safe_divide(y, size)
