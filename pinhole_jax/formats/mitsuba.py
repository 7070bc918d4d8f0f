"""Mitsuba XML sensors, `<sensor type="perspective">`.

Axes: x left, y up, z forward; `to_world` is world_from_camera. `fov` is in degrees, and `fov_axis`
names the side: x (the default: HORIZONTAL), y (vertical), diagonal, smaller or larger.
`principal_point_offset_x` and `principal_point_offset_y` are fractions of the film's width and
height, positive where the principal point moves left and up. Film positions count from its edges:
pixel centres at halves.
"""

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from xml.sax.saxutils import quoteattr

import numpy as np

from .._camera.camera import Camera
from .._files.paths import read_text
from .fields import (
    KIND,
    Fields,
    Size,
    add_named,
    check_cameras,
    number,
    parse_xml,
    save_text,
    short,
)
from .pinhole import (
    LEFT_UP_FORWARD,
    Pinhole,
    camera_of,
    focal_of_fov,
    fov_of_focal,
    pinhole,
    rigid,
    world_from_camera,
)
from .rotations import matrix_of_vector
from .unknown import unknown

AXES = ("x", "y", "diagonal", "smaller", "larger")
FILM = {"width": 768, "height": 576}  # Mitsuba's own, where a film says nothing
#: Characters that XML 1.0 cannot hold, escaped or not.
NO_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
#: The longest name of a `<default>`, and the longest attribute once it is filled in.
MOST_NAME, MOST_TEXT, MOST_DEFAULTS = 64, 1 << 16, 1 << 20


def read_mitsuba(path: str | os.PathLike[str], *, size: Size | None = None) -> dict[str, Camera]:
    """Return the perspective sensors of a Mitsuba scene, by `id`, or "sensor", "sensor_1" ...

    What a scene leaves out has Mitsuba's values: fov_axis x, 50 mm (of a 36 x 24 mm film's
    diagonal), 768 x 576 px. `size` is for a sensor without a film. `$names` take their `<default>`.

    Raises ValueError naming file and field where something is missing or wrong: another type of
    sensor, a transform that scales or mirrors, an unknown transform, a property given twice.

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
    defaults = _defaults(root, repr(str(path)))
    sensors = [root] if root.tag == "sensor" else list(root.iter("sensor"))
    if not sensors:
        raise ValueError(f"`sensor`: expected one in a Mitsuba scene, got none (in {str(path)!r})")
    cameras: dict[str, Camera] = {}
    for k, sensor in enumerate(sensors):
        name = sensor.get("id") or (f"sensor_{k}" if k else "sensor")
        camera = _read(sensor, defaults, f"{str(path)!r}, sensor {short(name)}", size)
        add_named(cameras, name, camera, repr(str(path)))
    return cameras


def write_mitsuba(path: str | os.PathLike[str], cameras: Mapping[str, Camera]) -> None:
    """Write perspective sensors, `fov_axis` y, as a Mitsuba 3 scene of nothing else.

    Raises ValueError for a camera whose pixels are not square (Mitsuba has no other), and for a
    name that XML cannot hold, or that holds a `$`, which Mitsuba fills in.

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
            fov=float(np.rad2deg(fov_of_focal(view.fy, view.H))),
            x=0.5 - view.cx / view.W,
            y=0.5 - view.cy / view.H,
            matrix=" ".join(repr(float(m)) for m in matrix.ravel()),
            W=view.W,
            H=view.H,
        )
    save_text(path, text + "</scene>\n")


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


def _defaults(root: ET.Element, where: str) -> dict[str, str]:
    """Return what `$names` stand for; as in Mitsuba, the first of a name holds for what follows."""
    defaults: dict[str, str] = {}
    together = 0
    for element in root.iter("default"):
        name = element.get("name", "")
        if not 0 < len(name) <= MOST_NAME:
            words = f"a name of 1 to {MOST_NAME} characters, got {short(name)}"
            raise ValueError(f"`default`: expected {words} (in {where})")
        defaults.setdefault(name, _filled(element, "value", defaults, where))
        together += len(name) + len(defaults[name])
        if together > MOST_DEFAULTS:
            words = f"values of at most {MOST_DEFAULTS} characters together, got more"
            raise ValueError(f"`default`: expected {words} (in {where})")
    return defaults


def _read(sensor: ET.Element, defaults: Mapping[str, str], where: str, size: Size | None) -> Camera:
    fields = _properties(sensor, defaults, where)
    fields.text("type", ("perspective",))
    film = sensor.find("film")
    if film is None and size is not None:
        full = Fields({"width": size[0], "height": size[1]}, "`size`")
        frame = full.size("width", "height", None)
    else:
        full = _properties(film, defaults, f"{where}, film") if film is not None else fields
        full = Fields({**FILM, **full.data}, full.where)
        frame = full.size("width", "height", size)
    focal = _focal(fields, *frame)
    cx = frame[0] * (0.5 - fields.number("principal_point_offset_x", 0))
    cy = frame[1] * (0.5 - fields.number("principal_point_offset_y", 0))
    W = full.integer("crop_width") if "crop_width" in full else frame[0]
    H = full.integer("crop_height") if "crop_height" in full else frame[1]
    cx -= full.number("crop_offset_x", 0)
    cy -= full.number("crop_offset_y", 0)
    pose = np.eye(4)
    moves = [t for t in sensor.findall("transform") if _snake(t.get("name", "")) == "to_world"]
    if len(moves) > 1 or len(sensor.findall("film")) > 1:
        raise ValueError(f"`to_world`: expected one transform and one film, got two (in {where})")
    with np.errstate(all="ignore"):  # what overflows is no rotation
        for step in (step for move in moves for step in move):
            pose = _step(step, defaults, where) @ pose
    pose = rigid(pose, fields, "to_world")
    return camera_of(Pinhole(focal, focal, cx, cy, W, H), pose, LEFT_UP_FORWARD, fields)


def _properties(element: ET.Element, defaults: Mapping[str, str], where: str) -> Fields:
    """Return an element's type and its named numbers and texts, names as Mitsuba 3 has them."""
    data: dict = {"type": _filled(element, "type", defaults, where, "")}
    for part in element:
        if part.tag in ("float", "integer", "string"):
            name, value = _snake(part.get("name", "")), _filled(part, "value", defaults, where)
            if name in data:
                words = f"expected one such property, got two (in {where})"
                raise ValueError(f"`{name[:60]}`: {words}")
            data[name] = value if part.tag == "string" else _number(name, value, where)
    return Fields(data, where)


def _focal(fields: Fields, W: int, H: int) -> float:
    """Return the focal length in px."""
    if "fov" in fields and "focal_length" in fields:
        raise fields.wrong("fov", "it or focal_length", "both")
    if "fov" not in fields:
        words = fields.text("focal_length", default="50mm")
        focal_mm = _number("focal_length", words.removesuffix("mm"), fields.where)
        lens = Fields({"focal_length": focal_mm}, fields.where).positive("focal_length")
        return float(lens * np.hypot(W, H) / np.hypot(36, 24))
    fov, axis = fields.number("fov"), fields.text("fov_axis", AXES, "x")
    if not 0 < fov < 180:
        raise fields.wrong("fov", "an angle in (0, 180) degrees", f"{fov:g}")
    sides = {
        "x": W,
        "y": H,
        "diagonal": float(np.hypot(W, H)),
        "smaller": min(W, H),
        "larger": max(W, H),
    }
    return focal_of_fov(float(np.deg2rad(fov)), sides[axis])


def _step(element: ET.Element, defaults: Mapping[str, str], where: str) -> np.ndarray:
    """Return one operation of a transform as a (4, 4) matrix."""
    kind = _snake(element.tag)
    vector = lambda name: _vector(element, name, defaults, where)
    matrix = np.eye(4)
    if kind == "matrix":
        values = vector("value")
        if len(values) not in (9, 16):
            words = f"{len(values)} (in {where})"
            raise ValueError(f"`matrix`: expected 9 or 16 numbers, got {words}")
        side = int(len(values) ** 0.5)
        matrix[:side, :side] = values.reshape(side, side)
    elif kind in ("lookat", "look_at"):
        origin, target, up = (vector(name) for name in ("origin", "target", "up"))
        if any(len(v) != 3 for v in (origin, target, up)):
            raise ValueError(f"`lookat`: expected three numbers in each, got others (in {where})")
        forward, left = target - origin, np.cross(up, target - origin)
        if not np.any(forward) or np.linalg.norm(left) < 1e-12 * np.linalg.norm(forward):
            raise ValueError(f"`lookat`: expected up not along the view, got it (in {where})")
        forward, left = forward / np.linalg.norm(forward), left / np.linalg.norm(left)
        matrix[:3] = np.stack([left, np.cross(forward, left), forward, origin], axis=1)
    elif kind == "rotate":
        axis = _xyz(element, 0.0, defaults, where)
        angle = _number("angle", _filled(element, "angle", defaults, where), where)
        if not np.any(axis):
            raise ValueError(f"`rotate`: expected an axis, got none (in {where})")
        rotation = np.deg2rad(angle) * axis / np.linalg.norm(axis)
        matrix[:3, :3] = matrix_of_vector(rotation)
    elif kind == "translate":
        matrix[:3, 3] = _xyz(element, 0.0, defaults, where)
    elif kind == "scale":
        matrix[:3, :3] = np.diag(_xyz(element, 1.0, defaults, where))
    else:
        raise ValueError(
            "`to_world`: expected matrix, lookat, rotate, translate or scale, got"
            f" {element.tag!r} (in {where})"
        )
    return matrix


def _xyz(element: ET.Element, rest: float, defaults: Mapping[str, str], where: str) -> np.ndarray:
    if element.get("value") is None:
        words = [_filled(element, x, defaults, where, str(rest)) for x in "xyz"]
        return np.array([_number(x, word, where) for x, word in zip("xyz", words, strict=True)])
    values = _vector(element, "value", defaults, where)
    if len(values) not in (1, 3):
        raise ValueError(f"`{element.tag}`: expected 3 numbers, got {len(values)} (in {where})")
    return np.broadcast_to(values, (3,))


def _vector(element: ET.Element, name: str, defaults: Mapping[str, str], where: str) -> np.ndarray:
    words = re.split(r"[,\s]+", _filled(element, name, defaults, where).strip())
    return np.array([_number(element.tag, word, where) for word in words])


def _filled(
    element: ET.Element,
    name: str,
    defaults: Mapping[str, str],
    where: str,
    rest: str | None = None,
) -> str:
    """Return an attribute, its `$names` replaced."""
    text = element.get(name, rest)
    if text is None:
        raise ValueError(f"`{element.tag}`: expected the attribute {name!r}, got none (in {where})")
    head, *parts = text.split("$")
    filled, length = [head], len(head)
    for part in parts:  # in one pass: what is filled in is not filled in again
        ends = range(min(len(part), MOST_NAME), 0, -1)
        end = next((n for n in ends if part[:n] in defaults), 0)
        filled.append(defaults[part[:end]] + part[end:] if end else f"${part}")
        length += len(filled[-1])
        if length > MOST_TEXT:
            words = f"at most {MOST_TEXT} characters once it is filled in, got more (in {where})"
            raise ValueError(f"`{name}`: expected {words}")
    return "".join(filled)


def _number(name: str, text: str, where: str) -> float:
    try:
        value = number(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(f"`{name[:60]}`: expected a finite number, got {short(text)} (in {where})")
    return value


def _snake(name: str) -> str:
    """Return a name as Mitsuba 3 writes it: toWorld, of Mitsuba 0.6, is to_world."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()
