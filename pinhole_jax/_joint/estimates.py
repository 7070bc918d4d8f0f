"""Reported numbers of a joint fit, and how they follow its unknowns."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._solver.looks import View
from .._solver.parameters import LABELS
from .knowledge import reported
from .system import JointProblem
from .views import MOTIONS, POSE, SCALE, ZERO, State

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


def _estimates(
    problem: JointProblem, unknowns: Iterable[tuple[str, str]], state: State, **given: Any
) -> Estimates:
    """The numbers by which some unknowns are reported; none for what is not unknown."""
    return concatenate(
        [
            Estimates(found.labels, place, found.by_unknown)
            for name, kind in unknowns
            if (place := problem.place(name, kind)) is not None
            for found in [reported(state, name, kind, **given)]
        ]
    )


def camera_estimates(
    problem: JointProblem, name: str, state: State, view: View | None = None
) -> Estimates:
    """The parameters of a camera as in a `Fit`, if one of its views is given, else its pose."""
    eye = problem.eye_of(name)[1]
    lens = () if view is None else ((owner, row) for row, owner in eye.owners.items())
    unknowns = *((eye.moving, kind) for kind in MOTIONS), *lens
    given = {"freed": eye.solver.freed, "view": view, "rig": eye.rig}
    found = _estimates(problem, unknowns, state, **given)
    found.by_unknowns[[LABELS[x].unit == "px" for x in found.labels]] *= problem.cameras[name].H
    return found


def estimates_of(problem: JointProblem, name: str, kind: str, state: State) -> Estimates:
    """The numbers of an object's pose, a scale, or a joint's zero."""
    return _estimates(problem, [(name, kind)], state, freed=(), view=None, rig=None)


def all_estimates(problem: JointProblem, state: State, views: Sequence[View]) -> Estimates:
    """All reported numbers, with the names of their owners before their labels."""
    owners = [
        (name, camera_estimates(problem, name, state, views[problem.eye_of(name)[0]]))
        for name in problem.cameras
    ]
    alone = [(name, POSE) for name in problem.objects()]
    alone += [(name, kind) for kind in (SCALE, ZERO) for name in problem.named(kind)]
    owners += [(name, estimates_of(problem, name, kind, state)) for name, kind in alone]
    return concatenate(
        [
            part._replace(labels=tuple(f"{name} {label}" for label in part.labels))
            for name, part in owners
        ]
    )
