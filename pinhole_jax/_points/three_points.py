"""All poses from which three points are seen along three lines of sight: P3P.

Source: R. Haralick et al., "Review and Analysis of Solutions of the Three Point Perspective Pose
Estimation Problem" (1994): Grunert's equations and his quartic, of 1841.
"""

import itertools

import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial

#: Newton steps on the three distances.
STEPS = 12
#: Three points are of a line where the sine of a corner of theirs is below this.
THIN = 1e-6
#: Distances that differ by a smaller share are the same, and ones that leave a side off by a larger
#: share of the longest are none.
SAME, OFF = 1e-6, 0.1
#: The ends of the side opposite to each point; its squared length and its angle's cosine have the
#: point's number.
NEXT, LAST = [1, 2, 0], [2, 0, 1]

Pose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]


def poses_of_three(points: Float[np.ndarray, "3 3"], rays: Float[np.ndarray, "3 3"]) -> list[Pose]:
    """Rotations and translations that bring three points (rows) onto their rays (unit), in
    front of the eye: up to four, none of three points of a line.

    Where noise leaves no exact pose, two that nearly meet are replaced by what lies between them.
    """
    a, b = points[1:] - points[0]
    if not np.linalg.norm(np.cross(a, b)) > THIN * np.linalg.norm(a) * np.linalg.norm(b):
        return []
    sides = np.sum((points[NEXT] - points[LAST]) ** 2, axis=1)
    cosines = np.sum(rays[NEXT] * rays[LAST], axis=1)
    found: list[np.ndarray] = []
    for begin in _depths(sides, cosines):
        depths, off = _polish(begin, sides, cosines)
        is_new = not any(np.allclose(depths, other, rtol=SAME) for other in found)
        if np.all(depths > 0) and off < OFF * sides.max() and is_new:
            found.append(depths)
    return [align(points, depths[:, None] * rays) for depths in found]


def _depths(sides: np.ndarray, cosines: np.ndarray) -> list[np.ndarray]:
    """Distances (3,) from the eye by Grunert's quartic, not yet polished."""
    result = []
    for v in _ratios(*sides, *cosines):
        first = sides[1] / max(1 + v * v - 2 * v * cosines[1], 1e-300)
        # The second point's distance, by the side between it and the first: one of two.
        half = cosines[2]
        root = np.sqrt(max(half * half - 1 + sides[2] / first, 0.0))
        result += [np.sqrt(first) * np.array([1, u, v]) for u in (half - root, half + root)]
    return result


def _ratios(a: float, b: float, c: float, x: float, y: float, z: float) -> np.ndarray:
    """The real parts of all ratios of the third distance to the first: the roots of
    Grunert's quartic, of squared sides a, b, c and cosines x, y, z of the angles opposite."""
    p = (a - c) / b
    # The second distance's ratio is `over / under`, by two sides; the third side is the quartic.
    over, under = Polynomial([1 + p, -2 * p * y, p - 1]), Polynomial([2 * z, -2 * x])
    rest = 1 - c / b * Polynomial([1, -2 * y, 1])
    quartic = (over**2 - 2 * z * over * under + rest * under**2).coef[::-1]
    roots = np.roots(quartic) if np.all(np.isfinite(quartic)) else np.zeros(0)
    return np.unique(roots.real[roots.real > 0])


def _polish(depths: np.ndarray, sides: np.ndarray, cosines: np.ndarray) -> tuple[np.ndarray, float]:
    """Distances (3,) after Gauss-Newton on the squared sides, and how far off the worst of
    these then is."""
    for _ in range(STEPS):
        near, far = depths[NEXT], depths[LAST]
        slope = np.zeros((3, 3))
        slope[range(3), NEXT] = 2 * (near - far * cosines)
        slope[range(3), LAST] = 2 * (far - near * cosines)
        off = _squared_sides(depths, cosines) - sides
        depths = depths - np.linalg.pinv(slope, rcond=1e-9) @ off
    return depths, float(np.max(np.abs(_squared_sides(depths, cosines) - sides)))


def _squared_sides(depths: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    """Squared sides (3,) of a triangle at these distances."""
    near, far = depths[NEXT], depths[LAST]
    return near * near + far * far - 2 * near * far * cosines


def align(points: np.ndarray, seen: np.ndarray, about_middle: bool = True) -> Pose:
    """The rotation and the translation that bring points onto others (Kabsch 1976), none
    but a rotation unless it may be about their middle."""
    middle, there = (x.mean(axis=0) * about_middle for x in (points, seen))
    left, _, right = np.linalg.svd((seen - there).T @ (points - middle))
    flip = np.array([1, 1, np.linalg.det(left @ right)])
    rotation = (left * flip) @ right
    return rotation, there - rotation @ middle


def triangles(
    points: Float[np.ndarray, "N 3"], seen_at: Float[np.ndarray, "N 2"], most: int
) -> np.ndarray:
    """The indices (T, 3) of this many triangles at most, those that are largest in the world
    and where they are seen first."""
    threes = np.array([*itertools.combinations(range(len(points)), 3)])
    world, image = (_areas(x[threes]) for x in (points, seen_at))
    order = np.argsort(-np.round(np.log(np.maximum(world * image, 1e-300)), 9), kind="stable")
    return threes[order[:most]]


def _areas(corners: np.ndarray) -> np.ndarray:
    """The areas of triangles (m, 3, k)."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.sum(a * b, axis=1) ** 2
    return np.sqrt(np.maximum(np.sum(a * a, axis=1) * np.sum(b * b, axis=1) - across, 0)) / 2
