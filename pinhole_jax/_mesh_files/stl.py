"""STL, binary and text: triangles."""

import re

import numpy as np

from .numbers import parse_rows, strip_mark
from .polygons import Polygons

#: A facet of a binary file.
FACET = np.dtype([("normal", "<3f4"), ("corners", "<9f4"), ("attribute", "<u2")])
#: Lines of text that count, and what follows in them: a solid's may be any name.
LINE = re.compile(rb"^[ \t]*(solid|endsolid|endloop|vertex)\b(.*)", re.I | re.M)
WHOLE = re.compile(rb"vertex vertex vertex endloop|solid|endsolid| ")


def read_stl(data: bytes) -> Polygons:
    """Return the triangles of an STL file: text, if its length is not that of its count.

    Raises ValueError for text that is not whole, or has loops of other than three corners.
    """
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + count * FACET.itemsize:
        points = np.frombuffer(data, FACET, count, 84)["corners"].astype(float)
    else:
        data = strip_mark(data) if data[:2] != b"\0\0" else data
        lines = LINE.findall(data.replace(b"\r", b"\n"))
        words = b" ".join(word for word, _ in lines).lower()
        if not words.startswith(b"solid"):
            raise ValueError(f"{len(data)} bytes for {count} faces, and no text either")
        if not words.endswith(b"endsolid"):
            raise ValueError("text without its end, `endsolid`")
        vertices = [rest for word, rest in lines if word.lower() == b"vertex"]
        points, counts = parse_rows(vertices, float, "vertices")
        if WHOLE.sub(b"", words) or np.any(counts != 3):
            raise ValueError("expected facets of three corners, of three coordinates, got others")
    corners = np.arange(points.size // 3)
    return Polygons(points.reshape(-1, 3), corners, np.full(len(corners) // 3, 3))
