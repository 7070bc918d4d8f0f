"""Stanford PLY, text and binary: polygons and triangle strips."""

import re
from typing import Any, NamedTuple

import numpy as np

from .numbers import parse_numbers, strip_mark, to_integers
from .polygons import Polygons, cut_strips

#: What the header calls a type, and NumPy.
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
}  # fmt: skip
SIZED = "int8 uint8 int16 uint16 int32 uint32 int64 uint64 float16 float32 float64"
TYPES |= {name: np.dtype(name).str[1:] for name in SIZED.split()}
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
#: What a list of a face's vertices is called.
CORNERS = ("vertex_indices", "vertex_index")


#: A column: its name, its type, and if it holds lists the type of their lengths.
Column = tuple[str, np.dtype, np.dtype | None]


class Table(NamedTuple):
    """What the header says of a table: its name, its number of rows, and its columns."""

    name: str
    number: int
    columns: list[Column]


class Lists(NamedTuple):
    """A column of lists: the `values` of all rows, and the length of each row's."""

    values: np.ndarray
    counts: np.ndarray


def read_ply(data: bytes) -> Polygons:
    """Return the polygons of a ply file: of its faces, and of its triangle strips if it has some.

    Raises ValueError for a header that is none, for fewer or more data than it says, and for faces
    without a list of vertices.
    """
    tables, order, body = _header(data)
    if order == "=":
        body = parse_numbers(body, float, "the rows").tobytes()

    end, columns = 0, {}
    for table in tables:
        if table.name in columns:
            raise ValueError(f"the element {table.name!r} twice in its header")
        columns[table.name], end = _columns(table, body, end)
    if end != len(body):
        raise ValueError(f"expected {end} bytes of rows as its header says, got {len(body)}")

    points = _points(columns.get("vertex", {}))
    faces = _corners(columns.get("face"), "face")
    triangles = cut_strips(*_corners(columns.get("tristrips"), "tristrips"))
    corners = np.concatenate([faces.values, triangles.ravel()])
    return Polygons(points, corners, np.concatenate([faces.counts, np.full(len(triangles), 3)]))


def _header(data: bytes) -> tuple[list[Table], str | None, bytes]:
    """Return the tables that follow, their byte order, and their bytes."""
    data = strip_mark(data)
    end = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if not end:
        raise ValueError("no ply at its beginning")
    found = re.search(rb"(?:\r|\n)end_header[ \t]*" + end[1], data)
    if not found:
        raise ValueError("no end of its header")

    order, tables = None, []
    for line in data[end.end() : found.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", name, "1.0"] if name in ORDERS:
                order = ORDERS[name]
            case ["element", name, number] if number.isdecimal() and len(number) < 19:
                tables.append(Table(name, int(number), []))
            case ["property", "list", length, kind, name] if tables:
                tables[-1].columns.append((name, _type(kind, order), _type(length, order)))
            case ["property", kind, name] if tables:
                tables[-1].columns.append((name, _type(kind, order), None))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"the line {line[:60]!r} in its header")
    return tables, order, data[found.end() :]


def _type(name: str, order: str | None) -> np.dtype:
    """Return NumPy's type; text is read as doubles, whatever the header says."""
    if order is None:
        raise ValueError("no format in its header, or behind the tables")
    if name not in TYPES:
        raise ValueError(f"the type {name!r} in its header")
    return np.dtype("f8" if order == "=" else order + TYPES[name])


def _columns(table: Table, body: bytes, start: int) -> tuple[dict[str, Lists], int]:
    """Return the columns of a table that begins at byte `start`, and the byte at its end.

    Rows whose lists are as long as those of the current row are read at once: a run, looked for in
    twice as many rows as the one before had, so that many short ones take no longer.
    """
    runs, left, run = [], table.number, table.number
    while left and table.columns:
        row = _row(table, body, start)
        count = min(left, 2 * run, (len(body) - start) // row.itemsize)
        if count == 0:
            raise _cut_short(table)
        rows = np.frombuffer(body, row, count, start)
        lists = [name for name, _, length in table.columns if length]
        differs = [rows[f"{name} length"] != row[name].shape for name in lists]
        run = int(np.argmax(np.append(np.any([np.zeros(count, bool), *differs], axis=0), True)))
        runs.append(rows[:run])
        left, start = left - run, start + run * row.itemsize

    columns = {}
    for name, *_ in table.columns:
        lists = [rows[name] for rows in runs] or [np.empty((0, 0))]
        counts = np.repeat([x.shape[1] for x in lists], [len(x) for x in lists])
        columns[name] = Lists(np.concatenate([x.ravel() for x in lists]), counts)
    return columns, start


def _row(table: Table, body: bytes, start: int) -> np.dtype:
    """Return the type of the row at a byte: lists are as long as they are there."""
    fields: list[Any] = []
    for name, kind, length in table.columns:
        count = 1
        if length:
            if start + length.itemsize > len(body):
                raise _cut_short(table)
            given = np.frombuffer(body, length, 1, start)[0]
            if not (given >= 0 and float(given).is_integer()):
                raise ValueError(f"a list of {given} values in {table.name!r}")
            fields.append((f"{name} length", length))
            count, start = int(given), start + length.itemsize
        fields.append((name, kind, (count,)))
        start += count * kind.itemsize
    return np.dtype(fields)


def _cut_short(table: Table) -> ValueError:
    return ValueError(f"it ends before the {table.number} rows of {table.name!r}")


def _points(vertex: dict[str, Lists]) -> np.ndarray:
    columns = [vertex[x].values for x in "xyz" if x in vertex and np.all(vertex[x].counts == 1)]
    if len(columns) < 3:
        got = ", ".join(vertex) or "none"
        raise ValueError(f"expected vertices with one x, y and z each, got {got}")
    return np.stack(columns, axis=-1).astype(float)


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
    return Lists(to_integers(values, CORNERS[0]), counts.astype(int))
