"""Directions to move a camera and a scene in, one at a time, and their steps."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array

from .._camera.camera import Camera, focal_px
from .._scene.scene import Scene, bounding_sphere
from .differences import Scales

Point = tuple[Camera, Scene]


class Probe(NamedTuple):
    """A direction `value` in the leaf that `where` picks from (camera, scene).

    `step` is a power of two, in the leaf's units: the rounding of x + step is then the least.
    """

    name: str
    where: Callable[[Any], Array]
    value: np.ndarray
    step: float


def camera_and_scene(point: Point, scales: Scales, directions: int, seed: int) -> Iterator[Probe]:
    """Yield each of the camera's parameters, then random directions of the scene's arrays.

    Steps move the picture by some `scales.step_px` at most; they depend on camera and scene alone.
    A vertex moves independently of its neighbours. If differences are coarse it moves smoothly with
    them: over a long step the outline would jump from vertex to vertex.
    """
    for name, where, scale in _camera_leaves(*point):
        leaf = np.asarray(where(point))
        for index in np.ndindex(leaf.shape):
            unit = np.zeros_like(leaf)
            unit[index] = 1
            axis = "." + "xyz"[index[0]] if index else ""
            yield Probe(name + axis, where, unit, _power_of_two(scales.step_px * scale))
    random = np.random.default_rng(seed)
    step = _power_of_two(scales.step_px * _distance(*point) / float(focal_px(point[0])[1]))
    for name, where in _scene_leaves(point[1]):
        leaf = np.asarray(where(point))
        for k in range(directions):
            value = random.uniform(-1, 1, leaf.shape)
            if name == "vertices" and not scales.exact:
                value = _waves(leaf, random)
            yield Probe(f"{name} #{k + 1}", where, value.astype(leaf.dtype), step)


def _waves(vertices: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return a smooth displacement of each vertex, between -1 and 1: a random wave."""
    middle, extent = vertices.mean(axis=0), np.ptp(vertices, axis=0).max()
    wave = random.normal(size=(3, 3)) * np.pi / (extent or 1)
    return np.sin((vertices - middle) @ wave + random.uniform(0, 2 * np.pi, 3))


def _camera_leaves(camera: Camera, scene: Scene) -> list[tuple[str, Callable, float]]:
    """Return each parameter's name, leaf, and the change that moves the picture by a pixel."""
    half, fy = max(camera.W, camera.H) / 2, float(focal_px(camera)[1])
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    view, phi, d = float(np.linalg.norm(p - e)), float(camera.phi), float(camera.d)
    upright = float(np.linalg.norm(np.cross(p - e, u))) / view
    leaves = [
        ("e", lambda x: x[0].e, min(view, _distance(camera, scene)) / fy),
        ("p", lambda x: x[0].p, view / fy),
        ("u", lambda x: x[0].u, upright / half),
        ("phi", lambda x: x[0].phi, np.sin(phi) / half),
        ("d", lambda x: x[0].d, d / half),
    ]
    if camera.lens is not None:
        aspect = float(camera.lens.aspect)
        leaves.append(("principal_point", lambda x: x[0].lens.principal_point, 1.0))
        leaves.append(("aspect", lambda x: x[0].lens.aspect, aspect / half))
        powers = {} if camera.lens.distortion is None else camera.lens.distortion.powers
        for name, power in powers.items():
            coefficient = lambda x, name=name: getattr(x[0].lens.distortion, name)
            leaves.append((name, coefficient, (fy / half) ** power / fy))
    return leaves


def _scene_leaves(scene: Scene) -> list[tuple[str, Callable]]:
    leaves = []
    if scene.mesh is not None and scene.mesh.vertices.shape[0]:
        leaves.append(("vertices", lambda x: x[1].mesh.vertices))
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        leaves.append(("centers", lambda x: x[1].spheres.centers))
        leaves.append(("radii", lambda x: x[1].spheres.radii))
    return leaves


def _distance(camera: Camera, scene: Scene) -> float:
    """Return the distance of the scene's middle from the eye or, from within, its radius."""
    if not _scene_leaves(scene):
        return float(np.linalg.norm(np.asarray(camera.p - camera.e)))
    parts = Scene(
        scene.mesh if scene.mesh is not None and scene.mesh.vertices.shape[0] else None,
        scene.spheres if scene.spheres is not None and scene.spheres.radii.shape[0] else None,
    )
    center, radius = bounding_sphere(parts)
    return max(float(np.linalg.norm(np.asarray(center - camera.e))), float(radius))


def _power_of_two(x: float) -> float:
    return float(2.0 ** np.round(np.log2(x)))
