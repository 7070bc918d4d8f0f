"""Stanford PLY, text and binary: polygons and triangle strips."""

import re
import struct
from typing import NamedTuple

import numpy as np

from .polygons import Polygons, strips_cut
from .text import numbers_of, taken, unmarked, whole

#: What the header calls a type, and NumPy.
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float16": "f2",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q",
         "f2": "e", "f4": "f", "f8": "d"}  # fmt: skip
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
#: What a list of a face's vertices is called.
CORNERS = ("vertex_indices", "vertex_index")


class Property(NamedTuple):
    """A column: its name, its type, and if it holds lists the type of their lengths."""

    name: str
    kind: str
    length: str | None


class Element(NamedTuple):
    """A table of `number` rows."""

    name: str
    number: int
    properties: list[Property]


class Lists(NamedTuple):
    """A column of lists: the `values` of all rows, and how many each row has."""

    values: np.ndarray
    counts: np.ndarray


def read_ply(data: bytes) -> Polygons:
    """Return the polygons of a ply file: of its faces, and of its triangle strips if it has some.

    Raises ValueError for a header that is none, for fewer or more data than it says, and for faces
    without a list of vertices.
    """
    elements, order, body = _header(data)
    if order == "=":
        body = numbers_of(body, float, "the rows").tobytes()
        elements = [_of_doubles(element) for element in elements]

    at, tables = 0, {}
    for element in elements:
        tables[element.name], at = _table(element, body, at, order)
    if at != len(body):
        raise ValueError(f"expected {at} bytes of rows as its header says, got {len(body)}")

    points = _points(tables.get("vertex", {}))
    faces = _corners(tables.get("face"), "face")
    strips = _corners(tables.get("tristrips"), "tristrips")
    triangles = strips_cut(*strips)
    corners = np.concatenate([faces.values, triangles.ravel()])
    return Polygons(points, corners, np.concatenate([faces.counts, np.full(len(triangles), 3)]))


def _header(data: bytes) -> tuple[list[Element], str, bytes]:
    """Return the tables that follow, their byte order, and their bytes."""
    data = unmarked(data)
    end = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if not end:
        raise ValueError("no ply at its beginning")
    found = re.search(rb"(?:\r|\n)end_header[ \t]*" + end[1], data)
    if not found:
        raise ValueError("no end of its header")

    order, elements = None, []
    for line in data[end.end() : found.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", name, "1.0"] if name in ORDERS:
                order = ORDERS[name]
            case ["element", name, number] if number.isdecimal() and len(number) < 19:
                elements.append(Element(name, int(number), []))
            case ["property", "list", length, kind, name] if elements:
                elements[-1].properties.append(Property(name, _type(kind), _type(length)))
            case ["property", kind, name] if elements:
                elements[-1].properties.append(Property(name, _type(kind), None))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"the line {line[:60]!r} in its header")
    if order is None:
        raise ValueError("no format in its header")
    names = [element.name for element in elements]
    if len(set(names)) < len(names):
        raise ValueError(f"an element twice in its header: {sorted(names)}")
    return elements, order, data[found.end() :]


def _type(name: str) -> str:
    if name not in TYPES:
        raise ValueError(f"the type {name!r} in its header")
    return TYPES[name]


def _of_doubles(element: Element) -> Element:
    """Return the table as one of doubles only, which is what text is read as."""
    doubles = [p._replace(kind="f8", length=p.length and "f8") for p in element.properties]
    return element._replace(properties=doubles)


def _table(element: Element, body: bytes, at: int, order: str) -> tuple[dict[str, Lists], int]:
    """Return the columns of a table that begins at byte `at`, and where it ends.

    A row that is as long as every other is the rule; only where it is not are rows gone through
    one by one.
    """
    names = [p.name for p in element.properties]
    if not element.number or not names:
        return {name: Lists(np.empty(0), np.empty(0, int)) for name in names}, at
    lengths, end = _lengths(element, body, at, order)
    last = at + element.number * (end - at)
    columns = None
    if last <= len(body):
        columns = _alike(element, lengths, body, at, order)
    if columns is None:
        columns, last = _one_by_one(element, body, at, order)
    return dict(zip(names, columns, strict=True)), last


def _lengths(element: Element, body: bytes, at: int, order: str) -> tuple[list[int], int]:
    """Return how many values each property has in the row at byte `at`, and where the row ends."""
    lengths = []
    for p in element.properties:
        length = 1
        if p.length and at + int(p.length[1]) <= len(body):
            (given,) = struct.unpack_from(order + CODES[p.length], body, at)
            length, at = int(given), at + int(p.length[1])
            if length != given or length < 0:
                raise ValueError(f"a list of {given} values in {element.name!r}")
        lengths.append(length)
        at += length * int(p.kind[1])
    if at > len(body):
        raise ValueError(f"it ends before the {element.number} rows of {element.name!r}")
    return lengths, at


def _alike(
    element: Element, lengths: list[int], body: bytes, at: int, order: str
) -> list[Lists] | None:
    """Return the columns of a table of rows that all have these lengths, or None if they differ."""
    fields = []
    for k, (p, length) in enumerate(zip(element.properties, lengths, strict=True)):
        fields += [(f"length {k}", order + p.length)] if p.length else []
        fields.append((f"values {k}", order + p.kind, (length,)))
    rows = np.frombuffer(body, np.dtype(fields), element.number, at)

    columns = []
    for k, (p, length) in enumerate(zip(element.properties, lengths, strict=True)):
        if p.length and np.any(rows[f"length {k}"] != length):
            return None
        columns.append(Lists(rows[f"values {k}"].reshape(-1), np.full(len(rows), length)))
    return columns


def _one_by_one(element: Element, body: bytes, at: int, order: str) -> tuple[list[Lists], int]:
    """Return the columns of a table whose rows differ in length, and where it ends."""
    ends, counts = [], []
    for _ in range(element.number):
        lengths, at = _lengths(element, body, at, order)
        counts.append(lengths)
        ends.append(at)

    counts, octets, columns = np.array(counts), np.frombuffer(body, np.uint8), []
    stop = np.array(ends)
    for k in reversed(range(len(element.properties))):
        p = element.properties[k]
        sizes = counts[:, k] * int(p.kind[1])
        values = taken(octets, stop - sizes, sizes).view(order + p.kind)
        columns.append(Lists(values, counts[:, k]))
        stop = stop - sizes - (int(p.length[1]) if p.length else 0)
    return columns[::-1], at


def _points(vertex: dict[str, Lists]) -> np.ndarray:
    if missing := [name for name in "xyz" if name not in vertex]:
        raise ValueError(f"expected vertices with x, y and z, got no {missing[0]}")
    columns = [vertex[name] for name in "xyz"]
    if any(np.any(column.counts != 1) for column in columns):
        raise ValueError("expected vertices with one x, y and z each, got lists")
    return np.stack([column.values.astype(float) for column in columns], axis=-1)


def _corners(table: dict[str, Lists] | None, name: str) -> Lists:
    """Return the lists of vertices of a table, none if there is no such table."""
    if table is None:
        return Lists(np.empty(0, int), np.empty(0, int))
    found = [column for key, column in table.items() if key in CORNERS]
    if len(found) != 1:
        raise ValueError(
            f"expected {CORNERS[0]!r} in {name!r}, got {', '.join(table) or 'nothing'}"
        )
    values, counts = found[0]
    return Lists(whole(values, CORNERS[0]), counts)
