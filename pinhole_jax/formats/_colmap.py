"""COLMAP models: a folder of cameras and images, as text (.txt) or binary (.bin).

Axes: x right, y down, z forward; quaternion (w, x, y, z) and translation are camera_from_world.
Focal lengths in px, no field of view. Pixel centres lie at halves: the image's top-left corner is
(0, 0), y down. Format: colmap.github.io/format.html.
"""

import os
import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._camera import Camera
from .._distortion import BrownConrady, Fisheye
from ._fields import Fields, add_named, read_bytes, read_text, save_bytes, save_text
from ._pinhole import (
    OPENCV,
    Pinhole,
    camera_from_world,
    camera_of,
    distortion_of,
    inverse,
    model_of,
    pinhole,
)
from ._turns import matrix_of_quaternion, quaternion_of_matrix

#: COLMAP's models by number, with their parameters; distortion is what is not f, fx, fy, cx, cy.
MODELS = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
}
PARAMETERS = {name: parameters.split() for name, parameters in MODELS.values()}
PARTS = ("cameras", "images", "points3D")


def read_colmap(folder: str | os.PathLike) -> dict[str, Camera]:
    """Return the cameras of a COLMAP model, by image name.

    Reads cameras and images, binary if there are both kinds. Points are not read.

    Raises FileNotFoundError, or ValueError naming file and field where something is missing,
    truncated or wrong, and where the camera model is none of OpenCV's (FOV, thin prisms, ...) or
    FULL_OPENCV with k4, k5 or k6 that is not zero.
    """
    place = Path(folder)
    for ending, read in ((".bin", _read_binary), (".txt", _read_text)):
        files = [place / f"{part}{ending}" for part in ("cameras", "images")]
        if all(file.exists() for file in files):
            intrinsics, images = read(*files)
            break
    else:
        raise FileNotFoundError(
            "`folder`: expected a COLMAP model (cameras.txt and images.txt, or .bin), got"
            f" {str(folder)!r}"
        )
    cameras: dict[str, Camera] = {}
    for name, pose in images:
        key = pose.data["CAMERA_ID"]
        if key not in intrinsics:
            raise pose.wrong("CAMERA_ID", f"a camera of {str(files[0])!r}", f"{key}")
        camera = _camera(intrinsics[key], pose)
        add_named(cameras, name, camera, repr(str(files[1])))
    return cameras


def write_colmap(
    folder: str | os.PathLike, cameras: Mapping[str, Camera], *, binary: bool = False
) -> None:
    """Write a COLMAP model without points: cameras, images, points3D.

    Cameras are PINHOLE, with distortion OPENCV (FULL_OPENCV if k3 is not zero) or OPENCV_FISHEYE.
    The cameras' names become image names; equal intrinsics are written once.

    Raises ValueError where the folder holds a model of the other kind, or rigs and frames: COLMAP
    would read those, or take them together.
    """
    place, ending = Path(folder), ".bin" if binary else ".txt"
    other = ".txt" if binary else ".bin"
    stale = [f"{part}{other}" for part in (*PARTS, "rigs", "frames")]
    stale += [f"rigs{ending}", f"frames{ending}"]
    found = [name for name in stale if (place / name).exists()]
    if found:
        raise ValueError(f"`folder`: expected none of another model, got {found[0]} in {folder!s}")
    for name in cameras:
        if not name or name.split() != name.split(" ") or "\0" in name:
            raise ValueError(f"`cameras`: expected names COLMAP can hold, got {name!r}")
    views: dict[View, int] = {}
    keys = [views.setdefault(_view(camera), len(views) + 1) for camera in cameras.values()]
    poses = [_quaternion_and_translation(camera) for camera in cameras.values()]
    images = list(zip(keys, poses, cameras, strict=True))
    if binary:
        data = _binary(views, images)
        for part in PARTS:
            save_bytes(place / f"{part}.bin", data[part])
    else:
        texts = _text(views, images)
        for part in PARTS:
            save_text(place / f"{part}.txt", texts[part])


def _camera(intrinsics: Fields, pose: Fields) -> Camera:
    number = intrinsics.number
    fx, fy = ("f", "f") if "f" in intrinsics else ("fx", "fy")
    view = Pinhole(
        intrinsics.positive(fx),
        intrinsics.positive(fy),
        number("cx"),
        number("cy"),
        intrinsics.integer("WIDTH"),
        intrinsics.integer("HEIGHT"),
    )
    plain = {"f", "fx", "fy", "cx", "cy", "WIDTH", "HEIGHT"}
    fisheye = bool(number("FISHEYE"))
    plain.add("FISHEYE")
    bent = {name: number(name) for name in intrinsics.data if name not in plain}
    distortion = model_of(bent, intrinsics, fisheye)
    q = pose.array("QUATERNION", (4,))
    if abs(np.linalg.norm(q) - 1) > 1e-4:
        raise pose.wrong("QUATERNION", "one of length 1", q)
    matrix = np.eye(4)
    matrix[:3, :3] = matrix_of_quaternion(q)
    matrix[:3, 3] = pose.array("TRANSLATION", (3,))
    return camera_of(view, inverse(matrix), OPENCV, intrinsics, distortion)


def _quaternion_and_translation(camera: Camera) -> list[float]:
    matrix = camera_from_world(camera, OPENCV)
    return [*quaternion_of_matrix(matrix[:3, :3]).tolist(), *matrix[:3, 3].tolist()]


def _fields_of(model: str, size: Any, parameters: Any, where: str) -> Fields:
    names = PARAMETERS.get(model)
    if names is None:
        raise ValueError(f"`MODEL`: expected one of {', '.join(PARAMETERS)}, got {model} ({where})")
    if len(parameters) != len(names):
        raise ValueError(
            f"`PARAMS`: expected {len(names)} numbers ({', '.join(names)}) of {model}, got"
            f" {len(parameters)} ({where})"
        )
    values = dict(zip(names, parameters, strict=True))
    fisheye = float(model.endswith("FISHEYE"))
    return Fields({"WIDTH": size[0], "HEIGHT": size[1], "FISHEYE": fisheye, **values}, where)


def _pose_of(numbers: Any, camera: int, where: str) -> Fields:
    data = {"QUATERNION": numbers[:4], "TRANSLATION": numbers[4:], "CAMERA_ID": camera}
    return Fields(data, where)


def _read_text(cameras: Path, images: Path) -> tuple[dict[int, Fields], list[tuple[str, Fields]]]:
    intrinsics = {}
    for number, line in _lines(cameras):
        where = f"{str(cameras)!r}, line {number}"
        words = line.split()
        if not words:
            continue
        if len(words) < 5:
            raise ValueError(
                f"expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line!r} ({where})"
            )
        values = _numbers([words[0], *words[2:]], where)
        if values[0] in intrinsics:
            raise ValueError(f"`CAMERA_ID`: expected each once, got {words[0]} twice ({where})")
        intrinsics[int(values[0])] = _fields_of(words[1], values[1:3], values[3:], where)
    found, lines = [], _lines(images)
    for number, line in lines:
        where = f"{str(images)!r}, line {number}"
        words = line.split(maxsplit=9)
        if not words:
            continue
        if len(words) < 10:
            raise ValueError(
                f"expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line!r} ({where})"
            )
        values = _numbers(words[:9], where)
        found.append((words[9].strip(), _pose_of(values[1:8], int(values[8]), where)))
        number, points = next(lines, (number + 1, ""))
        _check_points(points, f"{str(images)!r}, line {number}")
    _check_count(cameras, len(intrinsics))
    _check_count(images, len(found))
    return intrinsics, found


def _lines(file: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if not line.startswith("#"):
            yield number, line


def _numbers(words: list[str], where: str) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise ValueError(f"expected numbers, got {error} ({where})") from None


def _check_points(line: str, where: str) -> None:
    """An image's second line: X Y POINT3D_ID, again and again. A pose there was taken for it."""
    words = line.split()
    if len(words) % 3 or not all(re.fullmatch(r"-?\d+", word) for word in words[2::3]):
        raise ValueError(
            "expected the image's points (X Y POINT3D_ID, or an empty line), got"
            f" {line[:60]!r} ({where})"
        )


def _check_count(file: Path, count: int) -> None:
    said = re.search(r"^# Number of (?:cameras|images): (\d+)", read_text(file), re.MULTILINE)
    if said is not None and int(said[1]) != count:
        raise ValueError(
            f"expected {said[1]} entries, as its heading says, got {count} (in {str(file)!r})"
        )


def _read_binary(cameras: Path, images: Path) -> tuple[dict[int, Fields], list[tuple[str, Fields]]]:
    intrinsics, reader = {}, _Reader(cameras)
    for _ in range(reader.take("<Q")[0]):
        key, model, W, H = reader.take("<IiQQ")
        where = f"{str(cameras)!r}, camera {key}"
        if model not in MODELS:
            raise ValueError(
                f"`MODEL`: expected one of {', '.join(PARAMETERS)}, got number {model} ({where})"
            )
        name, parameters = MODELS[model]
        values = reader.take(f"<{len(parameters.split())}d")
        intrinsics[key] = _fields_of(name, (W, H), values, where)
    reader.end()
    found, reader = [], _Reader(images)
    for _ in range(reader.take("<Q")[0]):
        key, *numbers, camera = reader.take("<I7dI")
        name = reader.name()
        found.append((name, _pose_of(numbers, camera, f"{str(images)!r}, image {key}")))
        reader.skip(24 * reader.take("<Q")[0])
    reader.end()
    return intrinsics, found


class _Reader:
    """Little-endian values of a file, one after the other; never past its end."""

    def __init__(self, file: Path):
        self.file = file
        self.data = read_bytes(file)
        self.at = 0

    def skip(self, count: int) -> int:
        start, self.at = self.at, self.at + count
        if self.at > len(self.data):
            raise ValueError(
                f"expected more than {len(self.data)} bytes, got the end (in {str(self.file)!r})"
            )
        return start

    def take(self, form: str) -> tuple:
        return struct.unpack_from(form, self.data, self.skip(struct.calcsize(form)))

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        start = self.skip((end if end >= 0 else len(self.data)) + 1 - self.at)
        return self.data[start : self.at - 1].decode("utf-8", "replace")

    def end(self) -> None:
        if self.at != len(self.data):
            raise ValueError(
                f"expected {self.at} bytes, got {len(self.data)} (in {str(self.file)!r})"
            )


class View(NamedTuple):
    """Intrinsics as a COLMAP model has them: its number, and its parameters in order."""

    model: int
    W: int
    H: int
    parameters: tuple[float, ...]


def _view(camera: Camera) -> View:
    view, distortion = pinhole(camera, bent=True), distortion_of(camera)
    number = 5 if isinstance(distortion, Fisheye) else 1
    if isinstance(distortion, BrownConrady):
        number = 6 if float(distortion.k3) else 4
    values = {**view._asdict(), **({} if distortion is None else distortion.coefficients())}
    names = MODELS[number][1].split()
    return View(number, view.W, view.H, tuple(values.get(name, 0.0) for name in names))


def _text(views: dict[View, int], images: list) -> dict[str, str]:
    words = lambda values: " ".join(map(repr, values))
    cameras = "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n" + "".join(
        f"{key} {MODELS[v.model][0]} {v.W} {v.H} {words(v.parameters)}\n"
        for v, key in views.items()
    )
    poses = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its points: none\n" + "".join(
        f"{k} {words(pose)} {key} {name}\n\n" for k, (key, pose, name) in enumerate(images, 1)
    )
    return {"cameras": cameras, "images": poses, "points3D": "# no points\n"}


def _binary(views: dict[View, int], images: list) -> dict[str, bytes]:
    cameras = struct.pack("<Q", len(views)) + b"".join(
        struct.pack(f"<IiQQ{len(v.parameters)}d", key, v.model, v.W, v.H, *v.parameters)
        for v, key in views.items()
    )
    poses = struct.pack("<Q", len(images)) + b"".join(
        struct.pack("<I7dI", k, *pose, key) + name.encode() + b"\0" + struct.pack("<Q", 0)
        for k, (key, pose, name) in enumerate(images, 1)
    )
    return {"cameras": cameras, "images": poses, "points3D": struct.pack("<Q", 0)}
