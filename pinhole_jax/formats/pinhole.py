"""What every format comes down to: focal lengths, a principal point, axes and a rigid transform.

A format says which axes its camera frame has and where its pixel coordinates begin; all else is
here, so that a reader or a writer is the list of its file's fields.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .._camera.camera import Camera, check_camera
from .._camera.distortion import Distortion, Fisheye
from .._camera.matrices import is_rotation
from .._camera.poses import rigid as transform
from .fields import Fields
from .matrices import from_opencv, to_opencv

#: A camera frame's axes, as columns, in OpenCV's frame (x right, y down, z forward).
OPENCV = np.diag([1.0, 1.0, 1.0])
#: x right, y up, z backward: OpenGL, Blender, NeRF, glTF.
OPENGL = np.diag([1.0, -1.0, -1.0])
#: x left, y up, z forward: PyTorch3D, Mitsuba.
LEFT_UP_FORWARD = np.diag([-1.0, -1.0, 1.0])


class Pinhole(NamedTuple):
    """Intrinsics in px: focal lengths, and the principal point from the image's top-left corner.

    y runs down, and pixel centres lie at halves: the corner itself is (0, 0).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    W: int
    H: int


def pinhole(camera: Camera, *, distorted: bool = False) -> Pinhole:
    """Return the camera's intrinsics, or raise ValueError for a distortion unless it goes beside
    (`distorted`)."""
    check_camera(camera)
    model = camera.distortion
    if model is not None and not distorted:
        raise ValueError(
            "`cameras`: expected no lens distortion, which this format cannot hold, got a"
            f" {type(model).__name__}"
        )
    K = to_opencv(camera, pixel_centres="half")[0]
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Pinhole(fx, fy, cx, cy, camera.W, camera.H)


def model_of(
    coefficients: Mapping[str, float], fields: Fields, models: Sequence[type[Distortion]]
) -> Distortion | None:
    """Return the distortion with these coefficients, of the first of some models that has them;
    None if those of no fisheye are all 0."""
    distorted = {name: value for name, value in coefficients.items() if value != 0}
    model = next((model for model in models if distorted.keys() <= model.powers.keys()), models[-1])
    if unknown := {name: value for name, value in distorted.items() if name not in model.powers}:
        words = ", ".join(f"{name} = {value:g}" for name, value in unknown.items())
        known = ", ".join(model.powers)
        raise fields.wrong("distortion", f"{known} of a {model.__name__} only", words)
    return model(**distorted) if distorted or model is Fisheye else None


def camera_from_world(camera: Camera, axes: np.ndarray) -> np.ndarray:
    """Return the (4, 4) transform of world points to a camera frame with these axes."""
    _, R, t = to_opencv(camera, pixel_centres="half")
    return transform(axes.T @ R, axes.T @ t)


def world_from_camera(camera: Camera, axes: np.ndarray) -> np.ndarray:
    """Return the (4, 4) transform of points in a camera frame with these axes to the world."""
    _, R, _ = to_opencv(camera, pixel_centres="half")
    return transform(R.T @ axes, np.asarray(camera.e, float))


def rotation(matrix: np.ndarray, fields: Fields, name: str) -> np.ndarray:
    """Return the rotation nearest to a (3, 3) matrix, which must be one to within rounding."""
    small = np.all(np.abs(matrix) < 2)  # no product overflows
    if not (small and is_rotation(matrix)):
        raise fields.wrong(name, "a rotation (orthonormal, determinant 1)", matrix)
    left, _, right = np.linalg.svd(matrix)
    return left @ right


def rigid(matrix: np.ndarray, fields: Fields, name: str) -> np.ndarray:
    """Return a (3, 4) or (4, 4) transform as (4, 4), its rotation freed of rounding."""
    if len(matrix) == 4 and not np.abs(matrix[3] - [0, 0, 0, 1]).max() <= 1e-9:
        raise fields.wrong(name, "a last row of 0 0 0 1", matrix[3])
    return transform(rotation(matrix[:3, :3], fields, name), matrix[:3, 3])


def camera_of(
    view: Pinhole,
    world_from_camera: np.ndarray,
    axes: np.ndarray,
    fields: Fields,
    distortion: Distortion | None = None,
) -> Camera:
    """Return the camera of intrinsics and a rigid transform from a frame with these axes."""
    for name in ("fx", "fy"):
        if not getattr(view, name) > 0:
            raise fields.wrong(name, "a positive focal length in px", f"{getattr(view, name)}")
    R = (world_from_camera[:3, :3] @ axes.T).T
    K = np.array([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]])
    t = -R @ world_from_camera[:3, 3]
    try:
        size = (view.W, view.H)
        return from_opencv(K, R, t, *size, pixel_centres="half", distortion=distortion)
    except ValueError as error:
        raise ValueError(f"{error} (in {fields.where})") from None


def focal_of_fov(fov: float, length: float | int) -> float:
    """Return the focal length in px of a field of view (rad) over this many px."""
    return float(length / (2 * np.tan(fov / 2)))


def fov_of_focal(focal: float, length: float | int) -> float:
    """Return the field of view in rad of a focal length in px over this many px."""
    return float(2 * np.arctan(length / (2 * focal)))
