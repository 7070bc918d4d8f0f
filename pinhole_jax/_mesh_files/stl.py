"""STL, binary and text: triangles, each with corners of its own."""

import re
import struct

import numpy as np

from .polygons import Polygons
from .text import counts_of, numbers_of, unmarked

RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
BODY = 84


def read_stl(data: bytes) -> Polygons:
    """Return the triangles of an stl file: binary where the length is that of its count.

    Raises ValueError where it is neither that nor whole text, and for facets of other than three
    corners.
    """
    (count,) = struct.unpack_from("<I", data.ljust(BODY, b"\0"), BODY - 4)
    if len(data) == BODY + count * RECORD.itemsize:
        return _own_corners(np.frombuffer(data, RECORD, count, BODY)["corners"])
    data = unmarked(data) if data[:2] != b"\0\0" else data
    if not re.match(rb"\s*solid\b", data, re.IGNORECASE):
        raise ValueError(f"{len(data)} bytes for {count} faces, and no text either")
    return _read_text(data)


def _read_text(data: bytes) -> Polygons:
    words = re.compile(rb"^[ \t]*(vertex|endloop|endsolid|facet)\b([^\r\n]*)", re.I | re.M)
    found = [(name.lower(), rest) for name, rest in words.findall(data.replace(b"\r", b"\n"))]
    names = np.array([name for name, _ in found])
    if not found or names[-1] != b"endsolid":
        raise ValueError("text without its end, `endsolid`")

    loops = np.flatnonzero(names == b"endloop")
    corners = np.diff(np.cumsum(names == b"vertex")[loops], prepend=0)
    number = np.count_nonzero(names == b"vertex")
    if np.any(corners != 3) or number != 3 * len(loops):
        raise ValueError("expected facets of three corners, got others")
    lines = [rest for name, rest in found if name == b"vertex"]
    if np.any(counts_of(lines) != 3):
        raise ValueError("expected vertices of three coordinates, got others")
    return _own_corners(numbers_of(b"\n".join(lines), float, "vertices", 3 * len(lines)))


def _own_corners(corners: np.ndarray) -> Polygons:
    points = corners.astype(corners.dtype.newbyteorder("=")).reshape(-1, 3)
    return Polygons(points, np.arange(len(points)), np.full(len(points) // 3, 3))
