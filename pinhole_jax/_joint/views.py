"""Views of one problem: which unknown transforms stand between a view's scene and its camera.

A view sees its scene through `mount X rig`, where X is the unknown pose of a camera (or of the rig
that it is fixed to) on what carries it, and Y `placed`, where Y is the unknown pose of an object. A
small motion of X or Y is one of the camera in the scene's frame, by an adjoint; and a scene that is
s times as large looks as it did from s times as near. So what one view's program says of its own
camera says all about the unknowns, and no other program is compiled.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import equinox as eqx
import numpy as np

from .._camera.camera import Camera
from .._camera.poses import Pose, adjoint, at_pose, exponential, inverse, pose_of, rigid
from .._mask.edges import Weights
from .._mask.mask import Mask
from .._numerics.arrays import ArrayLike, Input
from .._scene.assembly import Posture
from .._scene.scene import Scene
from .._solver.looks import View
from .._solver.parameters import PARAMETERS, components, labels_of
from .._solver.solver import Solver
from .._solver.subject import Subject

#: What an unknown may be, beside a parameter of a camera's lens: a pose, the scale of what is seen,
#: or the zero of a joint.
POSE, SCALE, ZERO = "pose", "scale", "zero"
#: The numbers of a rigid motion: a small rotation (rad), a shift (world units).
TWIST = 6
#: Which of these are free of what moves rigidly.
MOTIONS = {POSE: slice(0, TWIST), "orientation": slice(0, 3), "position": slice(3, TWIST)}
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
    - `posture`: what the scene is where its joints' zeros are elsewhere: `Robot.posture(angles)`.
      None: it has no joints, or their zeros are not sought.
    - `photo`: what the mask was made of (H, W, 3), as in `fit_camera`: the fit is refined on it.
    - `scale`: the name of an unknown number by which the scene is larger than it is given, about
      its frame's origin; views that give the same name have it in common. None: it is as given.

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
    """What is sought: poses by the names of cameras (or the rig) and objects, and cameras
    (canonical) whose focal length and lens count; scales of what is seen; what is added to
    joints' readings."""

    poses: Mapping[str, Pose]
    lenses: Mapping[str, Camera]
    scales: Mapping[str, float]
    zeros: Mapping[str, float]


class Unknown(NamedTuple):
    """Some columns of the problem: a pose (6, or 3 of them), a parameter of a lens, a scale's
    logarithm, a joint's zero.

    `kind` is one of `MOTIONS`, `SCALE`, `ZERO`, or the parameter's name; `cameras` are those that
    have such a parameter in common, the first of which gives it its name.
    """

    name: str
    kind: str
    size: int
    cameras: tuple[str, ...] = ()


@dataclass(frozen=True)
class Eye:
    """One view of the problem: its mask, the solver of its own camera, and its known transforms.

    `owners` names for each parameter of the lens the unknown that it is, by a camera that has it.
    """

    mask: Mask
    solver: Solver
    camera: str
    owners: Mapping[str, str]
    moving: str
    object: str | None
    sized: str | None
    mount: Pose
    rig: Pose
    placed: Pose
    posture: Posture | None
    photo: np.ndarray | None = None
    #: The last offsets that were asked for, and the subject with its joints' zeros there.
    shown: list[tuple[np.ndarray, Subject]] = field(default_factory=list)
    #: The last state, the view's own camera in it, and this one's pose: each look asks many times.
    standing: list[tuple[State, Camera, Pose]] = field(default_factory=list)

    def scene(self, state: State) -> Scene:
        """Return the view's scene, with its joints' zeros where they are."""
        return self._subject(state).given

    def looking(self, state: State) -> Solver:
        """Return the solver that looks at the scene with its joints' zeros where they are."""
        subject = self._subject(state)
        same = subject is self.solver.subject
        return self.solver if same else replace(self.solver, subject=subject)

    def look(self, state: State) -> View:
        """Return what is seen on the finest level."""
        solver = self.looking(state)
        return solver.look(self.canonical(state), solver.finest)

    def weighed(
        self, weights: Weights, target: np.ndarray | None = None, only_finest: bool = False
    ) -> "Eye":
        """Return the eye to which pixels count otherwise, as `Solver.weighed` has it."""
        return replace(self, solver=self.solver.weighed(weights, target, only_finest))

    def _subject(self, state: State) -> Subject:
        offsets = self.offsets(state)
        if self.posture is None or not np.any(offsets):
            return self.solver.subject
        if not (self.shown and np.array_equal(self.shown[0][0], offsets)):
            subject = self.solver.subject.elsewhere(self.posture.scene(offsets))
            self.shown[:] = [(offsets, subject)]
        return self.shown[0][1]

    def offsets(self, state: State) -> np.ndarray:
        """Return what is added to the joints' readings (J,)."""
        names = () if self.posture is None else self.posture.joints
        return np.array([state.zeros.get(name, 0.0) for name in names])

    def canonical(self, state: State) -> Camera:
        """Return the view's own camera (canonical) in its scene's frame, as the scene is given."""
        return self._stands(state)[1]

    def pose(self, state: State) -> Pose:
        """Return the pose of the view's own camera in its scene's frame, as the scene is given."""
        return self._stands(state)[2]

    def scale(self, state: State) -> float:
        """Return by how many times the scene is larger than it is given."""
        return 1.0 if self.sized is None else state.scales[self.sized]

    def _stands(self, state: State) -> tuple[State, Camera, Pose]:
        for known in self.standing:
            if known[0] is state:
                return known
        pose = self.mount @ state.poses[self.moving] @ self.rig
        there = stretched(inverse(self._scene(state)) @ pose, 1 / self.scale(state))
        camera = at_pose(state.lenses[self.camera], there)
        known = state, camera, pose_of(camera)
        self.standing[:] = [known]
        return known

    def at(self, name: str, pose: Pose, state: State) -> State:
        """Return the state in which the view's camera is at a pose in its scene's frame, as the
        scene is given, by moving the camera or the object of that name alone."""
        pose = stretched(pose, self.scale(state))
        if name == self.moving:
            moved = inverse(self.mount) @ self._scene(state) @ pose @ inverse(self.rig)
        else:
            camera = self.mount @ state.poses[self.moving] @ self.rig
            moved = camera @ inverse(self.placed @ pose)
        return state._replace(poses={**state.poses, name: moved})

    def by_twist(self, state: State, view: View) -> np.ndarray:
        """Return the view's moves (n, 6), in its solver's units, by a twist of its own camera (by
        the part of one that these moves are)."""
        freed, pose = self.solver.freed, self.pose(state)
        known = components(freed)
        of_pose = np.array([name in _POSE for name in known])
        labels = labels_of(freed)
        reported = np.array([label in _REPORTED for label in labels])
        # How the camera's own twist is reported, and what moves do to that.
        twisted = np.zeros((TWIST, TWIST))
        twisted[:3, :3], twisted[3:, 3:] = TO_B, pose[:3, :3]
        twisted = twisted[[_REPORTED.index(label) for label in labels if label in _REPORTED]]
        by_moves = np.asarray(view.to_reported, float)[np.ix_(reported, of_pose)]
        by_twist = np.zeros((len(known), TWIST))
        by_twist[of_pose] = np.linalg.solve(by_moves, twisted)
        return by_twist

    def by_motion(self, state: State, view: View) -> np.ndarray:
        """Return the view's moves (n, 6), in its solver's units, by a twist of its own camera in
        the world, whatever the scale of what it sees."""
        result = self.by_twist(state, view)
        result[:, 3:] /= self.scale(state)
        return result

    def moves(self, state: State, view: View, unknowns: list[Unknown]) -> np.ndarray:
        """Return the view's moves (n, k), in its solver's units, by the poses and lenses that it
        depends on."""
        freed, pose, scale = self.solver.freed, self.pose(state), self.scale(state)
        known, sizes = components(freed), np.asarray(view.scale, float)
        by_twist = self.by_motion(state, view)
        nearer = by_twist[:, 3:] @ pose[:3, :3].T @ (-scale * pose[:3, 3])
        parts = [np.zeros((len(known), 0))]
        for unknown in unknowns:
            if unknown.kind == SCALE:
                columns = nearer[:, None]
            elif unknown.kind not in MOTIONS:
                place = _places(freed, unknown.kind)
                columns = np.zeros((len(known), len(place)))
                columns[place, np.arange(len(place))] = 1 / sizes[place]
            elif unknown.name == self.moving:
                columns = (by_twist @ adjoint(inverse(self.rig)))[:, MOTIONS[unknown.kind]]
            else:
                columns = -by_twist @ adjoint(inverse(self.placed @ stretched(pose, scale)))
            parts.append(columns)
        return np.concatenate(parts, axis=1)

    def _scene(self, state: State) -> Pose:
        return self.placed if self.object is None else state.poses[self.object] @ self.placed

    def depends_on(self) -> Iterator[tuple[str, str]]:
        """Yield names and kinds of what the view depends on, if it is unknown."""
        yield from ((self.moving, kind) for kind in MOTIONS)
        if self.object is not None:
            yield self.object, POSE
        if self.sized is not None:
            yield self.sized, SCALE
        yield from ((owner, kind) for kind, owner in self.owners.items())
        if self.posture is not None:
            yield from ((joint, ZERO) for joint in self.posture.joints)

    def ways_out(self, state: State, view: View, unknown: Unknown) -> np.ndarray:
        """Return which way an unknown's numbers (size,) would leave their bounds, where they are at
        an end of these: 1, -1, and 0 of the others."""
        result, bounds, kind = np.zeros(unknown.size), self.solver.bounds, unknown.kind
        if bounds is None or kind not in self.ended(state):
            return result
        one, k = bounds.labels.index(kind), labels_of(self.solver.freed).index(kind)
        middle = float(bounds.low[one] + bounds.high[one]) / 2
        value = float(PARAMETERS[kind].leaves[0].of(state.lenses[self.camera]))
        result[:] = np.sign(np.asarray(view.to_reported)[k, k]) * (1 if value > middle else -1)
        return result

    def ended(self, state: State) -> tuple[str, ...]:
        """Return which of the camera's parameters are at an end of their bounds."""
        bounds = self.solver.bounds
        return () if bounds is None else bounds.ended(state.lenses[self.camera])

    def level(self, depth: int) -> int:
        """Return the number of the level this far from the last, or of the first."""
        return max(len(self.solver.levels) - depth, 0)


def stretched(pose: Pose, times: float) -> Pose:
    """Return the pose in a world that is this many times as large."""
    return rigid(pose[:3, :3], times * pose[:3, 3])


_POSE = frozenset(components(("pose",)))
_REPORTED = labels_of(("pose",))


def _places(freed: tuple[str, ...], kind: str) -> np.ndarray:
    """Return where a parameter's moves are among those that names free."""
    begin = len(components(freed[: freed.index(kind)]))
    return begin + np.arange(len(components((kind,))))


def lens_reported(view: View, freed: tuple[str, ...], kind: str) -> np.ndarray:
    """Return how what is reported of a lens's parameter (film coordinates in film heights) follows
    its moves."""
    at, begin = _places(freed, kind), labels_of(freed).index(labels_of((kind,))[0])
    rows = np.array(view.to_reported, float)[begin : begin + len(at)]
    return rows[:, at] / np.asarray(view.scale, float)[at]


def stepped(state: State, unknowns: list[Unknown], x: np.ndarray, eyes: Sequence[Eye]) -> State:
    """Return the state after a step: twists of poses, and moves of what is free of lenses."""
    poses, lenses = dict(state.poses), dict(state.lenses)
    scales, zeros = dict(state.scales), dict(state.zeros)
    by_camera = {eye.camera: eye for eye in eyes}
    begin = 0
    for unknown in unknowns:
        part = x[begin : begin + unknown.size]
        begin += unknown.size
        if unknown.kind in MOTIONS:
            twist = np.zeros(TWIST)
            twist[MOTIONS[unknown.kind]] = part
            poses[unknown.name] = poses[unknown.name] @ exponential(twist)
        elif unknown.kind == SCALE:
            scales[unknown.name] *= float(np.exp(part[0]))
        elif unknown.kind == ZERO:
            zeros[unknown.name] = zeros.get(unknown.name, 0.0) + float(part[0])
        elif seen_by := [name for name in unknown.cameras if name in by_camera]:
            name, kind = seen_by[0], unknown.kind
            moved = _lens_moved(by_camera[name], lenses[name], kind, part)
            for name in unknown.cameras:
                lenses[name] = with_parameter(lenses[name], kind, moved)
    return State(poses, lenses, scales, zeros)


def with_parameter(camera: Camera, kind: str, other: Camera) -> Camera:
    """Return the camera with a parameter of another one."""
    for leaf in PARAMETERS[kind].leaves:
        camera = eqx.tree_at(leaf.of, camera, leaf.of(other))
    return camera


def _lens_moved(eye: Eye, camera: Camera, kind: str, part: np.ndarray) -> Camera:
    """Return a canonical camera with a parameter of its lens moved."""
    solver = eye.solver
    start, place = solver.move(camera, solver.finest), _places(solver.freed, kind)
    y = np.zeros(len(components(solver.freed)))
    y[place] = part / np.asarray(start.scale, float)[place]
    return solver.step(camera, solver.finest, y)
