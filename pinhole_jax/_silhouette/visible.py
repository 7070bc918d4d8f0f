"""The silhouette's outline as lines on the film, and the points of the object that make it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._camera.bent import bent
from .._camera.camera import Camera, camera_coordinates, film_map
from .._camera.rays import project
from .._native.rasteriser import sphere_frames
from .._numerics.safe import norm
from .._scene.scene import Mesh, Scene, astype, check_view
from .clip import Curve
from .conics import film_at
from .contour import contour_weights, edge_curves
from .spheres import ARCS_PER_SPHERE, Points, shown_arcs
from .surrounding import surrounding

#: Outline points are at most this far apart (px), and no closer than that.
STEP_PX = 2.0
#: Shorter gaps (px) do not count: they come from rounding.
LEAST_PX = 1e-6
#: Points along an arc of a sphere's outline.
ARC_POINTS = 65


def outline(camera: Camera, scene: Scene) -> Float[np.ndarray, "n 2 2"]:
    """Return the silhouette's outline as short segments (start, end) in film coordinates (px).

    Only the parts of the contour with background on their outer side: folds within the object and
    parts behind it are left out.

    ```python
    segments = pj.outline(fit.camera, scene)  # (n, 2, 2) in px: matplotlib's LineCollection
    ```
    """
    check_view(camera, scene)
    if not _has_parts(scene):
        return np.zeros((0, 2, 2))
    *lines, layers = _lines(camera, astype(scene, camera.e.dtype))
    on = np.asarray(lines[2]) != 0
    start, end, weight = (np.asarray(x, float)[on] for x in lines)
    reverse = weight < 0  # cover on the right: the same line run the other way
    start[reverse], end[reverse] = end[reverse], start[reverse]
    weight = np.abs(weight)
    line, first, last = _short_parts(start, end)
    along = (end - start)[line]
    short = np.stack([start[line] + t[:, None] * along for t in (first, last)], axis=1)
    # Points just outside and inside: with cover on the left. (A face of no area has none.)
    direction = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)
    right = 1e-3 * np.stack([direction[:, 1], -direction[:, 0]], axis=1)
    outside, inside = (
        _winding(short.mean(axis=1) + side, start, end, weight) + int(layers)
        for side in (right, -right)
    )
    visible = (outside <= 0) & (inside > 0)
    return bent(camera, short[visible])


def _has_parts(scene: Scene) -> bool:
    """Return True for a scene with an edge or a sphere."""
    edges = scene.mesh is not None and scene.mesh.edge_faces.shape[0]
    return bool(edges or (scene.spheres is not None and scene.spheres.radii.shape[0]))


def contour_points(camera: Camera, scene: Scene) -> Float[np.ndarray, "n 3"]:
    """Return points in space (n, 3) on the contour, in front of the eye.

    On edges some px apart, on spheres where rays touch them.

    ```python
    pj.contour_points(fit.camera, scene).shape
    ```
    """
    check_view(camera, scene)
    scene, real = astype(scene, camera.e.dtype), camera.e.dtype
    parts = [np.zeros((0, 3))]
    if scene.mesh is not None and scene.mesh.edge_faces.shape[0]:
        on = np.flatnonzero(np.asarray(edge_weights(scene.mesh, camera.e)))
        edges = np.asarray(scene.mesh.vertices, float)[np.asarray(scene.mesh.edge_vertices)[on]]
        film = np.asarray(project(camera, edges.astype(real)), float)
        counts = _part_counts(film[:, 0], film[:, 1], 200)
        edge, rank = ranks(counts)
        share = ((rank + 0.5) / counts[edge])[:, None]
        parts.append(edges[edge, 0] + share * (edges[edge, 1] - edges[edge, 0]))
    if scene.spheres is not None:
        centers, radii = (
            np.asarray(x, float) for x in (scene.spheres.centers, scene.spheres.radii)
        )
        parts += map(_rim, centers - np.asarray(camera.e, float), radii, centers)
    points = np.concatenate(parts)
    ahead = np.asarray(camera_coordinates(camera, points.astype(real)))[:, 2] > 0
    return points[ahead]


def _rim(offset: np.ndarray, radius: float, centre: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Return the points where rays touch a sphere; none from within."""
    far = np.linalg.norm(offset)
    if far <= radius:
        return np.zeros((0, 3))
    axis, sine = offset / far, radius / far
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)[:, None]
    ring = np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)
    return centre + radius * (np.sqrt(1 - sine**2) * ring - sine * axis)


@eqx.filter_jit
def _lines(camera: Camera, scene: Scene) -> tuple[Array, Array, Array, Int[Array, ""]]:
    """Starts, ends and weights of the contour's lines, and the layers far on the left.

    The contour in and near the film, then the parts left of it; arcs are cut into lines.
    """
    film, kinds = film_map(camera), []
    if scene.mesh is not None and scene.mesh.edge_faces.shape[0]:
        kinds += edge_curves(film(scene.mesh.vertices), film, scene.mesh)
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        frames = sphere_frames(film, scene.spheres).reshape(-1, 3, 3)
        outside = norm(scene.spheres.centers - film.eye[None]) > scene.spheres.radii
        kinds.append(_arc_lines(frames, *shown_arcs(frames, outside)))
    start, end, weight = (jnp.concatenate(x) for x in zip(*kinds, strict=True))
    return start, end, weight, surrounding(film, scene)


def _arc_lines(
    frames: Float[Array, "S 3 3"], start: Points, end: Points, weight: Float[Array, "A"]
) -> Curve:
    """Arcs as `ARC_POINTS` - 1 straight lines each: their ends on the film, and weights."""
    begin, until = (jnp.arctan2(w[:, 1:], w[:, :1]) for w in (start, end))
    share = jnp.linspace(1e-6, 1 - 1e-6, ARC_POINTS, dtype=weight.dtype)[None]
    angle = begin + (until - begin) % (2 * np.pi) * share
    w = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    frame = jnp.repeat(frames, ARCS_PER_SPHERE, axis=0)[:, None]
    points = jnp.clip(film_at(jnp.broadcast_to(frame, (*angle.shape, 3, 3)), w), -1e9, 1e9)
    first, last = points[:, :-1].reshape(-1, 2), points[:, 1:].reshape(-1, 2)
    return first, last, jnp.repeat(weight, ARC_POINTS - 1)


@eqx.filter_jit
def edge_weights(mesh: Mesh, e: Float[Array, "3"]) -> Int[Array, "E"]:
    """`contour_weights` as a program of its own."""
    return contour_weights(mesh, e)


def _part_counts(start: np.ndarray, end: np.ndarray, most: int) -> Int[np.ndarray, "n"]:
    """Return the numbers of parts, about `STEP_PX` long each, of lines."""
    length = np.linalg.norm(end - start, axis=1)
    return np.clip(np.ceil(length / STEP_PX), 1, most).astype(int)


def ranks(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each item's group and its rank there, for groups of these sizes."""
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - (np.cumsum(counts) - counts)[group]


def _short_parts(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lines' parts, cut at other lines and every `STEP_PX`.

    The number of the line, and the share of it (0 to 1) at which the part begins and ends.
    """
    counts = _part_counts(start, end, 10_000)
    length = np.linalg.norm(end - start, axis=1)
    line, rank = ranks(counts + 1)
    crossed, crossing = _meetings(start, end)
    share = np.append(rank / counts[line], crossing)
    line = np.append(line, crossed)
    order = np.lexsort((share, line))
    line, share = line[order], share[order]
    gap = np.append(np.diff(share), -1)
    parts = np.flatnonzero((np.append(np.diff(line), 1) == 0) & (gap * length[line] > LEAST_PX))
    return line[parts], share[parts], share[parts + 1]


def _meetings(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of lines that cross others, and at which share of them (0 to 1).

    Lines that run on one another need no cut: those that they go on as mark where that begins.
    """
    low, high = np.minimum(start, end) - LEAST_PX, np.maximum(start, end) + LEAST_PX
    cross = lambda a, b: a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    lines, along = [np.zeros(0, int)], [np.zeros(0)]
    for begin in range(0, len(start), 512):
        block = slice(begin, begin + 512)
        apart = (low[block, None] > high[None]) | (low[None] > high[block, None])
        line, other = np.nonzero(~apart.any(axis=2))
        line = line + begin
        own, theirs = end[line] - start[line], end[other] - start[other]
        sweep, offset = cross(own, theirs), start[other] - start[line]
        safe = np.where(sweep == 0, 1, sweep)
        t, reach = cross(offset, theirs) / safe, cross(offset, own) / safe
        met = (sweep != 0) & (t > 0) & (t < 1) & (np.abs(reach - 0.5) < 0.5 + 1e-9)
        lines.append(line[met])
        along.append(t[met])
    return np.concatenate(lines), np.concatenate(along)


def _winding(
    points: np.ndarray, start: np.ndarray, end: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Return the number of layers over each point: signed crossings of the ray to its left."""
    result = np.zeros(len(points))
    for begin in range(0, len(points), 512):
        x, y = points[begin : begin + 512, None].transpose(2, 0, 1)
        spans = (start[:, 1] <= y) != (end[:, 1] <= y)
        rise = np.where(start[:, 1] == end[:, 1], 1, end[:, 1] - start[:, 1])
        crossing = start[:, 0] + (y - start[:, 1]) / rise * (end[:, 0] - start[:, 0])
        sign = np.where(end[:, 1] < start[:, 1], 1, -1)
        result[begin : begin + 512] = np.sum(spans * (crossing < x) * sign * weight, axis=1)
    return np.round(result)
