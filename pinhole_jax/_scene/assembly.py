"""Several rigid bodies that move against one another, as one mesh; joints that move them."""

from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._camera.poses import moved
from .._numerics.arrays import ArrayLike, Input, check_known
from .scene import Mesh, Scene

#: The units of joints that turn and that slide, and of a body's size.
UNITS = ("rad", "world", "scale")
#: Half the step of a joint in the central difference of its motion.
STEP = 1e-4
#: The most that a body's shape changes per unit of a joint.
STIFF = 1e-2


class Assembly:
    """Rigid bodies, each a `Mesh`: `scene_at` puts them in their places.

    Edges are found once, so that a posture costs no more than moving the vertices; scenes of all
    postures share their faces, and compiled programs.

    Raises ValueError for anything but meshes.

    ```python
    arm = pj.Assembly([mesh, mesh])
    moved = np.eye(4)
    moved[:3, 3] = [0, 0, 2]
    # faces and edges are worked out once, for all postures:
    scene = arm.scene_at([np.eye(4), moved])
    ```
    """

    def __init__(self, bodies: Sequence[Mesh]):
        bodies = list(bodies)
        if not bodies or not all(isinstance(body, Mesh) for body in bodies):
            kinds = ", ".join(type(body).__name__ for body in bodies) or "none"
            raise ValueError(f"`bodies`: expected at least one Mesh, got {kinds}")
        counts = [len(body.vertices) for body in bodies]
        begin = np.cumsum([0, *counts[:-1]])
        faces = [np.asarray(b.faces) + n for b, n in zip(bodies, begin, strict=True)]
        self._dtype = bodies[0].vertices.dtype
        self._bodies = [np.asarray(body.vertices, float) for body in bodies]
        points = np.concatenate(self._bodies).astype(self._dtype)
        self._mesh = Mesh(points, np.concatenate(faces))

    def __len__(self) -> int:
        """Return the number of bodies."""
        return len(self._bodies)

    def scene_at(self, poses: Input[ArrayLike, "B 4 4"]) -> Scene:
        """Return the scene with each body at its pose: rigid transforms (B, 4, 4), body to world.

        Raises ValueError for another shape, and for numbers that are not finite.
        """
        matrices, shape = np.asarray(poses, float), (len(self), 4, 4)
        if matrices.shape != shape or not np.all(np.isfinite(matrices)):
            got = f"shape {matrices.shape}" if matrices.shape != shape else "others"
            raise ValueError(f"`poses`: expected finite numbers {shape}, got {got}")
        points = jnp.asarray(self.points_at(matrices), self._dtype)
        return Scene(mesh=eqx.tree_at(lambda mesh: mesh.vertices, self._mesh, points))

    at = scene_at  # (its name so far)

    def points_at(self, poses: np.ndarray) -> np.ndarray:
        """Return the vertices (V, 3) with each body at its pose (B, 4, 4)."""
        pairs = zip(poses, self._bodies, strict=True)
        return np.concatenate([moved(pose, points) for pose, points in pairs])


class Posture:
    """Bodies in one posture, as a function of the joints' zeros, which `fit_joint` may find.

    - `poses`: returns the poses (B, 4, 4) of the bodies of an `assembly` for offsets (J,) that are
      added to the joints' readings.
    - `joints`: their names and units: "rad", or "world" for one that slides. A body of unknown size
      has a "joint" of its own with the unit "scale": its poses also make it 1 + x times as large.

    Raises ValueError for another unit.

    ```python
    def raised(offsets):
        pose = np.eye(4)
        pose[2, 3] = 2 + offsets[0]
        return [np.eye(4), pose]


    posture = pj.Posture(arm, raised, {"lift": "world"})
    scene = posture.scene(
        [0.1]
    )  # a `JointView` takes the posture where `fit_joint` shall find the zero
    ```
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]

    def __init__(
        self,
        assembly: Assembly,
        poses: Callable[[np.ndarray], ArrayLike],
        joints: Mapping[str, str],
    ):
        check_known("joints", joints.values(), UNITS, "units")
        self._assembly, self._poses = assembly, poses
        self.joints, self.units = tuple(joints), tuple(joints.values())

    def scene(self, offsets: Input[ArrayLike | None, "J"] = None) -> Scene:
        """Return the scene where offsets (J,) are added to the joints' readings."""
        return self._assembly.scene_at(self._poses(self._checked(offsets)))

    def velocities(self, offsets: Input[ArrayLike | None, "J"] = None) -> np.ndarray:
        """Return the velocities of the scene's vertices by each joint's offset (J, V, 3).

        Raises ValueError for bodies that are bent, or stretched more one way than another.
        """
        at, result = self._checked(offsets), []
        for step in STEP * np.eye(len(self.joints)):
            ahead, back = (np.asarray(self._poses(at + s), float) for s in (step, -step))
            _check_shape(ahead @ np.linalg.inv(back))
            result.append(self._assembly.points_at((ahead - back) / (2 * STEP)))
        return np.array(result)

    def _checked(self, offsets: ArrayLike | None) -> np.ndarray:
        values = np.zeros(len(self.joints)) if offsets is None else np.asarray(offsets, float)
        if values.shape != (len(self.joints),):
            words = f"expected one of each of {len(self.joints)} joints, got shape {values.shape}"
            raise ValueError(f"`offsets`: {words}")
        return values


def _check_shape(change: np.ndarray) -> None:
    """Raise ValueError unless small changes of bodies (B, 4, 4) keep their shapes."""
    linear, turned = change[:, :3, :3], change[:, :3, :3].transpose(0, 2, 1)
    grows = np.cbrt(np.linalg.det(linear))[:, None] - 1
    bent = (linear + turned) / 2 - (1 + grows[..., None]) * np.eye(3)
    if np.max(np.abs(bent)) > 2 * STEP * STIFF:
        raise ValueError("`poses`: expected bodies that move rigidly or grow evenly, got bent ones")
