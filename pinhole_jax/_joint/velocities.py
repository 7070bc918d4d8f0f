"""The answer of a joint fit as a function of its views: see `_fit.implicit`."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._camera.poses import at_pose
from .._fit.implicit import OBJECT, Vantage, ViewInputs, slope_of, velocities_of
from .agreement import Agreement
from .joint_fit import JointFit
from .views import MOTIONS, JointView


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
    problem, state = found.problem, found.descent.state
    slopes = []
    for k, (eye, view, change) in enumerate(zip(problem.eyes, views, moving, strict=True)):
        name, pose, weights = eye.shot.camera, state.poses[eye.moving], eye.solver.weights
        weight = weights if isinstance(weights, np.ndarray) else weights.image()
        is_object = lambda u, eye=eye: u.kind in MOTIONS and u.name != eye.moving
        vantage = Vantage(
            at_pose(state.lenses[name], pose @ eye.rig),
            problem.cameras[name],
            pose,
            tuple(OBJECT if is_object(u) else u.kind for u in problem.unknowns_of(k)),
            None if eye.shot.object is None else state.poses[eye.shot.object],
            np.array(eye.scale(state)),
        )
        given, rates = (
            ViewInputs(*(getattr(x, name) for name in ViewInputs._fields)) for x in (view, change)
        )
        counted = float(problem.weights[k]) * weight
        slopes.append(
            slope_of(vantage, given.checked(vantage.film), counted, rates, problem.columns(k))
        )
    cameras, places, scales = {}, {}, {}
    for eye, rates in zip(problem.eyes, velocities_of(slopes), strict=True):
        shot = eye.shot
        cameras[shot.camera], places[shot.object], scales[shot.scale] = rates
    return [
        *(cameras[name] for name in fit.cameras),
        *(places[name] for name in fit.objects),
        *(scales[name] for name in fit.scales),
    ]
