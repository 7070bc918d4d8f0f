"""The silhouette's outline as lines on the film, and the points of the object that make it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._camera.axes import axes_of
from .._camera.bent import bent
from .._camera.camera import Camera, camera_coordinates, film_map
from .._camera.rays import project
from .._native.rasteriser import sphere_frames
from .._numerics.safe import norm
from .._scene.scene import Mesh, Scene, Spheres, astype, check_view
from .conics import film_at
from .contour import Curve, contour_weights, edge_curves
from .spheres import ARCS_PER_SPHERE, shown_arcs
from .surrounding import surrounding

#: Outline points are at most this far apart (px), and no closer than that.
STEP_PX = 2.0
#: ... nor does a gap count that is shorter (px): rounding makes these.
LEAST_PX = 1e-6


def outline(camera: Camera, scene: Scene) -> Float[np.ndarray, "n 2 2"]:
    """Return the silhouette's outline as short segments (start, end) in film coordinates (px).

    Only the parts of the contour with background on their outer side: folds within the object and
    parts behind it are left out.

    ```python
    segments = pj.outline(fit.camera, scene)  # (n, 2, 2) in px: matplotlib's LineCollection
    ```
    """
    check_view(camera, scene)
    scene = astype(scene, camera.e.dtype)
    start, end, weight = _pieces(camera, scene)
    reversed_ = weight < 0  # cover on the right: the same contour run the other way
    start[reversed_], end[reversed_] = end[reversed_], start[reversed_]
    weight = np.abs(weight)
    of, first, last = _short_parts(start, end)
    along = (end - start)[of]
    short = np.stack([start[of] + t[:, None] * along for t in (first, last)], axis=1)
    # Points just outside and inside: with cover on the left. (A face of no area has none.)
    direction = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)
    right = 1e-3 * np.stack([direction[:, 1], -direction[:, 0]], axis=1)
    base = _base(camera, scene)
    outside, inside = (
        _winding(short.mean(axis=1) + side, start, end, weight) + base for side in (right, -right)
    )
    visible = (outside <= 0) & (inside > 0)
    return bent(camera, short[visible])


def contour_points(camera: Camera, scene: Scene) -> Float[np.ndarray, "n 3"]:
    """Return points in space, in front of the eye, that the contour is made of: on edges some
    px apart, on spheres where rays touch them.

    ```python
    pj.contour_points(fit.camera, scene).shape
    ```
    """
    check_view(camera, scene)
    scene = astype(scene, camera.e.dtype)
    parts = [np.zeros((0, 3))]
    if scene.mesh is not None and scene.mesh.edge_faces.shape[0]:
        on = np.flatnonzero(np.asarray(_edge_weights(scene.mesh, camera.e)))
        edges = np.asarray(scene.mesh.vertices, float)[np.asarray(scene.mesh.edge_vertices)[on]]
        film = np.asarray(project(camera, np.asarray(edges, camera.e.dtype)), float)
        length = np.linalg.norm(film[:, 1] - film[:, 0], axis=1)
        counts = np.clip(np.ceil(length / STEP_PX), 1, 200).astype(int)
        of = np.repeat(np.arange(len(counts)), counts)
        part = (np.arange(len(of)) - (np.cumsum(counts) - counts)[of] + 0.5) / counts[of]
        parts.append(edges[of, 0] + part[:, None] * (edges[of, 1] - edges[of, 0]))
    if scene.spheres is not None:
        eye = np.asarray(camera.e, float)
        angle = np.linspace(0, 2 * np.pi, 180, endpoint=False)
        balls = zip(np.asarray(scene.spheres.centers, float), scene.spheres.radii, strict=True)
        for centre, radius in balls:
            offset, r = centre - eye, float(radius)
            far = np.linalg.norm(offset)
            if far > r:
                axis = offset / far
                first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
                first /= np.linalg.norm(first)
                ring = np.outer(np.cos(angle), first)
                ring += np.outer(np.sin(angle), np.cross(axis, first))
                sine = r / far
                parts.append(centre + r * (np.sqrt(1 - sine**2) * ring - sine * axis))
    points = np.concatenate(parts)
    ahead = np.asarray(camera_coordinates(camera, np.asarray(points, camera.e.dtype)))[:, 2] > 0
    return points[ahead]


@eqx.filter_jit
def _segments(camera: Camera, mesh: Mesh) -> Curve:
    """All edges as segments in and near the film, and then what of them lies left of it."""
    film = film_map(camera)
    kinds = edge_curves(film(mesh.vertices), film, mesh)
    start, end, weight = (jnp.concatenate(x) for x in zip(*kinds, strict=True))
    return start, end, weight


def _base(camera: Camera, scene: Scene) -> int:
    """Return how many layers cover all else on the left: none where all is ahead of the eye."""
    forward, eye = axes_of(camera)[2], np.asarray(camera.e, float)
    nearest = [np.inf]
    if scene.mesh is not None:
        nearest.extend((np.asarray(scene.mesh.vertices, float) - eye) @ forward)
    if scene.spheres is not None:
        ahead = (np.asarray(scene.spheres.centers, float) - eye) @ forward
        nearest.extend(ahead - np.asarray(scene.spheres.radii, float))
    return 0 if min(nearest) > 0 else int(_layers(camera, scene))


@eqx.filter_jit
def _layers(camera: Camera, scene: Scene) -> Int[Array, ""]:
    return surrounding(film_map(camera), scene)


@eqx.filter_jit
def _edge_weights(mesh: Mesh, e: Float[Array, "3"]) -> Int[Array, "E"]:
    return contour_weights(mesh, e)


@eqx.filter_jit
def _arcs(camera: Camera, spheres: Spheres) -> tuple[Array, ...]:
    """Arcs' conics, from which angle to which they go, and their weights."""
    film = film_map(camera)
    frames = sphere_frames(film, spheres).reshape(-1, 3, 3)
    outside = norm(spheres.centers - film.eye[None]) > spheres.radii
    (*ends, weight) = shown_arcs(frames, outside)
    begin, until = (jnp.arctan2(y, x) for x, y in ends)
    return jnp.repeat(frames, ARCS_PER_SPHERE, axis=0), begin, until, weight


def _pieces(camera: Camera, scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return starts (n, 2), ends (n, 2) and weights (n,) of the whole contour, arcs sampled."""
    parts = [(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))]
    if scene.mesh is not None and scene.mesh.edge_faces.shape[0]:
        segments = _segments(camera, scene.mesh)
        on = np.asarray(segments[2]) != 0
        start, end, weight = (np.asarray(x, float)[on] for x in segments)
        parts.append((start, end, weight))
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        frame, begin, until, weight = map(np.asarray, _arcs(camera, scene.spheres))
        sweep = (until - begin) % (2 * np.pi)
        angle = begin[:, None] + sweep[:, None] * np.linspace(1e-6, 1 - 1e-6, 65)
        w = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(frame.dtype)
        frames = np.broadcast_to(frame[:, None], (*angle.shape, 3, 3))
        points = np.asarray(film_at(jnp.asarray(frames), jnp.asarray(w)), float)
        points = np.clip(points, -1e9, 1e9)[weight != 0]
        ends = points[:, :-1].reshape(-1, 2), points[:, 1:].reshape(-1, 2)
        parts.append((*ends, np.ones(len(ends[0]))))
    start, end, weight = (np.concatenate(x) for x in zip(*parts, strict=True))
    return start, end, weight


def _short_parts(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lines' parts, cut where they meet others and every `STEP_PX`: the line's number,
    and from where to where along it (0 to 1)."""
    length = np.linalg.norm(end - start, axis=1)
    counts = np.clip(np.ceil(length / STEP_PX), 1, 10_000).astype(int)
    of = np.repeat(np.arange(len(counts)), counts + 1)
    step = np.arange(len(of)) - (np.cumsum(counts + 1) - counts - 1)[of]
    line, along = _meetings(start, end)
    of, along = np.append(of, line), np.append(step / counts[of], along)
    order = np.lexsort((along, of))
    of, along = of[order], along[order]
    gap = np.append(np.diff(along), -1)
    parts = np.flatnonzero((np.append(np.diff(of), 1) == 0) & (gap * length[of] > LEAST_PX))
    return of[parts], along[parts], along[parts + 1]


def _meetings(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where lines meet others that are not parallel: their numbers, how far along (0 to 1).

    Where lines run on one another, those that they go on as tell where that begins and ends.
    """
    low, high = np.minimum(start, end) - LEAST_PX, np.maximum(start, end) + LEAST_PX
    cross = lambda a, b: a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    lines, along = [np.zeros(0, int)], [np.zeros(0)]
    for begin in range(0, len(start), 512):
        some = slice(begin, begin + 512)
        apart = (low[some, None] > high[None]) | (low[None] > high[some, None])
        one, other = np.nonzero(~apart.any(axis=2))
        one = one + begin
        own, theirs = end[one] - start[one], end[other] - start[other]
        sweep, offset = cross(own, theirs), start[other] - start[one]
        safe = np.where(sweep == 0, 1, sweep)
        t, reach = cross(offset, theirs) / safe, cross(offset, own) / safe
        met = (sweep != 0) & (t > 0) & (t < 1) & (np.abs(reach - 0.5) < 0.5 + 1e-9)
        lines.append(one[met])
        along.append(t[met])
    return np.concatenate(lines), np.concatenate(along)


def _winding(
    points: np.ndarray, start: np.ndarray, end: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Return how many layers lie over each point: signed crossings of the ray to its left."""
    result = np.zeros(len(points))
    for begin in range(0, len(points), 512):
        x, y = points[begin : begin + 512, None].transpose(2, 0, 1)
        spans = (start[:, 1] <= y) != (end[:, 1] <= y)
        rise = np.where(start[:, 1] == end[:, 1], 1, end[:, 1] - start[:, 1])
        at = start[:, 0] + (y - start[:, 1]) / rise * (end[:, 0] - start[:, 0])
        sign = np.where(end[:, 1] < start[:, 1], 1, -1)
        result[begin : begin + 512] = np.sum(spans * (at < x) * sign * weight, axis=1)
    return np.round(result)
