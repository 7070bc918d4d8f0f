"""What a joint fit found, put in its result: covariances, statuses, sentences."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._camera.camera import Camera
from .._camera.poses import at_pose
from .._fit.places import Free, transported
from .._fit.result import (
    WRONG,
    Fit,
    MaskError,
    Progress,
    held_words,
    iou_and_rms,
    progress_at,
    uncertain_rotation,
    widened,
)
from .._rules import RULES
from .._solver.moves import on_film
from .._solver.solver import Solution, Stop
from ..names import STATUSES
from .agreement import Agreement
from .estimates import (
    HARDLY,
    Estimates,
    camera_estimates,
    concatenate,
    estimates_of,
    forget,
)
from .joint_fit import JointFit, JointZeros, ObjectFit, SceneScale, ViewFit
from .levels import Outcome
from .views import POSE, SCALE, ZERO

#: A view this many times farther off than is usual is named: it has less than 0.28 of the weight.
OFF = 2.5
#: Views that differ by this many times what their masks' errors say do not do so by chance: where
#: two views determine one pose (6 numbers) that has a chance of 5e-4 (chi-squared), with more less.
TELLING = 2.0
#: A view with more than this share of its outline far from the mask's edge shows something else; a
#: fit to more than this share of such views is none.
LOST, MOST_LOST = 0.25, 1 / 3
#: A view with less weight than this decides nothing: it is 4.4 times as far off as the middle one.
COUNTS = 0.1


def report(end: Outcome, free: Mapping[str, Sequence[Free]]) -> JointFit:
    """The end of a fit as a user reads it; poses are `free` along these directions."""
    problem, found, state = end.problem, end.found, end.found.descent.state
    views = tuple(_view_fit(end, k) for k in range(len(problem.eyes)))
    cameras = {
        name: _camera_fit(end, name, views, free.get(problem.eye_of(name)[1].moving, []))
        for name in problem.cameras
    }
    objects = {
        name: ObjectFit(
            pose=state.poses[name],
            covariance=found.covariance_of(estimates_of(problem, name, POSE, state)),
        )
        for name in problem.objects()
    }
    scales = _scales(end)
    open_still = [f"{name}: {f}" for name in objects for f in free.get(name, [])]
    stds = [np.ravel(part.std) for part in (*objects.values(), *scales.values())]
    known = bool(np.all(np.isfinite(np.concatenate([*stds, [0.0]])))) and not open_still
    return JointFit(
        status=worst(
            [*(fit.status for fit in cameras.values()), "converged" if known else "rank_deficient"]
        ),
        cameras=cameras,
        objects=objects,
        views=views,
        excess=found.excess,
        weak=(*_weak_scales(scales), *open_still, *_disagreement(found, views), *end.notes),
        steps=end.path.steps,
        scales=scales,
        joint_zeros=_zeros(found),
    )


def worst(statuses: Sequence[str]) -> str:
    """The status that is the least to be trusted."""
    return max(statuses, key=[*STATUSES].index)


def _view_fit(end: Outcome, k: int) -> ViewFit:
    problem, found = end.problem, end.found
    eye, state = problem.eyes[k], found.descent.state
    iou, rms = iou_and_rms([end.whole[k]])
    return ViewFit(
        camera=on_film(eye.canonical(state), problem.cameras[eye.shot.camera]),
        iou=iou,
        rms=rms,
        off=float(found.off[k]),
        weight=float(found.problem.weights[k]),
        astray=end.astray[k],
        mask_error=MaskError.from_outline(found.errors[k]),
        scene=eye.solver_at(state).subject.given,
        sigma=float(found.sigma[k]),
        worth=_worth(found, k),
    )


def _worth(found: Agreement, k: int) -> float:
    """The factor by which the errors of a view's camera would grow without the view."""
    problem = found.problem
    moving = problem.eyes[k].moving
    if (place := problem.place(moving, POSE)) is None:
        return float("nan")
    known = [*(eye.moving for eye in problem.eyes), *(prior.name for prior in problem.priors)]
    if known.count(moving) == 1:
        return float("inf")
    less = found.without(k)
    if np.any(np.abs(less.unseen[place]) > HARDLY):
        return float("inf")
    with np.errstate(all="ignore"):
        before, after = (np.linalg.slogdet(x.covariance(place))[1] for x in (found, less))
        return float(np.exp((after - before) / (2 * len(place))))


def _camera_fit(end: Outcome, name: str, views: tuple[ViewFit, ...], free: Sequence[Free]) -> Fit:
    problem, found, film = end.problem, end.found, end.problem.cameras[name]
    numbers = [k for k, eye in enumerate(problem.eyes) if eye.shot.camera == name]
    eye, seen, state = problem.eyes[numbers[0]], found.descent.seen[numbers[0]], found.descent.state
    seen_from = lambda state: at_pose(state.lenses[name], state.poses[eye.moving] @ eye.rig)
    camera = on_film(seen_from(state), film)

    estimates = camera_estimates(problem, name, state, seen.view)
    covariance = found.covariance_of(estimates)
    free = [transported(eye.solver, Solution(eye.canonical(state), seen.view, ()), f) for f in free]
    if free:
        _widen(covariance, found, numbers[0], estimates, free)
    iou, rms = iou_and_rms([end.whole[k] for k in numbers])
    known = [error for k in numbers if (error := views[k].mask_error) is not None]
    fit = Fit(
        camera=camera,
        status="converged",
        names=estimates.labels,
        covariance=covariance,
        rms=rms,
        iou=iou,
        steps=end.path.steps,
        history=_history(end, numbers[0], seen_from, film),
        independent_covariance=found.covariance_of(estimates, independent=True),
        mask_error=max(known, key=lambda e: e.px) if known else None,
    )
    status, weak = _status(end, numbers, views, fit)
    if free:
        weak = (*map(str, free), *weak)
        status = "rank_deficient" if status == "converged" else status
    return fit._replace(status=status, weak=weak + held_words(eye.ended(state)))


def _widen(
    covariance: np.ndarray, found: Agreement, k: int, estimates: Estimates, free: Sequence[Free]
) -> None:
    """Let the covariance (p, p) of a view's camera hold what is free about it."""
    back = np.linalg.pinv(found.descent.seen[k].moves)
    rows = np.searchsorted(found.problem.columns(k), estimates.place)
    to_reported = estimates.by_unknowns @ back[rows]
    covariance += widened(to_reported, free, 0.0)
    lost = [to_reported @ f.move for f in free if np.isinf(f.ahead)]
    if lost:
        forget(covariance, np.array(lost).T)


def _history(
    end: Outcome, k: int, seen_from: Callable[[Any], Camera], film: Camera
) -> tuple[Progress, ...]:
    """The way of a camera, canonical from `seen_from`, by the levels of one of its views."""
    eye = end.problem.eyes[k]
    levels = eye.solver.levels
    stops = [Stop(seen_from(p.state), levels[eye.level(p.depth)], p.steps) for p in end.path.way]
    return tuple(progress_at(stop, film) for stop in stops)


def _status(
    end: Outcome, numbers: list[int], views: tuple[ViewFit, ...], fit: Fit
) -> tuple[str, tuple[str, ...]]:
    """The status of a camera, and what its masks determine badly, as sentences."""
    found = end.found
    if not np.isfinite(found.descent.squares) or np.any(np.isnan(fit.std)):
        return "non_finite", ()
    if fit.iou < RULES.overlap:
        return "no_overlap", ()
    if not found.descent.ended:
        return "max_steps", ()
    wrong = [k for k in numbers if not _is_explained(found, k)]
    if wrong:
        which = ", ".join(map(str, wrong))
        return "misfit", (f"views {which}: the model does not match exact masks closely enough",)
    lost = [k for k in numbers if views[k].astray > LOST]
    if len(lost) > MOST_LOST * len(numbers):
        return "misfit", (
            f"{len(lost)} of {len(numbers)} masks do not show the model: another object?",
        )
    far = float(np.median([views[k].astray for k in numbers]))
    # (What several masks show alone was compared with all places that it may be seen from.)
    if far > RULES.astray and not _is_compared(end, numbers[0]):
        edges = "the edges of most masks" if len(numbers) > 1 else "the mask's edge"
        return "misfit", (f"{far:.0%} of the outline is far from {edges}: {WRONG}",)
    if np.any(np.isinf(fit.std)):
        return "rank_deficient", ("the masks leave a direction open (infinite standard errors)",)
    open_turn = uncertain_rotation(fit.covariance, fit.names, fit.camera)
    return "uncertain" if open_turn else "converged", open_turn


def _is_compared(end: Outcome, k: int) -> bool:
    """True if the fit compared other places of the one pose that view k leaves unknown: several
    views share it, or there is no other."""
    poses, lone = (
        [u.name for u in end.problem.unknowns_of(k) if u.kind == POSE],
        end.problem.lone_poses,
    )
    alone = len(poses) == 1 and poses[0] in lone
    return alone and (len(lone) == 1 or len(lone[poses[0]]) > 1)


def _is_explained(found: Agreement, k: int) -> bool:
    """True unless a view counts, its mask is exact, and the model does not match it."""
    kind, view = found.problem.eyes[k].solver.kind, found.descent.seen[k].view
    explained = not kind.exact or kind.explains(view.touched_misfit, False)
    return bool(explained or found.problem.weights[k] < COUNTS)


def _scales(end: Outcome) -> dict[str, SceneScale]:
    problem, found, state = end.problem, end.found, end.found.descent.state
    poses = {name: estimates_of(problem, name, POSE, state) for name in problem.objects()}
    poses |= {name: camera_estimates(problem, name, state) for name in problem.cameras}
    result = {}
    for name in problem.named(SCALE):
        estimates = estimates_of(problem, name, SCALE, state)
        across = {
            owner: found.covariance_of(concatenate([pose, estimates]))[:-1, -1]
            for owner, pose in poses.items()
            if pose.labels
        }
        std = float(found.covariance_of(estimates)[0, 0] ** 0.5)
        result[name] = SceneScale(state.scales[name], std, across)
    return result


def _zeros(found: Agreement) -> JointZeros | None:
    problem, state = found.problem, found.descent.state
    if not (names := tuple(problem.named(ZERO))):
        return None
    units = {}
    for posture in (eye.shot.posture for eye in problem.eyes):
        units |= {} if posture is None else dict(zip(posture.joints, posture.units, strict=True))
    estimates = concatenate([estimates_of(problem, name, ZERO, state) for name in names])
    return JointZeros(
        names=names,
        values=np.array([state.zeros[name] for name in names]),
        units=tuple(units[name] for name in names),
        covariance=found.covariance(estimates.place),
    )


def _weak_scales(scales: dict[str, SceneScale]) -> list[str]:
    return [
        f"the scale of {name!r} and its distance cannot be told apart: larger and farther away, it"
        " looks the same; add a camera at a known place, or give a `prior` on scale or distance"
        for name, found in scales.items()
        if np.isinf(found.std)
    ]


def _disagreement(found: Agreement, views: tuple[ViewFit, ...]) -> list[str]:
    """Sentences on how far views differ, and which of them do."""
    result = []
    if found.excess > TELLING:
        result.append(
            f"views differ {found.excess:.1f} times as much as their masks' errors explain: check"
            " joint angles, meshes, transforms and the lens"
        )
    for k, view in enumerate(views):
        if len(views) > 2 and view.off > OFF:
            result.append(
                f"view {k}: mask and outline are {view.off:.1f} times as far apart as in most"
                f" views; its weight is {view.weight:.2g}"
            )
    for k, view in enumerate(views):
        if view.astray > LOST:
            result.append(
                f"view {k}: {view.astray:.0%} of the outline is far from the mask's edge: check"
                " its mask, joint angles and transforms"
            )
    return result
