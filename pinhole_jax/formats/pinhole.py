"""The common ground of all formats: focal lengths, a principal point, axes, a rigid transform;
cameras by name, in JSON and text.

A format says which axes its camera frame has and where its pixel coordinates begin. All else is
here: a reader or a writer is the list of its file's fields.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from .._camera.camera import Camera, check_camera, focal_px, principal_point
from .._camera.distortion import COEFFICIENTS, BrownConrady, Distortion, Fisheye, Rational
from .._camera.matrices import Centres, half_pixel
from .._camera.poses import Pose, check_pose, inverse, pose_of
from .._files.fields import Fields, Part, read_fields, short
from .._files.paths import FilePath, replace_file
from .._numerics.arrays import ArrayLike, Input

#: Cameras by name.
Cameras = dict[str, Camera]
#: What is written: cameras by name in any mapping.
NamedCameras = Mapping[str, Camera]
#: What readers here expect a file to be.
KIND = "a camera file"
#: Camera frames as poses in OpenCV's (x right, y down, z forward): each is its own inverse.
OPENCV = np.eye(4)
#: x right, y up, z backward: OpenGL, Blender, NeRF, glTF.
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
#: x left, y up, z forward: PyTorch3D, Mitsuba.
LEFT_UP_FORWARD = np.diag([-1.0, -1.0, 1.0, 1.0])


class Pinhole(NamedTuple):
    """Intrinsics in px: focal lengths, and the principal point from the image's top-left corner;
    and the lens's distortion.

    y runs down, and pixel centres lie at halves: the corner itself is (0, 0).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    W: int
    H: int
    distortion: Distortion | None = None

    def matrix(self, half: float = 0.0) -> np.ndarray:
        """Return K (3, 3), whose pixel centres are at integers (`half` is 0.5) or at halves (0)."""
        return np.array([[self.fx, 0, self.cx - half], [0, self.fy, self.cy - half], [0, 0, 1]])


def pinhole(camera: Camera, *, distorted: bool = False) -> Pinhole:
    """Return the camera's intrinsics.

    Raises ValueError for a lens with distortion, unless the caller writes it too (`distorted`).
    """
    check_camera(camera)
    if camera.distortion is not None and not distorted:
        raise ValueError(
            "`cameras`: expected no lens distortion, which this format cannot hold, got a"
            f" {type(camera.distortion).__name__}"
        )
    (fx, fy), (x, y) = (map(float, pair(camera)) for pair in (focal_px, principal_point))
    return Pinhole(fx, fy, x, camera.H - y, camera.W, camera.H, camera.distortion)


def from_opencv(
    K: Input[ArrayLike, "3 3"],
    R: Input[ArrayLike, "3 3"],
    t: Input[ArrayLike, "3"],
    W: Input[int, "px"],
    H: Input[int, "px"],
    *,
    pixel_centres: Input[Centres, "of K"],
    d: float = 1.0,
    distortion: Distortion | None = None,
) -> Camera:
    """Return the camera of OpenCV's K (3, 3) in px, R (3, 3) and t (3,): `Camera.from_K`, beside
    the other conventions.

    Raises ValueError as it does.

    ```python
    same = pj.formats.from_opencv(K, R, t, 96, 80, pixel_centres="integer")
    ```
    """
    return Camera.from_K(K, R, t, W, H, pixel_centres=pixel_centres, d=d, distortion=distortion)


def to_opencv(
    camera: Camera, *, pixel_centres: Input[Centres, "of K"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return OpenCV's matrices in float64: x right, y down, z forward.

    - K (3, 3): `(u, v, 1) ~ K X_camera`, px, y down.
    - R (3, 3) and t (3,): `X_camera = R X_world + t`.

    `pixel_centres` says where the reader puts them: "integer" (OpenCV: the first pixel's centre is
    0) or "half" (0.5). A lens's distortion is not in them: `camera.lens.distortion` goes beside.

    ```python
    K, R, t = pj.formats.to_opencv(camera, pixel_centres="integer")
    ```
    """
    half, view = half_pixel(pixel_centres), pinhole(camera, distorted=True)
    pose = inverse(pose_of(camera))
    return (
        view.matrix(half),
        pose[:3, :3].copy(),
        pose[:3, 3].copy(),
    )  # OpenCV wants them contiguous


def read_distortion(
    fields: Fields, fisheye: bool, rational: bool = True, names: Iterable[str] = COEFFICIENTS
) -> Distortion | None:
    """Return the distortion of the coefficients among some fields: a fisheye's, or of the first of
    Brown's models that has them.

    None if all are 0 and it is no fisheye.
    """
    numbers = {name: fields.number(name) for name in names if name in fields}
    distorted = {name: value for name, value in numbers.items() if value != 0}
    is_brown = not rational or distorted.keys() <= BrownConrady.powers.keys()
    model = Fisheye if fisheye else BrownConrady if is_brown else Rational
    if unknown := [f"{k} = {x:g}" for k, x in distorted.items() if k not in model.powers]:
        known = f"{', '.join(model.powers)} of a {model.__name__} only"
        raise fields.wrong("distortion", known, ", ".join(unknown))
    return model(**distorted) if distorted or fisheye else None


def world_from_camera(camera: Camera, axes: Pose) -> Pose:
    """Return the transform of points in a camera frame with these axes to the world."""
    return pose_of(camera) @ axes


def pose_from_matrix(matrix: np.ndarray, fields: Fields, name: str) -> Pose:
    """Return a (3, 4) or (4, 4) transform as (4, 4), its rotation freed of rounding."""
    try:
        with np.errstate(all="ignore"):  # what overflows is no rotation
            return check_pose(name, np.vstack([matrix, np.eye(4)[len(matrix) :]]))
    except ValueError:
        expected = "a rotation (orthonormal, determinant 1) and a shift, its last row 0 0 0 1"
        raise fields.wrong(name, expected, matrix) from None


def read_pose(fields: Fields, name: str) -> Pose:
    """Return the rigid transform of a field, (3, 4) or (4, 4)."""
    return pose_from_matrix(fields.array(name, (3, 4), (4, 4)), fields, name)


def read_matrix(fields: Fields, name: str, W: int, H: int, half: float) -> Pinhole:
    """Return the intrinsics of a field's K (3, 3), or fx, fy, cx, cy, whose pixel centres are at
    integers (`half` is 0.5) or at halves (0)."""
    K = np.ravel(fields.array(name, expected="finite numbers of shape (3, 3)"))
    if len(K) == 9 and [K[3], *K[6:]] == [0, 0, 0, 1] and abs(K[1]) <= 1e-9 * abs(K[0]):
        K = K[[0, 4, 2, 5]]
    if len(K) != 4:
        raise fields.wrong(name, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], or fx, fy, cx, cy", K)
    fx, fy, cx, cy = K
    return Pinhole(fx, fy, cx + half, cy + half, W, H)


def camera_from_pinhole(
    view: Pinhole, world_from_camera: Pose, axes: Pose, fields: Fields
) -> Camera:
    """Return the camera of intrinsics and a rigid transform from a frame with these axes."""
    pose = inverse(world_from_camera @ axes)
    R, t = pose[:3, :3], pose[:3, 3]
    try:
        return Camera.from_K(
            view.matrix(), R, t, view.W, view.H, pixel_centres="half", distortion=view.distortion
        )
    except ValueError as error:
        raise ValueError(f"{error} (in {fields.where})") from None


def focal_from_fov(fov: float, length: float | int) -> float:
    """Return the focal length in px of a field of view (rad) over this many px."""
    return float(length / (2 * np.tan(fov / 2)))


def fov_from_focal(focal: float, length: float | int) -> float:
    """Return the field of view in rad of a focal length in px over this many px."""
    return float(2 * np.arctan(length / (2 * focal)))


def json_cameras(path: FilePath, read: Callable[[Fields], Camera]) -> Cameras:
    """Return the cameras of a JSON file: of its field `cameras` by name, or the file's one."""
    top = read_fields(path, KIND)
    if "cameras" not in top:
        return {top.text("name", default="camera"): read(top)}
    parts = top.part("cameras")
    return {name: read(parts.part(name)) for name in parts.data}


def save_json(path: FilePath, data: Any) -> None:
    """Write JSON, whole or not at all."""
    replace_file(path, (json.dumps(data, indent=1, allow_nan=False) + "\n").encode())


def check_cameras(
    cameras: Any, program: str = "JSON", can_hold: Callable[[str], Any] = lambda name: True
) -> None:
    """Raise ValueError unless these are cameras by names that a program can hold."""
    if not isinstance(cameras, Mapping):
        kind = type(cameras).__name__
        raise ValueError(f"`cameras`: expected a dict of Cameras by their names, got {kind}")
    if not cameras:
        raise ValueError("`cameras`: expected at least one, got none")
    for name, camera in cameras.items():
        check_camera(camera, f"cameras[{short(name)}]")
        try:
            fits = isinstance(name, str) and name.encode() is not None and can_hold(name)
        except UnicodeEncodeError:
            fits = False
        if not fits:
            raise ValueError(f"`cameras`: expected names {program} can hold, got {short(name)}")


def chosen(cameras: Mapping[str, Part], name: str | None, where: str) -> Part:
    """Return the camera of this name; without one, the only one."""
    if name is None and len(cameras) == 1:
        name = next(iter(cameras))
    if name is None or name not in cameras:
        known = short([*cameras])
        words = f"one camera, or FILE:NAME with a name among {known}"
        got = f"{len(cameras)} cameras" if name is None else repr(name)
        raise ValueError(f"`path`: expected {words}, got {got} (in {where})")
    return cameras[name]


def by_name(cameras: Iterable[tuple[str, Camera]], where: str) -> Cameras:
    """Return cameras by name, or raise ValueError where two have the same."""
    named: Cameras = {}
    for name, camera in cameras:
        if name in named:
            raise ValueError(
                f"expected one camera of each name, got two of {short(name)} (in {where})"
            )
        named[name] = camera
    return named
