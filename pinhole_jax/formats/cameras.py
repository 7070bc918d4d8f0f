"""Cameras by name, in JSON, XML and text."""

import json
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from .._camera.camera import Camera, check_camera
from .._files.fields import Fields, Part, read_fields, short
from .._files.paths import FilePath, replace_file

#: Cameras by name.
Cameras = dict[str, Camera]
#: What is written: cameras by name in any mapping.
NamedCameras = Mapping[str, Camera]
#: What readers here expect a file to be.
KIND = "a camera file"


def json_cameras(path: FilePath, read: Callable[[Fields], Camera]) -> Cameras:
    """Return the cameras of a JSON file: of its field `cameras` by name, or the file's one."""
    top = read_fields(path, KIND)
    if "cameras" not in top:
        return {top.text("name", default="camera"): read(top)}
    parts = top.part("cameras")
    return {name: read(parts.part(name)) for name in parts.data}


def parse_xml(text: str, path: FilePath) -> ET.Element:
    """Return the root of a file's XML, which has no DOCTYPE."""
    try:
        return ET.fromstring(text, ET.XMLParser(target=_NoDoctype()))
    except (ET.ParseError, ValueError) as error:
        raise ValueError(f"`path`: expected XML, got {str(path)!r}: {error}") from None


class _NoDoctype(ET.TreeBuilder):
    """A tree without a DOCTYPE, whose entities can grow without bound."""

    def doctype(self, name: str, public: str, system: str) -> None:
        raise ValueError("a DOCTYPE, which no camera file has")


def save_json(path: FilePath, data: Any) -> None:
    """Write JSON, whole or not at all."""
    save_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def save_text(path: FilePath, text: str) -> None:
    """Write a text, whole or not at all."""
    replace_file(path, text.encode())


def check_cameras(
    cameras: Any, program: str, can_hold: Callable[[str], Any] = lambda name: True
) -> None:
    """Raise ValueError unless these are cameras by names that a program can hold."""
    if not isinstance(cameras, Mapping):
        kind = type(cameras).__name__
        raise ValueError(f"`cameras`: expected a dict of Cameras by their names, got {kind}")
    if not cameras:
        raise ValueError("`cameras`: expected at least one, got none")
    for name, camera in cameras.items():
        check_camera(camera, f"cameras[{short(name)}]")
        try:
            fits = isinstance(name, str) and name.encode() is not None and can_hold(name)
        except UnicodeEncodeError:
            fits = False
        if not fits:
            raise ValueError(f"`cameras`: expected names {program} can hold, got {short(name)}")


def chosen(cameras: Mapping[str, Part], name: str | None, where: str) -> Part:
    """Return the camera of this name; without one, the only one."""
    if name is None and len(cameras) == 1:
        name = next(iter(cameras))
    if name is None or name not in cameras:
        known = short([*cameras])
        words = f"one camera, or FILE:NAME with a name among {known}"
        got = f"{len(cameras)} cameras" if name is None else repr(name)
        raise ValueError(f"`path`: expected {words}, got {got} (in {where})")
    return cameras[name]


def by_name(cameras: Iterable[tuple[str, Camera]], where: str) -> Cameras:
    """Return cameras by name, or raise ValueError where two have the same."""
    named: Cameras = {}
    for name, camera in cameras:
        if name in named:
            raise ValueError(
                f"expected one camera of each name, got two of {short(name)} (in {where})"
            )
        named[name] = camera
    return named
