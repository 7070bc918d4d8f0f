"""One door for all files: `read` and `write` guess the format by name and content."""

from collections.abc import Callable
from functools import partial
from os.path import isdir
from pathlib import Path
from typing import Any, NamedTuple

from .._camera.camera import Camera
from .._files.fields import Fields, Size, short
from .._files.paths import (
    FilePath,
    as_path,
    file_and_name,
    parse_xml,
    read_json as load_json,
    read_text,
)
from .blender import SCHEMA as BLENDER_SCHEMA, read_blender, write_blender, write_blender_script
from .colmap import read_colmap, write_colmap
from .gltf import read_gltf, write_gltf
from .mitsuba import read_mitsuba, write_mitsuba
from .native import read_json, write_json
from .nerf import read_nerf, write_nerf
from .opencv import read_opencv, write_opencv
from .pinhole import KIND, Cameras, NamedCameras, chosen
from .pytorch3d import read_pytorch3d, write_pytorch3d
from .unknown import unknown


class Format(NamedTuple):
    """A format's reader, writer, and the endings of its files; `sized`: reading may need the
    image's size."""

    read: Callable[..., Cameras] | None
    write: Callable[[Any, NamedCameras], None]
    endings: tuple[str, ...] = ()
    sized: bool = True


FORMATS = {
    "json": Format(read_json, write_json, sized=False),
    "opencv": Format(read_opencv, write_opencv, (".yml", ".yaml")),
    "colmap": Format(read_colmap, write_colmap, sized=False),
    "colmap-binary": Format(read_colmap, partial(write_colmap, binary=True), sized=False),
    "nerf": Format(read_nerf, write_nerf),
    "blender": Format(read_blender, write_blender),
    "blender-script": Format(None, write_blender_script, (".py",)),
    "gltf": Format(read_gltf, write_gltf, (".gltf", ".glb")),
    "pytorch3d": Format(read_pytorch3d, write_pytorch3d),
    "mitsuba": Format(read_mitsuba, write_mitsuba, (".xml",)),
}
ENDINGS = {ending: name for name, format in FORMATS.items() for ending in format.endings}
#: Formats that are JSON, by the part of a file's name that asks for them; the others are our own.
JSON_NAMES = {"transforms": "nerf", "blender": "blender", "pytorch3d": "pytorch3d"}
COLMAP_FILES = ("cameras.txt", "images.txt", "cameras.bin", "images.bin")
#: Fields of JSON, or its schema, that identify a format; the first that are all there.
FIELDS = {
    BLENDER_SCHEMA: "blender",
    "matrix_world": "blender",
    "R T in_ndc": "pytorch3d",
    "frames": "nerf",
    "camera_matrix": "opencv",
    "cameraMatrix": "opencv",
    **dict.fromkeys(("schema", "e", "p", "u", "phi", "phi_degrees", "lens", "W", "H"), "json"),
}


def read(path: FilePath, format: str | None = None, *, size: Size | None = None) -> Cameras:
    """Return the cameras of a file (COLMAP: a folder), by name.

    `format` is one of `FORMATS`; None guesses it by the path's ending and, of JSON and XML, by
    what is in it.
    `size` is the image's (W, H) in px, for files that do not hold it.

    Raises FileNotFoundError, or ValueError naming the file and the field that is missing or wrong.

    ```python
    pj.formats.write("camera.json", {"left": camera})
    cameras = pj.formats.read("camera.json")
    ```
    """
    place = as_path(path)
    name = _checked(format) or _guess_read(place)
    if name.startswith("colmap") and place.name in COLMAP_FILES and not isdir(place):
        place = place.parent
    reader = FORMATS[name].read
    if reader is None:
        raise ValueError(f"`format`: expected one that can be read, got {name!r}: written only")
    if FORMATS[name].sized:
        return reader(place, size=size)
    cameras = reader(place)
    for camera in cameras.values():
        Fields({"W": camera.W, "H": camera.H}, repr(str(place))).size("W", "H", size)
    return cameras


def read_one(path: FilePath, *, size: Size | None = None) -> Camera:
    """Return the camera of a file that holds one, or by its name: "transforms.json:left".

    `size` is the image's (W, H) in px, for formats whose files need not hold it.

    Raises FileNotFoundError or ValueError as `read` does, and ValueError where there are several
    cameras and no name, or none of this name.

    ```python
    camera_again = pj.formats.read_one("camera.json")  # FILE:NAME is one of several
    ```
    """
    place, name = file_and_name(path)
    format = _guess_read(place)
    cameras = read(place, format, size=size if FORMATS[format].sized else None)
    return chosen(cameras, name, repr(str(place)))


def write(path: FilePath, cameras: NamedCameras, format: str | None = None) -> None:
    """Write cameras to a file (COLMAP: a folder), whole or not at all.

    `format` is one of `FORMATS`; None guesses it by the path. A file ending in .yaml is OpenCV,
    .xml Mitsuba, .gltf and .glb glTF, .py a Blender script; a name without an ending is a COLMAP
    folder. A .json is the project's own, unless its name holds transforms (NeRF), blender or
    pytorch3d.

    Raises ValueError where there is no camera, or one that the format cannot hold.

    ```python
    pj.formats.write("transforms.json", {"left": camera, "right": camera.replace(e=[1, 1, 5])})
    ```
    """
    FORMATS[_checked(format) or guess_write(path)].write(path, cameras)


def _checked(format: str | None) -> str | None:
    if format is not None and format not in FORMATS:
        raise ValueError(f"`format`: expected one of {', '.join(FORMATS)}, got {format!r}")
    return format


def _guess_read(path: Path) -> str:
    if isdir(path) or path.name in COLMAP_FILES:
        return "colmap"
    if path.suffix.lower() == ".xml":
        root = parse_xml(read_text(path, KIND), path)
        return "opencv" if root.tag == "opencv_storage" else "mitsuba"
    return _json_format(path) if path.suffix.lower() == ".json" else _by_ending(path)


def _json_format(path: Path) -> str:
    """Return the format of a JSON file, by its fields."""
    data = load_json(path, KIND)
    named = data if isinstance(data, dict) else {}
    names = {*named, str(named.get("schema"))}
    for fields, format in FIELDS.items():
        if names.issuperset(fields.split()):
            return format
    known = ", ".join(name for name, format in FORMATS.items() if format.read)
    held = f"JSON with the fields {short(sorted(named))}" if named else short(data)
    got = unknown(data) or held
    raise ValueError(f"`path`: expected one of {known}, got {got} (in {str(path)!r})")


def guess_write(path: FilePath) -> str:
    """Return the format that a path to be written asks for.

    ```python
    pj.formats.guess_write("camera.yaml")  # "opencv"
    ```
    """
    place = as_path(path)
    if isdir(place) or not place.suffix:
        return "colmap"
    if place.suffix.lower() != ".json":
        return _by_ending(place)
    stem = place.stem.lower()
    return next((format for part, format in JSON_NAMES.items() if part in stem), "json")


def _by_ending(path: Path) -> str:
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise ValueError(
            f"`path`: expected a folder (COLMAP) or one of {', '.join(['.json', *ENDINGS])}, got"
            f" {path.name!r}; formats are {', '.join(FORMATS)}"
        )
    return ENDINGS[ending]
