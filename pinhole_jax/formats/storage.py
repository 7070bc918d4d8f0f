"""OpenCV's FileStorage: its YAML, XML or JSON as fields."""

import re
import xml.etree.ElementTree as ET
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .._files.fields import Fields, as_numbers, short
from .._files.paths import MOST_DEPTH, FilePath, first_repeat, is_deep, parse_json, read_text
from .cameras import KIND, parse_xml

#: The largest YAML that is read here, in characters (it takes a second and 0.3 GB).
MOST_YAML = 1 << 20
INTEGER = re.compile(r"[-+]?\d{1,18}")
NUMBER = re.compile(r"[-+]?(?:\d++\.?\d*+|\.\d++)(?:[eE][-+]?\d++)?")
PIECES = re.compile(r'"[^"]*+"?|[^\s"]++')


class _Loader(yaml.CSafeLoader):
    """Plain values alone: a tag stands for the value that it is on, whatever its name."""

    def value(self, node: yaml.Node) -> Any:
        """Return a node's value; a map has each field once."""
        if isinstance(node, yaml.ScalarNode):
            return node.value if node.style else _scalar(node.value)
        if isinstance(node, yaml.SequenceNode):
            return self.construct_sequence(node, deep=True)
        assert isinstance(node, yaml.MappingNode)
        if twice := first_repeat(str(key.value) for key, _ in node.value):
            raise _wrong(f"the field {short(twice)} twice", node)
        return self.construct_mapping(node, deep=True)

    yaml_implicit_resolvers = {}  # noqa: RUF012
    yaml_constructors = {None: value}  # noqa: RUF012


def _wrong(words: str, part: yaml.Node | yaml.Event) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=words, problem_mark=part.start_mark)


def load(path: FilePath) -> Fields:
    """Return a file's top-level fields: numbers, texts, lists and maps.

    Raises ValueError naming file and line where it is no YAML, XML or JSON of that kind.
    """
    text, where = read_text(path, KIND), repr(str(path))
    if text.lstrip().startswith("<"):
        data = _xml_value(parse_xml(text, path), where)
    elif Path(path).suffix.lower() == ".json":
        data = parse_json(text, path)
    else:
        data = _parse_yaml(text, where)
    return Fields(data, where)


def _parse_yaml(text: str, where: str) -> Any:
    if len(text) > MOST_YAML:
        raise ValueError(f"`path`: expected YAML of at most {MOST_YAML} bytes, got {where}: more")
    plain = re.sub(r"\A\s*%YAML:.*", "", text)
    try:
        for event in yaml.parse(plain, _Loader):  # by aliases a small file grows without bound
            if isinstance(event, yaml.AliasEvent):
                raise _wrong("an alias (*name), which is not read", event)
        data = yaml.load(plain, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.context_mark or error.problem_mark
        line = 0 if mark is None else mark.line
        shown = text.splitlines()[line : line + 1] or [""]
        words = f"line {line + 1}: expected YAML, got {short(shown[0])}: {error.problem}"
        raise ValueError(f"{words[:400]} (in {where})") from None
    except (yaml.YAMLError, RecursionError) as error:
        words = str(error).partition("\n")[0][:200]
        raise ValueError(f"`path`: expected YAML, got {where}: {words}") from None
    if is_deep(data):
        raise ValueError(f"`path`: expected YAML of at most {MOST_DEPTH} levels, got {where}: more")
    return data


def _xml_value(element: ET.Element, where: str, depth: int = 0) -> Any:
    """Return an element's value: a map of its children, a list, a text or a number."""
    children = list(element)
    if depth > MOST_DEPTH:
        raise ValueError(f"`path`: expected XML of at most {MOST_DEPTH} levels, got {where}: more")
    values = [_xml_value(child, where, depth + 1) for child in children]
    names = [child.tag for child in children]
    if twice := first_repeat(name for name in names if name != "_"):
        raise ValueError(f"`path`: expected XML, got {where}: the field {short(twice)} twice")
    if names and set(names) != {"_"}:
        return dict(zip(names, values, strict=True))
    values += [_scalar(word) for word in PIECES.findall(element.text or "")]
    return values[0] if len(values) == 1 and not children else values


def _scalar(text: str) -> Any:
    """Return a number where a text is one (also .Nan, -.Inf), else the text without quotes."""
    if INTEGER.fullmatch(text):
        return int(text)
    if NUMBER.fullmatch(text):
        return float(text)
    special = text.lower().lstrip("+-")
    if special in (".inf", ".nan"):
        return float(text.replace(".", "", 1))
    return text.strip('"')


def matrix_array(name: str, value: Any, where: str) -> Any:
    """Return the array of a matrix (rows, cols, dt, data), float64; another value as it is."""
    if not isinstance(value, dict) or "data" not in value:
        return value
    numbers = as_numbers(value["data"])
    size = value.get("sizes", [value.get("rows"), value.get("cols")])
    with suppress(AttributeError, TypeError, ValueError):  # no numbers, no size, or another one
        array = numbers.reshape(size)  # pyright: ignore[reportOptionalMemberAccess]
        is_plain = len(str(value.get("dt", "d"))) == 1 and list(array.shape) == size
        if is_plain and np.all(np.isfinite(array)):
            return array
    words = "an OpenCV matrix (rows, cols, dt, data): rows x cols finite numbers in one channel"
    raise Fields({}, where).wrong(name, words, value)
