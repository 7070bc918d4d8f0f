"""Moves of a camera by hand: turn, shift and zoom about the middle of the object, change the lens.

Plain NumPy: each move takes a millisecond.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .. import BrownConrady, Camera, Lens
from ..show.space import axes_of, from_top

#: The first direction from an upright object to the camera: ahead, to the right and above.
FIRST_LOOK = (0.4, 0.45, 1.0)
#: The axes that an object may have upwards. Its front is along z, or along -y where z is up.
UPRIGHT = dict(zip("xyz", np.eye(3), strict=True))
#: The share of the picture's shorter side that an object first takes.
ROOM = 0.75
#: The least and the greatest distance of the eye from the object's middle, in radii.
NEAREST, FARTHEST = 1e-3, 1e5

Vector = Float[np.ndarray, "3"]


def focal_px(camera: Camera) -> Float[np.ndarray, "2"]:
    """Return the focal length (px) along x and y."""
    return np.diagonal(np.asarray(camera.K, float))[:2]


def principal_point(camera: Camera) -> Float[np.ndarray, "2"]:
    """Return the principal point in film coordinates (px)."""
    return from_top(camera, np.asarray(camera.K, float)[:2, 2] + 0.5)


class Extent(NamedTuple):
    """The middle of an object's box, and the distance of its farthest point."""

    centre: Vector
    radius: float


def extent_of(points: Float[np.ndarray, "n 3"]) -> Extent:
    """Return the extent about points, centred in the middle of their box."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return Extent(centre, float(np.max(np.linalg.norm(points - centre, axis=1), initial=1e-12)))


def frame_object(camera: Camera, extent: Extent, up: str = "y") -> Camera:
    """Return the camera looking at a whole object that stands with its axis x, y or z upwards."""
    if up not in UPRIGHT:
        raise ValueError(f"`up`: expected one of {', '.join(UPRIGHT)}, got {up!r}")
    upwards, ahead = UPRIGHT[up], -UPRIGHT["y"] if up == "z" else UPRIGHT["z"]
    right = np.cross(upwards, ahead)
    look = np.stack([right, upwards, ahead], axis=1) @ FIRST_LOOK
    half = np.arctan(ROOM * min(camera.W, camera.H) / 2 / focal_px(camera)[1])
    eye = extent.centre + extent.radius / np.sin(half) * look / np.linalg.norm(look)
    return camera.replace(e=eye, p=extent.centre, u=upwards)


def upright(camera: Camera) -> str | None:
    """Return the axis x, y or z that `frame_object` put upwards, None after turns."""
    return next((axis for axis, up in UPRIGHT.items() if np.array_equal(camera.u, up)), None)


def moved(
    camera: Camera,
    extent: Extent,
    turn: Sequence[float] = (0.0, 0.0, 0.0),
    shift: Sequence[float] = (0.0, 0.0),
    nearer: float = 1.0,
) -> Camera:
    """Return the camera that sees the object turned about its centre (rad: its front to the right,
    upwards, clockwise in the picture), shifted (px: right, down), at a scaled distance."""
    axes, away = axes_of(camera), np.asarray(camera.e, float) - extent.centre
    right, up, clockwise = turn
    rotation = Rotation.from_rotvec([-up, right, clockwise] @ axes).inv()  # the other way
    axes, away = rotation.apply(axes), rotation.apply(away)
    across = np.array([-1, 1]) * shift / focal_px(camera)
    away = away + abs(axes[2] @ away) * across @ axes[:2]
    far = float(np.linalg.norm(away))
    least, most = NEAREST * extent.radius, FARTHEST * extent.radius
    away = away * np.clip(far * nearer, least, most) / max(far, 1e-300)
    return camera.with_pose(extent.centre + away, axes)


def with_phi(camera: Camera, centre: Vector, phi: float) -> Camera:
    """Return the camera with another field of view (rad), moved to keep the object's size."""
    axes, eye = axes_of(camera), np.asarray(camera.e, float)
    depth = float(axes[2] @ (centre - eye))
    wider = camera.replace(phi=phi)
    ratio = np.tan(float(camera.phi) / 2) / np.tan(phi / 2)
    return wider.with_pose(eye + depth * (1 - ratio) * axes[2], axes)


def with_lens(camera: Camera, changes: dict[str, float]) -> Camera:
    """Return the camera with new numbers of its lens, without a lens if it changes nothing.

    Their names are principal_x and principal_y (px, from the film's lower left corner), aspect, and
    the coefficients of its distortion (of a camera without: OpenCV's k1, k2, p1, p2, k3).

    Raises ValueError for other names, and if no such lens holds on the film.
    """
    distortion: Any = camera.distortion or BrownConrady()
    x, y = principal_point(camera)
    aspect = 1.0 if camera.lens is None else float(camera.lens.aspect)
    own = {"principal_x": x, "principal_y": y, "aspect": aspect, **distortion.coefficients()}
    if unknown := sorted(changes.keys() - own.keys()):
        raise ValueError(f"`lens`: expected some of {', '.join(own)}, got {', '.join(unknown)}")
    x, y, aspect, *coefficients = (own | changes).values()
    bent = type(distortion)(*coefficients) if any(coefficients) else None
    is_trivial = bent is None and (2 * x, 2 * y, aspect) == (camera.W, camera.H, 1)
    return camera.replace(lens=None if is_trivial else Lens([x, y], aspect, bent))
