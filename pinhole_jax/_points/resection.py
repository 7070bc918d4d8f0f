"""A camera's pose from points, directly: no start, no iteration.

Cameras are canonical, and where points are seen is in film heights.

Source of poses of three points: R. Haralick et al., "Review and Analysis of Solutions of the Three
Point Perspective Pose Estimation Problem" (1994): Grunert's equations and his quartic, of 1841.
"""

import itertools
from collections.abc import Iterable, Iterator

import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial

from .._camera.camera import Camera
from .._camera.poses import inverse, pose_of
from .._camera.rays import rays_through

#: Three points are of a line where the sine of a corner of theirs is below this.
THIN = 1e-6
#: Distances that leave a squared side off by a larger share of the longest are none.
OFF = 0.1
#: The ends of the side opposite to each point; its squared length and its angle's cosine have the
#: point's number.
NEXT, LAST = [1, 2, 0], [2, 0, 1]
#: Points whose spread across a line is below this share of that along it are nearly of the line.
SLIM = 1e-3

Pose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]
Points = Float[np.ndarray, "N 3"]
SeenAt = Float[np.ndarray, "N 2"]


def resect(
    camera: Camera, points: Points, rays: Points, threes: Iterable[np.ndarray]
) -> list[Camera]:
    """The camera in all poses that see three of the points along their rays: the only pose, or
    up to four, of each of the `threes` of indices."""
    poses = (poses_of_three(points[three], rays[three]) for three in threes)
    return [_posed(camera, *pose) for some in poses for pose in some]


def poses_of_three(points: Float[np.ndarray, "3 3"], rays: Float[np.ndarray, "3 3"]) -> list[Pose]:
    """Rotations and translations that bring three points (rows) onto their rays (unit), in
    front of the eye: up to four, none of three points of a line.

    Where noise leaves no exact pose, two that nearly meet are replaced by what lies between them.
    """
    from scipy.spatial.transform import Rotation

    a, b = points[1:] - points[0]
    thin = np.linalg.norm(np.cross(a, b)) <= THIN * np.linalg.norm(a) * np.linalg.norm(b)
    if thin or not np.all(np.isfinite(rays)):
        return []
    sides = np.sum((points[NEXT] - points[LAST]) ** 2, axis=1)
    poses = []
    for depths in _depths(sides, np.sum(rays[NEXT] * rays[LAST], axis=1)):
        there = depths[:, None] * rays
        off = np.sum((there[NEXT] - there[LAST]) ** 2, axis=1) - sides
        if np.all(depths > 0) and np.max(np.abs(off)) < OFF * sides.max():
            middles = points.mean(axis=0), there.mean(axis=0)
            turn = Rotation.align_vectors(there - middles[1], points - middles[0])[0].as_matrix()
            poses.append((turn, middles[1] - turn @ middles[0]))
    return poses


def _depths(sides: np.ndarray, cosines: np.ndarray) -> Iterator[np.ndarray]:
    """Distances (3,) from the eye by the real parts of the roots of Grunert's quartic: the ratios
    of the third distance to the first."""
    (a, b, c), (x, y, z) = sides, cosines
    p = (a - c) / b
    # The second distance's ratio is `over / under`, by two sides; the third side is the quartic.
    over, under = Polynomial([1 + p, -2 * p * y, p - 1]), Polynomial([2 * z, -2 * x])
    rest = 1 - c / b * Polynomial([1, -2 * y, 1])
    roots = (over**2 - 2 * z * over * under + rest * under**2).roots().real
    for v in np.unique(roots[roots > 0]):
        first = b / max(1 + v * v - 2 * v * y, 1e-300)
        # The second point's distance, by the side between it and the first: one of two.
        half = np.sqrt(max(z * z - 1 + c / first, 0.0))
        for u in (z - half, z + half):
            yield np.sqrt(first) * np.array([1, u, v])


def triangles(points: Points, rays: Points, most: int) -> np.ndarray:
    """The indices (T, 3) of this many triangles at most, those that are largest in the world
    and where they are seen first."""
    threes = np.array([*itertools.combinations(range(len(points)), 3)], int).reshape(-1, 3)
    edges = [x[threes[:, 1:]] - x[threes[:, :1]] for x in (points, rays)]
    sizes = np.prod([np.linalg.det(x @ x.transpose(0, 2, 1)) for x in edges], axis=0)
    order = np.argsort(-np.round(np.log(np.maximum(sizes, 1e-300)), 9), kind="stable")
    return threes[order[:most]]


def turn(camera: Camera, points: Points, seen_at: SeenAt) -> Camera:
    """The camera turned about its eye so that it sees points where they are seen (Kabsch
    1976)."""
    from scipy.spatial.transform import Rotation

    eye = np.asarray(camera.e, float)
    rotation = Rotation.align_vectors(lines_of_sight(camera, seen_at), points - eye)[0].as_matrix()
    return _posed(camera, rotation, -rotation @ eye)


def shift(camera: Camera, points: Points, seen_at: SeenAt) -> Camera:
    """The camera shifted, its axes as they are, so that it sees points where they are seen:
    least squares of how far they are from their lines of sight."""
    rotation = inverse(pose_of(camera))[:3, :3]
    rays = lines_of_sight(camera, seen_at) @ rotation
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    eye = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, points))[0]
    return _posed(camera, rotation, -rotation @ eye)


def plane_of(points: Points) -> tuple[np.ndarray, np.ndarray] | None:
    """The middle and the normal of the plane that is nearest to points, None if these are nearly
    of a line."""
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
    return (middle, axes[-1]) if spread[1] > SLIM * spread[0] else None


def lines_of_sight(camera: Camera, seen_at: np.ndarray) -> np.ndarray:
    """Unit vectors along the lines of sight, right, down, forward."""
    rays = rays_through(camera, seen_at.astype(camera.e.dtype)).direction
    return np.asarray(rays, float) @ pose_of(camera)[:3, :3]


def _posed(camera: Camera, rotation: np.ndarray, translation: np.ndarray) -> Camera:
    """The camera with `rotation @ x + translation` right, down and forward of the eye."""
    right, down, forward = rotation
    return camera.with_pose(-rotation.T @ translation, np.stack([right, -down, forward]))
