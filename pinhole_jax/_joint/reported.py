"""How what a joint fit reports follows its unknowns."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .._camera.poses import adjoint, inverse
from .._solver.looks import View
from .._solver.parameters import LABELS, labels_of
from .problem import JointProblem
from .views import POSE, SCALE, TO_B, TWIST, State, lens_reported

#: The six numbers of an object's pose, as they are reported.
OF_OBJECT = ("rotation_x", "rotation_y", "rotation_z", "x", "y", "z")
#: A parameter moves along a direction if by more than this share of what moves most.
HARDLY = 1e-6


class Reported(NamedTuple):
    """Numbers (p,) that are reported, their `labels`, and their derivative (p, q) by the unknowns
    at a `place` (q,)."""

    labels: tuple[str, ...]
    place: np.ndarray
    by_unknowns: np.ndarray

    def part(self, labels: tuple[str, ...]) -> "Reported":
        """Return those of some labels, by the unknowns that these follow."""
        rows = [k for k, label in enumerate(self.labels) if label in labels]
        follows = np.any(self.by_unknowns[rows] != 0, axis=0)
        some = tuple(self.labels[k] for k in rows)
        return Reported(some, self.place[follows], self.by_unknowns[rows][:, follows])

    def covariance(
        self, of: Callable[[np.ndarray], np.ndarray], unseen: np.ndarray | None = None
    ) -> np.ndarray:
        """Return their covariance (p, p), given that `of` the unknowns at some place; infinite,
        with no covariances, where they move along `unseen` directions (size, d) of all unknowns."""
        result = self.by_unknowns @ of(self.place) @ self.by_unknowns.T
        if unseen is not None:
            _forget(result, self.by_unknowns @ unseen[self.place])
        return result


def together(parts: list[Reported]) -> Reported:
    """Return several as one."""
    by_unknowns = np.zeros(np.sum([part.by_unknowns.shape for part in parts], axis=0, dtype=int))
    row = column = 0
    for part in parts:
        m, n = part.by_unknowns.shape
        by_unknowns[row : row + m, column : column + n] = part.by_unknowns
        row, column = row + m, column + n
    place = [part.place for part in parts]
    return Reported(
        tuple(label for part in parts for label in part.labels),
        np.concatenate(place) if place else np.zeros(0, int),
        by_unknowns if parts else np.zeros((0, 0)),
    )


def of_camera(problem: JointProblem, name: str, state: State, view: View) -> Reported:
    """Return what is reported of a camera, one of whose views is given, as in a `Fit`."""
    layout, parts = problem.layout, []
    back = problem.rig.get(name, np.eye(4))
    if (place := layout.place(problem.moving[name], POSE)) is not None:
        pose = state.poses[problem.moving[name]] @ back
        twisted = np.zeros((TWIST, TWIST))
        twisted[:3, :3], twisted[3:, 3:] = TO_B, pose[:3, :3]
        parts.append(Reported(labels_of(("pose",)), place, twisted @ adjoint(inverse(back))))
    owners = next(eye.owners for eye in layout.eyes if eye.camera == name)
    for row, owner in owners.items():
        place, labels = layout.place(owner, row), labels_of((row,))
        assert place is not None
        by_unknowns = lens_reported(view, problem.freed, row)
        by_unknowns[[LABELS[x].unit == "px" for x in labels]] *= problem.cameras[name].H
        parts.append(Reported(labels, place, by_unknowns))
    return together(parts)


def of_object(problem: JointProblem, name: str, state: State) -> Reported:
    """Return what is reported of an object's pose: a turn about its own axes, its place."""
    place = problem.layout.place(name, POSE)
    assert place is not None
    turned = np.eye(TWIST)
    turned[3:, 3:] = state.poses[name][:3, :3]
    return Reported(OF_OBJECT, place, turned)


def of_scale(problem: JointProblem, name: str, state: State) -> Reported:
    """Return what is reported of a scale, whose logarithm is the unknown."""
    place = problem.layout.place(name, SCALE)
    assert place is not None
    return Reported((SCALE,), place, np.array([[state.scales[name]]]))


def _forget(covariance: np.ndarray, unseen: np.ndarray) -> None:
    """Put infinite variances, and no covariances, where parameters move along directions (p, d)
    that change no mask."""
    most = np.max(np.abs(unseen), axis=0, initial=0)
    lost = np.any(np.abs(unseen) > HARDLY * np.maximum(most, 1e-300), axis=1)
    covariance[lost, :] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
