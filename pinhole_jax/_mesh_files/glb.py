"""glTF 2.0, .gltf (JSON) and .glb (binary): a file's fields, and its nodes in the world."""

import struct
from collections.abc import Iterable
from typing import Any

import numpy as np

from .._files.fields import Fields
from .._files.paths import decode_text, parse_json

#: glTF's mark, version 2, the sizes of the file and of the first chunk, whose kind is JSON.
HEAD = struct.Struct("<4s4I")
MAGIC, VERSION, JSON_CHUNK = b"glTF", 2, 0x4E4F534A
#: The most bytes of a file, and of a head: of the chunk behind the JSON, which has data.
MOST_BYTES, CHUNK_HEAD = 1 << 31, 8


def parse_gltf(data: bytes, path: Any) -> tuple[Fields, bytes]:
    """Return a file's top-level fields, and the binary data behind them.

    Raises ValueError for what is no JSON, and for a glb that is cut short, of another version, or
    begins with other data.
    """
    start, end = 0, len(data)
    if data[:4] == MAGIC:
        _, version, whole, length, kind = HEAD.unpack(data[: HEAD.size].ljust(HEAD.size, b"\0"))
        start, end = HEAD.size, HEAD.size + length
        if not end <= whole <= len(data):
            words = f"a whole glb of {whole} bytes, got {len(data)}: cut short"
        elif version != VERSION or kind != JSON_CHUNK:
            words = f"JSON first in a glb of version {VERSION}, got other data"
        else:
            words = ""
        if words:
            raise ValueError(f"`path`: expected {words} (in {str(path)!r})")
    top = parse_json(decode_text(data[start:end], path), path, "glTF")
    return Fields(top, repr(str(path))), data[end + CHUNK_HEAD :]


def pack_glb(text: bytes) -> bytes:
    """Return the binary file of some JSON."""
    text += b" " * (-len(text) % 4)
    return HEAD.pack(MAGIC, VERSION, HEAD.size + len(text), len(text), JSON_CHUNK) + text


def parts(top: Fields, name: str) -> list[Fields]:
    """Return the objects of one of a file's lists, none where it has no such list."""
    return top.parts(name) if name in top else []


def place_nodes(nodes: list[Fields], roots: Iterable[int]) -> dict[int, np.ndarray]:
    """Return the transform (4, 4) to the world of each node below these, in the file's order.

    Raises ValueError for a node with two parents: such could stand for 2^depth copies.
    """
    places: dict[int, np.ndarray] = {}
    waiting = [(root, np.eye(4)) for root in roots]
    while waiting:
        k, above = waiting.pop()
        if k in places:
            raise nodes[k].wrong("children", "nodes with one parent each", f"two of node {k}")
        with np.errstate(over="ignore", invalid="ignore"):  # found where it matters
            places[k] = above @ _local(nodes[k])
        waiting += [(child, places[k]) for child in children(nodes[k], nodes)]
    return dict(sorted(places.items()))


def children(part: Fields, nodes: list[Fields], name: str = "children") -> list[int]:
    """Return the numbers of nodes that a field lists."""
    expected, most = f"numbers of nodes below {len(nodes)}", len(nodes) - 1.0
    return part.counts(name, expected, most) if name in part else []


def _local(node: Fields) -> np.ndarray:
    """Return a node's own transform (4, 4)."""
    if "matrix" in node:
        if both := {"rotation", "scale", "translation"} & node.data.keys():
            raise node.wrong("matrix", "one kind of transform", f"both it and {min(both)}")
        return node.array("matrix", (16,)).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node:
        matrix[:3, :3] = node.rotation("rotation")
    matrix[:3, :3] *= node.array("scale", (3,), default=1)
    matrix[:3, 3] = node.array("translation", (3,), default=0)
    return matrix
