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

from .._camera.camera import Camera
from .._camera.distortion import BrownConrady, Distortion, Fisheye, Rational
from .._camera.poses import inverse, rigid
from .._files.paths import opened, replace_file
from .fields import KIND, Fields, add_named, check_cameras, number, save_text, short
from .pinhole import (
    OPENCV,
    Pinhole,
    camera_from_world,
    camera_of,
    model_of,
    pinhole,
)
from .rotations import is_unit, rotations

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
#: The most bytes of an image's name (a path, on any system), of a line, and of a file, whose points
#: are passed over.
MOST_NAME, MOST_LINE, MOST_MODEL = 4096, 1 << 26, 1 << 36


def read_colmap(folder: str | os.PathLike[str]) -> dict[str, Camera]:
    """Return the cameras of a COLMAP model, by image name.

    Reads cameras and images, binary if there are both kinds. Points are not read.

    Raises FileNotFoundError, or ValueError naming file and field where something is missing,
    truncated or wrong, and where the camera model is none of OpenCV's (FOV, thin prisms, ...).

    ```python
    pj.formats.write_colmap("model", {"left.png": camera})
    cameras = pj.formats.read_colmap("model")
    ```
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
    folder: str | os.PathLike[str], cameras: Mapping[str, Camera], *, binary: bool = False
) -> None:
    """Write a COLMAP model without points: cameras, images, points3D.

    Cameras are PINHOLE, with distortion OPENCV (FULL_OPENCV if k3 is not zero) or OPENCV_FISHEYE.
    The cameras' names become image names; equal intrinsics are written once.

    Raises ValueError for names that are empty, long or, in text, hold white space, where COLMAP
    would end them; and where the folder holds a model of the other kind, or rigs and frames: COLMAP
    would read those, or take them together.

    ```python
    pj.formats.write_colmap("model", {"left.png": camera})
    ```
    """
    place, ending = Path(folder), ".bin" if binary else ".txt"
    if place.exists() and not place.is_dir():
        raise ValueError(f"`folder`: expected a folder, got {str(folder)!r}: something else")
    other = ".txt" if binary else ".bin"
    stale = [f"{part}{other}" for part in (*PARTS, "rigs", "frames")]
    stale += [f"rigs{ending}", f"frames{ending}"]
    found = [name for name in stale if (place / name).exists()]
    if found:
        raise ValueError(f"`folder`: expected none of another model, got {found[0]} in {folder!s}")
    check_cameras(cameras, "COLMAP", lambda name: _can_hold(name, binary))
    views: dict[View, int] = {}
    keys = [views.setdefault(_view(camera), len(views) + 1) for camera in cameras.values()]
    poses = [_quaternion_and_translation(camera) for camera in cameras.values()]
    images = list(zip(keys, poses, cameras, strict=True))
    if binary:
        data = _binary(views, images)
        for part in PARTS:
            replace_file(place / f"{part}.bin", data[part])
    else:
        texts = _text(views, images)
        for part in PARTS:
            save_text(place / f"{part}.txt", texts[part])


def _can_hold(name: str, binary: bool) -> bool:
    in_one = binary or name.split() == [name]
    return in_one and "\0" not in name and 0 < len(name.encode()) <= MOST_NAME


def colmap_intrinsics(file: Path) -> dict[str, tuple[Pinhole, Distortion | None]]:
    """Return the intrinsics and lenses of a model's cameras.txt or .bin, by their numbers."""
    read = _binary_cameras if file.suffix == ".bin" else _text_cameras
    return {str(key): _intrinsics(fields) for key, fields in read(file).items()}


def _intrinsics(intrinsics: Fields) -> tuple[Pinhole, Distortion | None]:
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
    distorted = {name: number(name) for name in intrinsics.data if name not in plain}
    models = (Fisheye,) if fisheye else (BrownConrady, Rational)
    return view, model_of(distorted, intrinsics, models)


def _camera(intrinsics: Fields, pose: Fields) -> Camera:
    view, distortion = _intrinsics(intrinsics)
    q = pose.array("QUATERNION", (4,))
    if not is_unit(q):
        raise pose.wrong("QUATERNION", "one of length 1", q)
    R = rotations().from_quat(q[[1, 2, 3, 0]]).as_matrix()
    matrix = rigid(R, pose.array("TRANSLATION", (3,)))
    return camera_of(view, inverse(matrix), OPENCV, intrinsics, distortion)


def _quaternion_and_translation(camera: Camera) -> list[float]:
    matrix = camera_from_world(camera, OPENCV)
    *xyz, w = rotations().from_matrix(matrix[:3, :3]).as_quat(canonical=True).tolist()
    return [w, *xyz, *matrix[:3, 3].tolist()]


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


def _text_cameras(cameras: Path) -> dict[int, Fields]:
    intrinsics: dict[int, Fields] = {}
    for where, line in _lines(cameras):
        words = line.split()
        if not words:
            continue
        if len(words) < 5:
            raise ValueError(
                f"expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {short(line)} ({where})"
            )
        key, values = _id("CAMERA_ID", words[0], where), _numbers(words[2:], where)
        fields = _fields_of(words[1], values[:2], values[2:], where)
        _add(intrinsics, "CAMERA_ID", key, fields, where)
    _check_count(cameras, len(intrinsics))
    return intrinsics


def _read_text(cameras: Path, images: Path) -> tuple[dict[int, Fields], list[tuple[str, Fields]]]:
    intrinsics = _text_cameras(cameras)
    found: dict[int, tuple[str, Fields]] = {}
    lines = _lines(images)
    for where, line in lines:
        words = line.split(maxsplit=9)
        if not words:
            continue
        if len(words) < 10:
            raise ValueError(
                "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got"
                f" {short(line)} ({where})"
            )
        key, camera = _id("IMAGE_ID", words[0], where), _id("CAMERA_ID", words[8], where)
        pose = _pose_of(_numbers(words[1:8], where), camera, where)
        _add(found, "IMAGE_ID", key, (words[9].strip(), pose), where)
        _check_points(*next(lines, (where, "")))
    _check_count(images, len(found))
    return intrinsics, list(found.values())


def _lines(file: Path, comments: bool = False) -> Iterator[tuple[str, str]]:
    """Yield where a line is, and the line, one after the other: the points need not fit memory."""
    with opened(file, KIND, MOST_MODEL) as stream:
        for number, raw in enumerate(iter(lambda: stream.readline(MOST_LINE), b""), 1):
            where = f"{str(file)!r}, line {number}"
            if len(raw) == MOST_LINE:
                raise ValueError(f"expected less than {MOST_LINE} bytes in a line ({where})")
            try:
                line = raw.decode("utf-8" if number > 1 else "utf-8-sig")
            except UnicodeDecodeError:
                raise ValueError(f"expected text, got bytes that are no UTF-8 ({where})") from None
            if comments or not line.startswith("#"):
                yield where, line


def _id(name: str, word: str, where: str) -> int:
    """Return a number that names a camera or an image."""
    if not re.fullmatch(r"[0-9]{1,10}", word):
        raise ValueError(f"`{name}`: expected a whole number, got {short(word)} ({where})")
    return int(word)


def _add(known: dict, name: str, key: int, value: Any, where: str) -> None:
    if key in known:
        raise ValueError(f"`{name}`: expected each once, got {key} twice ({where})")
    known[key] = value


def _numbers(words: list[str], where: str) -> list[float]:
    try:
        return [number(word) for word in words]
    except ValueError as error:
        raise ValueError(f"expected numbers, got {str(error)[:99]} ({where})") from None


def _check_points(where: str, line: str) -> None:
    """An image's second line: X Y POINT3D_ID, again and again. A pose there was taken for it."""
    words = line.split()
    if len(words) % 3 or not all(re.fullmatch(r"-?\d+", word) for word in words[2::3]):
        raise ValueError(
            "expected the image's points (X Y POINT3D_ID, or an empty line), got"
            f" {line[:60]!r} ({where})"
        )


def _check_count(file: Path, count: int) -> None:
    """The heading, where there is one, says how many entries there are."""
    for where, line in _lines(file, comments=True):
        if not line.startswith("#"):
            return
        said = re.match(r"# Number of (?:cameras|images): (\d{1,18})", line)
        if said is not None and int(said[1]) != count:
            words = f"{said[1]} entries, as its heading says, got {count}"
            raise ValueError(f"expected {words} ({where})")


def _binary_cameras(cameras: Path) -> dict[int, Fields]:
    intrinsics: dict[int, Fields] = {}
    with _Reader(cameras) as reader:
        for _ in range(reader.take("<Q")[0]):
            key, model, W, H = reader.take("<IiQQ")
            where = f"{str(cameras)!r}, camera {key}"
            if model not in MODELS:
                words = f"one of {', '.join(PARAMETERS)}, got number {model}"
                raise ValueError(f"`MODEL`: expected {words} ({where})")
            name, parameters = MODELS[model]
            values = reader.take(f"<{len(parameters.split())}d")
            _add(intrinsics, "CAMERA_ID", key, _fields_of(name, (W, H), values, where), where)
    return intrinsics


def _read_binary(cameras: Path, images: Path) -> tuple[dict[int, Fields], list[tuple[str, Fields]]]:
    intrinsics = _binary_cameras(cameras)
    found: dict[int, tuple[str, Fields]] = {}
    with _Reader(images) as reader:
        for _ in range(reader.take("<Q")[0]):
            key, *numbers, camera = reader.take("<I7dI")
            where = f"{str(images)!r}, image {key}"
            name = reader.name(where)
            _add(found, "IMAGE_ID", key, (name, _pose_of(numbers, camera, where)), where)
            reader.skip(24 * reader.take("<Q")[0])
    return intrinsics, list(found.values())


class _Reader:
    """Little-endian values of a file, one after the other; from its beginning to its end."""

    def __init__(self, file: Path):
        self.file = file
        self.stream = opened(file, KIND, MOST_MODEL)
        self.size = os.fstat(self.stream.fileno()).st_size

    def __enter__(self) -> "_Reader":
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        at = self.stream.tell()
        self.stream.close()
        if kind is None and at != self.size:
            raise ValueError(f"expected {at} bytes, got {self.size} (in {str(self.file)!r})")

    def skip(self, count: int) -> None:
        if self.stream.tell() + count > self.size:
            raise self._ends()
        self.stream.seek(count, os.SEEK_CUR)

    def take(self, form: str) -> tuple:
        data = self.stream.read(struct.calcsize(form))
        if len(data) < struct.calcsize(form):
            raise self._ends()
        return struct.unpack(form, data)

    def name(self, where: str) -> str:
        data = b""
        while (byte := self.stream.read(1)) != b"\0":
            data += byte
            if not byte:
                raise self._ends()
            if len(data) > MOST_NAME:
                raise ValueError(f"`NAME`: expected at most {MOST_NAME} bytes, got more ({where})")
        try:
            return data.decode("utf-8")
        except UnicodeDecodeError:
            raise ValueError(f"`NAME`: expected UTF-8, got {data[:60]!r} ({where})") from None

    def _ends(self) -> ValueError:
        words = f"expected more than {self.size} bytes, got the end"
        return ValueError(f"{words} (in {str(self.file)!r})")


class View(NamedTuple):
    """Intrinsics as a COLMAP model has them: its number, and its parameters in order."""

    model: int
    W: int
    H: int
    parameters: tuple[float, ...]


def _view(camera: Camera) -> View:
    view, distortion = pinhole(camera, distorted=True), camera.distortion
    number = 5 if isinstance(distortion, Fisheye) else 1
    if isinstance(distortion, BrownConrady):
        number = 6 if float(distortion.k3) else 4
    if isinstance(distortion, Rational):
        number = 6
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
