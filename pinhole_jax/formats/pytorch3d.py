"""PyTorch3D cameras, as arrays and as a JSON of those arrays.

Axes: x left, y up, z forward. Row vectors: `X_camera = X_world R + T`, so R is the transpose of the
usual camera_from_world. In screen space (`in_ndc=False`) focal lengths and principal point are px
from the image's top-left corner, y down, pixel centres at halves. In NDC the image's shorter side
spans [-1, 1], x to the left, y up, and lengths are halves of that side. `image_size` is (H, W).
"""

import numpy as np

from .._camera.camera import Camera
from .._camera.poses import inverse
from .._files.fields import Fields, Size, as_numbers, read_fields
from .._files.paths import FilePath
from .._numerics.arrays import ArrayLike, Input
from .pinhole import (
    KIND,
    LEFT_UP_FORWARD,
    Cameras,
    NamedCameras,
    Pinhole,
    by_name,
    camera_from_pinhole,
    check_cameras,
    focal_from_fov,
    pinhole,
    pose_from_matrix,
    save_json,
    world_from_camera,
)

SCHEMA = "pytorch3d.PerspectiveCameras"
#: The arrays of a file; each camera has a row of them.
ARRAYS = ("R", "T", "focal_length", "principal_point", "image_size")


def to_pytorch3d(camera: Camera) -> dict[str, np.ndarray]:
    """Return arguments of `PerspectiveCameras(**arrays, in_ndc=False)`: a batch of one, float64.

    `R` (1, 3, 3), `T` (1, 3), `focal_length` (1, 2) and `principal_point` (1, 2) in px, and
    `image_size` (1, 2) as (H, W). PyTorch3D wants tensors: `torch.as_tensor` each.

    ```python
    arrays = pj.formats.to_pytorch3d(camera)
    ```
    """
    view = pinhole(camera)
    pose = world_from_camera(camera, LEFT_UP_FORWARD)
    return {
        "R": pose[None, :3, :3],
        "T": inverse(pose)[None, :3, 3],
        "focal_length": np.array([[view.fx, view.fy]]),
        "principal_point": np.array([[view.cx, view.cy]]),
        "image_size": np.array([[view.H, view.W]]),
    }


def from_pytorch3d(
    R: Input[ArrayLike, "3 3"],
    T: Input[ArrayLike, "3"],
    image_size: Input[ArrayLike, "2"],
    *,
    focal_length: Input[ArrayLike | None, "NDC or px"] = None,
    principal_point: Input[ArrayLike | None, "2"] = None,
    in_ndc: bool = True,
    fov: Input[ArrayLike | None, "rad"] = None,
    aspect_ratio: Input[ArrayLike, ""] = 1.0,
) -> Camera:
    """Return the camera of one PerspectiveCameras or, with `fov`, FoVPerspectiveCameras.

    `R` (3, 3), `T` (3,), row vectors; a batch axis of 1 may lead. `image_size` is (H, W) in px.
    `focal_length` (a number, or x and y) and `principal_point` are in NDC, PyTorch3D's default, or
    in px with `in_ndc=False`. The default principal point is the image's centre. `fov` is in rad
    and spans the image's SHORTER side (the vertical one of a wide image, as PyTorch3D's NDC has
    it); `aspect_ratio` is that of FoVPerspectiveCameras: fy over fx.

    ```python
    same = pj.formats.from_pytorch3d(**arrays, in_ndc=False)
    ```
    """
    given = {
        "R": R,
        "T": T,
        "image_size": image_size,
        "focal_length": focal_length,
        "principal_point": principal_point,
        "fov": fov,
        "aspect_ratio": aspect_ratio,
    }
    if (fov is None) == (focal_length is None):
        raise ValueError("expected `focal_length` or `fov`, got both or neither")
    squeezed = lambda x: x if (numbers := as_numbers(x)) is None else np.squeeze(numbers)
    fields = {name: squeezed(x) for name, x in given.items() if x is not None}
    return _camera(Fields(fields, "the arguments"), in_ndc)


def _camera(fields: Fields, in_ndc: bool, size: Size | None = None) -> Camera:
    pair = fields.array("image_size", (2,)) if "image_size" in fields else ()
    film = Fields(dict(zip("HW", pair, strict=False)), f"{fields.where}, image_size")
    W, H = film.size("W", "H", size)
    half = min(W, H) / 2
    if "fov" in fields:
        fy = focal_from_fov(fields.angle("fov"), 2 * half)
        fx = fy / fields.positive("aspect_ratio")
    else:
        focal = fields.array("focal_length", (), (2,), expected="one number or two")
        fx, fy = np.broadcast_to(focal * (half if in_ndc else 1.0), 2)
    middle = [W / 2, H / 2]
    centre = fields.array("principal_point", (2,), default=0 if in_ndc else middle)
    cx, cy = middle - half * centre if in_ndc else centre
    pose = np.c_[fields.array("R", (3, 3)).T, fields.array("T", (3,))]
    pose = inverse(pose_from_matrix(pose, fields, "R"))
    return camera_from_pinhole(Pinhole(fx, fy, cx, cy, W, H), pose, LEFT_UP_FORWARD, fields)


def read_pytorch3d(path: FilePath, *, size: Size | None = None) -> Cameras:
    """Return the cameras of a JSON of PyTorch3D's arrays, by `names`, or "0", "1" ...

    `R` (N, 3, 3), `T` (N, 3), `focal_length` (N, 2), `principal_point` (N, 2), `image_size` (N, 2)
    as (H, W), and `in_ndc`, which must be there. `size` is (W, H) where there is no `image_size`.

    ```python
    pj.formats.write_pytorch3d("pytorch3d.json", {"left.png": camera})
    cameras = pj.formats.read_pytorch3d("pytorch3d.json")
    ```
    """
    top = read_fields(path, KIND)
    count, in_ndc = len(top.array("R", (-1, 3, 3))), top.flag("in_ndc")
    given = [
        name for name in ("names", *ARRAYS) if name in top or name not in ("names", "image_size")
    ]
    rows = {name: top.items(name, count, f"a list of {count}") for name in given}
    names = rows.pop("names", range(count))
    part = lambda k: Fields({x: rows[x][k] for x in rows}, f"{top.where}, camera {k}")
    cameras = ((str(name), _camera(part(k), in_ndc, size)) for k, name in enumerate(names))
    return by_name(cameras, top.where)


def write_pytorch3d(path: FilePath, cameras: NamedCameras) -> None:
    """Write PyTorch3D's arrays of all cameras, screen space (px), as JSON.

    ```python
    pj.formats.write_pytorch3d("pytorch3d.json", {"left.png": camera})
    ```
    """
    check_cameras(cameras)
    each = [to_pytorch3d(camera) for camera in cameras.values()]
    arrays = {name: np.concatenate([a[name] for a in each]).tolist() for name in each[0]}
    save_json(path, {"schema": SCHEMA, "in_ndc": False, "names": list(cameras), **arrays})
