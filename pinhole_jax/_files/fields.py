"""The fields of a file, taken out with checks that name the field, and the file it is in."""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from .paths import MOST_BYTES, FilePath, read_json

Part = TypeVar("Part")
#: Width and height of an image, px.
Size = tuple[int, int]
#: What stands for numbers that JSON has no word for.
NOT_FINITE: dict[str | None, float] = {None: np.nan, "Infinity": np.inf, "-Infinity": -np.inf}
#: Attributes of XML that are texts, whatever they look like.
NAMES = ("name", "type", "link", "joint", "filename")
YES, NO = ("true", "yes", "on", "1"), ("false", "no", "off", "0")


class Fields:
    """A mapping of names to values, and `where` it was read: a file, and which part of it.

    Every getter raises ValueError with the field (by its name there, if `written` has another),
    what was expected, what came, and `where`.
    """

    def __init__(self, data: Any, where: str, written: Mapping[str, str] | None = None):
        if not isinstance(data, Mapping):
            raise ValueError(f"expected fields with names, got {short(data)} (in {where})")
        self.data: Mapping[str, Any] = data
        self.where = where
        self.written: Mapping[str, str] = written or {}

    def __contains__(self, name: str) -> bool:
        return name in self.data

    def wrong(self, name: str, expected: str, got: Any) -> ValueError:
        """Return the error of a field; `got` is quoted as it stands if it is text."""
        words = got if isinstance(got, str) else short(got)
        name = self.written.get(name, name)
        return ValueError(f"`{name}`: expected {expected}, got {words} (in {self.where})")

    def get(self, name: str, expected: str, default: Any = None) -> Any:
        """Return a field's value as it is, or the default."""
        if name not in self.data and default is None:
            raise self.wrong(name, expected, "no such field")
        return self.data.get(name, default)

    def number(
        self,
        name: str,
        default: float | int | None = None,
        expected: str = "a finite number",
        least: float | int = -np.inf,
        most: float | int = np.inf,
    ) -> float:
        """Return a number between two others."""
        value = float(self.array(name, (), expected=expected, default=default))
        if value <= least or value >= most:  # (NaN stands for none)
            raise self.wrong(name, expected, f"{value:g}")
        return value

    def positive(self, name: str, default: float | int | None = None) -> float:
        """Return a finite number above 0."""
        return self.number(name, default, "a positive number", 0)

    def angle(self, name: str) -> float:
        """Return an angle in (0, pi) rad."""
        return self.number(name, None, "an angle in (0, pi) rad", 0, np.pi)

    def integer(self, name: str, least: int = 1, default: int | None = None) -> int:
        """Return a whole number of at least `least`, below 2**31; 640.0 counts as one."""
        expected = f"an integer of at least {least}"
        value = self.number(name, default, expected, least - 1, 2**31)
        if value != int(value):
            raise self.wrong(name, expected, f"{value:g}")
        return int(value)

    def chosen(self, name: str, parts: Sequence[Part], default: int | None = None) -> Part:
        """Return the part of a list whose number a field has."""
        number = self.integer(name, 0, default)
        if number >= len(parts):
            raise self.wrong(name, f"a number below {len(parts)}", str(number))
        return parts[number]

    def array(
        self,
        name: str,
        *shapes: tuple[int, ...],
        expected: str = "",
        finite: bool = True,
        default: Any = None,
    ) -> np.ndarray:
        """Return numbers of one of these shapes (-1: any size; none given: any shape), float64;
        unless `finite`, null is NaN. `default` stands for each number or all, as the first has."""
        if default is not None and name not in self.data:
            return np.full(shapes[0], default, float)
        words = " or ".join(str(shape).replace("-1", "N") for shape in shapes)
        expected = expected or f"{'finite ' * finite}numbers of shape {words}"
        value = self.get(name, expected)
        array = as_numbers(value if finite else _with_not_finite(value))
        if array is not None and (not finite or np.all(np.isfinite(array))):
            if not finite and array.shape == (0,):  # no parameters, no rows
                array = array.reshape(0, *shapes[0][1:])
            sizes = array.shape
            fits = lambda shape: (
                len(shape) == len(sizes)
                and all(x in (-1, y) for x, y in zip(shape, sizes, strict=True))
            )
            if not shapes or any(map(fits, shapes)):
                return array
        raise self.wrong(name, expected, short(value))

    def counts(
        self, name: str, expected: str = "a list of counts", most: float = np.inf
    ) -> list[int]:
        """Return a list of whole numbers, at least 0 and at most this."""
        numbers = self.array(name, (-1,), expected=expected)
        if np.any((numbers < 0) | (numbers > most) | (numbers % 1 != 0)):
            raise self.wrong(name, expected, numbers)
        return [*map(int, numbers)]

    def rotation(self, name: str) -> np.ndarray:
        """Return the rotation (3, 3) of a quaternion (x, y, z, w), of length 1 up to rounding."""
        from scipy.spatial.transform import Rotation

        quaternion = self.array(name, (4,))
        if abs(math.hypot(*quaternion) - 1) > 1e-3:
            raise self.wrong(name, "a quaternion of length 1", quaternion)
        return Rotation.from_quat(quaternion).as_matrix()

    def flag(self, name: str) -> bool:
        """Return True for true, 1, "true", "yes", "on", "1", and False for their opposites."""
        word = str(self.get(name, "true or false")).strip().lower()
        if word not in YES + NO:
            raise self.wrong(name, "true or false", short(self.data[name]))
        return word in YES

    def text(self, name: str, choices: Sequence[str] = (), default: str | None = None) -> str:
        """Return a string, one of `choices` if there are any."""
        expected = f"one of {', '.join(choices)}" if choices else "a text"
        value = self.get(name, expected, default)
        if not isinstance(value, str) or (choices and value not in choices):
            raise self.wrong(name, expected, short(value))
        return value

    def items(self, name: str, count: int | None = None, kind: str = "a list") -> list[Any]:
        """Return a list, of `count` entries if that is given."""
        value = self.get(name, kind)
        if not isinstance(value, list) or count not in (None, len(value)):
            raise self.wrong(name, kind, short(value))
        return value

    def parts(self, name: str) -> list["Fields"]:
        """Return the objects of a list, each with its place in `where`."""
        return [Fields(x, f"{self.where}, {name}[{k}]") for k, x in enumerate(self.items(name))]

    def part(
        self, name: str, expected: str = "fields with names", only: Iterable[str] = ()
    ) -> "Fields":
        """Return an object within this one, which has these fields only, if they are given."""
        value = self.get(name, expected)
        if not isinstance(value, Mapping):
            raise self.wrong(name, expected, short(value))
        if others := sorted(value.keys() - {*only}) if only else ():
            raise self.wrong(name, ", ".join(only), f"also {others}")
        return Fields(value, f"{self.where}, {name[:60]}")

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


def read_fields(path: FilePath, kind: str, most: int = MOST_BYTES) -> Fields:
    """Return the fields of a JSON file; `kind` is what its readers expect."""
    data = read_json(path, kind, most)
    if not isinstance(data, dict):
        raise ValueError(f"`path`: expected a JSON object, got {short(data)} in {str(path)!r}")
    return Fields(data, repr(str(path)))


def as_numbers(value: Any) -> np.ndarray | None:
    """Return real numbers as an array, None for anything else."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return None
    return array.astype(float) if array.dtype.kind in "iuf" else None


def _with_not_finite(value: Any) -> Any:
    """Return numbers in lists, with texts and null replaced by what they stand for."""
    if isinstance(value, list):
        return [_with_not_finite(part) for part in value]
    return NOT_FINITE.get(value, value) if value is None or isinstance(value, str) else value


def number_or_text(word: str) -> float | str:
    """Return the number that a word is, else the word; Python would read 1_0 as 10."""
    try:
        return word if "_" in word or not word.isascii() else float(word)
    except ValueError:
        return word


def attributes(element: ET.Element, where: str) -> Fields:
    """Return an XML element's attributes; but for names, those that are numbers (parted by commas
    or blanks) as such."""
    data = {name: text if name in NAMES else _value(text) for name, text in element.items()}
    return Fields(data, f"{where}, <{element.tag[:60]}>")


def _value(text: str) -> Any:
    """Return a text, or the number or the numbers that it is."""
    words = [number_or_text(word) for word in re.split(r"[,\s]+", text.strip())]
    if any(isinstance(word, str) for word in words):
        return text
    return words if len(words) > 1 else words[0]


def short(value: Any) -> str:
    """Return a value as a short text."""
    if isinstance(value, str):
        value = value[:80]
    words = repr(value.tolist() if isinstance(value, np.ndarray) else value)
    return words if len(words) <= 80 else f"{words[:77]}..."
