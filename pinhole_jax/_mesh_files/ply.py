"""Stanford PLY, text and binary: polygons and triangle strips."""

import re
from typing import Any

import numpy as np

from .numbers import parse_numbers, strip_mark, to_integers
from .polygons import NOTHING, Polygons, cut_strips

#: What the header calls a type, and NumPy.
NAMES = "char uchar short ushort int uint float double"
TYPES = dict(zip(NAMES.split(), "bBhHiIfd", strict=True))
SIZED = "int8 uint8 int16 uint16 int32 uint32 int64 uint64 float16 float32 float64"
TYPES |= {name: np.dtype(name).str[1:] for name in SIZED.split()}
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
#: What a list of a face's vertices is called.
CORNERS = ("vertex_indices", "vertex_index")


#: A column: its name, its type, and if it holds lists the type of their lengths; and a table, as
#: the header describes it: its name, its number of rows, and its columns.
Column = tuple[str, np.dtype, np.dtype | None]
Table = tuple[str, int, list[Column]]
#: A column's contents: the values of all rows, and how many each row has.
Lists = tuple[np.ndarray, np.ndarray]


def read_ply(data: bytes) -> Polygons:
    """Return the polygons of a ply file: of its faces, and of its triangle strips if it has some.

    Raises ValueError for a header that is none, for fewer or more data than it says, and for faces
    without a list of vertices.
    """
    tables, order, body = _header(data)
    if order == "=":
        body = parse_numbers(body, float, "the rows").tobytes()

    end, columns = 0, {}
    for name, number, kinds in tables:
        if name in columns:
            raise ValueError(f"the element {name!r} twice in its header")
        columns[name], end = _columns(name, number, kinds, body, end)
    if end != len(body):
        raise ValueError(f"expected {end} bytes of rows as its header says, got {len(body)}")

    points = _points(columns.get("vertex", {}))
    corners, counts = _corners(columns.get("face"), "face")
    triangles = cut_strips(*_corners(columns.get("tristrips"), "tristrips"))
    counts = np.concatenate([counts, np.full(len(triangles), 3)])
    return Polygons(points, np.concatenate([corners, triangles.ravel()]), counts)


def _header(data: bytes) -> tuple[list[Table], str | None, bytes]:
    """Return the tables that follow, their byte order, and their bytes."""
    data = strip_mark(data)
    end = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if not end:
        raise ValueError("no ply at its beginning")
    found = re.search(rb"(?:\r|\n)end_header[ \t]*" + end[1], data)
    if not found:
        raise ValueError("no end of its header")

    order, tables, columns = None, [], []
    for line in data[end.end() : found.start()].decode("latin-1").splitlines():
        match line.split():
            case ["format", name, "1.0"] if name in ORDERS:
                order = ORDERS[name]
            case ["element", name, number] if number.isdecimal() and len(number) < 19:
                columns = []
                tables.append((name, int(number), columns))
            case ["property", "list", length, kind, name] if tables:
                columns.append((name, _type(kind, order), _type(length, order)))
            case ["property", kind, name] if tables:
                columns.append((name, _type(kind, order), None))
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


def _columns(
    name: str, number: int, columns: list[Column], body: bytes, start: int
) -> tuple[dict[str, Lists], int]:
    """Return the columns of a table that begins at byte `start`, and the byte at its end.

    Rows whose lists are as long as those of the current row are read at once: a run, looked for in
    twice as many rows as the one before had, so that many short ones take no longer.
    """
    runs, left, run = [], number, number
    while left and columns:
        row = _row(name, columns, body, start)
        count = min(left, 2 * run, (len(body) - start) // row.itemsize)
        if count == 0:
            raise ValueError(f"it ends before the {number} rows of {name!r}")
        rows = np.frombuffer(body, row, count, start)
        lists = [name for name, _, length in columns if length]
        differs = [rows[f"{name} length"] != row[name].shape for name in lists]
        run = int(np.argmax(np.append(np.any([np.zeros(count, bool), *differs], axis=0), True)))
        runs.append(rows[:run])
        left, start = left - run, start + run * row.itemsize

    found = {}
    for name, *_ in columns:
        lists = [rows[name] for rows in runs] or [np.empty((0, 0))]
        counts = np.repeat([x.shape[1] for x in lists], [len(x) for x in lists])
        found[name] = np.concatenate([x.ravel() for x in lists]), counts
    return found, start


def _row(table: str, columns: list[Column], body: bytes, start: int) -> np.dtype:
    """Return the type of the row at a byte: lists are as long as they are there."""
    fields: list[Any] = []
    for name, kind, length in columns:
        count = 1
        if length:
            # (What is behind the end is 0.)
            given = np.frombuffer(body[start : start + 8].ljust(8, b"\0"), length, 1)[0]
            if not (given >= 0 and float(given).is_integer()):
                raise ValueError(f"a list of {given} values in {table!r}")
            fields.append((f"{name} length", length))
            count, start = int(given), start + length.itemsize
        fields.append((name, kind, (count,)))
        start += count * kind.itemsize
    return np.dtype(fields)


def _points(vertex: dict[str, Lists]) -> np.ndarray:
    numbers = {name: values for name, (values, counts) in vertex.items() if np.all(counts == 1)}
    if not numbers.keys() >= {*"xyz"}:
        got = ", ".join(vertex) or "none"
        raise ValueError(f"expected vertices with one x, y and z each, got {got}")
    return np.stack([numbers[x] for x in "xyz"], axis=-1).astype(float)


def _corners(table: dict[str, Lists] | None, name: str) -> Lists:
    """Return the lists of vertices of a table, none if there is no such table."""
    if table is None:
        return NOTHING[1:]
    found = [column for key, column in table.items() if key in CORNERS]
    if len(found) != 1:
        raise ValueError(
            f"expected {CORNERS[0]!r} in {name!r}, got {', '.join(table) or 'nothing'}"
        )
    values, counts = found[0]
    return to_integers(values, CORNERS[0]), counts.astype(int)
