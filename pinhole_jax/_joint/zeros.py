"""Rows of a view by its joints: a body that moves is a camera that moves the other way, where the
outline is that body's.

So what a view's program says of its own camera, pixel by pixel, says all about the joints, and no
other program is compiled. Pixels in which several bodies end count by the lengths of these ends.
"""

from typing import Any

import numpy as np

from .._camera.camera import Camera
from .._camera.poses import adjoint, inverse, pose_of
from .._camera.rays import project
from .._mask.pyramid import Level
from .._outline.stretches import Coverage
from .._silhouette.visible import edge_weights, ranks
from .._solver.looks import View
from .._solver.subject import on_film_plane
from .views import Eye, State

#: Contours are sampled this many times a pixel; what lies beside one is looked up so far away (px).
SAMPLES, BESIDE = 2.0, 1.0
#: Samples of one edge at most.
MOST = 2000


def with_joints(
    eye: Eye, state: State, view: View, moves: np.ndarray, joints: list[str]
) -> tuple[View, np.ndarray]:
    """A view and its moves (n, k) by the unknowns, with the offsets of joints among these."""
    from scipy.linalg import block_diag

    posture = eye.shot.posture
    assert posture is not None
    camera, pixels = eye.canonical(state), view.pixels
    share = _shares(eye, state, camera, view)
    twists = posture.twists(eye.offsets(state))[[posture.joints.index(name) for name in joints]]
    # (What grows looks as if it moved on, as seen from the eye.)
    grows, twists = twists[..., 6:], twists[..., :6]
    twists[..., 3:] += grows * np.asarray(camera.e, float)

    # How each touched pixel follows a twist of the whole scene, and of the body in it.
    jacobian = view.jacobian
    used = np.flatnonzero(pixels.weight > 0)
    of_scene = -jacobian[used] @ eye.by_twist(state, view) @ adjoint(inverse(pose_of(camera)))
    by_joint = np.zeros((len(jacobian), len(joints)))
    by_joint[used] = np.sum((of_scene @ twists.transpose(0, 2, 1)) * share[used], axis=-1).T

    # (In units in which a joint shows as much as a move of the camera does.)
    size = np.linalg.norm(by_joint, axis=0)
    usual = float(np.mean(np.linalg.norm(jacobian, axis=0)))
    scale = np.where(size > 1e-9 * usual, usual / np.maximum(size, 1e-300), 1.0)
    together = np.concatenate([jacobian, by_joint * scale], axis=1)
    n = together.shape[1]
    table = np.column_stack([together[used], pixels.residual[used]])
    r: Any = np.linalg.qr(np.concatenate([table, np.zeros((n, n + 1))]), mode="r")
    if not np.all(np.isfinite(np.asarray(view.triangle))):
        r = np.full(r.shape, np.nan)
    whole = view._replace(
        triangle=r[:n, :n],
        along=r[:n, n],
        by_joints=together,
        known=np.pad(view.known, ((0, 0), (0, len(joints)))),
    )
    return whole, np.asarray(block_diag(moves, np.diag(1 / scale)))


def _shares(eye: Eye, state: State, camera: Camera, view: View) -> np.ndarray:
    """Each body's share of the outline in each touched pixel (P, B)."""
    mesh, posture = eye.standpoint(state).solver.subject.given.mesh, eye.shot.posture
    assert mesh is not None
    assert posture is not None
    bodies = int(posture.body[-1]) + 1
    weights = np.asarray(edge_weights(mesh, camera.e))
    edges = np.asarray(mesh.edge_vertices)[weights != 0]
    ends = np.asarray(mesh.vertices, float)[edges]
    film = np.array([_in_pixels(camera, view.level, x) for x in (ends[:, 0], ends[:, 1])])
    ahead = np.all(np.isfinite(film), axis=(0, 2))
    start, along = film[0, ahead], film[1, ahead] - film[0, ahead]
    length, body = np.linalg.norm(along, axis=1), posture.body[edges[ahead, 0]]
    number = np.clip(np.ceil(SAMPLES * length), 1, MOST).astype(int)
    edge, rank = ranks(number)
    points = start[edge] + ((rank + 0.5) / number[edge])[:, None] * along[edge]
    # (Cover is on the left of a line of positive weight.)
    right = np.column_stack([along[:, 1], -along[:, 0]]) / np.maximum(length, 1e-12)[:, None]
    outside = points + BESIDE * (np.sign(weights[weights != 0][ahead])[:, None] * right)[edge]

    # What lies within the object, or behind it, is no outline.
    row, column, inside = _places(view.level, points)
    cell, cells = row * (int(view.level.W) + 2) + column + 1, view.pixels.cell
    slot = np.minimum(np.searchsorted(cells, cell), len(cells) - 1)
    found = inside & (cells[slot] == cell)
    row, column, inside = _places(view.level, outside)
    hidden = np.where(inside, Coverage.from_view(view).lookup(row, column), 0.0)
    weight = (length / number)[edge] * (1 - hidden)
    result = np.zeros((len(cells), bodies))
    np.add.at(result, (slot[found], body[edge][found]), weight[found])
    total = result.sum(axis=1, keepdims=True)
    return result / np.where(total > 0, total, 1.0)


def _in_pixels(camera: Camera, level: Level, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) on a level's window (n, 2), NaN behind the eye."""
    ahead = on_film_plane(camera, points)[:, 2:] > 0
    film = np.where(ahead, np.asarray(project(camera, points), float), np.nan)
    return film * float(level.scale) - np.asarray(level.origin, float)


def _places(level: Level, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (from the bottom) and columns of the pixels that points lie in, and whether these are
    pixels of the window; 0 and 0 beside it."""
    column, row = np.floor(points).astype(int).T
    inside = (column >= 0) & (column < level.W) & (row >= 0) & (row < level.H)
    return np.where(inside, row, 0), np.where(inside, column, 0), np.asarray(inside)
