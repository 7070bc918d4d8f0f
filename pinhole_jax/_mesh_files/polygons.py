"""Polygons of any number of corners, in any plane of space, cut into triangles.

A fan from the first corner is right only where that corner sees all others. A polygon is therefore
seen along its Newell normal, the sum of its fan's area vectors, and cut there: as a fan where that
is right, else by manifold3d. Its triangles meet edge to edge,
also at corners in line, so that a closed mesh stays closed. A triangle runs the way its polygon
runs.

The triangles' areas have to add up to the polygon's own, up to the rounding of 32 bits. Where they
do not, the sides cross.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

#: Cutting n corners takes up to n^2 steps, a nanosecond each: seconds for all faces of a file.
MOST_STEPS = 10**10
#: A small file can stand for more corners than these: instances of instances.
MOST_CORNERS = 1 << 26
#: Areas agree where they differ by less than this, the polygon being of size 1.
EXACT = 1e-9


class Polygons(NamedTuple):
    """Faces of a file: `points` (V, 3); the corners of all faces in a row, as indices of points;
    and how many of them each face has.
    """

    points: Float[np.ndarray, "V 3"]
    corners: Int[np.ndarray, "K"]
    counts: Int[np.ndarray, "F"]


NOTHING = Polygons(np.empty((0, 3)), np.empty(0, int), np.empty(0, int))


def check_corners(polygons: Polygons) -> Polygons:
    """Return the polygons, or raise ValueError for corners that are no points, or not finite."""
    points, corners, _ = polygons
    if corners.size and not 0 <= np.min(corners) <= np.max(corners) < len(points):
        got = f"{np.min(corners)} to {np.max(corners)}"
        raise ValueError(f"expected faces with vertices 0 to {len(points) - 1}, got {got}")
    if not (np.all(np.isfinite(points)) or np.all(np.isfinite(points[corners]))):
        raise ValueError("expected finite vertices, got NaN or infinity")
    return polygons


def merge(parts: Iterable[tuple[Polygons, np.ndarray]]) -> Polygons:
    """Return parts as one, each moved to its place (4, 4); a mirror turns its polygons round.

    Raises ValueError for corners that a part does not have, and for more than `MOST_CORNERS`.
    """
    moved, start, total = [NOTHING], 0, 0
    for part, place in parts:
        points, corners, counts = check_corners(part)
        total += len(points) + len(corners)
        if total > MOST_CORNERS:
            raise ValueError(f"expected at most {MOST_CORNERS} corners in all, got more")
        if not np.array_equal(place, np.eye(4)):
            points = points @ place[:3, :3].T + place[:3, 3]
        step = -1 if np.linalg.det(place[:3, :3]) < 0 else 1
        moved.append(Polygons(points, start + corners[::step], counts[::step]))
        start += len(points)
    return Polygons(*map(np.concatenate, zip(*moved, strict=True)))


def triangulate(polygons: Polygons) -> Int[np.ndarray, "T 3"]:
    """Return the polygons' triangles in the order of the polygons, as indices of points.

    Faces of fewer than three corners cover nothing and are left out, as are triangles that name a
    corner twice. All corners have to name points.

    Raises ValueError for a polygon whose sides cross, and for more corners than can be cut in
    seconds.
    """
    points, corners, counts = polygons
    if np.all(counts == 3):
        return _without_joints(corners.reshape(-1, 3))
    starts, numbers = np.cumsum(counts) - counts, np.flatnonzero(counts >= 3)
    starts, sides = starts[numbers], counts[numbers] - 2
    begin = np.cumsum(sides) - sides
    face = np.repeat(np.arange(len(sides)), sides)
    second = np.arange(len(face)) + (starts + 1 - begin)[face]
    triangles = corners[np.stack([starts[face], second, second + 1], axis=-1)]
    wrong = np.flatnonzero(sides > 1)
    if len(wrong):
        wrong = wrong[~_fans_are_right(points[triangles], begin, face)[wrong]]
    for k, steps in zip(wrong, np.cumsum((sides[wrong] + 2) ** 2), strict=True):
        count, number = sides[k] + 2, int(numbers[k]) + 1
        if steps > MOST_STEPS:
            raise ValueError(
                f"face {number}: {count} corners, not all seen from the first; that many take more"
                " than seconds to cut"
            )
        own = corners[starts[k] : starts[k] + count]
        triangles[begin[k] : begin[k] + sides[k]] = own[_cut(points[own], number)]
    return _without_joints(triangles)


def _without_joints(triangles: np.ndarray) -> np.ndarray:
    """Return the triangles whose corners differ: others only join strips."""
    return triangles[np.all(triangles != np.roll(triangles, 1, axis=1), axis=1)]


def cut_strips(corners: Int[np.ndarray, "K"], counts: Int[np.ndarray, "S"]) -> np.ndarray:
    """Return the triangles (T, 3) of strips, which -1 ends as well."""
    from trimesh.util import triangle_strips_to_faces

    ends = np.union1d(np.cumsum(counts), np.flatnonzero(corners == -1))
    parts = (part[part != -1] for part in np.split(corners, ends))
    strips = [part for part in parts if len(part) >= 3]
    return triangle_strips_to_faces(strips) if strips else np.empty((0, 3), int)


def _fans_are_right(space: np.ndarray, begin: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Return True (F,) for fans that turn one way, at most once around: `space` (T, 3, 3) are their
    triangles, `face` (T,) says whose, and `begin` (F,) which is the first of each."""
    arms = space[:, 1:] - space[:, :1]
    size = np.maximum.reduceat(np.max(np.abs(arms), axis=(1, 2)), begin)
    arms /= np.where(size > 0, size, 1)[face, None, None]
    areas = np.cross(arms[:, 0], arms[:, 1])
    normal = np.add.reduceat(areas, begin)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    cross = np.sum(areas * (normal / np.where(length > 0, length, 1))[face], axis=-1)
    dot = np.sum(arms[:, 0] * arms[:, 1], axis=-1)
    # Corners in line as seen from the first are no harm; a turn by half a circle is no fan's.
    ahead = (cross > 1e-15) | ((np.abs(cross) <= 1e-15) & (dot > 0))
    around = np.add.reduceat(np.arctan2(cross, dot), begin)
    return np.logical_and.reduceat(ahead, begin) & (around <= 2 * np.pi + 1e-9)


def _cut(space: np.ndarray, number: int) -> np.ndarray:
    """Return the triangles (n - 2, 3) of one polygon (n, 3) as corners 0 to n - 1."""
    import manifold3d

    arms = space - space[0]
    arms /= np.max(np.abs(arms)) or 1
    areas = np.cross(arms[1:-1], arms[2:])
    normal = np.sum(areas, axis=0)
    axis = np.argmax(np.abs(normal))
    flat = arms[:, [axis - 2, axis - 1] if normal[axis] > 0 else [axis - 1, axis - 2]]
    triangles = np.asarray(manifold3d.triangulate([flat]), int)
    cut = flat[triangles]
    excess = np.sum(np.abs(np.linalg.det(cut[:, 1:] - cut[:, :1]))) - abs(normal[axis])
    sides = np.sum(np.linalg.norm(flat - np.roll(flat, 1, axis=0), axis=-1))
    far = 4 * np.max(np.abs(space)) / (np.max(np.abs(space - space[0])) or 1)
    lobes_cancel = np.any(areas) and abs(normal[axis]) <= 1e-12 * np.max(np.abs(areas))
    if lobes_cancel or abs(excess) > (EXACT + far * np.finfo(np.float32).eps) * sides:
        raise ValueError(f"face {number}: its sides cross, so that it has no inside")
    return triangles
