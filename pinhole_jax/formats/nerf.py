"""NeRF's and nerfstudio's `transforms.json`.

Axes: x right, y up, z backward (OpenGL); `transform_matrix` is world_from_camera. `camera_angle_x`
is the HORIZONTAL field of view in rad, `camera_angle_y` the vertical; `fl_x`, `fl_y`, in px, come
before them. `cx`, `cy` are px from the image's top-left corner, y down; pixel centres at halves.
"""

from .._camera.camera import Camera
from .._camera.distortion import COEFFICIENTS, Fisheye, Rational
from .._files.fields import Fields, Size, read_fields
from .._files.paths import FilePath
from .pinhole import (
    KIND,
    OPENGL,
    Cameras,
    NamedCameras,
    Pinhole,
    by_name,
    camera_from_pinhole,
    check_cameras,
    focal_from_fov,
    fov_from_focal,
    pinhole,
    read_distortion,
    read_pose,
    save_json,
    world_from_camera,
)

#: Where a frame has one of these, the file's others of them do not count.
GROUPS = (
    {"fl_x", "fl_y", "camera_angle_x", "camera_angle_y"},
    {"camera_model", "is_fisheye"},
    {*COEFFICIENTS},
)
FISHEYE = "OPENCV_FISHEYE"
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", FISHEYE)


def read_nerf(path: FilePath, *, size: Size | None = None) -> Cameras:
    """Return the cameras of a transforms.json, by each frame's `file_path`.

    A frame's own focal lengths, model or coefficients replace all of the file's. Where the file
    holds no `w`, `h` (NeRF's Blender scenes), `size` gives them. World axes are the file's: no
    `applied_transform` is undone.

    Raises ValueError naming file and field where something is missing or wrong. Also for other
    camera models (equirectangular, ...) and for coefficients that OpenCV's models do not have.

    ```python
    pj.formats.write_nerf("transforms.json", {"left.png": camera})
    cameras = pj.formats.read_nerf("transforms.json")
    ```
    """
    top = read_fields(path, KIND)
    frames = enumerate(_with_shared(frame, top) for frame in top.parts("frames"))
    cameras = (
        (frame.text("file_path", default=str(k)), _camera(frame, size)) for k, frame in frames
    )
    return by_name(cameras, top.where)


def write_nerf(path: FilePath, cameras: NamedCameras) -> None:
    """Write a transforms.json that nerfstudio, instant-ngp and NeRF's own readers understand.

    Intrinsics that all cameras share stand at the top, otherwise with each frame.

    ```python
    pj.formats.write_nerf("transforms.json", {"left.png": camera})
    ```
    """
    check_cameras(cameras)
    models = {isinstance(camera.distortion, Fisheye) for camera in cameras.values()}
    if len(models) > 1:
        raise ValueError("`cameras`: expected fisheyes or none in one file, got both")
    views = [_intrinsics(camera) for camera in cameras.values()]
    common = views[0] if all(view == views[0] for view in views) else {}
    frames = [
        {
            "file_path": name,
            **({} if common else view),
            "transform_matrix": world_from_camera(camera, OPENGL).tolist(),
        }
        for (name, camera), view in zip(cameras.items(), views, strict=True)
    ]
    model = FISHEYE if True in models else "OPENCV"
    save_json(path, {"camera_model": model, **common, "frames": frames})


def _with_shared(frame: Fields, top: Fields) -> Fields:
    """Return a frame's fields, with the file's where it has none of the same group."""
    own = frame.data.keys()
    replaced = {"frames"}.union(*(group for group in GROUPS if group & own))
    shared = {name: value for name, value in top.data.items() if name not in replaced}
    return Fields({**shared, **frame.data}, frame.where)


def _camera(fields: Fields, size: Size | None) -> Camera:
    model = fields.text("camera_model", MODELS, "OPENCV")
    fisheye = model == FISHEYE or ("is_fisheye" in fields and fields.flag("is_fisheye"))
    distortion = read_distortion(fields, fisheye, rational=False)
    W, H = fields.size("w", "h", size)
    if "fl_x" in fields:
        fx = fields.positive("fl_x")
        fy = fields.positive("fl_y", fx)
    elif "camera_angle_x" in fields:
        fx = fy = focal_from_fov(fields.angle("camera_angle_x"), W)
        if "camera_angle_y" in fields:
            fy = focal_from_fov(fields.angle("camera_angle_y"), H)
    else:
        raise fields.wrong("fl_x", "fl_x (px) or camera_angle_x (rad, horizontal)", "neither")
    centre = fields.number("cx", W / 2), fields.number("cy", H / 2)
    pose = read_pose(fields, "transform_matrix")
    return camera_from_pinhole(Pinhole(fx, fy, *centre, W, H, distortion), pose, OPENGL, fields)


def _intrinsics(camera: Camera) -> dict[str, float | int]:
    view = pinhole(camera, distorted=True)
    if isinstance(view.distortion, Rational):  # k4 here is another term of the numerator
        raise ValueError("`cameras`: expected OpenCV's k1, k2, p1, p2, k3, got a Rational")
    return {
        **({} if view.distortion is None else view.distortion.coefficients()),
        "w": view.W,
        "h": view.H,
        "fl_x": view.fx,
        "fl_y": view.fy,
        "cx": view.cx,
        "cy": view.cy,
        "camera_angle_x": fov_from_focal(view.fx, view.W),
        "camera_angle_y": fov_from_focal(view.fy, view.H),
    }
