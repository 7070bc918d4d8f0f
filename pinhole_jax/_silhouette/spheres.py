"""Spheres on the film: conics, cut into arcs that are monotone in x and in y."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._camera.film import FilmMap, film_points
from .._numerics.safe import binary_scale, dot, norm, normalize, safe_sqrt
from .._scene.scene import Spheres
from .curves import Arcs, Segments, cut_circle
from .distorted import Cuts, arc_part_ends, arc_parts, cuts, seen_through

#: A conic has at most 4 points where it turns back in x or y, and 2 where it leaves for infinity.
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
    middle = film_points(film, spheres.centers[sphere]) / distance[:, None]
    middle = middle * cosine[:, None] / binary_scale(film.matrix)
    around = sine[:, None, None] * jnp.stack([e1, e2], axis=1)
    around = jnp.stack(film.turn(*jnp.moveaxis(around, -1, 0)), axis=-1)
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


def homogeneous_arc_parts(
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
    """Return the arcs' parts, the way they are seen under distortion; then nothing."""
    weight = sphere_arcs(film, spheres, parts.find(ids)[0]).weight
    ends = homogeneous_arc_parts(film, spheres, parts, ids)[..., :2]
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
    start = jnp.stack(_by_angle(list(cuts)))
    return start, jnp.roll(start, -1, axis=0)


def _by_angle(points: list[Float[Array, "S 2"]]) -> list[Float[Array, "S 2"]]:
    """Return points in the order of their angles, by neighbours that change places: a sort would
    be a kernel of its own."""
    points = [jnp.column_stack([p, jnp.arctan2(p[:, 1], p[:, 0])]) for p in points]
    for turn in range(len(points)):
        for k in range(turn % 2, len(points) - 1, 2):
            a, b = points[k : k + 2]
            swap = (a[:, 2] > b[:, 2])[:, None]
            points[k : k + 2] = jnp.where(swap, b, a), jnp.where(swap, a, b)
    return [p[:, :2] for p in points]


def _middle(start: Float[Array, "*K 2"], end: Float[Array, "*K 2"]) -> Float[Array, "*K 2"]:
    """Return the unit vector half way from start to end, counter-clockwise."""
    chord = end - start
    across = normalize(jnp.stack([chord[..., 1], -chord[..., 0]], axis=-1))
    return across
