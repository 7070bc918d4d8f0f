"""Mitsuba XML sensors, `<sensor type="perspective">`.

Axes: x left, y up, z forward; `to_world` is world_from_camera. `fov` is in degrees, and `fov_axis`
names the side: x (the default: HORIZONTAL), y (vertical), diagonal, smaller or larger.
`principal_point_offset_x` and `principal_point_offset_y` are fractions of the film's width and
height, positive where the principal point moves left and up. Film positions count from its edges:
pixel centres at halves.
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from .._camera.camera import Camera
from .._camera.poses import Pose, exponential, pose_of, rigid
from .._files.fields import Fields, Size, attributes, number_or_text, short
from .._files.paths import FilePath, parse_xml, read_text, replace_file
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
    fov_from_focal,
    pinhole,
    pose_from_matrix,
    world_from_camera,
)
from .unknown import unknown

FILM = {"width": 768, "height": 576}  # Mitsuba's own, where a film says nothing
#: Characters that XML 1.0 cannot hold, escaped or not.
NO_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
#: A small file can stand for a large text: the most characters that defaults add to a file, and the
#: most of a property's name.
MOST_ADDED, MOST_NAME = 1 << 20, 64


def read_mitsuba(path: FilePath, *, size: Size | None = None) -> Cameras:
    """Return the perspective sensors of a Mitsuba scene, by `id`, or "sensor", "sensor_1" ...

    What a scene leaves out has Mitsuba's values: fov_axis x, 50 mm (of a 36 x 24 mm film's
    diagonal), 768 x 576 px. `size` is for a sensor without a film. `$names` take their `<default>`.

    Raises ValueError naming file and field where something is missing or wrong: another type of
    sensor, a property given twice, a transform that scales, mirrors or is unknown.

    ```python
    pj.formats.write_mitsuba("left.xml", {"left.png": camera})
    cameras = pj.formats.read_mitsuba("left.xml")
    ```
    """
    root = parse_xml(read_text(path, KIND), path)
    if root.tag not in ("scene", "sensor"):
        words = "expected Mitsuba's XML (its root is <scene>) or OpenCV's (<opencv_storage>)"
        got = unknown(root.tag) or f"the root <{root.tag[:60]}>"
        raise ValueError(f"`path`: {words}, got {got} (in {str(path)!r})")
    return by_name(_cameras(root, size, repr(str(path))), repr(str(path)))


def write_mitsuba(path: FilePath, cameras: NamedCameras) -> None:
    """Write perspective sensors, `fov_axis` y, as a Mitsuba 3 scene of nothing else.

    Raises ValueError for a camera whose pixels are not square: Mitsuba has no others. Also for
    names that XML cannot hold, or with a `$`, which Mitsuba fills in.

    ```python
    pj.formats.write_mitsuba("left.xml", {"left.png": camera})
    ```
    """
    check_cameras(
        cameras, "Mitsuba", lambda name: name and "$" not in name and not NO_XML.search(name)
    )
    text = '<scene version="3.0.0">\n'
    for name, camera in cameras.items():
        view = pinhole(camera)
        if abs(view.fx / view.fy - 1) > 1e-9:
            raise ValueError(
                "`cameras`: expected square pixels, as Mitsuba has no others, got"
                f" fx/fy = {view.fx / view.fy:g} in {name!r}"
            )
        matrix = world_from_camera(camera, LEFT_UP_FORWARD)
        text += SENSOR.format(
            name=quoteattr(name),
            fov=float(np.rad2deg(fov_from_focal(view.fy, view.H))),
            x=0.5 - view.cx / view.W,
            y=0.5 - view.cy / view.H,
            matrix=" ".join(repr(float(m)) for m in matrix.ravel()),
            W=view.W,
            H=view.H,
        )
    replace_file(path, f"{text}</scene>\n".encode())


SENSOR = """\
  <sensor type="perspective" id={name}>
    <string name="fov_axis" value="y"/>
    <float name="fov" value="{fov!r}"/>
    <float name="principal_point_offset_x" value="{x!r}"/>
    <float name="principal_point_offset_y" value="{y!r}"/>
    <transform name="to_world">
      <matrix value="{matrix}"/>
    </transform>
    <film type="hdrfilm">
      <integer name="width" value="{W}"/>
      <integer name="height" value="{H}"/>
    </film>
  </sensor>
"""


def _cameras(root: ET.Element, size: Size | None, where: str) -> Iterator[tuple[str, Camera]]:
    """Yield the cameras of a scene's sensors, with their names."""
    _fill(root, where)
    sensors = list(root.iter("sensor"))
    if not sensors:
        raise ValueError(f"`sensor`: expected one in a Mitsuba scene, got none (in {where})")
    for k, sensor in enumerate(sensors):
        name = sensor.get("id") or (f"sensor_{k}" if k else "sensor")
        yield name, _camera(sensor, size, f"{where}, sensor {short(name)}")


def _fill(root: ET.Element, where: str) -> None:
    """Replace `$names` in attributes by their defaults: the first of a name holds, and of the names
    that fit the longest, as in Mitsuba."""
    defaults: dict[str, str] = {}
    added = 0
    inside = (element for sensor in root.iter("sensor") for element in sensor.iter())
    for element in (*root.iter("default"), *inside):
        for attribute, text in element.items():
            for name in sorted(defaults, key=len, reverse=True) if "$" in text else ():
                added += text.count(name) * len(defaults[name])
                if added > MOST_ADDED:
                    words = f"values of at most {MOST_ADDED} characters together, got more"
                    raise ValueError(f"`default`: expected {words} (in {where})")
                text = text.replace(name, defaults[name])
            element.set(attribute, text)
        if element.tag == "default" and element.get("name"):
            defaults.setdefault(f"${element.get('name')}", element.get("value", ""))


def _properties(element: ET.Element, where: str) -> Fields:
    """Return an element's type and its named numbers and texts, names as Mitsuba 3's."""
    data: dict[str, Any] = {"type": element.get("type", "")}
    for part in element:
        if part.tag in ("float", "integer", "string"):
            name = _snake(part.get("name", "")[:MOST_NAME])
            if name in data:
                raise ValueError(f"`{name}`: expected one such property, got two (in {where})")
            value = attributes(part, where).get("value", "a value")
            own = Fields({name: value}, where)
            data[name] = value if part.tag == "string" else own.number(name)
    return Fields(data, where)


def _camera(sensor: ET.Element, size: Size | None, where: str) -> Camera:
    fields = _properties(sensor, where)
    fields.text("type", ("perspective",))
    moves = [t for t in sensor.findall("transform") if _snake(t.get("name", "")) == "to_world"]
    films = sensor.findall("film")
    if len(moves) > 1 or len(films) > 1:
        raise fields.wrong("to_world", "one transform and one film", "two")
    own = _properties(films[0], where).data if films else dict(zip(FILM, size or (), strict=False))
    film = Fields({**FILM, **own}, f"{where}, film")
    W, H = film.size("width", "height", size)
    focal = _focal(fields, W, H)
    cx = W * (0.5 - fields.number("principal_point_offset_x", 0)) - film.number("crop_offset_x", 0)
    cy = H * (0.5 - fields.number("principal_point_offset_y", 0)) - film.number("crop_offset_y", 0)
    W, H = film.integer("crop_width", 1, W), film.integer("crop_height", 1, H)
    pose = np.eye(4)
    with np.errstate(all="ignore"):  # what overflows is no rotation
        for step in (step for move in moves for step in move):
            pose = _step(_snake(step.tag), attributes(step, where)) @ pose
    pose = pose_from_matrix(pose, fields, "to_world")
    return camera_from_pinhole(Pinhole(focal, focal, cx, cy, W, H), pose, LEFT_UP_FORWARD, fields)


def _focal(fields: Fields, W: int, H: int) -> float:
    """Return the focal length in px."""
    diagonal = float(np.hypot(W, H))
    if "fov" not in fields:
        words = str(fields.data.get("focal_length", "50mm"))
        film = Fields({"focal_length": number_or_text(words.removesuffix("mm"))}, fields.where)
        return film.positive("focal_length") * diagonal / float(np.hypot(36, 24))
    if "focal_length" in fields:
        raise fields.wrong("fov", "it or focal_length", "both")
    fov = fields.number("fov", None, "an angle in (0, 180) degrees", 0, 180)
    sides = {"x": W, "y": H, "diagonal": diagonal, "smaller": min(W, H), "larger": max(W, H)}
    return focal_from_fov(np.deg2rad(fov), sides[fields.text("fov_axis", [*sides], "x")])


def _step(kind: str, fields: Fields) -> Pose:
    """Return one operation of a transform as a (4, 4) matrix."""
    if kind == "matrix":
        numbers = fields.array("value", (9,), (16,))
        n, result = math.isqrt(numbers.size), np.eye(4)
        result[:n, :n] = numbers.reshape(n, n)
        return result
    if kind in ("lookat", "look_at"):
        origin, target, up = (fields.array(name, (3,)) for name in ("origin", "target", "up"))
        try:
            looking = Camera(origin, target, up, 1.0, 1.0, 1, 1)
        except ValueError:
            raise fields.wrong("up", "another direction than the view's", up) from None
        return pose_of(looking) @ LEFT_UP_FORWARD
    if kind not in ("rotate", "translate", "scale"):
        raise fields.wrong("to_world", "matrix, lookat, rotate, translate or scale", repr(kind))
    each = [fields.number(x, kind == "scale") for x in "xyz"]
    xyz = np.broadcast_to(fields.array("value", (3,), (), default=each), 3)
    if kind == "scale":
        return np.diag([*xyz, 1.0])
    if kind == "translate":
        return rigid(np.eye(3), xyz)
    if not np.any(xyz):
        raise fields.wrong("rotate", "an axis", "none")
    turn = np.deg2rad(fields.number("angle")) * xyz / np.linalg.norm(xyz)
    return exponential(np.r_[turn, np.zeros(3)])


def _snake(name: str) -> str:
    """Return a name as Mitsuba 3 writes it: toWorld, of Mitsuba 0.6, is to_world."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
