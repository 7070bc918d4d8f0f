"""COLMAP models: a folder of cameras and images, as text (.txt) or binary (.bin).

Axes: x right, y down, z forward; quaternion (w, x, y, z) and translation are camera_from_world.
Focal lengths in px, no field of view. Pixel centres lie at halves: the image's top-left corner is
(0, 0), y down. Format: colmap.github.io/format.html.
"""

import os
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from .._camera.camera import Camera
from .._camera.distortion import BrownConrady, Distortion, Fisheye, Rational
from .._camera.poses import inverse, pose_of, rigid
from .._files.fields import Fields, number, short
from .._files.paths import FilePath, open_file, replace_file
from .cameras import KIND, Cameras, by_name, check_cameras
from .pinhole import OPENCV, Pinhole, camera_from_pinhole, distortion_model, pinhole

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
NUMBERS = {name: number for number, (name, _) in MODELS.items()}
PARTS = ("cameras", "images", "points3D")
#: The most bytes of an image's name (a path, on any system), of a line, and of a file, whose points
#: are passed over.
MOST_NAME, MOST_LINE, MOST_MODEL = 4096, 1 << 26, 1 << 36

#: A camera's intrinsics, its lens, and the place in its file.
Intrinsics = tuple[Pinhole, Distortion | None, Fields]
#: A line of text or a record of bytes: its numbers, a name, and the place in the file.
Record = tuple[Sequence[Any], str, str]


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
    place = Path(folder)
    for ending in (".bin", ".txt"):
        files = [place / f"{part}{ending}" for part in ("cameras", "images")]
        if all(file.exists() for file in files):
            break
    else:
        raise FileNotFoundError(
            "`folder`: expected a COLMAP model (cameras.txt and images.txt, or .bin), got"
            f" {str(folder)!r}"
        )
    cameras, images = files
    intrinsics = colmap_intrinsics(cameras)
    records = _binary_images(images) if ending == ".bin" else _text_images(images)
    return by_name(_posed(records, intrinsics, cameras), repr(str(images)))


def write_colmap(folder: FilePath, cameras: Mapping[str, Camera], *, binary: bool = False) -> None:
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
    place, ending = Path(folder), ".bin" if binary else ".txt"
    if place.exists() and not place.is_dir():
        raise ValueError(f"`folder`: expected a folder, got {str(folder)!r}: something else")
    other = ".txt" if binary else ".bin"
    stale = [f"{part}{other}" for part in (*PARTS, "rigs", "frames")]
    stale += [f"rigs{ending}", f"frames{ending}"]
    if found := [name for name in stale if (place / name).exists()]:
        raise ValueError(f"`folder`: expected none of another model, got {found[0]} in {folder!s}")
    check_cameras(cameras, "COLMAP", lambda name: _can_hold(name, binary))
    views: dict[tuple, int] = {}
    images = [
        (views.setdefault(_view(camera), len(views) + 1), _pose(camera), name)
        for name, camera in cameras.items()
    ]
    parts = _binary(views, images) if binary else _text(views, images)
    for part, data in zip(PARTS, parts, strict=True):
        replace_file(place / f"{part}{ending}", data)


def _can_hold(name: str, binary: bool) -> bool:
    whole = binary or name.split() == [name]
    return whole and "\0" not in name and 0 < len(name.encode()) <= MOST_NAME


def colmap_intrinsics(file: Path) -> dict[str, Intrinsics]:
    """Return the intrinsics and lenses of a model's cameras.txt or .bin, by their numbers."""
    records = _binary_cameras(file) if file.suffix == ".bin" else _text_cameras(file)
    cameras: dict[str, Intrinsics] = {}
    for (key, *numbers), model, where in records:
        key = _key("CAMERA_ID", key, where, cameras)
        cameras[key] = _intrinsics(model, numbers, where)
    return cameras


def _key(name: str, value: object, where: str, known: Iterable[str] = ()) -> str:
    """Return the number of a camera or an image, which must not be known already."""
    key = str(value)
    if not re.fullmatch(r"[0-9]{1,10}", key):
        raise ValueError(f"`{name}`: expected a whole number, got {short(key)} ({where})")
    if key in known:
        raise ValueError(f"`{name}`: expected each once, got {key} twice ({where})")
    return key


def _intrinsics(model: str, numbers: Sequence[float | int], where: str) -> Intrinsics:
    if model not in NUMBERS:
        raise ValueError(f"`MODEL`: expected one of {', '.join(NUMBERS)}, got {model} ({where})")
    names = MODELS[NUMBERS[model]][1].split()
    if len(numbers) != len(names) + 2:
        raise ValueError(
            f"`PARAMS`: expected {len(names)} numbers ({', '.join(names)}) of {model}, got"
            f" {len(numbers) - 2} ({where})"
        )
    fields = Fields(dict(zip(("WIDTH", "HEIGHT", *names), numbers, strict=True)), where)
    fx, fy = ("f", "f") if "f" in names else ("fx", "fy")
    focals = fields.positive(fx), fields.positive(fy)
    centre = fields.number("cx"), fields.number("cy")
    view = Pinhole(*focals, *centre, fields.integer("WIDTH"), fields.integer("HEIGHT"))
    distorted = {name: fields.number(name) for name in names if name[0] in "kp"}
    models = (Fisheye,) if model.endswith("FISHEYE") else (BrownConrady, Rational)
    return view, distortion_model(distorted, fields, models), fields


def _posed(
    images: Iterable[Record], cameras: dict[str, Intrinsics], file: Path
) -> Iterator[tuple[str, Camera]]:
    """Yield the cameras of images, with their names."""
    met: set[str] = set()
    for (key, *pose, camera), name, where in images:
        met.add(_key("IMAGE_ID", key, where, met))
        number = _key("CAMERA_ID", camera, where)
        if number not in cameras:
            raise ValueError(
                f"`CAMERA_ID`: expected a camera of {str(file)!r}, got {number} ({where})"
            )
        view, distortion, source = cameras[number]
        w, *xyz = pose[:4]
        fields = Fields({"QUATERNION": [*xyz, w], "TRANSLATION": pose[4:]}, where)
        matrix = rigid(fields.rotation("QUATERNION"), fields.array("TRANSLATION", (3,)))
        yield name, camera_from_pinhole(view, inverse(matrix), OPENCV, source, distortion)


def _pose(camera: Camera) -> list[float]:
    """Return camera_from_world as a quaternion (w, x, y, z) and a translation."""
    from scipy.spatial.transform import Rotation

    matrix = inverse(pose_of(camera))
    *xyz, w = Rotation.from_matrix(matrix[:3, :3]).as_quat(canonical=True).tolist()
    return [w, *xyz, *matrix[:3, 3].tolist()]


def _text_cameras(file: Path) -> Iterator[Record]:
    for (key, model, *numbers), where in _entries(file, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"):
        yield (key, *_numbers(numbers, where)), model, where


def _text_images(file: Path) -> Iterator[Record]:
    columns = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    for (key, *pose, camera, name), where in _entries(file, columns, points=True):
        yield (key, *_numbers(pose, where), camera), name.strip(), where


def _entries(file: Path, columns: str, *, points: bool = False) -> Iterator[tuple[list[str], str]]:
    """Yield the words of each entry, and its place; `points`: a line of points follows each."""
    counts: list[int] = []
    names, number, lines = columns.split(), 0, _lines(file, counts)
    for where, line in lines:
        words = line.split(maxsplit=len(names) - 1 if points else -1)
        if not words:
            continue
        if len(words) < len(names):
            raise ValueError(f"expected {columns}, got {short(line)} ({where})")
        yield words, where
        number += 1
        if points:
            _check_points(*next(lines, (where, "")))
    if counts and counts[0] != number:
        words = f"{counts[0]} entries, as its heading says, got {number}"
        raise ValueError(f"expected {words} (in {str(file)!r})")


def _lines(file: Path, counts: list[int]) -> Iterator[tuple[str, str]]:
    """Yield the place and the text of each line but comments, whose number of entries is added to
    `counts`; points need not fit memory."""
    with open_file(file, KIND, MOST_MODEL) as stream:
        for number, raw in enumerate(iter(lambda: stream.readline(MOST_LINE), b""), 1):
            where = f"{str(file)!r}, line {number}"
            if len(raw) == MOST_LINE:
                raise ValueError(f"expected less than {MOST_LINE} bytes in a line ({where})")
            try:
                line = raw.decode("utf-8" if number > 1 else "utf-8-sig")
            except UnicodeDecodeError:
                raise ValueError(f"expected text, got bytes that are no UTF-8 ({where})") from None
            if not line.startswith("#"):
                yield where, line
            elif heading := re.match(r"# Number of (?:cameras|images): (\d{1,18})", line):
                counts.append(int(heading[1]))


def _numbers(words: list[str], where: str) -> list[float]:
    try:
        return [number(word) for word in words]
    except ValueError as error:
        raise ValueError(f"expected numbers, got {str(error)[:99]} ({where})") from None


def _check_points(where: str, line: str) -> None:
    """Check an image's second line, X Y POINT3D_ID, repeated: it may be a pose by mistake."""
    words = line.split()
    if len(words) % 3 or not all(re.fullmatch(r"-?\d+", word) for word in words[2::3]):
        raise ValueError(
            "expected the image's points (X Y POINT3D_ID, or an empty line), got"
            f" {line[:60]!r} ({where})"
        )


def _binary_cameras(file: Path) -> Iterator[Record]:
    with _stream(file) as stream:
        for _ in range(*_take(stream, "<Q")):
            key, model, W, H = _take(stream, "<IiQQ")
            where = f"{str(file)!r}, camera {key}"
            name, parameters = MODELS.get(model, (f"number {model}", ""))
            numbers = _take(stream, f"<{len(parameters.split())}d")
            yield (key, W, H, *numbers), name, where


def _binary_images(file: Path) -> Iterator[Record]:
    with _stream(file) as stream:
        for _ in range(*_take(stream, "<Q")):
            numbers = _take(stream, "<I7dI")
            where = f"{str(file)!r}, image {numbers[0]}"
            yield numbers, _name(stream, where), where
            points = 24 * _take(stream, "<Q")[0]
            stream.seek(min(points, MOST_MODEL), os.SEEK_CUR)


@contextmanager
def _stream(file: Path) -> Iterator[BinaryIO]:
    """Yield a file to read from its beginning to its end, which has to be reached."""
    with open_file(file, KIND, MOST_MODEL) as stream:
        size = os.fstat(stream.fileno()).st_size
        try:
            yield stream
        except struct.error:
            words = f"expected more than {size} bytes, got the end (in {str(file)!r})"
            raise ValueError(words) from None
        if stream.tell() != size:
            words = f"expected {stream.tell()} bytes, got {size} (in {str(file)!r})"
            raise ValueError(words)


def _take(stream: BinaryIO, form: str) -> tuple[Any, ...]:
    """Return the next values; raise struct.error at the end."""
    return struct.unpack(form, stream.read(struct.calcsize(form)))


def _name(stream: BinaryIO, where: str) -> str:
    """Return the text up to the next zero byte."""
    start = stream.tell()
    name, end, _ = stream.read(MOST_NAME + 1).partition(b"\0")
    if not end:
        _take(stream, "c")
        raise ValueError(f"`NAME`: expected at most {MOST_NAME} bytes, got more ({where})")
    stream.seek(start + len(name) + 1)
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"`NAME`: expected UTF-8, got {name[:60]!r} ({where})") from None


def _view(camera: Camera) -> tuple:
    """Return intrinsics as a COLMAP model has them: its number, W, H, its parameters in order."""
    view, distortion = pinhole(camera, distorted=True), camera.distortion
    k3 = isinstance(distortion, BrownConrady) and float(distortion.k3)
    name = "FULL_OPENCV" if k3 or isinstance(distortion, Rational) else "OPENCV"
    if distortion is None or isinstance(distortion, Fisheye):
        name = "OPENCV_FISHEYE" if distortion else "PINHOLE"
    values = {**view._asdict(), **({} if distortion is None else distortion.coefficients())}
    parameters = MODELS[NUMBERS[name]][1].split()
    return NUMBERS[name], view.W, view.H, *(values.get(name, 0.0) for name in parameters)


def _text(views: dict[tuple, int], images: list[tuple]) -> Iterator[bytes]:
    """Yield cameras.txt, images.txt and points3D.txt."""
    words = lambda *values: " ".join(map(str, values))
    cameras = [words(key, MODELS[model][0], *rest) for (model, *rest), key in views.items()]
    poses = [words(k, *pose, key, name) for k, (key, pose, name) in enumerate(images, 1)]
    yield "\n".join(["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", *cameras, ""]).encode()
    head = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its points: none\n"
    yield (head + "".join(f"{pose}\n\n" for pose in poses)).encode()
    yield b"# no points\n"


def _binary(views: dict[tuple, int], images: list[tuple]) -> Iterator[bytes]:
    """Yield cameras.bin, images.bin and points3D.bin."""
    none = struct.pack("<Q", 0)
    yield struct.pack("<Q", len(views)) + b"".join(
        struct.pack(f"<IiQQ{len(numbers)}d", key, model, W, H, *numbers)
        for (model, W, H, *numbers), key in views.items()
    )
    yield struct.pack("<Q", len(images)) + b"".join(
        struct.pack("<I7dI", k, *pose, key) + name.encode() + b"\0" + none
        for k, (key, pose, name) in enumerate(images, 1)
    )
    yield none
