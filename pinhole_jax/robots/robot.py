"""A robot: links whose poses follow from joint angles, and its scene."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from .._camera.poses import exponential
from .._numerics.arrays import ArrayLike, Input, check_known
from .._scene.assembly import Assembly, Posture
from .._scene.scene import Mesh, Scene
from .urdf import Joint, following, from_root

#: Of joints, by name or in their order: rad; of sliding ones m.
Angles = Input[Mapping[str, float] | ArrayLike, "J"]


class Robot:
    """A robot: `joints` in the order that angles are given in, `links` that have a shape.

    `limits` are the least and the greatest angle of each joint that the file gives any: rad, or m
    of a sliding one. `sliding` names those.

    `scene(angles)` is what a camera sees of it, in the frame of its base.

    ```python
    lamp.joints, lamp.links
    scene = lamp.scene([1.2])  # in the order of `joints`, or by name
    posture = lamp.posture([1.2])  # the same, and what it is where the joints' zeros are elsewhere
    ```
    """

    joints: tuple[str, ...]
    links: tuple[str, ...]
    limits: dict[str, tuple[float, float]]
    sliding: tuple[str, ...]

    def __init__(
        self,
        links: Sequence[str],
        joints: Mapping[str, Joint],
        bodies: Sequence[tuple[str, Float[np.ndarray, "4 4"], Mesh]],
    ):
        self._links, self._joints = links, joints
        self._from_root, self._following = from_root(links, joints), following(joints)
        free = {n: x for n, x in joints.items() if np.any(x.twist) and not x.leader}
        self.joints = (*free,)
        self.sliding = tuple(name for name, joint in free.items() if np.any(joint.twist[3:]))
        self.limits = {name: joint.limits for name, joint in free.items() if joint.limits}
        self._at = [(link, place) for link, place, _ in bodies]
        self.links = tuple(dict.fromkeys(link for link, _ in self._at))
        self._assembly = Assembly([mesh for _, _, mesh in bodies])

    def poses(self, angles: Angles) -> dict[str, Float[np.ndarray, "4 4"]]:
        """Return the pose of each link in the base's frame: what carries a camera on a link is one.

        - `angles`: of the joints (rad; of sliding ones in m), by name or in the order of `joints`.

        Raises ValueError for angles that are missing, of unknown joints or not finite.
        """
        known, poses = self._checked(angles), dict.fromkeys(self._links, np.eye(4))
        for name in self._following:
            joint = self._joints[name]
            known[name] = joint.factor * known[joint.leader] + joint.offset
        for name in self._from_root:
            joint = self._joints[name]
            moved = exponential(known.get(name, 0.0) * joint.twist)
            poses[joint.child] = poses[joint.parent] @ joint.origin @ moved
        return poses

    def scene(self, angles: Angles) -> Scene:
        """Return the robot with its joints at these angles (see `poses`)."""
        return self.scene_at(self.poses(angles))

    def posture(self, angles: Angles) -> Posture:
        """Return the robot with its joints at these angles (see `poses`), and its motion by their
        zeros. A `JointView` takes it where `fit_joint` is to find these."""
        checked = self._checked(angles)

        def poses(offsets: np.ndarray) -> list[np.ndarray]:
            added = zip(self.joints, offsets, strict=True)
            found = self.poses({name: checked[name] + x for name, x in added})
            return [found[link] @ place for link, place in self._at]

        units = {name: "world" if name in self.sliding else "rad" for name in self.joints}
        return Posture(self._assembly, poses, units)

    def scene_at(self, poses: Input[Mapping[str, ArrayLike], "4 4 each"]) -> Scene:
        """Return the robot with its links at poses (4, 4) that other kinematics found, by name.

        Raises ValueError where a link's is missing.
        """
        if missing := [link for link in self.links if link not in poses]:
            raise ValueError(f"`poses`: expected one of each link, got none of {missing[0]}")
        return self._assembly.scene_at(
            [np.asarray(poses[link]) @ place for link, place in self._at]
        )

    at = scene_at  # (its name so far)

    def _checked(self, angles: Angles) -> dict[str, float]:
        """Checked angles by joint, without joints that follow others; ValueError for others."""
        if not isinstance(angles, Mapping):
            values, number = np.asarray(angles, float), len(self.joints)
            if values.shape != (number,):
                names = ", ".join(self.joints)
                words = f"expected {number} numbers ({names}), got shape {values.shape}"
                raise ValueError(f"`angles`: {words}")
            angles = dict(zip(self.joints, values.tolist(), strict=True))
        # (The angle of a joint that follows another one is known from that.)
        given = {n: float(x) for n, x in angles.items() if n not in self._following}
        if missing := [name for name in self.joints if name not in given]:
            raise ValueError(f"`angles`: expected one of each joint, got none of {missing[0]}")
        check_known("angles", given, self.joints, "joints")
        for name, angle in given.items():
            if not np.isfinite(angle):
                raise ValueError(f"`angles`: expected finite numbers, got {angle} of {name}")
        return given
