"""Turns that bring most of a mesh's faces to where others were: its facets look alike from there.

An exact mask of a ball of facets tells its turn, by the facets alone. But if the ball has as many
turns that change nothing, and what sticks out of it or is dented is out of the outline, then the
mask fits as many cameras. A walk along what is nearly free does not find these: they are no
neighbours. The mesh tells.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .._numerics.memo import memoised

#: Finer meshes have facets that no mask shows: they are not looked at.
MOST_FACES = 30_000
#: Corners, and lengths of edges, closer than this share of the mesh's size are alike.
ALIKE = 1e-4
#: A turn counts if this share of the area lands where faces were (a dent is missed by two), at this
#: many sampled places; in the first few, half the share is enough.
MOST, LOOKED_AT, FIRST = 0.4, 200, 20
#: A few faces of each shape are turned to all others of it: this many shapes, this many turns at
#: most.
SHAPES, TURNS = 8, 2000
#: Turns closer than this (its trace's distance) are one.
ONE = 1e-4


class Turn(NamedTuple):
    """x -> rotation x + shift."""

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]


def turns_of_a_mesh(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> list[Turn]:
    """Return the turns (but for none at all) that bring most of a mesh's faces to other faces."""
    return memoised(_turns, vertices, faces) if 2 <= len(faces) <= MOST_FACES else []


def _turns(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> list[Turn]:
    from scipy.spatial import KDTree

    corners = np.asarray(vertices, float)[faces]
    size = float(np.max(np.linalg.norm(corners - corners.mean(axis=(0, 1)), axis=-1)))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    usable = area > (ALIKE * size) ** 2
    corners, area = corners[usable], area[usable]
    if len(corners) < 2:
        return []
    middles = corners.mean(axis=1)
    tree = KDTree(middles)
    share = (np.arange(LOOKED_AT) + 0.5) / LOOKED_AT
    looked_at = middles[np.searchsorted(np.cumsum(area), share * np.sum(area))]
    few = looked_at[:: LOOKED_AT // FIRST]

    def alike(places: np.ndarray, turn: Turn) -> float:
        off, _ = tree.query(
            places @ turn.rotation.T + turn.shift, distance_upper_bound=ALIKE * size
        )
        return float(np.mean(np.isfinite(off)))

    found: list[Turn] = []
    known, tried = np.eye(3)[None], 0
    for first, others in _shapes(corners, area, size):
        for begin in range(3):
            frames = _frames(np.roll(corners[others], -begin, axis=1))
            rotations = frames @ _frames(corners[first][None])[0].T
            shifts = middles[others] - rotations @ middles[first]
            tried += len(others)
            for turn in map(Turn, rotations, shifts):
                if np.any(np.linalg.norm(known - turn.rotation, axis=(1, 2)) < ONE):
                    continue
                if alike(few, turn) >= MOST / 2 and alike(looked_at, turn) >= MOST:
                    found.append(turn)
                    known = np.concatenate([known, turn.rotation[None]])
        if tried > TURNS:
            break
    return found


def _shapes(
    corners: Float[np.ndarray, "F 3 3"], area: Float[np.ndarray, "F"], size: float
) -> list[tuple[int, Int[np.ndarray, "k"]]]:
    """Return a face of each common shape, and all faces that have it: rare shapes first."""
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    key = np.sort(np.round(sides / (ALIKE * size)), axis=1)
    _, which, number = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    total = np.bincount(which, weights=area)
    order = np.argsort(-total)[:SHAPES]
    order = order[np.argsort(number[order], kind="stable")]
    members = [np.flatnonzero(which == k) for k in order if number[k] > 1]
    return [(int(m[0]), m[:TURNS]) for m in members]


def _frames(corners: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k 3 3"]:
    """Return axes of triangles in their columns: along the first side, in the plane, normal."""
    along = corners[:, 1] - corners[:, 0]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.cross(along, corners[:, 2] - corners[:, 0])
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([along, np.cross(normal, along), normal], axis=-1)
