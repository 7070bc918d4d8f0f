"""The silhouette's outline as lines on the film, and the points of the object that make it.

Rays that pass beside the contour say which parts of it are seen.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera, bent, film_map
from .._camera.rays import Rays
from .._native.rasteriser import sphere_frames
from .._numerics.safe import norm
from .._scene.scene import Scene, astype, check_view
from .._trace.trace import occluded
from .contour import contour_weights

#: Segments of an outline are at most this long (px), of this many steps that a ray decides on.
STEP_PX, STEPS = 2.0, 16
#: Rays pass the contour at this distance (px), and at this many roundings of their directions.
BESIDE_PX, ROUNDINGS = 1e-3, 8
#: A sphere's outline has this many lines times the root of the film's size (px).
LINES = 200
#: Steps go on straight if their directions' cosine is more.
STRAIGHT = 0.9999
#: A line's parts at most.
MOST_PARTS = 10_000


def outline(camera: Camera, scene: Scene) -> Float[np.ndarray, "n 2 2"]:
    """Return the silhouette's outline as short segments (start, end) in film coordinates (px).

    Only the parts of the contour with background on their outer side: folds within the object and
    parts behind it are left out.

    ```python
    segments = pj.outline(fit.camera, scene)  # (n, 2, 2) in px: matplotlib's LineCollection
    ```
    """
    lines, to_world = _contour(camera, scene)
    ends = lines[..., :2] / lines[..., 2:]
    line, shares = _parts(ends, STEP_PX / STEPS)
    way = ends[line, 1] - ends[line, 0]
    first, middle, last = ends[line, 0] + shares[..., None] * way
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-30)
    rounding = ROUNDINGS * np.finfo(camera.e.dtype).eps / np.linalg.norm(to_world[:, 0])
    aside = max(BESIDE_PX, rounding) * way[:, ::-1] * [1, -1]
    covered = (_covered(camera, scene, to_world, middle + s) for s in (aside, -aside))
    seen = np.logical_xor(*covered)

    # Steps that go on straight are one segment.
    joined = seen[1:] & seen[:-1] & (np.sum(way[1:] * way[:-1], axis=1) > STRAIGHT)
    joined &= np.all(np.abs(first[1:] - last[:-1]) < BESIDE_PX, axis=1)
    joined &= np.arange(1, len(seen)) % STEPS > 0
    begins, ends = seen & ~np.append(False, joined), seen & ~np.append(joined, False)
    return bent(camera, np.stack([first[begins], last[ends]], axis=1))


def contour_points(camera: Camera, scene: Scene) -> Float[np.ndarray, "n 3"]:
    """Return points in space (n, 3) on the contour, in front of the eye, in and near the film.

    On edges some px apart, on spheres where rays touch them.

    ```python
    pj.contour_points(fit.camera, scene).shape
    ```
    """
    lines, to_world = _contour(camera, scene)
    line, (_, middle, _) = _parts(lines[..., :2] / lines[..., 2:], STEP_PX)
    start, end = lines[line, 0], lines[line, 1]
    points = start + middle[:, None] * (end - start)
    return np.asarray(camera.e, float) + points @ to_world.T


def _covered(
    camera: Camera, scene: Scene, to_world: np.ndarray, film: Float[np.ndarray, "n 2"]
) -> np.ndarray:
    """Return True for ideal film points where the object is."""
    ways: Any = np.column_stack([film, np.ones(len(film))]) @ to_world.T
    return np.asarray(occluded(scene, Rays(camera.e, ways.astype(camera.e.dtype))))


def _contour(camera: Camera, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the contour's lines, seen or not, as homogeneous film points (n, 2, 3).

    Those in and near the film; and the map (3, 3) of such points to offsets from the eye.
    """
    check_view(camera, scene)
    curves = _curves(camera, astype(scene, camera.e.dtype))
    matrix, bounds, edges, frames = (np.asarray(x, float) for x in curves)
    angle = np.linspace(0, 2 * np.pi, int(LINES * max(camera.W, camera.H) ** 0.5) + 1)
    ring = np.stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)], axis=1) @ frames
    sides = np.stack([ring[:, :-1], ring[:, 1:]], axis=2).reshape(-1, 2, 3)
    lines = np.concatenate([edges, sides])
    return _cut_off(lines[np.any(lines, axis=(1, 2))], bounds), np.linalg.inv(matrix)


@eqx.filter_jit
def _curves(camera: Camera, scene: Scene) -> tuple[Array, Array, Array, Array]:
    """The film's matrix and bounds, edges (E, 2, 3) as homogeneous film points, and conics
    (S, 3, 3) of spheres; 0 off the contour."""
    film, mesh, spheres = film_map(camera), scene.mesh, scene.spheres
    edges, frames = jnp.zeros((0, 2, 3)), jnp.zeros((0, 3, 3))
    if mesh is not None and mesh.edge_faces.shape[0]:
        on = contour_weights(mesh, camera.e) != 0
        edges = jnp.where(on[:, None, None], film(mesh.vertices)[mesh.edge_vertices], 0)
    if spheres is not None:
        outside = norm(spheres.centers - camera.e[None]) > spheres.radii
        frames = sphere_frames(film, spheres).reshape(-1, 3, 3)
        frames = jnp.where(outside[:, None, None], frames, 0)
    return film.matrix, film.bounds, edges, frames


def _cut_off(lines: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return the parts of lines within bounds (left, right, low, high), in front of the eye."""
    xy, z = lines[..., :2], lines[..., 2:]
    inside = np.concatenate([xy - bounds[::2] * z, bounds[1::2] * z - xy], axis=-1)
    first, last = inside[:, 0], inside[:, 1]
    cut = first / np.where(first == last, 1, first - last)
    begin = np.max(np.where(first < 0, cut, 0), axis=1)
    end = np.min(np.where(last < 0, cut, 1), axis=1)
    some = (begin < end) & ~np.any((first < 0) & (last < 0), axis=1)
    start, way = lines[some, 0], lines[some, 1] - lines[some, 0]
    return np.stack([start + t[some, None] * way for t in (begin, end)], axis=1)


def _parts(ends: Float[np.ndarray, "n 2 2"], step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the parts, at most a step (px) long, of lines: the number of the line, and the shares
    of it (0 to 1) at its beginning, middle and end (3, n)."""
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    counts = np.clip(np.ceil(length / step), 1, MOST_PARTS).astype(int)
    line = np.repeat(np.arange(len(counts)), counts)
    rank = np.arange(len(line)) - (np.cumsum(counts) - counts)[line]
    return line, (rank + np.array([[0], [0.5], [1]])) / counts[line]
