"""`load_urdf`: a robot's file, and the shapes that it names.

`load_mesh` reads the meshes. It welds vertices by position: in a mesh whose faces share no vertices
every edge would be a border.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from .._files.fields import Fields
from .._files.paths import FilePath, as_path, parse_xml, read_bytes
from .._numerics.arrays import Input, check_known
from .._scene.scene import Mesh
from ..io.meshes import load_mesh
from .packages import check_packages, mesh_path
from .robot import Robot
from .urdf import read_urdf, read_visual


def load_urdf(
    path: FilePath,
    leave_out: Sequence[str] = (),
    packages: Input[Mapping[str, FilePath] | None, "folders by name"] = None,
) -> Robot:
    """Return the robot of a URDF file: the visual shapes of its links, their meshes welded.

    - `leave_out`: links that the masks do not show (a gripper).
    - `packages`: the folders of packages, by name.

    Meshes are any that `load_mesh` reads. Their names are relative to the file, or in a package
    (`package://NAME/...`). A package is looked up in `packages`, then above the file and beside the
    folders above it, then in `ROS_PACKAGE_PATH`: a folder called NAME, or with a `package.xml` of
    that name. Lengths are the file's, as a rule metres. Joints that follow others (`mimic`) need no
    angle.

    Raises FileNotFoundError, or ValueError for files that are no URDF (SDF, xacro that is not
    expanded), for shapes and joints that are not read (capsule; floating, planar), and for no
    shapes or no such link. Meshes in Collada need `pip install pinhole-jax[robots]`.

    ```python
    lamp = pj.robots.load_urdf("lamp.urdf")
    ```
    """
    file, folders, link, bodies = as_path(path), check_packages(packages), "", []
    root = parse_xml(read_bytes(path, "a URDF file"), path, "a URDF file")
    try:
        links, joints, visuals = read_urdf(root, leave_out)
        for link, visual in visuals:
            place, kind, shape = read_visual(visual, link)
            find = lambda name: mesh_path(name, file, folders)
            bodies.append((link, place, _shape(kind, shape, find)))
        link = ""
        robot = Robot(links, joints, bodies)
    except (FileNotFoundError, ValueError) as error:
        where = f"{str(path)!r}, link {link!r}" if link else repr(str(path))
        raise type(error)(f"`path`: expected a URDF file, got {where}: {error}") from error
    check_known("leave_out", leave_out, links, "links")
    return robot


def _shape(kind: str, shape: Fields, find: Callable[[str], Path]) -> Mesh:
    """Return the mesh of a link's shape, in the shape's frame."""
    from trimesh import creation

    if kind == "mesh":
        solid = load_mesh(find(shape.text("filename")))
    elif kind == "box":
        size = shape.array("size", (3,))
        if np.any(size <= 0):
            raise shape.wrong("size", "positive numbers", size)
        solid = creation.box(size)
    elif kind == "cylinder":
        solid = creation.cylinder(shape.positive("radius"), shape.positive("length"))
    else:
        solid = creation.icosphere(3, shape.positive("radius"))
    vertices, faces = np.asarray(solid.vertices), np.asarray(solid.faces)
    scale = np.broadcast_to(shape.array("scale", (), (3,), default=1), 3)
    faces = faces[:, :: -1 if np.prod(scale) < 0 else 1]
    return Mesh(vertices * scale.astype(vertices.dtype), faces)
