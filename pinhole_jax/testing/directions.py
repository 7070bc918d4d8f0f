"""Directions to move a camera and a scene in, one at a time, and their steps."""

from collections.abc import Callable, Iterator
from operator import attrgetter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._camera.rays import project, rays_through
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
    random, motion = np.random.default_rng(seed), (_motion(*point), None)
    for number, name, where in _float_arrays(point):
        leaf, in_scene = np.asarray(where(point)), number == 1
        # (What moves nothing is taken to turn the picture round; vertices move as the eye does.)
        px = np.max(np.abs(motion[0].e if in_scene else where(motion))) or point[0].W / np.max(leaf)
        step = float(2.0 ** np.round(np.log2(scales.step_px / px)))
        for k in range(directions * in_scene):
            value = random.uniform(-1, 1, leaf.shape)
            if name == "vertices" and not scales.exact:
                value = _waves(leaf, random)
            yield Probe(f"{name} #{k + 1}", where, value.astype(leaf.dtype), step)
        for index in () if in_scene else np.ndindex(leaf.shape):
            unit = np.zeros_like(leaf)
            unit[index] = 1
            yield Probe(".".join([name, *("xyz"[k] for k in index)]), where, unit, step)


def _float_arrays(point: Point) -> Iterator[tuple[int, str, Callable]]:
    """Yield the arrays of a camera (0) and a scene (1): which of both, name, and how to pick it."""
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(point, eqx.is_inexact_array))
    for (part, *path), leaf in leaves:
        names = [key.name for key in path]
        pick = attrgetter(".".join(names))
        if leaf.size:
            yield part.idx, names[-1], lambda x, number=part.idx, pick=pick: pick(x[number])


def _motion(camera: Camera, scene: Scene) -> Camera:
    """Return the derivative by the camera of nine points' places on the film (px): they lie at the
    scene's distance, behind the film's corners, sides and middle."""
    shares = np.indices((3, 3)).reshape(2, -1).T / 2
    places = (shares * [camera.W, camera.H]).astype(camera.e.dtype)
    rays = np.asarray(rays_through(camera, places).direction)
    far = np.asarray(_distance(camera, scene), rays.dtype)
    return jax.jacfwd(project)(camera, np.asarray(camera.e) + far * rays)


def _distance(camera: Camera, scene: Scene) -> float:
    """Return the distance of the scene's middle from the eye or, from within, its radius."""
    full = lambda part, points: None if part is None or not len(points(part)) else part
    parts = Scene(
        full(scene.mesh, lambda mesh: mesh.vertices),
        full(scene.spheres, lambda spheres: spheres.radii),
    )
    if parts.mesh is None and parts.spheres is None:
        return float(np.linalg.norm(np.asarray(camera.p - camera.e)))
    center, radius = bounding_sphere(parts)
    return max(float(np.linalg.norm(np.asarray(center - camera.e))), float(radius))


def _waves(
    vertices: Float[np.ndarray, "V 3"], random: np.random.Generator
) -> Float[np.ndarray, "V 3"]:
    """Return a smooth displacement of each vertex, between -1 and 1: a random wave."""
    middle, extent = vertices.mean(axis=0), np.ptp(vertices, axis=0).max()
    wave = random.normal(size=(3, 3)) * np.pi / (extent or 1)
    return np.sin((vertices - middle) @ wave + random.uniform(0, 2 * np.pi, 3))
