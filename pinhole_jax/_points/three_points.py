"""All poses from which three points are seen along three lines of sight: P3P.

Source: R. Haralick et al., "Review and Analysis of Solutions of the Three Point Perspective Pose
Estimation Problem" (1994): Grunert's equations and his quartic, of 1841.
"""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial

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
    from scipy.optimize import root
    from scipy.spatial.transform import Rotation

    a, b = points[1:] - points[0]
    thin = np.linalg.norm(np.cross(a, b)) <= THIN * np.linalg.norm(a) * np.linalg.norm(b)
    if thin or not np.all(np.isfinite(rays)):
        return []
    sides = np.sum((points[NEXT] - points[LAST]) ** 2, axis=1)
    cosines = np.sum(rays[NEXT] * rays[LAST], axis=1)

    def off(depths: np.ndarray) -> np.ndarray:
        near, far = depths[NEXT], depths[LAST]
        return near * near + far * far - 2 * near * far * cosines - sides

    found, poses = np.zeros((0, 3)), []
    for begin in _depths(sides, cosines):
        depths = root(off, begin, method="lm").x
        is_known = np.any(np.all(np.isclose(found, depths, rtol=SAME), axis=1))
        if np.all(depths > 0) and np.max(np.abs(off(depths))) < OFF * sides.max() and not is_known:
            found, there = np.vstack([found, depths]), depths[:, None] * rays
            middles = points.mean(axis=0), there.mean(axis=0)
            turn = Rotation.align_vectors(there - middles[1], points - middles[0])[0].as_matrix()
            poses.append((turn, middles[1] - turn @ middles[0]))
    return poses


def _depths(sides: np.ndarray, cosines: np.ndarray) -> Iterator[np.ndarray]:
    """Distances (3,) from the eye, not yet polished, by the real parts of the roots of Grunert's
    quartic: the ratios of the third distance to the first."""
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


def triangles(
    points: Float[np.ndarray, "N 3"], rays: Float[np.ndarray, "N 3"], most: int
) -> np.ndarray:
    """The indices (T, 3) of this many triangles at most, those that are largest in the world
    and where they are seen first."""
    threes = np.array([*itertools.combinations(range(len(points)), 3)])
    edges = [x[threes[:, 1:]] - x[threes[:, :1]] for x in (points, rays)]
    sizes = np.prod([np.linalg.det(x @ x.transpose(0, 2, 1)) for x in edges], axis=0)
    order = np.argsort(-np.round(np.log(np.maximum(sizes, 1e-300)), 9), kind="stable")
    return threes[order[:most]]
