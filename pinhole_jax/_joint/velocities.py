"""The answer of a joint fit as a function of its views: see `_fit.implicit`."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._camera.poses import at_pose
from .._fit.implicit import (
    OBJECT,
    Arrangement,
    Vantage,
    arrangement_of,
    end_of,
    steps_of,
    vantage_of,
    velocity_of,
)
from .agreement import Agreement
from .joint_fit import JointFit
from .system import JointProblem
from .views import MOTIONS, JointView, State


def answer_of(fit: JointFit) -> list[Any]:
    """The differentiable part of a joint fit: cameras, objects' poses, scales."""
    return [
        *(found.camera for found in fit.cameras.values()),
        *(found.pose for found in fit.objects.values()),
        *(found.value for found in fit.scales.values()),
    ]


def velocity(
    fit: JointFit, found: Agreement, views: Sequence[JointView], moving: Sequence[JointView]
) -> list[Any]:
    """The answer's rate of change, with the views' scenes, targets, weights, mounts and places."""
    problem, state, ends, slopes = found.problem, found.descent.state, [], []
    for k, (view, change) in enumerate(zip(views, moving, strict=True)):
        vantage = _vantage_of(problem, k, state)
        arranged = arrangement_of(view.scene, vantage.film.e.dtype, view.mount, view.placed)
        weights = problem.eyes[k].solver.weights
        weight = weights if isinstance(weights, np.ndarray) else weights.image()
        ends.append(end_of(vantage, arranged, view.target, weight))
        moved = Arrangement(change.scene, change.mount, change.placed)
        rates = change.target, change.weight, moved
        counts = float(problem.weights[k])
        slopes.append(ends[-1].slope(problem.columns(k), counts, view.weight, rates))
    cameras, places, scales = {}, {}, {}
    for eye, end, step in zip(problem.eyes, ends, steps_of(slopes), strict=True):
        shot, rates = eye.shot, velocity_of(end.vantage, step)
        cameras[shot.camera], places[shot.object], scales[shot.scale] = rates
    return [
        *(cameras[name] for name in fit.cameras),
        *(places[name] for name in fit.objects),
        *(scales[name] for name in fit.scales),
    ]


def _vantage_of(problem: JointProblem, k: int, state: State) -> Vantage:
    eye = problem.eyes[k]
    name, pose = eye.shot.camera, state.poses[eye.moving]
    unknowns = problem.unknowns_of(k)
    is_object = lambda u: u.kind in MOTIONS and u.name != eye.moving
    return vantage_of(
        at_pose(state.lenses[name], pose @ eye.rig),
        problem.cameras[name],
        pose,
        tuple(OBJECT if is_object(u) else u.kind for u in unknowns),
        None if eye.shot.object is None else state.poses[eye.shot.object],
        eye.scale(state),
    )
