"""glTF's meshes: triangles and strips where the scene's nodes place them.

Lines and points, names, cameras and materials are no shape and left out. What would change the
shape and is not read (skins, morph targets, instances, fans, sparse or normalised positions,
compression) is refused by name.
"""

import base64
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from .._files.fields import Fields
from .._files.paths import read_bytes
from .glb import MOST_BYTES, children, parse_gltf, parts, place_nodes
from .polygons import Polygons, cut_strips, merge

UNREAD = ("skin", "sparse", "EXT_mesh_gpu_instancing", "KHR_node_visibility",
          "KHR_draco_mesh_compression", "EXT_meshopt_compression",
          "KHR_meshopt_compression")  # fmt: skip
#: Extensions that a file may require: they say nothing about shape, or allow integers.
NO_SHAPE = ("KHR_mesh_quantization", "KHR_materials_", "KHR_texture_", "EXT_texture_",
            "MSFT_texture_", "KHR_lights_", "EXT_lights_", "KHR_xmp", "ADOBE_materials_",
            "EXT_materials_")  # fmt: skip
#: NumPy's types of glTF's numbers, and those that indices may have.
POSITIONS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
INDICES = {5121: "u1", 5123: "<u2", 5125: "<u4"}
TRIANGLES, STRIP = 4, 5
#: A part of a buffer, and the bytes from one of its elements to the next, 0: no gaps.
View = tuple[memoryview, int]


def read_gltf_mesh(data: bytes, file: Path) -> Polygons:
    """Return the triangles of a glTF file's scene.

    Raises ValueError, which names the field, for features that are not read.
    """
    top, binary = parse_gltf(data, file)
    asset = top.part("asset") if "asset" in top else top
    if not (version := str(asset.data.get("version", "2.0"))).startswith("2."):
        raise asset.wrong("version", "2.0", version)
    for name in top.data.get("extensionsRequired", ()):
        if not str(name).startswith(NO_SHAPE):
            raise top.wrong("extensionsRequired", "extensions that are read here", str(name))
    buffers = [_data(buffer, binary, file) for buffer in parts(top, "buffers")]
    views = [_view(view, buffers) for view in parts(top, "bufferViews")]
    return merge(_primitives(top, views))


def _view(view: Fields, buffers: list[memoryview]) -> View:
    begin, length = view.integer("byteOffset", 0, 0), view.integer("byteLength")
    data = _readable(view).chosen("buffer", buffers)[begin : begin + length]
    return data, view.integer("byteStride", 0, 0)


def _primitives(top: Fields, views: list[View]) -> Iterator[tuple[Polygons, np.ndarray]]:
    """Yield the polygons of each primitive in the scene, and their place (4, 4)."""
    nodes, meshes, accessors = (parts(top, name) for name in ("nodes", "meshes", "accessors"))
    roots = children(top.chosen("scene", parts(top, "scenes"), 0), nodes, "nodes")
    for k, place in place_nodes(nodes, roots).items():
        node = _readable(nodes[k])
        mesh = _readable(node.chosen("mesh", meshes)) if "mesh" in node else None
        for primitive in mesh.parts("primitives") if mesh else ():
            mode = _readable(primitive).integer("mode", 0, TRIANGLES)
            if mode > STRIP:
                raise primitive.wrong("mode", "at most 5: fans are not read", str(mode))
            if mode >= TRIANGLES:
                yield _polygons(primitive, mode, accessors, views), place


def _polygons(primitive: Fields, mode: int, accessors: list[Fields], views: list[View]) -> Polygons:
    position = primitive.part("attributes").chosen("POSITION", accessors)
    if position.data.get("normalized"):
        raise position.wrong("normalized", "positions that are not normalised", "True")
    points = _numbers(position, "VEC3", POSITIONS, views)
    corners = np.arange(len(points))
    if "indices" in primitive:
        indices = primitive.chosen("indices", accessors)
        corners = _numbers(indices, "SCALAR", INDICES, views)[:, 0].astype(int)
    if mode == STRIP:
        corners = cut_strips(corners, np.array([len(corners)]))
    elif len(corners) % 3:
        raise primitive.wrong("indices", "three for each triangle", str(len(corners)))
    return Polygons(points.astype(float), corners.ravel(), np.full(corners.size // 3, 3))


def _numbers(accessor: Fields, kind: str, types: dict[int, str], views: list[View]) -> np.ndarray:
    """Return an accessor's numbers, (count, 3) or (count, 1)."""
    _readable(accessor).text("type", (kind,))
    number, count = accessor.integer("componentType"), accessor.integer("count")
    if number not in types:
        raise accessor.wrong("componentType", f"one of {[*types]}", str(number))
    data, stride = accessor.chosen("bufferView", views)
    dtype, width = np.dtype(types[number]), 3 if kind == "VEC3" else 1
    stride = stride or dtype.itemsize * width
    start = accessor.integer("byteOffset", 0, 0)
    if start + (count - 1) * stride + dtype.itemsize * width > len(data):
        raise accessor.wrong("count", f"data in {len(data)} bytes", f"{count}")
    return np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))


def _data(buffer: Fields, binary: bytes, file: Path) -> memoryview:
    """Return a buffer's data: in the JSON, in the glb, or in a file beside it."""
    uri = buffer.text("uri", default="")
    if uri.startswith("data:"):
        binary = base64.b64decode(uri.partition(",")[2])
    elif uri:
        folder, found = file.parent.resolve(), None
        with suppress(OSError, RuntimeError, ValueError):  # no name of a file, a circle of links
            if (path := (folder / unquote(uri)).resolve()).is_relative_to(folder):
                found = read_bytes(path, "a buffer", MOST_BYTES)
        if found is None:
            raise buffer.wrong("uri", "a file in the mesh's folder", uri[:80])
        binary = found
    return memoryview(binary)[: buffer.integer("byteLength")]


def _readable(part: Fields) -> Fields:
    """Return the part, or raise ValueError where it has what is not read."""
    present = {*part.data, *part.data.get("extensions", ())}
    if unread := [name for name in UNREAD if name in present]:
        raise part.wrong(unread[0], "none, as it is not read", "one")
    if "weights" in part and np.any(part.array("weights", (-1,))):
        raise part.wrong("weights", "zeros: morph targets are not read", "others")
    return part
