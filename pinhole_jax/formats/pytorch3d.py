"""PyTorch3D cameras, as arrays and as a JSON of those arrays.

Axes: x left, y up, z forward. Row vectors: `X_camera = X_world R + T`, so R is the transpose of the
usual camera_from_world. In screen space (`in_ndc=False`) focal lengths and principal point are px
from the image's top-left corner, y down, pixel centres at halves. In NDC the image's shorter side
spans [-1, 1], x to the left, y up, and lengths are halves of that side. `image_size` is (H, W).
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from .._camera.camera import Camera
from .._camera.poses import inverse
from .._files.fields import Fields, Size, read_fields
from .._files.paths import FilePath
from .._numerics.arrays import ArrayLike, Input
from .cameras import KIND, Cameras, by_name, check_cameras, save_json
from .pinhole import (
    LEFT_UP_FORWARD,
    Pinhole,
    camera_from_pinhole,
    pinhole,
    pose_from_matrix,
    world_from_camera,
)

SCHEMA = "pytorch3d.PerspectiveCameras"
#: The arrays of a file, and the shape of each camera's.
SHAPES: dict[str, tuple[int, ...]] = {
    "R": (3, 3),
    "T": (3,),
    "focal_length": (2,),
    "principal_point": (2,),
    "image_size": (2,),
}


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
        "R": _without_batch(R, 2),
        "T": _without_batch(T, 1),
        "image_size": _without_batch(image_size, 1),
        "focal_length": _without_batch(focal_length, 1),
        "principal_point": _without_batch(principal_point, 1),
        "fov": fov,
        "aspect_ratio": aspect_ratio,
    }
    if (fov is None) == (focal_length is None):
        raise ValueError("expected `focal_length` or `fov`, got both or neither")
    fields = {name: value for name, value in given.items() if value is not None}
    return _camera(Fields(fields, "the arguments"), in_ndc)


def _camera(fields: Fields, in_ndc: bool) -> Camera:
    H, W = fields.array("image_size", (2,))
    whole = Fields({"H": H, "W": W}, f"{fields.where}, image_size")
    H, W = whole.integer("H"), whole.integer("W")
    half = min(W, H) / 2
    if "fov" in fields:
        fy = half / np.tan(fields.angle("fov") / 2)
        fx = fy / fields.positive("aspect_ratio")
    else:
        pair = fields.shape("focal_length") == (2,)
        focal = fields.array("focal_length", (2,) if pair else (), "one number or two")
        fx, fy = np.broadcast_to(focal * (half if in_ndc else 1.0), 2)
    cx, cy = W / 2, H / 2
    if "principal_point" in fields:
        x, y = fields.array("principal_point", (2,))
        cx, cy = (cx - half * x, cy - half * y) if in_ndc else (x, y)
    pose = np.c_[fields.array("R", (3, 3)).T, fields.array("T", (3,))]
    world_from_camera = inverse(pose_from_matrix(pose, fields, "R"))
    view = Pinhole(float(fx), float(fy), float(cx), float(cy), W, H)
    return camera_from_pinhole(view, world_from_camera, LEFT_UP_FORWARD, fields)


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
    count = len(top.array("R", (-1, 3, 3)))
    sizes = {} if size is None or "image_size" in top else {"image_size": [size[::-1]] * count}
    top = Fields({**top.data, **sizes}, top.where)
    names = map(str, range(count))
    if "names" in top:
        names = map(str, top.items("names", count, f"{count} names"))
    return by_name(zip(names, _cameras(top, count, size), strict=True), top.where)


def _cameras(top: Fields, count: int, size: Size | None) -> Iterator[Camera]:
    """Yield the cameras of a file's arrays."""
    in_ndc = top.flag("in_ndc")
    arrays = [top.array(name, (count, *shape)) for name, shape in SHAPES.items()]
    for k, values in enumerate(zip(*arrays, strict=True)):
        fields = Fields(dict(zip(SHAPES, values, strict=True)), f"{top.where}, camera {k}")
        if size is not None and tuple(fields.data["image_size"]) != size[::-1]:
            words = f"(H, W) = ({size[1]}, {size[0]})"
            raise fields.wrong("image_size", words, fields.data["image_size"])
        yield _camera(fields, in_ndc)


def write_pytorch3d(path: FilePath, cameras: Mapping[str, Camera]) -> None:
    """Write PyTorch3D's arrays of all cameras, screen space (px), as JSON.

    ```python
    pj.formats.write_pytorch3d("pytorch3d.json", {"left.png": camera})
    ```
    """
    check_cameras(cameras, "JSON")
    each = [to_pytorch3d(camera) for camera in cameras.values()]
    arrays = {name: np.concatenate([a[name] for a in each]).tolist() for name in each[0]}
    save_json(path, {"schema": SCHEMA, "in_ndc": False, "names": list(cameras), **arrays})


def _without_batch(value: Any, axes: int) -> Any:
    """Return an array without its batch axis of 1; anything else as it is, to be refused later."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        return value
    return array[0] if array.ndim == axes + 1 and len(array) == 1 else value
