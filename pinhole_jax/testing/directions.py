"""Directions to move a camera and a scene in, one at a time, and their steps."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from .._camera.camera import Camera
from .._camera.rays import project, rays_through
from .._scene.scene import Scene, ball_about, bounding_box
from .differences import Scales

Point = tuple[Camera, Scene]


class Probe(NamedTuple):
    """A direction of the numbers (n,) of `floats`, 0 in all arrays but one.

    `step` is a power of two, in that array's units: the rounding of x + step is then the least.
    `least` is the least slope along it that is no rounding.
    """

    name: str
    direction: Float[np.ndarray, "n"]
    step: float
    least: float


def floats(point: Any) -> list[Any]:
    """Return the float arrays of a camera, a scene, or both."""
    return jax.tree.leaves(eqx.filter(point, eqx.is_inexact_array))


def camera_and_scene(point: Point, scales: Scales, directions: int, seed: int) -> Iterator[Probe]:
    """Yield each of the camera's parameters, then random directions of the scene's arrays.

    Steps move the picture by some `scales.step_px` at most; they depend on camera and scene alone.
    A vertex moves independently of its neighbours. If differences are coarse it moves smoothly with
    them: over a long step the outline would jump from vertex to vertex.
    """
    random, motion = np.random.default_rng(seed), _motion(*point)
    leaves, _ = jax.tree.flatten_with_path(eqx.filter(point, eqx.is_inexact_array))
    slopes, ends = jax.tree.leaves(motion), np.cumsum([leaf.size for _, leaf in leaves])
    for number, ((part, *_, key), leaf) in enumerate(leaves):
        if not leaf.size:
            continue
        # (What moves nothing is taken to turn the picture round; vertices move as the eye does.)
        px = np.max(np.abs(motion.e if part.idx else slopes[number])) or point[0].W / np.max(leaf)
        step = float(2.0 ** np.round(np.log2(scales.step_px / px)))
        names = [f"{key.name}.{axis}" for axis in "xyz"[: leaf.size]] if leaf.ndim else [key.name]
        values = np.eye(leaf.size)
        if part.idx:
            smooth = key.name == "vertices" and not scales.exact
            draw = _waves if smooth else lambda leaf, random: random.uniform(-1, 1, leaf.shape)
            names = [f"{key.name} #{k + 1}" for k in range(directions)]
            values = [draw(np.asarray(leaf), random) for _ in names]
        for name, value in zip(names, values, strict=True):
            direction = np.zeros(ends[-1], point[0].e.dtype)
            direction[ends[number] - leaf.size : ends[number]] = np.ravel(value)
            yield Probe(name, direction, step, scales.least * scales.step_px / step)


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
    if not any(leaf.size for leaf in floats(scene)):
        return float(np.linalg.norm(np.asarray(camera.p - camera.e)))
    center, radius = ball_about(np.asarray(bounding_box(scene)))
    return max(float(np.linalg.norm(center - np.asarray(camera.e))), float(radius))


def _waves(
    vertices: Float[np.ndarray, "V 3"], random: np.random.Generator
) -> Float[np.ndarray, "V 3"]:
    """Return a smooth displacement of each vertex, between -1 and 1: a random wave."""
    middle, extent = vertices.mean(axis=0), np.ptp(vertices, axis=0).max()
    wave = random.normal(size=(3, 3)) * np.pi / (extent or 1)
    return np.sin((vertices - middle) @ wave + random.uniform(0, 2 * np.pi, 3))
