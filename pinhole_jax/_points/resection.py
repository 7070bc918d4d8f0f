"""A camera's pose from points, directly: no start, no iteration, least squares of equations.

Sources: R. Hartley and A. Zisserman, "Multiple View Geometry" (2004), 4.1 and 7.1; for points of a
plane Z. Zhang, "A Flexible New Technique for Camera Calibration" (2000), 3.1.
"""

import numpy as np
from jaxtyping import Float

from .._camera.axes import axes_of
from .._camera.bent import straightened
from .._camera.camera import Camera, focal_px, principal_point
from .three_points import align, poses_of_three, triangles

#: Points whose spread across a plane is below this share of that within are points of the plane.
FLAT = 1e-3


def resect(
    camera: Camera, points: Float[np.ndarray, "N 3"], seen_at: Float[np.ndarray, "N 2"]
) -> Camera | None:
    """The camera posed so that it sees points (world) where they are seen (px), or None.

    None where there are too few points (4 of a plane, else 6), or where they are degenerate.
    """
    view = _normalised(camera, seen_at)
    middle, spread, axes = _spread(points)
    flat = spread[-1] <= FLAT * spread[0]
    if len(points) < (4 if flat else 6) or not spread[1] > FLAT * spread[0]:
        return None
    # In the points' own axes, scaled: so the equations are well conditioned.
    axes = axes * np.sign(np.linalg.det(axes))
    scale = np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1)))
    local = (points - middle) @ axes.T / scale
    columns = [0, 1, 3] if flat else [0, 1, 2, 3]
    known = np.column_stack([local, np.ones(len(local))])[:, columns]
    none = np.zeros_like(known)
    x, y = view[:, :1], view[:, 1:]
    rows = np.concatenate(
        [np.hstack([known, none, -x * known]), np.hstack([none, known, -y * known])]
    )
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, -1)
    shift, turn = matrix[:, -1], matrix[:, :-1]
    if shift[2] < 0:
        shift, turn = -shift, -turn
    size = np.mean(np.linalg.norm(turn, axis=0))
    if not size > 0:
        return None
    if flat:
        turn = np.column_stack([turn / size, np.cross(turn[:, 0], turn[:, 1]) / size**2])
    left, _, right = np.linalg.svd(turn)
    if np.linalg.det(left @ right) < 0:
        return None
    rotation = (left @ right) @ axes
    translation = shift * (scale / size) - rotation @ middle
    return _posed(camera, rotation, translation)


def resect_three(
    camera: Camera, points: Float[np.ndarray, "N 3"], seen_at: Float[np.ndarray, "N 2"], most: int
) -> list[Camera]:
    """The camera in all poses that see three of the points where they are seen, of this many
    triangles at most: the only pose, or up to four, of each."""
    rays = _rays(camera, seen_at)
    threes = triangles(points, seen_at, most)
    poses = [pose for three in threes for pose in poses_of_three(points[three], rays[three])]
    return [_posed(camera, *pose) for pose in poses]


def turn(
    camera: Camera, points: Float[np.ndarray, "N 3"], seen_at: Float[np.ndarray, "N 2"]
) -> Camera:
    """The camera turned about its eye so that it sees points where they are seen (Kabsch
    1976)."""
    eye = np.asarray(camera.e, float)
    towards = (points - eye) / np.linalg.norm(points - eye, axis=1, keepdims=True)
    rotation, _ = align(towards, _rays(camera, seen_at), about_middle=False)
    return _posed(camera, rotation, -rotation @ eye)


def shift(
    camera: Camera, points: Float[np.ndarray, "N 3"], seen_at: Float[np.ndarray, "N 2"]
) -> Camera:
    """The camera shifted, its axes as they are, so that it sees points where they are seen:
    least squares of how far they are from their lines of sight."""
    axes = axes_of(camera) * [[1], [-1], [1]]
    rays = _rays(camera, seen_at) @ axes
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    eye = np.linalg.lstsq(across.sum(axis=0), (across @ points[..., None]).sum(axis=0)[:, 0])[0]
    return _posed(camera, axes, -axes @ eye)


def plane_of(points: Float[np.ndarray, "N 3"]) -> tuple[np.ndarray, np.ndarray] | None:
    """The middle and the normal of the plane that points are of, None if of none."""
    middle, spread, axes = _spread(points)
    if not spread[-1] <= FLAT * spread[0] < spread[1]:
        return None
    return middle, axes[-1]


def _spread(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The middle of points, how far they spread along three axes, and these (rows)."""
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle, full_matrices=True)
    return middle, np.pad(spread, (0, 3 - len(spread))), axes


def _normalised(camera: Camera, seen_at: np.ndarray) -> np.ndarray:
    """Ideal film points at distance 1, y down, in which right, down, forward are turned as
    the world's axes are."""
    focal, centre = (
        np.array([float(z) for z in x]) for x in (focal_px(camera), principal_point(camera))
    )
    return (straightened(camera, seen_at) - centre) / focal * [1, -1]


def _rays(camera: Camera, seen_at: np.ndarray) -> np.ndarray:
    """Unit vectors along the lines of sight, right, down, forward."""
    view = np.column_stack([_normalised(camera, seen_at), np.ones(len(seen_at))])
    return view / np.linalg.norm(view, axis=1, keepdims=True)


def _posed(camera: Camera, rotation: np.ndarray, translation: np.ndarray) -> Camera:
    """The camera with `rotation @ x + translation` right, down and forward of the eye."""
    right, down, forward = rotation
    return camera.with_pose(-rotation.T @ translation, np.stack([right, -down, forward]))
