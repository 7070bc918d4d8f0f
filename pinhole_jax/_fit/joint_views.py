"""Views of one problem: which unknown transforms stand between a view's scene and its camera.

A view sees its scene through `mount X rig`, where X is the unknown pose of a camera (or of the rig
that it is fixed to) on what carries it, and Y `placed`, where Y is the unknown pose of an object. A
small motion of X or Y is one of the camera in the scene's frame, by an adjoint: so what one view's
program says of its own camera says all about the unknowns, and no other program is compiled.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .._camera.camera import Camera
from .._camera.poses import Pose, adjoint, at_pose, exponential, inverse, pose_of
from .._scene.scene import Scene
from .mask import Mask
from .parameters import COMPONENTS, components, labels_of
from .problem import View
from .solver import Solver

#: The numbers of a rigid motion: a small rotation (rad), a shift (world units).
TWIST = 6
#: A twist's numbers by the camera's own axes, as reported parameters have them: b1, b2, v are x,
#: -y and z of the camera's frame.
TO_B = np.diag([1.0, -1.0, 1.0])


class JointView(NamedTuple):
    """One mask of a joint fit, what it shows, and what is known of where camera and scene are.

    - `scene`: what the mask shows, in a frame of its own.
    - `target`: the mask (H, W), as in `fit_camera`; `weight` (H, W) says which pixels count.
    - `camera`: the name of the camera that saw it.
    - `mount`: the pose in the world (4, 4) of what carries the camera, as of a robot's link; None:
      the camera's pose is one in the world.
    - `object`: the name of an unknown pose in the world that the scene has a place in; None: its
      place is one in the world.
    - `placed`: the scene's pose there (4, 4); None: it is in place.
    """

    scene: Scene
    target: Any
    camera: str = "camera"
    weight: Any = None
    mount: Any = None
    object: str | None = None
    placed: Any = None


class State(NamedTuple):
    """What is sought: poses by the names of cameras (or the rig) and objects, and cameras
    (canonical) of which the focal length and lens count."""

    poses: Mapping[str, Pose]
    lenses: Mapping[str, Camera]


class Unknown(NamedTuple):
    """Some columns of the problem: a pose (6), or what is free of a camera's lens."""

    name: str
    is_pose: bool
    size: int


@dataclass(frozen=True)
class Eye:
    """One view of the problem: its mask, the solver of its own camera, and its known transforms."""

    mask: Mask
    solver: Solver
    camera: str
    moving: str
    object: str | None
    mount: Pose
    rig: Pose
    placed: Pose

    def unit(self, state: State) -> Camera:
        """Return the view's own camera (canonical) in its scene's frame."""
        pose = self.mount @ state.poses[self.moving] @ self.rig
        return at_pose(state.lenses[self.camera], inverse(self._scene(state)) @ pose)

    def at(self, name: str, pose: Pose, state: State) -> State:
        """Return the state in which the view's camera is at a pose in its scene's frame, by moving
        the camera or the object of that name alone."""
        if name == self.moving:
            moved = inverse(self.mount) @ self._scene(state) @ pose @ inverse(self.rig)
        else:
            camera = self.mount @ state.poses[self.moving] @ self.rig
            moved = camera @ inverse(self.placed @ pose)
        return state._replace(poses={**state.poses, name: moved})

    def moves(self, state: State, view: View, unknowns: list[Unknown]) -> np.ndarray:
        """Return the view's moves (n, k), in its solver's units, by the unknowns it depends on."""
        unit, names = self.unit(state), self.solver.names
        pose = pose_of(unit)
        known = [COMPONENTS[name] for name in components(names)]
        of_pose = np.array([name in _POSE for name in components(names)])
        reported = np.array([label in _REPORTED for label in labels_of(names)])
        # How the camera's own twist is reported, and what moves do to that.
        twisted = np.zeros((TWIST, TWIST))
        twisted[:3, :3], twisted[3:, 3:] = TO_B, pose[:3, :3]
        by_moves = np.asarray(view.to_reported, float)[np.ix_(reported, of_pose)]
        by_twist = np.zeros((len(known), TWIST))
        by_twist[of_pose] = np.linalg.solve(by_moves, twisted)
        parts = []
        for unknown in unknowns:
            if not unknown.is_pose:
                columns = np.zeros((len(known), unknown.size))
                columns[~of_pose] = np.diag(1 / np.asarray(view.unit, float)[~of_pose])
            elif unknown.name == self.moving:
                columns = by_twist @ adjoint(inverse(self.rig))
            else:
                columns = -by_twist @ adjoint(inverse(self.placed @ pose))
            parts.append(columns)
        return np.concatenate(parts, axis=1)

    def _scene(self, state: State) -> Pose:
        return self.placed if self.object is None else state.poses[self.object] @ self.placed

    def depends_on(self, unknown: Unknown) -> bool:
        """Return whether what the view sees depends on an unknown."""
        if unknown.is_pose:
            return unknown.name in (self.moving, self.object)
        return unknown.name == self.camera

    def level(self, depth: int) -> int:
        """Return the number of the level this far from the last, or of the first."""
        return max(len(self.solver.levels) - depth, 0)


_POSE = frozenset(components(("pose",)))
_REPORTED = frozenset(labels_of(("pose",)))


def stepped(state: State, unknowns: list[Unknown], x: np.ndarray, eyes: list[Eye]) -> State:
    """Return the state after a step: twists of poses, and moves of what is free of lenses."""
    poses, lenses, begin = dict(state.poses), dict(state.lenses), 0
    for unknown in unknowns:
        part = x[begin : begin + unknown.size]
        begin += unknown.size
        if unknown.is_pose:
            poses[unknown.name] = poses[unknown.name] @ exponential(part)
            continue
        eye = next(eye for eye in eyes if eye.camera == unknown.name)
        lenses[unknown.name] = _lens_moved(eye, lenses[unknown.name], part)
    return State(poses, lenses)


def _lens_moved(eye: Eye, unit: Camera, part: np.ndarray) -> Camera:
    """Return a canonical camera with what is free of its lens moved."""
    solver = eye.solver
    start = solver.move(unit, solver.finest)
    of_pose = np.array([name in _POSE for name in components(solver.names)])
    y = np.zeros(len(of_pose))
    y[~of_pose] = part / np.asarray(start.unit, float)[~of_pose]
    return solver.step(unit, solver.finest, y)
