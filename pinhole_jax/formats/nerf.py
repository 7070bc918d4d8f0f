"""NeRF's and nerfstudio's `transforms.json`.

Axes: x right, y up, z backward (OpenGL); `transform_matrix` is world_from_camera. `camera_angle_x`
is the HORIZONTAL field of view in rad, `camera_angle_y` the vertical; `fl_x`, `fl_y`, in px, come
before them. `cx`, `cy` are px from the image's top-left corner, y down; pixel centres at halves.
"""

import os
from collections.abc import Mapping

from .._camera.camera import Camera
from .._camera.distortion import BrownConrady, Fisheye, Rational
from .fields import Fields, Size, add_named, check_cameras, load_json, save_json
from .pinhole import (
    OPENGL,
    Pinhole,
    camera_of,
    focal_of_fov,
    fov_of_focal,
    model_of,
    pinhole,
    rigid,
    world_from_camera,
)

COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
#: Where a frame has one of these, the file's others of them do not count.
GROUPS = (
    {"fl_x", "fl_y", "camera_angle_x", "camera_angle_y"},
    {"camera_model", "is_fisheye"},
    {*COEFFICIENTS},
)
FISHEYE = "OPENCV_FISHEYE"
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", FISHEYE)


def read_nerf(path: str | os.PathLike[str], *, size: Size | None = None) -> dict[str, Camera]:
    """Return the cameras of a transforms.json, by each frame's `file_path`.

    A frame's own focal lengths, model or coefficients replace all of the file's. Where the file
    holds no `w`, `h` (NeRF's Blender scenes), `size` gives them. World axes are the file's: no
    `applied_transform` is undone.

    Raises ValueError naming file and field where something is missing or wrong, for other camera
    models (equirectangular, ...), and for coefficients that OpenCV's models have not.

    ```python
    pj.formats.write_nerf("transforms.json", {"left.png": camera})
    cameras = pj.formats.read_nerf("transforms.json")
    ```
    """
    top = load_json(path)
    cameras: dict[str, Camera] = {}
    shared = {name: value for name, value in top.data.items() if name != "frames"}
    for k, frame in enumerate(top.parts("frames")):
        lost = set().union(*(group for group in GROUPS if group & frame.data.keys()))
        kept = {name: value for name, value in shared.items() if name not in lost}
        fields = Fields({**kept, **frame.data}, frame.where)
        name = fields.text("file_path", default=str(k))
        model = fields.text("camera_model", MODELS, "OPENCV")
        fisheye = model == FISHEYE or ("is_fisheye" in fields and fields.flag("is_fisheye"))
        short = "transform_matrix" in fields and fields.shape("transform_matrix") == (3, 4)
        matrix = fields.array("transform_matrix", (3 if short else 4, 4))
        pose = rigid(matrix, fields, "transform_matrix")
        coefficients = {c: fields.number(c) for c in COEFFICIENTS if c in fields}
        distortion = model_of(coefficients, fields, (Fisheye if fisheye else BrownConrady,))
        camera = camera_of(_intrinsics(fields, size), pose, OPENGL, fields, distortion)
        add_named(cameras, name, camera, repr(str(path)))
    return cameras


def write_nerf(path: str | os.PathLike[str], cameras: Mapping[str, Camera]) -> None:
    """Write a transforms.json that nerfstudio, instant-ngp and NeRF's own readers understand.

    Intrinsics that all cameras share stand at the top, otherwise with each frame.

    ```python
    pj.formats.write_nerf("transforms.json", {"left.png": camera})
    ```
    """
    check_cameras(cameras, "JSON")
    fisheye = [isinstance(camera.distortion, Fisheye) for camera in cameras.values()]
    if len({*fisheye}) > 1:
        raise ValueError("`cameras`: expected fisheyes or none in one file, got both")
    views = [_numbers(camera) for camera in cameras.values()]
    common = views[0] if all(view == views[0] for view in views) else {}
    frames = []
    for (name, camera), view in zip(cameras.items(), views, strict=True):
        own = {} if common else view
        matrix = world_from_camera(camera, OPENGL).tolist()
        frames.append({"file_path": name, **own, "transform_matrix": matrix})
    model = FISHEYE if fisheye[0] else "OPENCV"
    save_json(path, {"camera_model": model, **common, "frames": frames})


def _intrinsics(fields: Fields, size: Size | None) -> Pinhole:
    W, H = fields.size("w", "h", size)
    if "fl_x" in fields:
        fx = fields.positive("fl_x")
    elif "camera_angle_x" in fields:
        fx = focal_of_fov(fields.angle("camera_angle_x"), W)
    else:
        words = "neither"
        raise fields.wrong("fl_x", "fl_x (px) or camera_angle_x (rad, horizontal)", words)
    if "fl_y" in fields:
        fy = fields.positive("fl_y")
    elif "camera_angle_y" in fields and "fl_x" not in fields:
        fy = focal_of_fov(fields.angle("camera_angle_y"), H)
    else:
        fy = fx
    return Pinhole(fx, fy, fields.number("cx", W / 2), fields.number("cy", H / 2), W, H)


def _numbers(camera: Camera) -> dict[str, float | int]:
    view, distortion = pinhole(camera, distorted=True), camera.distortion
    if isinstance(distortion, Rational):  # k4 here is another term of the numerator
        raise ValueError("`cameras`: expected OpenCV's k1, k2, p1, p2, k3, got a Rational")
    distorted = {} if distortion is None else distortion.coefficients()
    return {
        **distorted,
        "w": view.W,
        "h": view.H,
        "fl_x": view.fx,
        "fl_y": view.fy,
        "cx": view.cx,
        "cy": view.cy,
        "camera_angle_x": fov_of_focal(view.fx, view.W),
        "camera_angle_y": fov_of_focal(view.fy, view.H),
    }
