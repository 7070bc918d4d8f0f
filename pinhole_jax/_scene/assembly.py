"""Several rigid bodies that move against one another, as one mesh; joints that move them."""

from collections.abc import Callable, Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from .._numerics.arrays import ArrayLike, Input
from .scene import Mesh, Scene, with_vertices

#: What the numbers of joints are measured in: those that turn, those that slide; a body that is as
#: many times larger, and one.
UNITS = ("rad", "world", "scale")
#: Half the step of a joint by which motions are told.
STEP = 1e-4
#: A body's shape changes by no more for a joint's unit.
STIFF = 1e-2


class Assembly:
    """Rigid bodies, each a `Mesh`: `at` puts them in their places.

    Which faces share which edges is worked out once, so that a posture costs no more than to move
    the vertices; scenes of all postures share their faces, and compiled programs.

    Raises ValueError for what are no meshes.

    ```python
    arm = pj.Assembly([mesh, mesh])
    moved = np.eye(4)
    moved[:3, 3] = [0, 0, 2]
    scene = arm.at([np.eye(4), moved])  # faces and edges are worked out once, for all postures
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
        self._points = np.concatenate([np.asarray(body.vertices, float) for body in bodies])
        #: The number of the body that each vertex is one of.
        self.body: np.ndarray = np.repeat(np.arange(len(bodies)), counts)
        self._mesh = Mesh(self._points.astype(self._dtype), np.concatenate(faces))

    def __len__(self) -> int:
        """Return the number of bodies."""
        return int(self.body[-1]) + 1

    def at(self, poses: Input[ArrayLike, "B 4 4"]) -> Scene:
        """Return the scene with each body at its pose: rigid transforms (B, 4, 4), body to world.

        Raises ValueError for another shape, and for numbers that are not finite.
        """
        matrices = np.asarray(poses, float)
        if matrices.shape != (len(self), 4, 4) or not np.all(np.isfinite(matrices)):
            got = "numbers that are not finite"
            got = got if matrices.shape == (len(self), 4, 4) else f"shape {matrices.shape}"
            raise ValueError(f"`poses`: expected finite numbers ({len(self)}, 4, 4), got {got}")
        rotation, shift = matrices[:, :3, :3][self.body], matrices[:, :3, 3][self.body]
        points = np.einsum("nij,nj->ni", rotation, self._points) + shift
        return Scene(mesh=with_vertices(self._mesh, jnp.asarray(points, self._dtype)))


class Posture:
    """Bodies in one posture, and where they are if the zeros of joints are elsewhere, which
    `fit_joint` may find.

    - `poses`: returns the poses (B, 4, 4) of the bodies of an `assembly`, by what is added to the
      joints' readings (J,).
    - `joints`: their names, and what each is measured in: "rad", or "world" for one that slides. A
      body whose size is not known has a "joint" of its own, "scale": `poses` returns then what
      makes it 1 + x times as large, too.

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
        if wrong := [unit for unit in joints.values() if unit not in UNITS]:
            raise ValueError(f"`joints`: expected units among {', '.join(UNITS)}, got {wrong[0]!r}")
        self._assembly, self._poses = assembly, poses
        self.joints, self.units = tuple(joints), tuple(joints.values())

    @property
    def body(self) -> np.ndarray:
        """Return the number of the body that each vertex is one of (V,)."""
        return self._assembly.body

    def scene(self, offsets: Input[ArrayLike | None, "J"] = None) -> Scene:
        """Return the scene where offsets (J,) are added to the joints' readings."""
        return self._assembly.at(self._poses(self._checked(offsets)))

    def twists(self, offsets: Input[ArrayLike | None, "J"] = None) -> np.ndarray:
        """Return how each joint's offset moves each body (J, B, 7), about and along the scene's
        axes: a small rotation about its origin, a shift, and by how much it grows about it.

        Raises ValueError for bodies that are bent, or stretched more one way than another.
        """
        at, result = self._checked(offsets), []
        for step in STEP * np.eye(len(self.joints)):
            one, other = (np.asarray(self._poses(at + s), float) for s in (step, -step))
            result.append(_motion(one @ np.linalg.inv(other)) / (2 * STEP))
        return np.array(result)

    def _checked(self, offsets: ArrayLike | None) -> np.ndarray:
        values = np.zeros(len(self.joints)) if offsets is None else np.asarray(offsets, float)
        if values.shape != (len(self.joints),):
            words = f"expected one of each of {len(self.joints)} joints, got shape {values.shape}"
            raise ValueError(f"`offsets`: {words}")
        return values


def _motion(change: np.ndarray) -> np.ndarray:
    """Return small changes of bodies (B, 4, 4) as rotation, shift and growth (B, 7)."""
    linear, turned = change[:, :3, :3], change[:, :3, :3].transpose(0, 2, 1)
    grows = np.cbrt(np.linalg.det(linear))[:, None] - 1
    bent = (linear + turned) / 2 - (1 + grows[..., None]) * np.eye(3)
    if np.max(np.abs(bent)) > 2 * STEP * STIFF:
        raise ValueError("`poses`: expected bodies that move rigidly or grow evenly, got bent ones")
    skew = (linear - turned) / 2
    turn = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    return np.concatenate([turn, change[:, :3, 3], grows], axis=1)
