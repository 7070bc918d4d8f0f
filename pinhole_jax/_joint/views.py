"""Views of one problem: which unknown transforms stand between a view's scene and its camera.

A view sees its scene through `mount X rig` and Y `placed`. X is the unknown pose of a camera (or
of the rig that it is fixed to) on its carrier, Y that of an object. A
small motion of X or Y is one of the camera in the scene's frame, by an adjoint; and a scene that is
s times as large looks as it did from s times as near. So what one view's program says of its own
camera says all about the unknowns, and no other program is compiled.
"""

from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import equinox as eqx
import numpy as np

from .._camera.camera import Camera
from .._camera.poses import Pose, adjoint, at_pose, inverse, pose_of, rigid
from .._fit.implicit import MOTIONS, SCALE, number_of
from .._mask.mask import Mask
from .._numerics.arrays import ArrayLike, Input
from .._scene.assembly import Posture
from .._scene.scene import Scene
from .._solver.looks import View
from .._solver.parameters import PARAMETERS, components
from .._solver.problem import UNIT_PX
from .._solver.solver import Solver

#: What an unknown may be, beside a parameter of a camera and the scale of the scene: a whole pose,
#: or the zero of a joint.
POSE, ZERO = "pose", "zero"
#: The numbers of a rigid motion: a small rotation (rad), a shift (world units).
TWIST = 6
#: A twist's numbers by the camera's own axes, as reported parameters have them: b1, b2, v are x,
#: -y and z of the camera's frame.
TO_B = np.diag([1.0, -1.0, 1.0])


class JointView(NamedTuple):
    """One mask of a joint fit, its scene, and the transforms that are known.

    - `scene`: the scene that the mask shows, in a frame of its own.
    - `target`: the mask (H, W), as in `fit_camera`; `weight` (H, W) says which pixels count.
    - `camera`: the name of the camera that took it.
    - `mount`: the pose (4, 4) in the world of the camera's carrier, such as a robot's link. None:
      the camera's own pose is in the world.
    - `object`: the name of an unknown object that the scene is part of. None: the scene's pose is
      in the world.
    - `placed`: the scene's pose (4, 4) in the object's frame (or the world's). None: identity.
    - `posture`: the scene as a function of its joints' zeros: `Robot.posture(angles)`. None: it has
      no joints, or their zeros are not sought.
    - `photo`: the photo (H, W, 3) that the mask was made from, as in `fit_camera`: the fit is
      refined on it.
    - `scale`: the name of an unknown factor of the scene's size, about its frame's origin. Views
      with the same name share it. None: the size is as given.

    ```python
    pj.JointView(scene, mask, camera="left", mount=np.eye(4))
    ```
    """

    scene: Scene
    target: Input[ArrayLike | None, "H W"]
    camera: str = "camera"
    weight: Input[ArrayLike | None, "H W"] = None
    mount: Input[ArrayLike | None, "4 4"] = None
    object: str | None = None
    placed: Input[ArrayLike | None, "4 4"] = None
    posture: Posture | None = None
    photo: Input[ArrayLike | None, "H W 3"] = None
    scale: str | None = None


class State(NamedTuple):
    """Values of the unknowns: poses by the names of cameras (or the rig) and objects; cameras
    (canonical), whose focal length and lens count; scales; offsets of joints' readings."""

    poses: Mapping[str, Pose]
    lenses: Mapping[str, Camera]
    scales: Mapping[str, float]
    zeros: Mapping[str, float]


class Unknown(NamedTuple):
    """Columns of the problem: a pose (6, or 3 of them), a parameter of a lens, a scale's logarithm,
    a joint's zero.

    `kind` is one of `MOTIONS`, `SCALE`, `ZERO`, or the parameter's name; `cameras` are those that
    have such a parameter in common; the first gives it its name.
    """

    name: str
    kind: str
    cameras: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return number_of(self.kind)


class Standpoint(NamedTuple):
    """A view at a state: the solver of its scene, joints' zeros where they are; its own camera
    (canonical) in the scene's frame, as the scene is given."""

    solver: Solver
    camera: Camera


@dataclass(frozen=True, eq=False)
class Eye:
    """A view of the problem: its mask, the solver of its own camera, and its known transforms.

    `owners` names for each parameter of the lens the unknown that it is, by a camera that has it;
    `moving` the pose that its camera goes with.
    """

    shot: JointView
    mask: Mask
    solver: Solver
    owners: Mapping[str, str]
    moving: str
    mount: Pose
    placed: Pose
    rig: Pose
    #: The last state, and the view there: each look asks many times.
    _last: list[tuple[State, Standpoint]] = field(default_factory=list, init=False)

    def standpoint(self, state: State) -> Standpoint:
        """The view at a state."""
        if not (self._last and self._last[0][0] is state):
            pose = self.mount @ state.poses[self.moving] @ self.rig
            there = stretched(inverse(self._scene_pose(state)) @ pose, 1 / self.scale(state))
            camera, solver = at_pose(state.lenses[self.shot.camera], there), self.solver
            if (posture := self.shot.posture) is not None and (units := self.joints(state)):
                offsets = np.array([state.zeros.get(name, 0.0) for name in posture.joints])
                if np.any(offsets):
                    scene = posture.scene(offsets)
                    solver = replace(solver, subject=solver.subject.elsewhere(scene))
                velocities = dict(zip(posture.joints, posture.velocities(offsets), strict=True))
                solver = solver.beside_motions(unit * velocities[n] for n, unit in units.items())
            self._last[:] = [(state, Standpoint(solver, camera))]
        return self._last[0][1]

    def canonical(self, state: State) -> Camera:
        """The view's own camera (canonical) in its scene's frame, as the scene is given."""
        return self.standpoint(state).camera

    def look(self, state: State, depth: int = 1) -> View:
        """The view on the level this far from the last, or on the first."""
        solver, camera = self.standpoint(state)
        return solver.look(camera, self.level(depth))

    def program(self, state: State, depth: int) -> Hashable:
        """A key of the compiled program that looks."""
        solver, camera = self.standpoint(state)
        return solver.program(camera, self.level(depth))

    def joints(self, state: State) -> dict[str, float]:
        """Units of the joints whose zeros are sought: they move an outline as moves do, about."""
        px, radius = UNIT_PX / len(self.mask.target), float(self.solver.subject.ball.radius)
        size = {"world": radius}
        each = joint_units([self.shot]).items()
        return {name: px * size.get(unit, 1.0) for name, unit in each if name in state.zeros}

    def scale(self, state: State) -> float:
        """The scene's size, in that of the given scene."""
        return 1.0 if self.shot.scale is None else state.scales[self.shot.scale]

    def _scene_pose(self, state: State) -> Pose:
        name = self.shot.object
        return self.placed if name is None else state.poses[name] @ self.placed

    def with_camera(self, name: str, camera: Camera, state: State) -> State:
        """The state in which the view's own camera is this one (canonical, in its scene's frame, as
        the scene is given): by moving the camera or the object of that name, and by the lens."""
        pose = stretched(pose_of(camera), self.scale(state))
        if name == self.moving:
            moved = inverse(self.mount) @ self._scene_pose(state) @ pose @ inverse(self.rig)
        else:
            moved = self.mount @ state.poses[self.moving] @ self.rig @ inverse(self.placed @ pose)
        lenses = dict(state.lenses)
        for row, owner in self.owners.items():
            if owner == self.shot.camera:
                lenses[owner] = with_parameter(lenses[owner], row, camera)
        return state._replace(poses={**state.poses, name: moved}, lenses=lenses)

    def moves(self, state: State, view: View, unknowns: list[Unknown]) -> np.ndarray:
        """Moves of the view's own camera, then of its joints (n, k), in its solver's units, by the
        unknowns that it depends on."""
        pose, by_moves = pose_of(self.canonical(state)), view.to_reported
        # Of a twist of the camera in the world, whatever the scale of its scene. (A solver's first
        # moves, and the first numbers that it reports, are those of the pose.)
        by_twist = np.zeros((len(view.triangle), TWIST))
        of_pose = by_moves[:TWIST, :TWIST]
        by_twist[:TWIST] = np.linalg.solve(of_pose, reported_twist(pose[:3, :3]))
        by_twist[:, 3:] /= self.scale(state)
        pose = stretched(pose, self.scale(state))
        joints = self.joints(state)
        own = np.diag(1 / np.append(view.scale, [*joints.values()]))
        parts = [np.zeros((len(by_twist), 0))]
        for name, kind, *_ in unknowns:
            if kind == SCALE:
                parts.append(-by_twist[:, 3:] @ pose[:3, :3].T @ pose[:3, 3:])
            elif kind == ZERO:
                parts.append(own[:, [len(view.scale) + [*joints].index(name)]])
            elif kind not in MOTIONS:
                parts.append(own[:, indices(self.solver.freed, kind)])
            elif name == self.moving:
                parts.append((by_twist @ adjoint(inverse(self.rig)))[:, MOTIONS[kind]])
            else:
                parts.append(-by_twist @ adjoint(inverse(self.placed @ pose)))
        return np.concatenate(parts, axis=1)

    def depends_on(self) -> Iterator[tuple[str | None, str]]:
        """Names and kinds that the view depends on, if they are unknown."""
        yield from ((self.moving, kind) for kind in MOTIONS)
        yield from ((self.shot.object, POSE), (self.shot.scale, SCALE))
        yield from ((owner, kind) for kind, owner in self.owners.items())
        if self.shot.posture is not None:
            yield from ((joint, ZERO) for joint in self.shot.posture.joints)

    def ended(self, state: State) -> dict[str, float]:
        """The camera's parameters that are at an end of their bounds, as `Bounds.ended`."""
        bounds = self.solver.bounds
        return {} if bounds is None else bounds.ended(state.lenses[self.shot.camera])

    def level(self, depth: int) -> int:
        """The number of the level this far from the last, or of the first."""
        return max(len(self.solver.levels) - depth, 0)


def joint_units(views: Iterable[JointView]) -> dict[str, str]:
    """The units of all joints that views have, by name."""
    postures = (view.posture for view in views if view.posture is not None)
    return {n: x for each in postures for n, x in zip(each.joints, each.units, strict=True)}


def stretched(pose: Pose, times: float) -> Pose:
    """The pose in a world that is this many times as large."""
    return rigid(pose[:3, :3], times * pose[:3, 3])


def reported_twist(rotation: np.ndarray, axes: np.ndarray = TO_B) -> np.ndarray:
    """Reported pose parameters (6, 6), turns about `axes`, by a twist of a pose."""
    result = np.zeros((TWIST, TWIST))
    result[:3, :3], result[3:, 3:] = axes, rotation
    return result


def indices(freed: tuple[str, ...], kind: str) -> np.ndarray:
    """Indices of a parameter's moves, and of its reported numbers, among those of the free names:
    there are as many of both."""
    begin = len(components(freed[: freed.index(kind)]))
    return begin + np.arange(len(components((kind,))))


def with_parameter(camera: Camera, kind: str, other: Camera) -> Camera:
    """The camera with a parameter of another one."""
    for leaf in PARAMETERS[kind].leaves:
        camera = eqx.tree_at(leaf.of, camera, leaf.of(other))
    return camera
