"""Rows of a view by its joints: how coverage follows the vertices that these move.

A view's program says how its pixels follow its own camera; what a joint moves is a part of the
scene, whose motion the image of exact coverage is differentiated by.
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._mask.pyramid import Level
from .._scene.scene import Mesh, Scene, with_vertices
from .._silhouette.silhouette import on_film
from .._solver.looks import View, film_of
from .views import Eye, State


def with_joints(
    eye: Eye, state: State, view: View, moves: np.ndarray, joints: list[str]
) -> tuple[View, np.ndarray]:
    """A view and its moves (n, k) by the unknowns, with the offsets of joints among these."""
    from scipy.linalg import block_diag

    pixels, jacobian = view.pixels, view.jacobian
    row, column = np.divmod(pixels.cell, int(view.level.W) + 2)
    changes = np.pad(_changes_by_joints(eye, state, view.level, joints), ((0, 0), (0, 0), (1, 1)))
    by_joint = (pixels.weight**0.5 * changes[:, row, column]).T

    # (In units in which a joint shows as much as a move of the camera does.)
    size = np.linalg.norm(by_joint, axis=0)
    usual = float(np.mean(np.linalg.norm(jacobian, axis=0)))
    scale = np.where(size > 1e-9 * usual, usual / np.maximum(size, 1e-300), 1.0)
    together = np.concatenate([jacobian, by_joint * scale], axis=1)
    n = together.shape[1]
    table = np.column_stack([together, pixels.residual])
    r: Any = np.linalg.qr(np.concatenate([table, np.zeros((n, n + 1))]), mode="r")
    if not np.all(np.isfinite(np.asarray(view.triangle))):
        r = np.full(r.shape, np.nan)
    whole = replace(
        view,
        triangle=r[:n, :n],
        along=r[:n, n],
        by_joints=together,
        known=np.pad(view.known, ((0, 0), (0, len(joints)))),
    )
    return whole, np.asarray(block_diag(moves, np.diag(1 / scale)))


def _changes_by_joints(eye: Eye, state: State, level: Level, joints: list[str]) -> np.ndarray:
    """How the coverage of a level's pixels follows joints (J, H, W), row 0 at the bottom."""
    solver, camera = eye.standpoint(state)
    mesh, posture = solver.subject.scene.mesh, eye.shot.posture
    assert mesh is not None
    assert posture is not None
    which = [posture.joints.index(name) for name in joints]
    turn, shift, growth = np.split(posture.twists(eye.offsets(state))[which], (3, 6), axis=2)
    body, vertices = posture.body, np.asarray(mesh.vertices)
    velocity = np.zeros((len(joints), *vertices.shape), vertices.dtype)
    # (The mesh is filled up.)
    at = vertices[: len(body)]
    velocity[:, : len(body)] = np.cross(turn[:, body], at) + shift[:, body] + growth[:, body] * at
    # (Sides that are powers of two, the same on all levels: there are few programs.)
    finest = solver.levels[-1]
    W, H = (1 << (int(side) - 1).bit_length() for side in (finest.W, finest.H))
    return np.asarray(_changes(camera, level, (W, H), mesh, velocity), float)[:, ::-1]


@eqx.filter_jit
def _changes(
    camera: Camera, level: Level, size: tuple[int, int], mesh: Mesh, velocities: Any
) -> Float[Array, "J H W"]:
    """How the coverage of a film of a size, which holds a level's window, follows vertices."""
    film = film_of(camera, level, size)
    image = lambda vertices: on_film(film, Scene(with_vertices(mesh, vertices)))
    push = lambda velocity: jax.jvp(image, (mesh.vertices,), (velocity,))[1]
    return jax.lax.map(push, velocities)
