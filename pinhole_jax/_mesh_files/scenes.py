"""The formats that trimesh reads: STL, and glTF's scenes."""

import io
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .numbers import strip_mark
from .plain_gltf import plain_gltf, resource
from .polygons import Polygons, merge

STL_NAME = re.compile(rb"^([ \t]*(?:end)?solid\b).*", re.I | re.M)
STL_NORMAL = re.compile(rb"^([ \t]*facet[ \t]+normal)(?:[ \t]+\S+){3}", re.I | re.M)
STL_WORD = re.compile(
    rb"^[ \t]*(solid|endsolid|endloop|vertex(?=(?:[ \t]+\S+){3}[ \t]*$))\b", re.I | re.M
)
STL_WHOLE = re.compile(rb"vertex vertex vertex endloop|solid|endsolid| ")


def read_scene(data: bytes, file: Path) -> Polygons:
    """Return the triangles of an STL or glTF file.

    Raises ValueError for what trimesh refuses or would pass over.
    """
    import trimesh
    from trimesh.resolvers import FilePathResolver

    class Folder(FilePathResolver):
        """Files beside this one alone."""

        def get(self, name: str) -> bytes:
            return resource(file, name)

    kind = file.suffix.lower()
    # (NumPy reads numbers up to the first that is none, and says so by this warning.)
    with (
        warnings.catch_warnings(action="error", category=DeprecationWarning),
        np.errstate(all="ignore"),
    ):
        try:
            plain = _checked_stl(data) if kind == ".stl" else plain_gltf(strip_mark(data))
            scene = trimesh.load(
                io.BytesIO(plain),
                file_type=kind[1:],
                resolver=Folder(str(file)),
                force="scene",
                process=False,
            )
        except (AssertionError, AttributeError, LookupError, TypeError) as error:
            words = f"numbers or objects that are not in their place: {type(error).__name__}"
            raise ValueError(f"{words} {error}") from error
        return merge(_parts(scene))


def _parts(scene: Any) -> Iterator[tuple[Polygons, np.ndarray]]:
    """Yield polygons and their places; trimesh itself takes n^3 steps for a chain of n nodes."""
    places = {scene.graph.base_frame: np.eye(4)}
    for parent, node, edge in scene.graph.to_edgelist():  # parents first
        places[node] = places[parent] @ np.array(edge.get("matrix", np.eye(4)))
        if "geometry" in edge:
            mesh = scene.geometry[edge["geometry"]]
            faces = np.asarray(mesh.faces)
            points, counts = np.asarray(mesh.vertices, float), np.full(len(faces), 3)
            yield Polygons(points, faces.ravel(), counts), places[node]


def _checked_stl(data: bytes) -> bytes:
    """Return an STL file. A file whose length is not that of its count is text. It must be whole,
    with three corners in each loop; names are removed. trimesh checks none of this."""
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * count:
        return data
    data = strip_mark(data) if data[:2] != b"\0\0" else data
    data = STL_NAME.sub(rb"\1", data.replace(b"\r", b"\n"))
    # (Of normals that are no numbers, -1.#IND, trimesh logs a traceback.)
    data = STL_NORMAL.sub(rb"\1 0 0 1", data)
    words = b" ".join(STL_WORD.findall(data)).lower()
    if not words.startswith(b"solid"):
        raise ValueError(f"{len(data)} bytes for {count} faces, and no text either")
    if not words.endswith(b"endsolid"):
        raise ValueError("text without its end, `endsolid`")
    if STL_WHOLE.sub(b"", words):
        raise ValueError("expected facets of three corners, of three coordinates, got others")
    return data
