"""OpenCV's FileStorage: its YAML, XML or JSON as fields."""

import re
import xml.etree.ElementTree as ET
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .._files.fields import Fields, as_numbers, short
from .._files.paths import (
    FilePath,
    as_fields,
    parse_data,
    parse_json,
    parse_xml,
    read_text,
)
from .pinhole import KIND

#: The largest YAML that is read here, in characters (it takes a second and 0.3 GB).
MOST_YAML = 1 << 20
INTEGER = re.compile(r"[-+]?\d{1,18}")
NUMBER = re.compile(r"[-+]?(?:\d++\.?\d*+|\.\d++)(?:[eE][-+]?\d++)?")
PIECES = re.compile(r'"[^"]*+"?|[^\s"]++')


def load(path: FilePath) -> Fields:
    """Return a file's top-level fields: numbers, texts, lists and maps.

    Raises ValueError naming file and line where it is no YAML, XML or JSON of that kind.
    """
    text = read_text(path, KIND)
    if text.lstrip().startswith("<"):
        data = parse_data(partial(_xml_value, parse_xml(text, path)), path, "XML")
    elif Path(path).suffix.lower() == ".json":
        data = parse_json(text, path)
    else:
        data = parse_data(partial(_parse_yaml, text), path, "YAML")
    return Fields(data, repr(str(path)))


def _parse_yaml(text: str) -> Any:
    if len(text) > MOST_YAML:
        raise ValueError(f"more than {MOST_YAML} characters")
    plain = re.sub(r"\A\s*%YAML:.*", "", text)
    try:
        for event in yaml.parse(plain, yaml.CBaseLoader):  # small files grow by them without bound
            if isinstance(event, yaml.AliasEvent):
                raise ValueError("an alias (*name), which is not read")
        return _yaml_value(yaml.compose(plain, yaml.CBaseLoader))
    except yaml.MarkedYAMLError as error:
        mark = error.context_mark or error.problem_mark
        line = 0 if mark is None else mark.line
        shown = text.splitlines()[line : line + 1] or [""]
        words = f"line {line + 1}, {short(shown[0])}: {error.problem}"
    except yaml.YAMLError as error:
        words = str(error)
    raise ValueError(words[:400])


def _yaml_value(node: Any) -> Any:
    """Return a node's value, whatever its tag."""
    if isinstance(node, yaml.MappingNode):
        return as_fields((str(key.value), _yaml_value(value)) for key, value in node.value)
    if isinstance(node, yaml.SequenceNode):
        return [*map(_yaml_value, node.value)]
    return node and (node.value if node.style else _scalar(node.value))


def _xml_value(element: ET.Element) -> Any:
    """Return an element's value: a map of its children, a list, a text or a number."""
    parts = [(child.tag, _xml_value(child)) for child in element]
    if {name for name, _ in parts} - {"_"}:
        return as_fields(parts)
    values = [value for _, value in parts]
    values += [_scalar(word) for word in PIECES.findall(element.text or "")]
    return values[0] if len(values) == 1 and not parts else values


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


def matrix_array(file: Fields, name: str, value: Any) -> Any:
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
    raise file.wrong(name, words, value)
