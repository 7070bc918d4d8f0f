"""glTF 2.0 cameras: .gltf (JSON) and .glb (binary).

Axes: x right, y up, z backward; a node's transform is world_from_camera. `yfov` is the VERTICAL
field of view in rad. The principal point is the image's centre and pixels are square: neither has
a field. Nor has the image's size: it is asked for, or read from `extras`, where this library puts
it. Pixel centres do not occur.

(trimesh keeps one camera of a file, no node above it, and takes `aspectRatio` for a ratio of
angles.)
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .._camera.camera import Camera
from .._files.fields import Fields, Size
from .._files.paths import FilePath, read_bytes, replace_file
from .._mesh_files.glb import MOST_BYTES, children, pack_glb, parse_gltf, parts, place_nodes
from .pinhole import (
    KIND,
    OPENGL,
    Cameras,
    NamedCameras,
    Pinhole,
    by_name,
    camera_from_pinhole,
    check_cameras,
    focal_from_fov,
    fov_from_focal,
    pinhole,
    pose_from_matrix,
    world_from_camera,
)


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
    top, _ = parse_gltf(read_bytes(path, KIND, MOST_BYTES), path)
    cameras = by_name(_cameras(top, size), top.where)
    if not cameras:
        raise top.wrong("cameras", "a node with a camera", "none")
    return cameras


def write_gltf(path: FilePath, cameras: NamedCameras) -> None:
    """Write cameras as glTF, .gltf or .glb by the file's ending; their sizes go to `extras`.

    Raises ValueError for a camera that glTF cannot say: a principal point off the image's centre,
    or pixels that are not square.

    ```python
    pj.formats.write_gltf("left.gltf", {"left.png": camera})
    ```
    """
    check_cameras(cameras)
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


def _cameras(top: Fields, size: Size | None) -> Iterator[tuple[str, Camera]]:
    """Yield the cameras of the nodes that have one, with their names."""
    nodes, own = parts(top, "nodes"), parts(top, "cameras")
    below = {k for node in nodes for k in children(node, nodes)}
    places = place_nodes(nodes, (k for k in range(len(nodes)) if k not in below))
    if len(places) < len(nodes):
        raise top.wrong("children", "a tree", "a circle")
    by_trimesh = "trimesh" in str(top.data.get("asset"))
    for (k, place), node in zip(places.items(), nodes, strict=True):
        if "camera" in node:
            camera = node.chosen("camera", own)
            name = node.text("name", default=camera.text("name", default=f"camera_{k}"))
            view = _intrinsics(camera, size, by_trimesh)
            pose = pose_from_matrix(place, node, "matrix")
            yield name, camera_from_pinhole(view, pose, OPENGL, node)


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
