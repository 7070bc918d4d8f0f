"""glTF 2.0 meshes, .gltf and .glb: the triangles of a file's scene as it stands, in its own axes.

Nodes place them (in metres, y up); morph targets have the file's weights and skins the pose that
the nodes are in. Animations, materials and cameras make no difference to that.
"""

import json
import struct
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .accessors import Accessors
from .json import at, integer, items, member, numbers, wrong
from .polygons import Polygons, strips_cut
from .skins import deformed, skinned

MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
#: More triangles than this, all instances together, are refused: a small file can stand for them.
MOST_TRIANGLES = 1 << 24
#: Extensions that a file may require: read here, or without any say about shape.
UNDERSTOOD = ("KHR_mesh_quantization", "EXT_mesh_gpu_instancing", "KHR_node_visibility")
NO_SHAPE = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_",
            "EXT_lights_", "KHR_xmp", "ADOBE_materials_", "EXT_materials_")  # fmt: skip
DRACO = "KHR_draco_mesh_compression"
TRIANGLES, STRIP, FAN = 4, 5, 6


def read_gltf(data: bytes, file: Path) -> Polygons:
    """Return the triangles of a glTF file's scene; buffers beside it are read from its folder only.

    Raises ValueError, which names the field, for what is missing or wrong, for a required extension
    that is not read here, for nodes with two parents and for data outside of the file's folder.
    """
    top, binary = _chunks(data)
    _check_version(top)
    accessors = Accessors(top, file, binary)
    points, faces, start, number = [np.empty((0, 3))], [np.empty((0, 3), int)], 0, 0

    with np.errstate(all="ignore"):  # what overflows is seen at the end
        for own, triangles, places in _parts(top, accessors):
            number += len(triangles) * len(places)
            if number > MOST_TRIANGLES:
                raise wrong("nodes", f"at most {MOST_TRIANGLES} triangles", f"{number} or more")
            points.append(_placed(own, places))
            faces.append(_turned(triangles, places, len(own)) + start)
            start += len(points[-1])

    corners = np.concatenate(faces)
    return Polygons(np.concatenate(points), corners.ravel(), np.full(len(corners), 3))


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes | None]:
    """Return the JSON of a .gltf or .glb file, and the binary data of the latter."""
    binary = None
    if data[:4] == struct.pack("<I", MAGIC):
        version, length = struct.unpack_from("<2I", data.ljust(12, b"\0"), 4)
        if version != 2 or not 20 <= length <= len(data):
            raise ValueError(
                f"a glb of version {version} and {length} bytes: expected version 2 and at"
                f" most {len(data)} bytes"
            )
        chunks, start = {}, 12
        while start + 8 <= length:
            size, kind = struct.unpack_from("<2I", data, start)
            if start + 8 + size > length:
                raise ValueError(
                    f"a chunk of {size} bytes, of which {length - start - 8} are there"
                )
            chunks.setdefault(kind, data[start + 8 : start + 8 + size])
            start += 8 + size
        data, binary = chunks.get(JSON_CHUNK, b""), chunks.get(BINARY_CHUNK)
    try:
        top = json.loads(data)
    except RecursionError:
        raise ValueError("JSON that is nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"no JSON: {error}") from None
    if not isinstance(top, dict):
        raise ValueError(f"expected a JSON object, got {type(top).__name__}")
    return top, binary


def _check_version(top: dict[str, Any]) -> None:
    version = member(top, "asset", "").get("version", "2.0")
    if not isinstance(version, str) or not version.startswith("2."):
        raise wrong("asset.version", "2.0", version)
    for name in items(top, "extensionsRequired"):
        known = isinstance(name, str) and (name in UNDERSTOOD or name.startswith(NO_SHAPE))
        if not known:
            raise wrong("extensionsRequired", "extensions that are read here", name)


# --- nodes ---------------------------------------------------------------------------------------


def _parts(
    top: dict[str, Any], accessors: Accessors
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield points (V, 3), triangles (T, 3) and the places (M, 4, 4) where they are to be put."""
    worlds = _worlds(top)
    instances, alone = defaultdict(list), []
    for k, world in worlds.items():
        node, where = top["nodes"][k], f"nodes[{k}]"
        if "mesh" not in node:
            continue
        mesh = integer(node, "mesh", where)
        weights = tuple(numbers(node, "weights", where)) if "weights" in node else None
        places = _copies(node, world, accessors, where)
        if "skin" in node:
            alone.append((k, mesh, weights, len(places)))
        else:
            instances[mesh, weights].append(places)

    for (mesh, weights), places in instances.items():
        for primitive, where in _primitives(top, mesh):
            triangles, used = _triangles(primitive, accessors, where)
            own = deformed(primitive, used, _weights(top, mesh, weights), accessors, where)
            yield own, triangles, np.concatenate(places)

    for k, mesh, weights, number in alone:
        if number != 1:
            raise wrong(f"nodes[{k}].skin", "no EXT_mesh_gpu_instancing beside it", number)
        for primitive, where in _primitives(top, mesh):
            triangles, used = _triangles(primitive, accessors, where)
            own = deformed(primitive, used, _weights(top, mesh, weights), accessors, where)
            own = skinned(own, primitive, used, top, k, worlds, accessors, where)
            yield own, triangles, np.eye(4)[None]


def _worlds(top: dict[str, Any]) -> dict[int, np.ndarray]:
    """Return the transforms (4, 4) to the world of the scene's nodes, by number."""
    parents = _parents(top)
    own = _locals(top, [*parents])
    worlds: dict[int, np.ndarray] = {}
    for (k, parent), matrix in zip(parents.items(), own, strict=True):
        worlds[k] = matrix if parent is None else worlds[parent] @ matrix
    return worlds


def _parents(top: dict[str, Any]) -> dict[int, int | None]:
    """Return the parents of the scene's nodes, by number, parents first.

    Every node is met once: a tree, as the specification has it. Nodes that have two parents could
    stand for 2^depth copies, or for a circle.
    """
    nodes = items(top, "nodes")
    parents: dict[int, int | None] = {}
    waiting = [(k, None) for k in _roots(top)]
    while waiting:
        k, parent = waiting.pop()
        if type(k) is not int or not 0 <= k < len(nodes):
            raise wrong("nodes", f"numbers of nodes below {len(nodes)} as children", k)
        if k in parents:
            raise wrong(f"nodes[{k}]", "one parent", "two, or itself")
        node = at(top, "nodes", k)
        if "extensions" in node and _is_hidden(node):
            continue
        parents[k] = parent
        waiting += [(child, k) for child in reversed(items(node, "children", f"nodes[{k}]"))]
    return parents


def _roots(top: dict[str, Any]) -> list[Any]:
    """Return the nodes of the scene; of all nodes that are no children where there is no scene."""
    if "scenes" in top:
        scene = at(top, "scenes", integer(top, "scene", "", default=0))
        return [*reversed(items(scene, "nodes", "scenes"))]
    nodes = items(top, "nodes")
    parts = [node for node in nodes if isinstance(node, dict)]
    children = {k for node in parts for k in items(node, "children", "nodes") if type(k) is int}
    return [k for k in reversed(range(len(nodes))) if k not in children]


def _is_hidden(node: dict[str, Any]) -> bool:
    extension = member(member(node, "extensions", "nodes"), "KHR_node_visibility", "nodes")
    return extension.get("visible") is False


def _locals(top: dict[str, Any], chosen: list[int]) -> np.ndarray:
    """Return the transforms (N, 4, 4) of nodes into their parents, all at once."""
    parts = {"translation": [0.0, 0, 0], "rotation": [0.0, 0, 0, 1], "scale": [1.0, 1, 1]}
    values, matrices = {name: [] for name in parts}, {}
    for at_row, k in enumerate(chosen):
        node, where = top["nodes"][k], f"nodes[{k}]"
        for name, default in parts.items():
            given = name in node
            if given and "matrix" in node:
                raise wrong(f"{where}.{name}", "none beside a matrix", node[name])
            own = numbers(node, name, where, len(default)) if given else default
            if name == "rotation" and not any(own):
                raise wrong(f"{where}.rotation", "a quaternion of length 1", own)
            values[name].append(own)
        if "matrix" in node:
            matrix = np.array(numbers(node, "matrix", where, 16))
            matrices[at_row] = matrix.reshape(4, 4).T

    translation, rotation, scale = (
        np.array(values[name]).reshape(-1, len(default)) for name, default in parts.items()
    )
    transforms = _transforms(translation, rotation, scale, "nodes")
    for at_row, matrix in matrices.items():
        transforms[at_row] = matrix
    return transforms


def _transforms(
    translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray, where: str
) -> np.ndarray:
    """Return (M, 4, 4) of M translations, quaternions (x, y, z, w) and scales."""
    length = np.sqrt(np.sum(rotation**2, axis=-1, keepdims=True))
    if not np.all(length > 1e-3):
        raise wrong(f"{where}.rotation", "quaternions of length 1", f"{np.min(length):g}")
    x, y, z, w = (rotation / length).T
    turns = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrices = np.zeros((len(translation), 4, 4))
    matrices[:, :3, :3] = np.moveaxis(np.array(turns), -1, 0) * scale[:, None]
    matrices[:, :3, 3] = translation
    matrices[:, 3, 3] = 1
    return matrices


def _copies(
    node: dict[str, Any], world: np.ndarray, accessors: Accessors, where: str
) -> np.ndarray:
    """Return the places (M, 4, 4) of a node's mesh: its own, or those of its instances."""
    extensions = member(node, "extensions", where) if "extensions" in node else {}
    if "EXT_mesh_gpu_instancing" not in extensions:
        return world[None]
    where = f"{where}.extensions.EXT_mesh_gpu_instancing"
    attributes = member(member(extensions, "EXT_mesh_gpu_instancing", where), "attributes", where)
    kinds = {"TRANSLATION": ("VEC3", 0.0), "ROTATION": ("VEC4", None), "SCALE": ("VEC3", 1.0)}
    read = {
        name: accessors.floats(integer(attributes, name, where), kind)
        for name, (kind, _) in kinds.items()
        if name in attributes
    }
    sizes = {len(values) for values in read.values()}
    if len(sizes) != 1:
        raise wrong(where, "attributes of one length", sorted(sizes))
    number = sizes.pop()
    translation = read.get("TRANSLATION", np.zeros((number, 3)))
    rotation = read.get("ROTATION", np.tile([0.0, 0, 0, 1], (number, 1)))
    scale = read.get("SCALE", np.ones((number, 3)))
    return world @ _transforms(translation, rotation, scale, where)


# --- meshes --------------------------------------------------------------------------------------


def _primitives(top: dict[str, Any], mesh: int) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the primitives of a mesh that cover something: those of triangles."""
    where = f"meshes[{mesh}].primitives"
    for k, primitive in enumerate(items(at(top, "meshes", mesh), "primitives", f"meshes[{mesh}]")):
        if not isinstance(primitive, dict):
            raise wrong(f"{where}[{k}]", "an object", type(primitive).__name__)
        mode = integer(primitive, "mode", f"{where}[{k}]", default=TRIANGLES, below=7)
        if mode >= TRIANGLES and "POSITION" in member(primitive, "attributes", f"{where}[{k}]"):
            yield primitive, f"{where}[{k}]"


def _triangles(
    primitive: dict[str, Any], accessors: Accessors, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles (T, 3), as indices of the vertices that are used, and these."""
    position = integer(primitive["attributes"], "POSITION", f"{where}.attributes")
    named = [position, *([integer(primitive, "indices", where)] if "indices" in primitive else [])]
    if not all(accessors.has_data(k) for k in named):
        packed = DRACO in member(primitive, "extensions", where)
        raise wrong(where, "accessors with data", DRACO if packed else "none")

    count = accessors.count(position)
    if len(named) == 2:
        corners = accessors.integers(named[1])
        if corners.size and np.max(corners) >= count:
            raise wrong(f"{where}.indices", f"numbers below {count}", np.max(corners))
    else:
        corners = np.arange(len(accessors.floats(position, "VEC3")))

    triangles = _of_mode(primitive.get("mode", TRIANGLES), corners, where)
    if count <= triangles.size:
        return triangles, np.arange(count)
    used, place = np.unique(triangles, return_inverse=True)
    return place.reshape(-1, 3), used


def _of_mode(mode: int, corners: np.ndarray, where: str) -> np.ndarray:
    if mode == STRIP:
        return strips_cut(corners, np.array([len(corners)]))
    if mode == FAN:
        rim = corners[1:]
        return np.stack([rim[:-1], rim[1:], np.broadcast_to(corners[:1], rim[1:].shape)], axis=-1)
    if len(corners) % 3:
        raise wrong(f"{where}.indices", "three for each triangle", len(corners))
    return corners.reshape(-1, 3)


def _weights(top: dict[str, Any], mesh: int, own: tuple | None) -> list[float]:
    """Return the weights of a mesh's morph targets: a node's own, or the mesh's."""
    if own is not None:
        return [*own]
    part = at(top, "meshes", mesh)
    return numbers(part, "weights", f"meshes[{mesh}]") if "weights" in part else []


def _placed(points: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return (M * V, 3) points, each at every place."""
    turned = points @ np.swapaxes(places[:, :3, :3], -1, -2)
    return (turned + places[:, None, :3, 3]).reshape(-1, 3)


def _turned(triangles: np.ndarray, places: np.ndarray, number: int) -> np.ndarray:
    """Return (M * T, 3) triangles, the other way round where a place is a mirror's."""
    copies = np.tile(triangles, (len(places), 1, 1))
    mirrored = np.linalg.det(places[:, :3, :3]) < 0
    copies[mirrored] = copies[mirrored][..., ::-1]
    return (copies + number * np.arange(len(places))[:, None, None]).reshape(-1, 3)
