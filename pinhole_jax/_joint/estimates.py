"""Reported numbers of a joint fit, and how they follow its unknowns."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .._camera.poses import adjoint, inverse
from .._solver.looks import View
from .._solver.parameters import LABELS, labels_of
from .system import JointProblem
from .views import MOTIONS, POSE, SCALE, TWIST, ZERO, State, lens_reported, reported_twist

#: The six numbers of an object's pose, as they are reported.
OF_OBJECT = ("rotation_x", "rotation_y", "rotation_z", "x", "y", "z")
#: A parameter moves along a direction if by more than this share of the largest move.
HARDLY = 1e-6


class Estimates(NamedTuple):
    """Reported numbers (p,): their `labels`, and their derivative (p, q) by the unknowns at a
    `place` (q,)."""

    labels: tuple[str, ...]
    place: np.ndarray
    by_unknowns: np.ndarray


def forget(covariance: np.ndarray, unseen: np.ndarray) -> None:
    """Put infinite variances, and no covariances, where numbers move along directions (p, d) that
    change no mask."""
    most = np.max(np.abs(unseen), axis=0, initial=0)
    lost = np.any(np.abs(unseen) > HARDLY * np.maximum(most, 1e-300), axis=1)
    covariance[lost, :] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf


def concatenate(parts: Sequence[Estimates]) -> Estimates:
    """Several as one."""
    from scipy.linalg import block_diag

    if not parts:
        return Estimates((), np.zeros(0, int), np.zeros((0, 0)))
    labels, places, by_unknowns = zip(*parts, strict=True)
    return Estimates(sum(labels, ()), np.concatenate(places), np.asarray(block_diag(*by_unknowns)))


def pose_estimates(problem: JointProblem, name: str, state: State) -> Estimates:
    """The pose of a camera, as in a `Fit`."""
    _, eye = problem.eye_of(name)
    rotation = (state.poses[eye.moving] @ eye.rig)[:3, :3]
    by_twist = reported_twist(rotation) @ adjoint(inverse(eye.rig))
    places = {kind: problem.place(eye.moving, kind) for kind in MOTIONS}
    return concatenate(
        [
            Estimates(labels_of((kind,)), place, by_twist[MOTIONS[kind], MOTIONS[kind]])
            for kind, place in places.items()
            if place is not None
        ]
    )


def camera_estimates(problem: JointProblem, name: str, state: State, view: View) -> Estimates:
    """The parameters of a camera, one of whose views is given, as in a `Fit`."""
    eye, parts = problem.eye_of(name)[1], [pose_estimates(problem, name, state)]
    for row, owner in eye.owners.items():
        labels, place = labels_of((row,)), problem.place(owner, row)
        by_unknowns = lens_reported(view, eye.solver.freed, row)
        by_unknowns[[LABELS[x].unit == "px" for x in labels]] *= problem.cameras[name].H
        if place is not None:
            parts.append(Estimates(labels, place, by_unknowns))
    return concatenate(parts)


def object_estimates(problem: JointProblem, name: str, state: State) -> Estimates:
    """The numbers of an object's pose: a turn about its own axes, its place."""
    by_twist = np.eye(TWIST)
    by_twist[3:, 3:] = state.poses[name][:3, :3]
    place = problem.place(name, POSE)
    return concatenate([]) if place is None else Estimates(OF_OBJECT, place, by_twist)


def number_estimate(problem: JointProblem, name: str, kind: str, state: State) -> Estimates:
    """A scale, whose logarithm is the unknown, or a joint's zero."""
    place = problem.place(name, kind)
    value = state.scales[name] if kind == SCALE else 1.0
    assert place is not None
    return Estimates((kind,), place, np.array([[value]]))


def all_estimates(problem: JointProblem, state: State, views: Sequence[View]) -> Estimates:
    """All reported numbers, with the names of whose they are."""
    parts = {
        name: camera_estimates(problem, name, state, views[problem.eye_of(name)[0]])
        for name in problem.cameras
    }
    result = [
        *parts.items(),
        *((n, object_estimates(problem, n, state)) for n in problem.objects()),
    ]
    for kind in (SCALE, ZERO):
        result += [(n, number_estimate(problem, n, kind, state)) for n in problem.named(kind)]
    return concatenate(
        [
            part._replace(labels=tuple(f"{name} {label}" for label in part.labels))
            for name, part in result
        ]
    )
