"""Wavefront OBJ: polygons. Groups, normals, textures, lines and points make no difference.

Files that it names (`mtllib`) are materials and not opened.
"""

import re
from itertools import compress

import numpy as np

from .numbers import COMMENT, parse_points, parse_rows, strip_mark
from .polygons import Polygons

#: How statements begin that are read, and those that add faces which are not.
VERTEX, FACE = (b"v ", b"v\t"), (b"f ", b"f\t")
OTHER_SHAPES = (b"surf", b"call", b"csh", b"bzp", b"bsp", b"cdc", b"cdp", b"res")


def read_obj(data: bytes) -> Polygons:
    """Return the polygons of an obj file. A negative index counts back from the vertex before it.

    Raises ValueError for vertices or faces that are no numbers, the index 0, and curved surfaces.
    """
    data = strip_mark(data)
    if b"#" in data:
        data = COMMENT.sub(b"", data)
    data = re.sub(rb"\\[ \t]*(\r\n|\n|\r)", b" ", data)
    lines = [line.strip() for line in data.splitlines()]
    for statement in (line.split()[0] for line in lines if line.startswith(OTHER_SHAPES)):
        if statement in OTHER_SHAPES:
            raise ValueError(f"the statement {statement.decode()!r}: only polygons are read")

    is_vertex, is_face = (
        np.array([line.startswith(kinds) for line in lines], bool) for kinds in (VERTEX, FACE)
    )
    faces = b"\n".join(line[2:] for line in compress(lines, is_face))
    plain = re.sub(rb"\b/\S*", b"", faces)  # without textures and normals
    corners, counts = parse_rows(plain.splitlines(), int, "faces")
    if np.any(corners == 0):
        raise ValueError("a face with the vertex 0; they are counted from 1")
    before = np.repeat(np.cumsum(is_vertex)[is_face], counts)
    points = parse_points([line[2:] for line in compress(lines, is_vertex)])
    return Polygons(points, np.where(corners < 0, corners + before, corners - 1), counts)
