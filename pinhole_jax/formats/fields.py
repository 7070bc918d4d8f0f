"""The fields of a camera file, taken out with checks that name the file and the field."""

import json
import os
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._camera.camera import check_camera
from .._files.paths import read_json, replace_file

Size = tuple[int, int]
#: What a reader here reads.
KIND = "a camera file"
YES, NO = ("true", "yes", "on", "1"), ("false", "no", "off", "0")


class Fields:
    """A mapping of names to values, read from `where`: a file, and which part of it.

    Every getter raises ValueError with the field, what was expected, what came, and `where`.
    """

    def __init__(self, data: Any, where: str):
        if not isinstance(data, Mapping):
            raise ValueError(f"expected fields with names, got {short(data)} (in {where})")
        self.data: Mapping[str, Any] = data
        self.where = where

    def __contains__(self, name: str) -> bool:
        return name in self.data

    def wrong(self, name: str, expected: str, got: Any) -> ValueError:
        """Return the error of a field; `got` as it stands if it is words, else shortened."""
        words = got if isinstance(got, str) else short(got)
        return ValueError(f"`{name}`: expected {expected}, got {words} (in {self.where})")

    def get(self, name: str, expected: str) -> Any:
        """Return a field's value as it is."""
        if name not in self.data:
            raise self.wrong(name, expected, "no such field")
        return self.data[name]

    def number(self, name: str, default: float | int | None = None) -> float:
        """Return a finite number."""
        if default is not None and name not in self.data:
            return float(default)
        return float(self.array(name, (), "a finite number"))

    def positive(self, name: str, default: float | int | None = None) -> float:
        """Return a finite number above 0."""
        value = self.number(name, default)
        if not value > 0:
            raise self.wrong(name, "a positive number", f"{value}")
        return value

    def angle(self, name: str) -> float:
        """Return an angle in (0, pi) rad."""
        value = self.number(name)
        if not 0 < value < np.pi:
            raise self.wrong(name, "an angle in (0, pi) rad", f"{value}")
        return value

    def integer(self, name: str, least: int = 1) -> int:
        """Return a whole number of at least `least`, below 2**31; 640.0 counts as one."""
        expected = f"an integer of at least {least}"
        value = float(self.array(name, (), expected))
        if value != int(value) or not least <= value < 2**31:
            raise self.wrong(name, expected, f"{value:g}")
        return int(value)

    def array(self, name: str, shape: Sequence[int], expected: str = "") -> np.ndarray:
        """Return finite numbers of this shape (-1: any size), float64."""
        expected = expected or f"finite numbers of shape {_shape(shape)}"
        value = self.get(name, expected)
        array = _numbers(value)
        if array is None:
            raise self.wrong(name, expected, short(value))
        fits = len(array.shape) == len(shape) and all(
            want in (-1, got) for want, got in zip(shape, array.shape, strict=True)
        )
        if not fits or not np.all(np.isfinite(array)):
            raise self.wrong(name, expected, short(value))
        return array

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of a field's numbers, () where it holds others."""
        array = _numbers(self.get(name, "numbers"))
        return () if array is None else array.shape

    def flag(self, name: str) -> bool:
        """Return yes or no: true, 1, "true", "yes", "on", "1" and their opposites."""
        word = str(self.get(name, "true or false")).strip().lower()
        if word not in YES + NO:
            raise self.wrong(name, "true or false", short(self.data[name]))
        return word in YES

    def text(self, name: str, choices: Sequence[str] = (), default: str | None = None) -> str:
        """Return a string, one of `choices` if there are any."""
        expected = f"one of {', '.join(choices)}" if choices else "a text"
        if default is not None and name not in self.data:
            return default
        value = self.get(name, expected)
        if not isinstance(value, str) or (choices and value not in choices):
            raise self.wrong(name, expected, short(value))
        return value

    def parts(self, name: str) -> list["Fields"]:
        """Return the objects of a list, each with its place in `where`."""
        value = self.get(name, "a list")
        if not isinstance(value, list):
            raise self.wrong(name, "a list", short(value))
        return [Fields(part, f"{self.where}, {name}[{k}]") for k, part in enumerate(value)]

    def part(self, name: str) -> "Fields":
        """Return an object within this one."""
        return Fields(self.get(name, "an object"), f"{self.where}, {name[:60]}")

    def size(self, width: str, height: str, size: Size | None) -> Size:
        """Return the image's width and height, px: the file's, or `size` where it holds none."""
        if width not in self and height not in self:
            if size is None:
                words = "no such field; give `size` (on the command line: --size W H)"
                raise self.wrong(width, "the image's width in px", words)
            return Fields({"W": size[0], "H": size[1]}, "`size`").size("W", "H", None)
        own = self.integer(width), self.integer(height)
        if size is not None and tuple(size) != own:
            words = f"{size[0]} x {size[1]}; read it without a size, then use `resized`"
            raise self.wrong("size", f"the file's own {own[0]} x {own[1]}", words)
        return own


def load_json(path: str | os.PathLike[str]) -> Fields:
    """Return the fields of a JSON file."""
    data = read_json(path, KIND)
    if not isinstance(data, dict):
        raise ValueError(f"`path`: expected a JSON object, got {short(data)} in {str(path)!r}")
    return Fields(data, repr(str(path)))


def parse_xml(text: str, path: str | os.PathLike[str]) -> ET.Element:
    """Return the root of a file's XML, which has no DOCTYPE."""
    try:
        return ET.fromstring(text, ET.XMLParser(target=_NoDoctype()))
    except (ET.ParseError, ValueError) as error:
        raise ValueError(f"`path`: expected XML, got {str(path)!r}: {error}") from None


class _NoDoctype(ET.TreeBuilder):
    """A tree without a DOCTYPE, whose entities can grow without bound."""

    def doctype(self, name: str, public: str, system: str) -> None:
        raise ValueError("a DOCTYPE, which no camera file has")


def save_json(path: str | os.PathLike[str], data: Any) -> None:
    """Write JSON, whole or not at all."""
    save_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def save_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text, whole or not at all."""
    replace_file(path, text.encode())


def check_cameras(
    cameras: Any, program: str, can_hold: Callable[[str], Any] = lambda name: True
) -> None:
    """Raise ValueError unless these are cameras by their names, which a program can hold."""
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


def add_named(cameras: dict[str, Any], name: str, camera: Any, where: str) -> None:
    """Add a camera under its name, which no other may have."""
    if name in cameras:
        words = f"expected one camera of each name, got two of {short(name)}"
        raise ValueError(f"{words} (in {where})")
    cameras[name] = camera


def _numbers(value: Any) -> np.ndarray | None:
    """Return real numbers as an array, None where they are no such thing."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return None
    return array.astype(float) if array.dtype.kind in "iuf" else None


def _shape(shape: Sequence[int]) -> str:
    sizes = ["N" if n == -1 else str(n) for n in shape]
    return f"({', '.join(sizes)}{',' if len(sizes) == 1 else ''})"


def number(text: str) -> float:
    """Return the number that a text is, or raise ValueError; Python would read 1_0 as 10."""
    if "_" in text:
        raise ValueError(f"could not convert to a number: {short(text)}")
    return float(text)


def short(value: Any) -> str:
    """Return a value as a short text."""
    if isinstance(value, str):
        value = value[:80]
    words = repr(value.tolist() if isinstance(value, np.ndarray) else value)
    return clipped(words, 80)


def clipped(words: str, length: int) -> str:
    """Return words, cut where they are longer."""
    return words if len(words) <= length else words[: length - 3] + "..."
