"""glTF 2.0 cameras: .gltf (JSON) and .glb (binary).

Axes: x right, y up, z backward; a node's transform is world_from_camera. `yfov` is the VERTICAL
field of view in rad. The principal point is the image's centre and pixels are square: neither has
a field. Nor has the image's size: it is asked for, or read from `extras`, where this library puts
it. Pixel centres do not occur.

Read here and not through trimesh, which keeps one camera of a file, no node above it, and takes
`aspectRatio` for a ratio of angles.
"""

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .._camera.camera import Camera
from .._files.paths import (
    MOST_BYTES,
    FilePath,
    decode_text,
    open_file,
    parse_json,
    read_text,
    replace_file,
)
from .._mesh_files.glb import HEAD, json_size, pack_glb
from .fields import KIND, Cameras, Fields, Size, by_name, check_cameras, short
from .pinhole import (
    OPENGL,
    Pinhole,
    camera_from_pinhole,
    focal_from_fov,
    fov_from_focal,
    pinhole,
    pose_from_matrix,
    world_from_camera,
)
from .rotations import rotation_from_quaternion


def read_gltf(path: FilePath, *, size: Size | None = None) -> Cameras:
    """Return the perspective cameras of a glTF file, by the name of their node.

    `size` is the image's (W, H) in px, unless the camera's `extras` hold `W` and `H`.

    Raises ValueError naming file and field where something is missing or wrong: an orthographic
    camera, a node that scales, an `aspectRatio` that is not W/H to 1 %. (In trimesh's files that
    field means something else and is ignored.)

    ```python
    pj.formats.write_gltf("left.gltf", {"left.png": camera})
    cameras = pj.formats.read_gltf("left.gltf", size=(96, 80))
    ```
    """
    top = Fields(_header(path), repr(str(path)))
    cameras = by_name(_cameras(top, size), top.where)
    if not cameras:
        raise top.wrong("cameras", "a node with a camera", "none")
    return cameras


def write_gltf(path: FilePath, cameras: Mapping[str, Camera]) -> None:
    """Write cameras as glTF, .gltf or .glb by the file's ending; their sizes go to `extras`.

    Raises ValueError for a camera that glTF cannot say: a principal point off the image's centre,
    or pixels that are not square.

    ```python
    pj.formats.write_gltf("left.gltf", {"left.png": camera})
    ```
    """
    check_cameras(cameras, "JSON")
    nodes = [
        {"name": name, "camera": k, "matrix": world_from_camera(camera, OPENGL).T.ravel().tolist()}
        for k, (name, camera) in enumerate(cameras.items())
    ]
    data = {
        "asset": {"version": "2.0", "generator": "pinhole_jax"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "cameras": [_perspective(name, pinhole(camera)) for name, camera in cameras.items()],
    }
    text = json.dumps(data, indent=1, allow_nan=False).encode()
    replace_file(path, pack_glb(text) if Path(path).suffix.lower() == ".glb" else text)


def _perspective(name: str, view: Pinhole) -> dict[str, Any]:
    """Return glTF's camera of intrinsics that it can say."""
    off = max(abs(view.cx - view.W / 2), abs(view.cy - view.H / 2))
    if off > 1e-9 * max(view.W, view.H) or abs(view.fx / view.fy - 1) > 1e-9:
        raise ValueError(
            "`cameras`: expected a centred principal point and square pixels, as glTF has"
            f" nothing else, got ({view.cx:g}, {view.cy:g}) px of {view.W} x {view.H} and"
            f" fx/fy = {view.fx / view.fy:g} in {name!r}"
        )
    fov = fov_from_focal(view.fy, view.H)
    return {
        "name": name,
        "type": "perspective",
        "perspective": {"aspectRatio": view.W / view.H, "yfov": fov, "znear": 0.01},
        "extras": {"W": view.W, "H": view.H},
    }


def _header(path: FilePath) -> Any:
    """Return the JSON of a .gltf, or of a .glb's first chunk."""
    with open_file(path, KIND, None) as stream:
        try:
            size = json_size(stream.read(HEAD.size), os.fstat(stream.fileno()).st_size)
        except ValueError as error:
            raise ValueError(f"`path`: {error} (in {str(path)!r})") from None
        if size is not None and size > MOST_BYTES:
            words = f"JSON of at most {MOST_BYTES} bytes in a glb, got {str(path)!r}: {size}"
            raise ValueError(f"`path`: expected {words}")
        text = read_text(path, KIND) if size is None else decode_text(stream.read(size), path)
        return parse_json(text, path, "glTF")


def _cameras(top: Fields, size: Size | None) -> Iterator[tuple[str, Camera]]:
    """Yield the cameras of the nodes that have one, with their names."""
    nodes, own = (top.parts(name) if name in top else [] for name in ("nodes", "cameras"))
    parents = _parents(nodes)
    worlds: dict[int, np.ndarray] = {}
    asset = top.data.get("asset", {})
    by_trimesh = isinstance(asset, dict) and "trimesh" in str(asset.get("generator", ""))
    for k, node in enumerate(nodes):
        if "camera" in node:
            index = node.integer("camera", 0)
            if index >= len(own):
                raise node.wrong("camera", f"a number below {len(own)}", f"{index}")
            name = node.text("name", default=own[index].text("name", default=f"camera_{k}"))
            pose = pose_from_matrix(_world(k, nodes, parents, worlds), node, "matrix")
            yield (
                name,
                camera_from_pinhole(_intrinsics(own[index], size, by_trimesh), pose, OPENGL, node),
            )


def _parents(nodes: list[Fields]) -> dict[int, int]:
    parents: dict[int, int] = {}
    for k, node in enumerate(nodes):
        for child in node.items("children") if "children" in node else ():
            if type(child) is not int or child in parents or not 0 <= child < len(nodes):
                raise node.wrong("children", "nodes with one parent each", short(child))
            parents[child] = k
    return parents


def _world(
    k: int, nodes: list[Fields], parents: dict[int, int], worlds: dict[int, np.ndarray]
) -> np.ndarray:
    """Return the (4, 4) transform of a node's frame to the world, and add it to `worlds`, with
    those of the nodes above it."""
    above: dict[int, None] = {}
    node: int | None = k
    while node is not None and node not in worlds:
        if node in above:
            raise nodes[node].wrong("children", "a tree", "a circle")
        above[node] = None
        node = parents.get(node)
    matrix = np.eye(4) if node is None else worlds[node]
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is no rotation
        for node in reversed(above):
            matrix = worlds[node] = matrix @ _local(nodes[node])
    return matrix


def _local(node: Fields) -> np.ndarray:
    """Return a node's own transform (4, 4)."""
    if "matrix" in node:
        if both := {"rotation", "scale", "translation"} & node.data.keys():
            raise node.wrong("matrix", "one kind of transform", f"both it and {min(both)}")
        return node.array("matrix", (16,)).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node:
        matrix[:3, :3] = rotation_from_quaternion(node.array("rotation", (4,)), node, "rotation")
    if "scale" in node:
        matrix[:3, :3] *= node.array("scale", (3,))
    if "translation" in node:
        matrix[:3, 3] = node.array("translation", (3,))
    return matrix


def _intrinsics(fields: Fields, size: Size | None, by_trimesh: bool) -> Pinhole:
    fields.text("type", ("perspective",))
    perspective = fields.part("perspective")
    extras = fields.data.get("extras")
    own = Fields(extras if isinstance(extras, dict) else {}, f"{fields.where}, extras")
    W, H = own.size("W", "H", size)
    aspect = perspective.positive("aspectRatio", W / H)
    if abs(aspect * H / W - 1) > 0.01 and not by_trimesh:
        raise perspective.wrong("aspectRatio", f"W/H = {W / H:g} of {W} x {H} px", f"{aspect:g}")
    focal = focal_from_fov(perspective.angle("yfov"), H)
    return Pinhole(focal, focal, W / 2, H / 2, W, H)
