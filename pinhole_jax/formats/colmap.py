"""COLMAP models: a folder of cameras and images, as text (.txt) or binary (.bin).

Axes: x right, y down, z forward; quaternion (w, x, y, z) and translation are camera_from_world.
Focal lengths in px, no field of view. Pixel centres lie at halves: the image's top-left corner is
(0, 0), y down. Format: colmap.github.io/format.html.
"""

import os
import re
import struct
from collections.abc import Container, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

from .._camera.camera import Camera
from .._camera.distortion import BrownConrady, Fisheye, Rational
from .._camera.poses import inverse, pose_of, rigid
from .._files.fields import Fields, number_or_text, short
from .._files.paths import FilePath, open_file, replace_file
from .pinhole import (
    KIND,
    OPENCV,
    Cameras,
    NamedCameras,
    Pinhole,
    by_name,
    camera_from_pinhole,
    check_cameras,
    pinhole,
    read_distortion,
)

#: COLMAP's models by name: their numbers, and parameters; what is not f, fx, fy, cx, cy is
#: distortion.
MODELS = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": (8, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, "f cx cy k1 k2"),
}
#: The same by number.
NUMBERED = {number: (name, names) for name, (number, names) in MODELS.items()}
PARTS = ("cameras", "images", "points3D")
#: The most bytes of an image's name (a path, on any system), of a line, and of a file, whose points
#: are passed over.
MOST_NAME, MOST_LINE, MOST_MODEL = 4096, 1 << 26, 1 << 36

#: A camera's intrinsics, and their place in the file.
Intrinsics = tuple[Pinhole, Fields]
#: The values of a line or a binary record, in the order of `COLUMNS`, and the record's place.
Record = tuple[Sequence[Any], str]
COLUMNS = {
    "cameras": "CAMERA_ID MODEL WIDTH HEIGHT PARAMS",
    "images": "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME",
}
#: How a binary record begins.
FORMS = {"cameras": "<IiQQ", "images": "<I7dI"}


def read_colmap(folder: FilePath) -> Cameras:
    """Return the cameras of a COLMAP model, by image name.

    Reads cameras and images, binary if there are both kinds. Points are not read.

    Raises FileNotFoundError, or ValueError naming file and field where something is missing,
    truncated or wrong. Of the camera models, OpenCV's are read (no FOV, no thin prisms).

    ```python
    pj.formats.write_colmap("model", {"left.png": camera})
    cameras = pj.formats.read_colmap("model")
    ```
    """
    for ending in ("bin", "txt"):
        cameras, images = (Path(folder) / f"{part}.{ending}" for part in COLUMNS)
        if cameras.exists() and images.exists():
            return by_name(_posed(images, cameras), repr(str(images)))
    words = "expected a COLMAP model (cameras.txt and images.txt, or .bin)"
    raise FileNotFoundError(f"`folder`: {words}, got {str(folder)!r}")


def write_colmap(folder: FilePath, cameras: NamedCameras, *, binary: bool = False) -> None:
    """Write a COLMAP model without points: cameras, images, points3D.

    Cameras are PINHOLE, with distortion OPENCV (FULL_OPENCV if k3 is not zero) or OPENCV_FISHEYE.
    The cameras' names become image names; equal intrinsics are written once.

    Raises ValueError for names that are empty or long, or in text hold white space, where COLMAP
    would end them. Also for a folder with a model of the other kind, or with rigs and frames:
    COLMAP would read those, or both together.

    ```python
    pj.formats.write_colmap("model", {"left.png": camera})
    ```
    """
    place, ending, other = Path(folder), *((".bin", ".txt") if binary else (".txt", ".bin"))
    if place.exists() and not place.is_dir():
        raise ValueError(f"`folder`: expected a folder, got {str(folder)!r}: something else")
    stale = [f"{part}{other}" for part in PARTS]
    stale += [f"{part}{end}" for part in ("rigs", "frames") for end in (ending, other)]
    if found := [name for name in stale if (place / name).exists()]:
        raise ValueError(f"`folder`: expected none of another model, got {found[0]} in {folder!s}")
    can_hold = lambda name: "\0" not in name and 0 < len(name.encode()) <= MOST_NAME
    in_text = lambda name: name.split() == [name] and can_hold(name)
    check_cameras(cameras, "COLMAP", can_hold if binary else in_text)
    keys: dict[tuple, int] = {}
    images = [
        (number, *_pose(camera), keys.setdefault(_intrinsics(camera), len(keys) + 1), name)
        for number, (name, camera) in enumerate(cameras.items(), 1)
    ]
    views = [(key, *view) for view, key in keys.items()]
    parts = _binary(views, images) if binary else _text(views, images)
    for part, data in zip(PARTS, parts, strict=True):
        replace_file(place / f"{part}{ending}", data)


def colmap_intrinsics(file: Path) -> dict[str, Intrinsics]:
    """Return the intrinsics of a model's cameras.txt or .bin, by their numbers."""
    cameras: dict[str, Intrinsics] = {}
    for (key, model, *values), where in _records(file):
        given = Fields({"CAMERA_ID": key}, where)
        if model not in MODELS:
            raise given.wrong("MODEL", f"one of {', '.join(MODELS)}", str(model))
        names = MODELS[model][1].split()
        if len(values) != len(names) + 2:
            words = f"{len(names)} numbers ({', '.join(names)}) of {model}"
            raise given.wrong("PARAMS", words, str(len(values) - 2))
        fields = Fields(dict(zip(("WIDTH", "HEIGHT", *names), values, strict=True)), where)
        focals = [fields.positive(name) for name in names if name[0] == "f"]
        centre = fields.number("cx"), fields.number("cy")
        size = fields.integer("WIDTH"), fields.integer("HEIGHT")
        distortion = read_distortion(fields, model.endswith("FISHEYE"))
        view = Pinhole(focals[0], focals[-1], *centre, *size, distortion)
        cameras[_new_key(given, "CAMERA_ID", cameras)] = view, fields
    return cameras


def _posed(images: Path, cameras: Path) -> Iterator[tuple[str, Camera]]:
    """Yield the cameras of images, with their names."""
    known, met = colmap_intrinsics(cameras), set[str]()
    for (key, w, x, y, z, *shift, camera, name), where in _records(images):
        data = {"IMAGE_ID": key, "QUATERNION": [x, y, z, w], "TRANSLATION": shift}
        fields = Fields({**data, "CAMERA_ID": camera}, where)
        met.add(_new_key(fields, "IMAGE_ID", met))
        number = _new_key(fields, "CAMERA_ID")
        if number not in known:
            raise fields.wrong("CAMERA_ID", f"a camera of {str(cameras)!r}", number)
        view, source = known[number]
        pose = rigid(fields.rotation("QUATERNION"), fields.array("TRANSLATION", (3,)))
        yield name, camera_from_pinhole(view, inverse(pose), OPENCV, source)


def _new_key(fields: Fields, name: str, known: Container[str] = ()) -> str:
    """Return the number of a camera or an image, which must not be known already."""
    key = str(fields.integer(name, 0))
    if key in known:
        raise fields.wrong(name, "each once", f"{key} twice")
    return key


def _pose(camera: Camera) -> list[float]:
    """Return camera_from_world as a quaternion (w, x, y, z) and a translation."""
    from scipy.spatial.transform import Rotation

    matrix = inverse(pose_of(camera))
    *xyz, w = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True).tolist()
    return [w, *xyz, *matrix[:3, 3].tolist()]


def _records(file: Path) -> Iterator[Record]:
    """Yield a file's records, each with its place."""
    return _lines_of(file) if file.suffix == ".txt" else _binary_records(file)


def _lines_of(file: Path) -> Iterator[Record]:
    """Yield the words of each entry of a text file, numbers as such; a line of points follows each
    image's."""
    columns, count, promised = COLUMNS[file.stem].split(), 0, None
    images, lines = file.stem == "images", _lines(file)
    for line, where in lines:
        if heading := re.match(r"# Number of (?:cameras|images): (\d{1,18})", line):
            promised = int(heading[1])
        words = line.strip().split(maxsplit=len(columns) - 1 if images else -1)
        if not words or line.startswith("#"):
            continue
        if len(words) < len(columns):
            raise ValueError(f"expected {COLUMNS[file.stem]}, got {short(line)} (in {where})")
        *head, last = map(number_or_text, words)
        yield [*head, words[-1] if images else last], where
        count += 1
        if images:
            _check_points(*next(lines, ("", where)))
    if promised not in (None, count):
        words = f"{promised} entries, as its heading says, got {count}"
        raise ValueError(f"expected {words} (in {str(file)!r})")


def _lines(file: Path) -> Iterator[tuple[str, str]]:
    """Yield each line and its place; points need not fit memory."""
    with open_file(file, KIND, MOST_MODEL) as stream:
        for number, raw in enumerate(iter(lambda: stream.readline(MOST_LINE), b""), 1):
            where = f"{str(file)!r}, line {number}"
            if len(raw) == MOST_LINE:
                raise ValueError(f"expected less than {MOST_LINE} bytes in a line (in {where})")
            yield _decoded(raw, where).removeprefix("\ufeff"), where


def _decoded(data: bytes, where: str, what: str = "") -> str:
    try:
        return data.decode()
    except UnicodeDecodeError:
        raise ValueError(f"{what}expected text, got bytes that are no UTF-8 (in {where})") from None


def _check_points(line: str, where: str) -> None:
    """Check an image's second line, X Y POINT3D_ID, repeated: it may be a pose by mistake."""
    words = line.split()
    if len(words) % 3 or not all(re.fullmatch(r"-?\d+", word) for word in words[2::3]):
        raise ValueError(
            "expected the image's points (X Y POINT3D_ID, or an empty line), got"
            f" {line[:60]!r} (in {where})"
        )


def _binary_records(file: Path) -> Iterator[Record]:
    """Yield a binary file's records: it has to end where they do."""
    with open_file(file, KIND, MOST_MODEL) as stream:
        take = lambda form: struct.unpack(form, stream.read(struct.calcsize(form)))
        size = os.fstat(stream.fileno()).st_size
        try:
            for _ in range(*take("<Q")):
                head = take(FORMS[file.stem])
                where = f"{str(file)!r}, {file.stem[:-1]} {head[0]}"
                if file.stem == "cameras":
                    key, model, *film = head
                    name, names = NUMBERED.get(model, (f"number {model}", ""))
                    yield (key, name, *film, *take(f"<{len(names.split())}d")), where
                else:
                    yield (*head, _take_name(stream, where)), where
                    stream.seek(min(24 * take("<Q")[0], MOST_MODEL), os.SEEK_CUR)
        except struct.error:
            raise ValueError(
                f"expected more than {size} bytes, got the end (in {str(file)!r})"
            ) from None
        if stream.tell() != size:
            raise ValueError(f"expected {stream.tell()} bytes, got {size} (in {str(file)!r})")


def _take_name(stream: BinaryIO, where: str) -> str:
    """Return the name up to the next zero byte."""
    name = b"".join(islice(iter(lambda: stream.read(1), b"\0"), MOST_NAME + 1))
    if len(name) > MOST_NAME:
        raise ValueError(f"`NAME`: expected at most {MOST_NAME} bytes, got more (in {where})")
    return _decoded(name, where, "`NAME`: ")


def _intrinsics(camera: Camera) -> tuple:
    """Return intrinsics as a COLMAP model has them: its name, W, H, its parameters in order."""
    view = pinhole(camera, distorted=True)
    distortion = view.distortion
    k3 = isinstance(distortion, BrownConrady) and float(distortion.k3)
    name = "FULL_OPENCV" if k3 or isinstance(distortion, Rational) else "OPENCV"
    if distortion is None or isinstance(distortion, Fisheye):
        name = "OPENCV_FISHEYE" if distortion else "PINHOLE"
    values = {**view._asdict(), **({} if distortion is None else distortion.coefficients())}
    parameters = MODELS[name][1].split()
    return name, view.W, view.H, *(values.get(name, 0.0) for name in parameters)


def _text(views: list[tuple], images: list[tuple]) -> Iterator[bytes]:
    """Yield cameras.txt, images.txt and points3D.txt."""
    for part, rows, end in (("cameras", views, "\n"), ("images", images, "\n\n")):
        lines = (" ".join(map(str, row)) + end for row in rows)
        yield "".join([f"# {COLUMNS[part]}\n", *lines]).encode()
    yield b"# no points\n"


def _binary(views: list[tuple], images: list[tuple]) -> Iterator[bytes]:
    """Yield cameras.bin, images.bin and points3D.bin."""
    count = struct.Struct("<Q").pack
    yield count(len(views)) + b"".join(
        struct.pack(f"{FORMS['cameras']}{len(numbers)}d", key, MODELS[model][0], W, H, *numbers)
        for key, model, W, H, *numbers in views
    )
    yield count(len(images)) + b"".join(
        struct.pack(FORMS["images"], *row) + name.encode() + b"\0" + count(0)
        for *row, name in images
    )
    yield count(0)
