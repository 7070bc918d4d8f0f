"""Object File Format (OFF), as text: polygons of vertices that may have colours and normals."""

import re

import numpy as np

from .numbers import (
    COMMENT,
    parse_numbers,
    parse_points,
    parse_rows,
    strip_mark,
    to_integers,
)
from .polygons import Polygons

HEADER = re.compile(rb"\s*((?:ST)?C?N?)(4?n?)OFF\b[ \t]*(BINARY)?|\s*(?=\d)|\s*OFF(?=\d)")


def read_off(data: bytes) -> Polygons:
    """Return the polygons of an off file.

    Raises ValueError for binary files, vertices of other than three dimensions, and fewer vertices
    or faces than the header says.
    """
    header = HEADER.match(data := COMMENT.sub(b"", strip_mark(data)))
    if not header:
        raise ValueError("no OFF at its beginning")
    if header[2] or header[3]:
        raise ValueError(f"{header[0].decode().strip()}: only text and three dimensions are read")
    lines = [line for line in data[header.end() :].splitlines() if line.strip()]
    sizes = parse_numbers(lines[0] if lines else b"", int, "the line of counts")
    if sizes.size < 2 or np.any(sizes[:2] < 0):
        raise ValueError("expected the numbers of vertices and faces first, got no such numbers")

    vertices, faces = (int(size) for size in sizes[:2])
    if len(lines) - 1 < vertices + faces:
        raise ValueError(
            f"expected {vertices} vertices and {faces} faces as its header says, got"
            f" {len(lines) - 1} lines"
        )
    points = parse_points(lines[1 : 1 + vertices])
    # A face's line is a number of corners, as many vertices, then perhaps a colour.
    lines = lines[1 + vertices : 1 + vertices + faces]
    numbers, words = parse_rows(lines, float, "faces")
    starts = np.cumsum(words) - words
    counts = to_integers(numbers[starts], "the numbers of corners")
    wrong = (counts < 0) | (counts >= words)
    if np.any(wrong):
        k = int(np.argmax(wrong))
        raise ValueError(f"face {k + 1}: {counts[k]} corners in a line of {words[k]} numbers")
    place = np.arange(numbers.size) - np.repeat(starts, words)  # of a number in its line
    corners = numbers[(place > 0) & (place <= np.repeat(counts, words))]
    return Polygons(points, to_integers(corners, "faces"), counts)
