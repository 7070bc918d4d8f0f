"""What a fit looks at: a scene as its programs take it, and what its shape says of views."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .._mask.target import Window
from .._scene.alike import Alike
from .._scene.coarse import seen_from_afar
from .._scene.scene import Ball, Mesh, Scene, astype, ball_about, bounding_box, padded


@dataclass(frozen=True, eq=False)
class Subject:
    """A scene that masks show; solvers of many masks may have one in common.

    - `given`: the scene as the user gave it; `scene`: filled up, of the fit's float type.
    - `ball`: a ball about it; moves of a camera are taken about its centre, `pivot` in that type.
    - `corners`: those of a box about it (8, 3).
    """

    given: Scene
    scene: Scene
    ball: Ball
    pivot: Ball
    corners: np.ndarray

    @classmethod
    def from_scene(cls, scene: Scene, dtype: Any) -> "Subject":
        """Return a scene as a fit of a float type looks at it."""
        box = _box_about(scene)
        ball = ball_about(box)
        pivot = Ball(*(jnp.asarray(np.asarray(x, dtype), dtype) for x in ball))
        corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(8, 3)
        return cls(scene, padded(astype(scene, np.dtype(dtype))), ball, pivot, corners)

    def elsewhere(self, scene: Scene) -> "Subject":
        """Return the subject with its vertices elsewhere; moves are taken as before."""
        return replace(self.from_scene(scene, self.dtype), ball=self.ball, pivot=self.pivot)

    @property
    def dtype(self) -> np.dtype:
        """Return the float type that a fit works in."""
        return np.dtype(self.pivot.centre.dtype)

    @cached_property
    def alike(self) -> Alike:
        """What of the mesh looks alike."""
        mesh, centre = self.given.mesh, np.asarray(self.ball.centre, float)
        if mesh is None:
            return Alike(np.zeros((0, 3)), np.zeros((0, 3), int), centre)
        return Alike(*_with_faces(mesh), centre)

    @cached_property
    def from_afar(self) -> Scene:
        """Return the scene as small pictures of it show it (`_mask.search`)."""
        mesh = self.given.mesh
        return Scene(None if mesh is None else seen_from_afar(mesh), self.given.spheres)

    def within(self, window: Window, camera: Camera, W: int, H: int) -> bool:
        """True if a camera (canonical) shows nothing of the scene outside a window of the
        film, as far as a box about the scene tells."""
        if window == (0, 0, W, H):
            return True
        lens = camera.lens
        assert lens is not None
        if lens.distortion is not None:
            return False
        seen = (self.corners - np.asarray(camera.e, float)) @ axes_of(camera).T
        focal, depth = 0.5 / np.tan(float(camera.phi) / 2), seen[:, 2:]
        at = focal * np.array([float(lens.aspect), 1]) * seen[:, :2] / depth
        shown = H * (at + np.asarray(lens.principal_point, float))
        return bool(np.all(depth > 0) and window.holds(shown, W, H))


def _with_faces(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The vertices that faces have, and the faces by these."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    return (vertices, faces) if np.all(used) else (vertices[used], (np.cumsum(used) - 1)[faces])


def _box_about(scene: Scene) -> np.ndarray:
    """The least and largest coordinates (2, 3) of a scene, but for vertices far beyond its faces:
    one that no face has may be anywhere."""
    whole = np.asarray(bounding_box(scene), float)
    if scene.mesh is None:
        return whole
    vertices, _ = _with_faces(scene.mesh)
    if len(vertices) == len(scene.mesh.vertices):
        return whole
    shown = eqx.tree_at(lambda s: s.mesh.vertices, scene, vertices)
    box = np.asarray(bounding_box(shown), float)
    return box if np.max(np.ptp(whole, axis=0)) > 2 * np.max(np.ptp(box, axis=0)) else whole


def reach_of(scene: Scene) -> float:
    """About how large a scene is: a power of two, by which nothing is rounded, whose square is a
    number in float32, too."""
    radius = float(ball_about(_box_about(scene)).radius)
    return 2.0 ** round(np.log2(np.clip(radius, 1e-12, 1e12)))
