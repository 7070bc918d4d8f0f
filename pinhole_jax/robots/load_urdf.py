"""`load_urdf`: a robot's file, and the shapes that it names.

yourdfpy reads the URDF, `load_mesh` the meshes. It welds vertices by position: in a mesh whose
faces share no vertices every edge would be a border.
"""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._files.paths import FilePath, existing_file, read_bytes, reason
from .._scene.scene import Mesh
from ..io.meshes import load_mesh
from .packages import check_packages, mesh_path
from .robot import Robot
from .urdf import plain_urdf


def load_urdf(
    path: FilePath,
    leave_out: Sequence[str] = (),
    packages: Mapping[str, FilePath] | None = None,
) -> Robot:
    """Return the robot of a URDF file: the visual shapes of its links, their meshes welded.

    - `leave_out`: links that the masks do not show (a gripper).
    - `packages`: the folders of packages, by name.

    Meshes are any that `load_mesh` reads. Their names are relative to the file, or in a package
    (`package://NAME/...`). A package is looked up in `packages`, then above the file and beside the
    folders above it, then in `ROS_PACKAGE_PATH`: a folder called NAME, or with a `package.xml` of
    that name. Lengths are the file's, as a rule metres. Joints that follow others (`mimic`) need no
    angle.

    Raises ModuleNotFoundError without yourdfpy (`pip install pinhole-jax[robots]`), and
    FileNotFoundError. Raises ValueError for files that are no URDF (SDF, xacro that is not
    expanded), for shapes and joints that are not read (capsule; floating, planar), and for no
    shapes or no such link.

    ```python
    lamp = pj.robots.load_urdf("lamp.urdf")
    ```
    """
    file = existing_file(path, "a URDF file")
    folders = check_packages(packages)
    try:
        import yourdfpy
    except ModuleNotFoundError as error:
        words = "a URDF is read by yourdfpy: pip install 'pinhole-jax[robots]'"
        raise ModuleNotFoundError(words, name=error.name) from error
    try:
        plain = plain_urdf(read_bytes(file, "a URDF file"), leave_out)
        urdf = yourdfpy.URDF.load(io.BytesIO(plain), load_meshes=False)
    except Exception as error:  # whatever a reader meets that it did not expect
        raise ValueError(
            f"`path`: expected a URDF file, got {str(path)!r}: {reason(error)}"
        ) from error
    if unknown := [link for link in leave_out if link not in urdf.link_map]:
        known = ", ".join(urdf.link_map)
        raise ValueError(f"`leave_out`: expected links among {known}, got {unknown[0]!r}")

    bodies = []
    for name, link in urdf.link_map.items():
        for visual in link.visuals:
            place = np.eye(4) if visual.origin is None else visual.origin
            try:
                find = lambda mesh: mesh_path(mesh, file, folders)
                bodies.append((name, place, _shape(visual.geometry, find)))
            except (FileNotFoundError, ValueError) as error:
                words = f"`path`: {str(path)!r}, link {name!r}: {error}"
                raise type(error)(words) from error
    return Robot(urdf, bodies)


def _shape(geometry: Any, find: Any) -> Mesh:
    """Return the mesh of a link's shape, in the shape's frame."""
    from trimesh import creation

    if geometry.mesh is not None:
        mesh = load_mesh(find(geometry.mesh.filename))
        scale = np.broadcast_to(1.0 if geometry.mesh.scale is None else geometry.mesh.scale, 3)
        faces = np.asarray(mesh.faces)[:, :: -1 if np.prod(scale) < 0 else 1]
        return Mesh(np.asarray(mesh.vertices) * scale.astype(mesh.vertices.dtype), faces)
    if geometry.box is not None:
        solid = creation.box(geometry.box.size)
    elif geometry.cylinder is not None:
        solid = creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length)
    else:
        solid = creation.icosphere(3, geometry.sphere.radius)
    return Mesh(np.asarray(solid.vertices, np.float32), np.asarray(solid.faces))
