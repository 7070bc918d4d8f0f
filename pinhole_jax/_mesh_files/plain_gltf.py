"""glTF 2.0, .gltf and .glb, cut down to what trimesh reads right: triangles, strips and nodes.

trimesh reads raw numbers where an accessor is sparse or normalised. It passes over skins, morph
targets, instances, fans and compression, and over the children of a node with a camera. These
features are refused here, and names, cameras and materials, which are no shape, are left out.
"""

import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from .._files.paths import first_repeat, read_bytes
from .glb import HEAD, json_size, pack_glb

#: The lists that are read, and fields that count their entries, bytes or numbers.
LISTS = ("scenes", "nodes", "meshes", "accessors", "bufferViews", "buffers")
COUNTS = {"buffer": "buffers", "bufferView": "bufferViews", "mesh": "meshes"}
COUNTS |= dict.fromkeys(("POSITION", "indices"), "accessors")
COUNTS |= dict.fromkeys(("byteLength", "byteOffset", "byteStride", "count", "mode"))
#: Fields that list nodes.
FAMILIES = ("children", "nodes")
PARTS = {"rotation", "scale", "translation"}
READ = {*COUNTS, *PARTS, *FAMILIES, "attributes", "componentType", "matrix", "normalized"}
READ |= {"primitives", "type", "uri"}
UNREAD = ("skin", "sparse", "EXT_mesh_gpu_instancing", "KHR_node_visibility",
          "KHR_draco_mesh_compression", "EXT_meshopt_compression",
          "KHR_meshopt_compression")  # fmt: skip
#: Extensions that a file may require: they say nothing about shape, or allow integers.
NO_SHAPE = ("KHR_mesh_quantization", "KHR_materials_", "KHR_texture_", "EXT_texture_",
            "MSFT_texture_", "KHR_lights_", "EXT_lights_", "KHR_xmp", "ADOBE_materials_",
            "EXT_materials_")  # fmt: skip
UNSIGNED, TRIANGLES, STRIP = (5121, 5123, 5125), 4, 5
#: Views and primitives may show the same data many times.
MOST_NUMBERS, MOST_BYTES = 1 << 28, 1 << 31


def plain_gltf(data: bytes) -> bytes:
    """Return the file without what is no shape.

    Raises ValueError, which names the field, for features that are not read, for nodes with two
    parents, and for small files that stand for more than memory holds.
    """
    size, start = json_size(data, len(data)), HEAD.size
    try:
        top = json.loads(data if size is None else data[start : start + size])
    except RecursionError:
        raise ValueError("JSON that is nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"no JSON: {error}") from None

    _check_version(top)
    sizes = {name: len(top.get(name, ())) for name in LISTS}
    plain = {name: _plain(top.get(name, []), name, sizes) for name in LISTS}
    plain |= {"scene": top.get("scene", 0), "asset": {"version": "2.0"}}
    _check_below(sizes["scenes"], plain["scene"], "scene")
    _check_nodes(plain)
    _keep_solid(plain)
    text = json.dumps(plain).encode()
    return text if size is None else pack_glb(text, data[start + size :])


def wrong(name: str, expected: str, got: Any) -> ValueError:
    """Return the error of a field."""
    return ValueError(f"`{name}`: expected {expected}, got {str(got)[:80]}")


def _check_version(top: Any) -> None:
    if not isinstance(top, dict):
        raise ValueError(f"expected a JSON object, got {type(top).__name__}")
    version = top.get("asset", {}).get("version", "2.0")
    if not str(version).startswith("2."):
        raise wrong("asset.version", "2.0", version)
    for name in top.get("extensionsRequired", []):
        if not str(name).startswith(NO_SHAPE):
            raise wrong("extensionsRequired", "extensions that are read here", name)


def _plain(part: Any, where: str, sizes: dict[str, int]) -> Any:
    """Return a part of the JSON, of its objects the fields that are read, and these checked."""
    if isinstance(part, list):
        return [_plain(entry, f"{where}[{k}]", sizes) for k, entry in enumerate(part)]
    if not isinstance(part, dict):
        return part

    if unread := [name for name in UNREAD if name in part or name in part.get("extensions", ())]:
        raise wrong(where, f"none with {unread[0]}, which is not read", unread[0])
    if any(part.get("weights", ())):
        raise wrong(f"{where}.weights", "zeros: morph targets are not read", part["weights"])
    for name, value in part.items():
        if name in COUNTS:
            _check_below(sizes.get(COUNTS[name] or "", 1 << 62), value, f"{where}.{name}")
        for child in value if name in FAMILIES else ():
            _check_below(sizes["nodes"], child, f"{where}.{name}")
    return {name: _plain(x, f"{where}.{name}", sizes) for name, x in part.items() if name in READ}


def _check_below(most: int, number: Any, where: str) -> None:
    if not (type(number) is int and 0 <= number < most):
        raise wrong(where, f"a number below {most}, at least 0", number)


def _check_nodes(plain: dict[str, Any]) -> None:
    """Check that nodes make trees: with two parents, they could stand for 2^depth copies."""
    for k, node in enumerate(plain["nodes"]):
        if "matrix" in node and PARTS & node.keys():
            raise wrong(f"nodes[{k}].matrix", "none beside it", PARTS & node.keys())
        if not any(node.get("rotation", (1,))):
            raise wrong(f"nodes[{k}].rotation", "a quaternion of length 1", node["rotation"])
    parents = (plain["scenes"][plain["scene"]], *plain["nodes"])
    children = (k for part in parents for name in FAMILIES for k in part.get(name, ()))
    if (twice := first_repeat(children)) is not None:
        raise wrong(f"nodes[{twice}]", "one parent", "two, or itself")


def _keep_solid(plain: dict[str, Any]) -> None:
    """Drop points and lines from the file, and check all accessors and their total size."""
    numbers = sum(accessor.get("count", 0) for accessor in plain["accessors"])
    for m, mesh in enumerate(plain["meshes"]):
        for p, primitive in enumerate(mesh.get("primitives", [])):
            where = f"meshes[{m}].primitives[{p}]"
            if primitive.get("mode", TRIANGLES) > STRIP:
                raise wrong(f"{where}.mode", "at most 5: fans are not read", primitive["mode"])
            numbers += _used(plain, primitive, where)
        solid = [p for p in mesh.get("primitives", []) if p.get("mode", TRIANGLES) >= TRIANGLES]
        mesh["primitives"] = solid
    if 3 * numbers > MOST_NUMBERS:
        raise wrong("accessors", f"at most {MOST_NUMBERS} numbers", 3 * numbers)
    size = sum(view.get("byteLength", 0) for view in plain["bufferViews"])
    if size > MOST_BYTES:
        raise wrong("bufferViews", f"at most {MOST_BYTES} bytes", size)


def _used(plain: dict[str, Any], primitive: dict[str, Any], where: str) -> int:
    """Return the number of a primitive's vertices and indices, its accessors checked."""
    position = primitive.get("attributes", {}).get("POSITION")
    if position is None:
        raise wrong(f"{where}.attributes", "POSITION", "none")
    used = [("VEC3", position)]
    used += [("SCALAR", primitive["indices"])] if "indices" in primitive else []
    for kind, k in used:
        accessor, place = plain["accessors"][k], f"accessors[{k}]"
        if accessor.get("type") != kind:
            raise wrong(f"{place}.type", kind, accessor.get("type"))
        if "bufferView" not in accessor:
            raise wrong(f"{place}.bufferView", "data", "none")
        if kind == "VEC3" and accessor.get("normalized"):
            raise wrong(f"{place}.normalized", "positions that are not normalised", True)
        if kind == "SCALAR" and accessor.get("componentType") not in UNSIGNED:
            expected = "indices of unsigned integers"
            raise wrong(f"{place}.componentType", expected, accessor.get("componentType"))
    return sum(plain["accessors"][k].get("count", 0) for _, k in used)


def resource(file: Path, uri: str) -> bytes:
    """Return the bytes of a file that a mesh file names, from its folder or below."""
    folder = file.parent.resolve()
    try:
        path = (folder / unquote(uri)).resolve()
        if not urlsplit(uri).scheme and path.is_relative_to(folder) and path.is_file():
            return read_bytes(path, "a buffer", MOST_BYTES)
    except (OSError, RuntimeError, ValueError):  # no name of a file, a circle of links
        pass
    raise wrong("buffers.uri", "a file in the mesh's folder", uri)
