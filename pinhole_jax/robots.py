"""Robots: the scene that a URDF and joint angles make, for `fit_joint` (needs `[robots]`).

yourdfpy reads the URDF and knows where links are; the meshes are welded by position, since in a
mesh whose faces do not share their vertices every edge would be a border.
"""

import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ._files.paths import existing, reason
from ._numerics.arrays import ArrayLike, Input
from ._scene.assembly import Assembly, Posture
from ._scene.scene import Mesh, Scene
from .io.meshes import load_mesh, welded

if TYPE_CHECKING:
    from yourdfpy import URDF

#: What only another library reads, of the mesh files that robots have.
OTHERS = (".dae",)


#: Of joints, by name or in their order: rad; of sliding ones m.
Angles = Input[Mapping[str, float] | ArrayLike, "J"]


class Robot:
    """A robot: `joints` in the order that angles are given in, `links` that have a shape.

    `scene(angles)` is what a camera sees of it, in the frame of its base.

    ```python
    lamp.joints, lamp.links
    scene = lamp.scene([1.2])  # in the order of `joints`, or by name
    posture = lamp.posture([1.2])  # the same, and what it is where the joints' zeros are elsewhere
    ```
    """

    joints: tuple[str, ...]
    links: tuple[str, ...]

    def __init__(
        self,
        urdf: Input["URDF", "yourdfpy's"],
        bodies: Sequence[tuple[str, Float[np.ndarray, "4 4"], Mesh]],
    ):
        self._urdf, self._posing = urdf, threading.Lock()
        self.joints = tuple(urdf.actuated_joint_names)
        self._following = {n for n, j in urdf.joint_map.items() if j.mimic is not None}
        self._at = [(link, place) for link, place, _ in bodies]
        self.links = tuple(dict.fromkeys(link for link, _ in self._at))
        self._assembly = Assembly([mesh for _, _, mesh in bodies])

    def poses(self, angles: Angles) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Return the pose of each link in the base's frame: what carries a camera on a link is one.

        - `angles`: of the joints (rad; of sliding ones in m), by name or in the order of `joints`.

        Raises ValueError for angles that are missing, of unknown joints or not finite.
        """
        checked, names = self._checked(angles), self._urdf.link_map
        with self._posing:  # the file's own kinematics stand in one posture at a time
            self._urdf.update_cfg(checked)
            return {name: np.array(self._urdf.get_transform(name), float) for name in names}

    def scene(self, angles: Angles) -> Scene:
        """Return the robot with its joints at these angles (see `poses`)."""
        return self.at(self.poses(angles))

    def posture(self, angles: Angles) -> Posture:
        """Return the robot with its joints at these angles (see `poses`), and how it moves with
        their zeros: what a `JointView` takes where `fit_joint` shall find these."""
        checked = self._checked(angles)

        def poses(offsets: np.ndarray) -> list[np.ndarray]:
            added = zip(self.joints, offsets, strict=True)
            found = self.poses({name: checked[name] + x for name, x in added})
            return [found[link] @ place for link, place in self._at]

        kinds = {name: self._urdf.joint_map[name].type for name in self.joints}
        units = {n: "world" if kind == "prismatic" else "rad" for n, kind in kinds.items()}
        return Posture(self._assembly, poses, units)

    def at(self, poses: Input[Mapping[str, ArrayLike], "4 4 each"]) -> Scene:
        """Return the robot with its links at poses (4, 4) that other kinematics found, by name.

        Raises ValueError where a link's is missing.
        """
        if missing := [link for link in self.links if link not in poses]:
            raise ValueError(f"`poses`: expected one of each link, got none of {missing[0]}")
        return self._assembly.at([np.asarray(poses[link]) @ place for link, place in self._at])

    def _checked(self, angles: Angles) -> dict[str, float]:
        if not isinstance(angles, Mapping):
            values = np.asarray(angles, float)
            if values.shape != (len(self.joints),):
                names = ", ".join(self.joints)
                raise ValueError(
                    f"`angles`: expected {len(self.joints)} numbers ({names}), got shape"
                    f" {values.shape}"
                )
            angles = dict(zip(self.joints, values.tolist(), strict=True))
        # (A joint that follows another one is told by that.)
        given = {n: float(x) for n, x in angles.items() if n not in self._following}
        if missing := [name for name in self.joints if name not in given]:
            raise ValueError(f"`angles`: expected one of each joint, got none of {missing[0]}")
        if unknown := [name for name in given if name not in self.joints]:
            known = ", ".join(self.joints)
            raise ValueError(f"`angles`: expected joints among {known}, got {unknown[0]!r}")
        if wrong := [n for n, x in given.items() if not np.isfinite(x)]:
            raise ValueError(
                f"`angles`: expected finite numbers, got {given[wrong[0]]} of {wrong[0]}"
            )
        return given


def load_urdf(path: str | os.PathLike[str], leave_out: Sequence[str] = ()) -> Robot:
    """Return the robot of a URDF file: the visual shapes of its links, their meshes welded.

    - `leave_out`: links that the masks do not show (a gripper).

    Meshes are looked for beside the file (`package://` too, as yourdfpy does); any that `load_mesh`
    reads, and Collada's (.dae). Lengths are the file's, as a rule metres.

    Raises ModuleNotFoundError without yourdfpy (`pip install pinhole-jax[robots]`),
    FileNotFoundError, and ValueError for what is no URDF, has no shapes, or no such link.

    ```python
    lamp = pj.robots.load_urdf("lamp.urdf")
    ```
    """
    file = existing(path, "a URDF file")
    try:
        import yourdfpy
    except ModuleNotFoundError as error:
        words = "a URDF is read by yourdfpy: pip install 'pinhole-jax[robots]'"
        raise ModuleNotFoundError(words, name=error.name) from error
    try:
        urdf = yourdfpy.URDF.load(str(file), load_meshes=False, build_scene_graph=True)
    except Exception as error:  # whatever a reader meets that it did not expect
        raise ValueError(
            f"`path`: expected a URDF file, got {str(path)!r}: {reason(error)}"
        ) from error
    if unknown := [link for link in leave_out if link not in urdf.link_map]:
        known = ", ".join(urdf.link_map)
        raise ValueError(f"`leave_out`: expected links among {known}, got {unknown[0]!r}")
    find = lambda name: yourdfpy.urdf.filename_handler_magic(name, dir=str(file.parent))
    bodies = [
        (name, np.eye(4) if visual.origin is None else visual.origin, _shape(visual.geometry, find))
        for name, link in urdf.link_map.items()
        if name not in leave_out
        for visual in link.visuals
    ]
    if not bodies:
        raise ValueError(f"`path`: expected links with visual shapes, got {str(path)!r}: none")
    return Robot(urdf, bodies)


def _shape(geometry: Any, find: Any) -> Mesh:
    """Return the mesh of a link's shape, in the shape's frame."""
    if geometry.mesh is not None:
        mesh = _read(Path(find(geometry.mesh.filename)))
        scale = geometry.mesh.scale
        if scale is None:
            return mesh
        points = np.asarray(mesh.vertices) * np.asarray(scale, mesh.vertices.dtype)
        return Mesh(points, mesh.faces)
    from trimesh import creation

    if geometry.box is not None:
        solid = creation.box(geometry.box.size)
    elif geometry.cylinder is not None:
        solid = creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length)
    else:
        solid = creation.icosphere(3, geometry.sphere.radius)
    return Mesh(np.asarray(solid.vertices, np.float32), np.asarray(solid.faces))


def _read(file: Path) -> Mesh:
    if file.suffix.lower() not in OTHERS:
        return load_mesh(file)
    import trimesh

    try:
        found: Any = trimesh.load(existing(file, "a mesh file"), force="mesh")
        points, faces = welded(np.asarray(found.vertices, float), np.asarray(found.faces))
    except Exception as error:
        raise ValueError(
            f"`path`: expected a readable mesh, got {str(file)!r}: {reason(error)}"
        ) from error
    return Mesh(points, faces)
