"""Blender cameras: their settings as JSON, and a script that creates them in Blender.

Axes: x right, y up, z backward; `matrix_world` is world_from_camera, Blender's units and axes (its
world has z up, which is not changed here). `lens` and `sensor_width`, `sensor_height` are mm;
`sensor_fit` says which side of the image the sensor spans: HORIZONTAL the width, VERTICAL the
height, AUTO the longer, always measured by `sensor_width` except when VERTICAL. So it says which
field of view `2 atan(sensor/(2 lens))` is. `shift_x`, `shift_y` are fractions of that side,
positive where the window moves right and up. There are no pixel coordinates: the image's edges
count.
"""

from typing import Any

from .._camera.camera import Camera
from .._files.fields import Fields, Size
from .._files.paths import FilePath, replace_file
from .pinhole import (
    OPENGL,
    Cameras,
    NamedCameras,
    Pinhole,
    camera_from_pinhole,
    check_cameras,
    json_cameras,
    pinhole,
    read_pose,
    save_json,
    world_from_camera,
)

SCHEMA = "pinhole_jax.blender/1"
FITS = ("AUTO", "HORIZONTAL", "VERTICAL")
SENSOR_MM = 36.0
#: Settings of Blender's scene, and of a camera's data.
RENDER = ("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x",
          "pixel_aspect_y")  # fmt: skip
DATA = ("type", "lens", "sensor_width", "sensor_height", "sensor_fit", "shift_x", "shift_y")


def read_blender(path: FilePath, *, size: Size | None = None) -> Cameras:
    """Return the cameras of a JSON of Blender settings, by name.

    Either one object with the fields of `write_blender`, or `{"cameras": {name: object}}`. Fields
    that are left out have Blender's values: `sensor_width` 36, `sensor_height` 24, `sensor_fit`
    AUTO, shifts 0, percentage 100, pixel aspects 1. The resolution may come as `size`.

    Raises ValueError naming file and field where something is missing or wrong; `type` other than
    PERSP, too.

    ```python
    pj.formats.write_blender("blender.json", {"left.png": camera})
    cameras = pj.formats.read_blender("blender.json")
    ```
    """
    return json_cameras(path, lambda fields: _camera(fields, size))


def write_blender(path: FilePath, cameras: NamedCameras) -> None:
    """Write the settings of Blender's cameras as JSON: see `to_blender`.

    ```python
    pj.formats.write_blender("blender.json", {"left.png": camera})
    ```
    """
    check_cameras(cameras)
    parts = {name: to_blender(camera) for name, camera in cameras.items()}
    save_json(path, {"schema": SCHEMA, "cameras": parts})


def to_blender(camera: Camera) -> dict[str, object]:
    """Return Blender's settings of a camera: lens and sensor in mm, shifts, resolution, pose.

    `sensor_fit` is HORIZONTAL: the sensor of 36 mm spans the image's width, so
    `2 atan(36/(2 lens))` is the horizontal field of view. Blender itself keeps 32-bit floats.

    ```python
    pj.formats.to_blender(camera)["lens"]
    ```
    """
    view = pinhole(camera)
    tall = view.fx / view.fy  # a pixel's height over its width
    return {
        "type": "PERSP",
        "lens": view.fx * SENSOR_MM / view.W,
        "sensor_width": SENSOR_MM,
        "sensor_height": SENSOR_MM * tall * view.H / view.W,
        "sensor_fit": "HORIZONTAL",
        "shift_x": 0.5 - view.cx / view.W,
        "shift_y": (view.cy - view.H / 2) * tall / view.W,
        "resolution_x": view.W,
        "resolution_y": view.H,
        "resolution_percentage": 100,
        "pixel_aspect_x": max(1.0, 1 / tall),  # Blender takes none below 1
        "pixel_aspect_y": max(1.0, tall),
        "matrix_world": world_from_camera(camera, OPENGL).tolist(),
    }


def to_blender_script(cameras: NamedCameras) -> str:
    """Return a Python script that creates these cameras when run in Blender.

    In Blender's text editor, or as `blender --python FILE`. The last camera becomes the scene's.
    Resolution and pixel aspect belong to Blender's scene: cameras must share them. Blender's names
    have 1 to 63 bytes; a longer one it would cut.

    ```python
    print(pj.formats.to_blender_script({"left": camera})[:60])
    ```
    """
    check_cameras(cameras, "Blender", lambda name: 0 < len(name.encode()) < 64 and "\0" not in name)
    settings: dict[str, dict[str, Any]] = {
        name: to_blender(camera) for name, camera in cameras.items()
    }
    first = next(iter(settings.values()))
    render = {field: first[field] for field in RENDER}
    for name, own in settings.items():
        if any(abs(own[field] - value) > 1e-9 for field, value in render.items()):
            raise ValueError(
                "`cameras`: expected one resolution and pixel aspect in a Blender scene, got"
                f" others in {name!r} than in {next(iter(settings))!r}; write one script each"
            )
    poses = {
        name: ({field: own[field] for field in DATA}, own["matrix_world"])
        for name, own in settings.items()
    }
    return SCRIPT.format(render=render, cameras=poses)


def write_blender_script(path: FilePath, cameras: NamedCameras) -> None:
    """Write the script of `to_blender_script`.

    ```python
    pj.formats.write_blender_script("left.py", {"left": camera})
    ```
    """
    replace_file(path, to_blender_script(cameras).encode())


SCRIPT = """\
# Creates cameras. Run it in Blender: in its text editor, or as `blender --python THIS_FILE`.
import bpy
from mathutils import Matrix

RENDER = {render!r}
# name: (settings, matrix_world: x right, y up, z backward)
CAMERAS = {cameras!r}

scene = bpy.context.scene
for field, value in RENDER.items():
    setattr(scene.render, field, value)
for name, (settings, matrix) in CAMERAS.items():
    data = bpy.data.cameras.new(name)
    for field, value in settings.items():
        setattr(data, field, value)
    camera = bpy.data.objects.new(name, data)
    scene.collection.objects.link(camera)
    camera.matrix_world = Matrix(matrix)
    scene.camera = camera
"""


def _camera(fields: Fields, size: Size | None) -> Camera:
    fields.text("type", ("PERSP",), "PERSP")
    W, H = fields.size("resolution_x", "resolution_y", size)
    percentage = fields.positive("resolution_percentage", 100)
    W, H = (max(1, int(n * percentage / 100)) for n in (W, H))  # Blender cuts the fraction off
    tall = fields.positive("pixel_aspect_y", 1) / fields.positive("pixel_aspect_x", 1)
    fit = fields.text("sensor_fit", FITS, "AUTO")
    sensor = ("sensor_height", 24) if fit == "VERTICAL" else ("sensor_width", SENSOR_MM)
    horizontal = fit == "HORIZONTAL" or (fit == "AUTO" and H * tall <= W)
    side = W if horizontal else H * tall  # in widths of a pixel
    fx = fields.positive("lens") * side / fields.positive(*sensor)
    cx = W / 2 - fields.number("shift_x", 0) * side
    cy = H / 2 + fields.number("shift_y", 0) * side / tall
    view = Pinhole(fx, fx / tall, cx, cy, W, H)
    return camera_from_pinhole(view, read_pose(fields, "matrix_world"), OPENGL, fields)
