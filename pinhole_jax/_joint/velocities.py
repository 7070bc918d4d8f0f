"""The answer of a joint fit as a function of its views: see `_fit.implicit`."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .._camera.camera import Camera
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


class Answer(NamedTuple):
    """The differentiable part of a joint fit: cameras, objects' poses and scales, by name."""

    cameras: dict[str, Camera]
    poses: dict[str, Any]
    scales: dict[str, Any]


def answer_of(fit: JointFit) -> Answer:
    """The answer of a fit."""
    return Answer(
        {name: found.camera for name, found in fit.cameras.items()},
        {name: np.asarray(found.pose) for name, found in fit.objects.items()},
        {name: np.asarray(found.value) for name, found in fit.scales.items()},
    )


def with_answer(fit: JointFit, answer: Answer) -> JointFit:
    """The fit with another answer."""
    return fit._replace(
        cameras={n: x._replace(camera=answer.cameras[n]) for n, x in fit.cameras.items()},
        objects={n: x._replace(pose=answer.poses[n]) for n, x in fit.objects.items()},
        scales={n: x._replace(value=answer.scales[n]) for n, x in fit.scales.items()},
    )


def velocity(
    fit: JointFit, found: Agreement, views: Sequence[JointView], moving: Sequence[JointView]
) -> Answer:
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
    result = Answer({}, {}, {})
    for eye, end, step in zip(problem.eyes, ends, steps_of(slopes), strict=True):
        camera, place, scale = velocity_of(end.vantage, step)
        result.cameras[eye.shot.camera] = camera
        if eye.shot.object is not None:
            result.poses[eye.shot.object] = place
        if eye.shot.scale is not None:
            result.scales[eye.shot.scale] = scale
    pairs = zip(answer_of(fit), result, strict=True)
    return Answer(*({name: rates[name] for name in own} for own, rates in pairs))


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
