"""The result of a joint fit as a user reads it, and what was found put in it: covariances,
statuses, sentences."""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from .._camera.camera import Camera
from .._camera.poses import Pose, at_pose
from .._fit.places import Free, transported
from .._fit.result import (
    WRONG,
    Fit,
    MaskError,
    Measurement,
    Record,
    Result,
    held_words,
    iou_and_rms,
    progress_at,
    uncertain_rotation,
    widened,
)
from .._fit.words import UNIT, Estimate
from .._rules import RULES
from .._scene.scene import Scene
from .._solver.moves import on_film
from .._solver.solver import Solution, Stop
from ..names import STATUSES
from .agreement import HARDLY, OFF, Agreement, forget
from .levels import Outcome
from .system import Part
from .views import MOTIONS, POSE, SCALE, ZERO, joint_units

#: A view with more than this share of its outline far from the mask's edge shows something else; a
#: fit to more than this share of such views is none.
LOST, MOST_LOST = 0.25, 1 / 3
#: A view with less weight than this decides nothing: it is 4.4 times as far off as the middle one.
COUNTS = 0.1
#: What makes one view unlike the others.
UNLIKE = "check what cameras share, transforms, the mesh and the mask"


class ViewFit(NamedTuple):
    """One view of a joint fit.

    - `camera`: its camera in its scene's frame: `silhouette(camera, scene)` draws the view.
    - `iou`, `rms`: of its mask, as in `Fit`.
    - `off`: the root mean square difference of mask and outline, relative to the median view's.
    - `weight`: the weight of the view, at most 1: views with a large `off` count less.
    - `astray`: the share of the outline that is more than `outlier_px` from the mask's edge.
    - `mask_error`: the error of the mask's outline; None where the mask is exact and matches.
    - `scene`: the scene that it shows, with joints' zeros as found.
    - `sigma`: its disagreement with the other views, in standard errors.
    - `worth`: the factor by which the standard errors of its camera's pose would grow without it
      (geometric mean). Infinite where the other views do not determine that pose.
    """

    camera: Camera
    iou: float
    rms: float
    off: float
    weight: float
    astray: float
    mask_error: MaskError | None
    scene: Scene
    sigma: float
    worth: float


class JointZeros(Measurement):
    """Corrections to add to joints' readings, by `names`, and their covariance (n, n).

    `units` are "rad" for a joint that turns, "world" for one that slides, "scale" for a body that
    grows.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, "n"]
    units: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]

    @property
    def rows(self) -> list[Estimate]:
        """The zeros for people, angles in degrees."""
        units = {"rad": (180 / np.pi, "deg")}
        each = zip(self.names, self.values, self.std, self.units, strict=True)
        return [
            Estimate(name, times * value, times * std, unit, "")
            for name, value, std, known in each
            for times, unit in [units.get(known, (1.0, known))]
        ]

    def __str__(self) -> str:
        """The zeros as a table."""
        lines = ["joint         zero off   one sigma  unit"]
        for name, value, std, unit, _ in self.rows:
            lines.append(f"{name:<12}{value:>+10.3g}{std:>12.2g}  {unit}")
        return "\n".join(lines)


class ObjectFit(Measurement):
    """An object's `pose` in the world (4, 4), and its `covariance` (6, 6).

    The covariance is of a small rotation about the object's own axes x, y, z (rad), then of its
    position (world units).
    """

    pose: Pose
    covariance: Float[np.ndarray, "6 6"]


class SceneScale(Record):
    """The factor by which a scene is larger than its mesh: `value`, standard deviation `std`.

    `across` has its covariances (k,) with the pose of each unknown camera and object, by name.
    """

    value: float
    std: float
    across: Mapping[str, Float[np.ndarray, "k"]]


class JointFit(Result):
    """The result of `fit_joint`.

    - `status`: as in `Fit`; trust the answer only where it is "converged".
    - `cameras`: a `Fit` for each camera, by name. The pose is relative to the camera's carrier (to
      the world, if it has none), the covariance is that of all views together.
    - `objects`: an `ObjectFit` for each unknown object.
    - `views`: a `ViewFit` for each mask, in their order.
    - `excess`: the differences of views, relative to what their masks' errors explain (1: no more).
      Above 1, joint angles, meshes or lenses err, and covariances have grown by its square.
    - `weak`: sentences on what the masks determine badly, and on views that disagree.
    - `modes`: other answers that match the masks as well.
    - `steps`: the number of steps on each level, coarse to fine.
    - `scales`: a `SceneScale` for each scale that views name.
    - `joint_zeros`: the corrections of joints' zeros; None where none were sought.

    ```python
    joint.status, joint.cameras
    ```
    """

    status: str
    cameras: Mapping[str, Fit]
    objects: Mapping[str, ObjectFit]
    views: tuple[ViewFit, ...]
    excess: float
    steps: tuple[int, ...]
    scales: Mapping[str, SceneScale]
    joint_zeros: JointZeros | None = None
    _: KW_ONLY
    modes: tuple["JointFit", ...] = ()

    data: ClassVar[str] = "the masks"

    @property
    def camera(self) -> Camera:
        """The camera, where there is one."""
        if len(self.cameras) != 1:
            known = ", ".join(self.cameras)
            raise ValueError(f"`camera`: expected one camera, got {known}: see `cameras`")
        return next(iter(self.cameras.values())).camera

    def __str__(self) -> str:
        """The fit as tables."""
        lines = [f"{self.status}: {len(self.views)} views"]
        lines += [f"  {words}" for words in self.notes]
        for name, fit in self.cameras.items():
            lines += [f"{name}:", str(fit)]
        for name, found in self.objects.items():
            place = ", ".join(f"{x:.6g}" for x in found.pose[:3, 3])
            sigma = ", ".join(f"{x:.2g}" for x in found.std[3:])
            lines.append(f"{name}: at ({place}), one sigma ({sigma}) {UNIT}")
        for name, scale in self.scales.items():
            lines.append(f"{name}: {scale.value:.6g} times as large, one sigma {scale.std:.2g}")
        if self.joint_zeros is not None:
            lines.append(str(self.joint_zeros))
        lines.append("view   IoU     rms     off (sigma)  weight")
        for k, v in enumerate(self.views):
            lines.append(f"{k:4d}  {v.iou:.4f}  {v.rms:.4f}  {v.sigma:11.1f}  {v.weight:.2f}")
        return "\n".join(lines)


def report(end: Outcome, free: Mapping[str, Sequence[Free]]) -> JointFit:
    """The end of a fit as a user reads it; poses are `free` along these directions."""
    problem, found, state = end.problem, end.found, end.found.descent.state
    views = tuple(_view_fit(end, k) for k in range(len(problem.eyes)))
    fits = {name: _camera_fit(end, name, views, free) for name in problem.cameras}
    scales = _scales(found)
    objects = {
        name: ObjectFit(state.poses[name], found.covariance_of([Part(name, POSE)]))
        for name in problem.objects()
    }
    open_still = [f"{name}: {f}" for name in objects for f in free.get(name, [])]
    stds = [np.ravel(part.std) for part in (*objects.values(), *scales.values())]
    is_known = not open_still and all(np.all(np.isfinite(std)) for std in stds)
    statuses = *(fit.status for fit in fits.values()), "converged" if is_known else "rank_deficient"
    return JointFit(
        status=max(statuses, key=[*STATUSES].index),  # the least to be trusted
        cameras=fits,
        objects=objects,
        views=views,
        excess=found.excess,
        weak=(*_weak_scales(scales), *open_still, *_disagreement(found, views), *end.notes),
        steps=found.descent.taken,
        scales=scales,
        joint_zeros=_zeros(found),
    )


def _view_fit(end: Outcome, k: int) -> ViewFit:
    problem, found = end.problem, end.found
    eye, standpoint = problem.eyes[k], problem.eyes[k].standpoint(found.descent.state)
    iou, rms = iou_and_rms([end.whole[k]])
    return ViewFit(
        camera=on_film(standpoint.camera, problem.cameras[eye.shot.camera]),
        iou=iou,
        rms=rms,
        off=float(found.off[k]),
        weight=float(found.problem.weights[k]),
        astray=end.astray[k],
        mask_error=MaskError.from_outline(found.errors[k]),
        scene=standpoint.solver.subject.given,
        sigma=float(found.sigma[k]),
        worth=_worth(found, k),
    )


def _worth(found: Agreement, k: int) -> float:
    """The factor by which the errors of a view's camera would grow without the view."""
    problem = found.problem
    moving = problem.eyes[k].moving
    if (place := problem.places.get((moving, POSE))) is None:
        return float("nan")
    known = [*(e.moving for e in problem.eyes), *(prior.part.name for prior in problem.priors)]
    if known.count(moving) == 1:
        return float("inf")
    less = found.without(k)
    if np.any(np.abs(less.unseen[place]) > HARDLY):
        return float("inf")
    with np.errstate(all="ignore"):
        before, after = (np.linalg.slogdet(x.by_masks.covariance(place))[1] for x in (found, less))
        return float(np.exp((after - before) / (2 * len(place))))


def _camera_fit(
    end: Outcome, name: str, views: tuple[ViewFit, ...], free_poses: Mapping[str, Sequence[Free]]
) -> Fit:
    problem, found, film = end.problem, end.found, end.problem.cameras[name]
    numbers = [k for k, eye in enumerate(problem.eyes) if eye.shot.camera == name]
    (k, eye), state = problem.eye_of(name), found.descent.state
    levels, seen = eye.solver.levels, found.descent.seen[k]
    in_carrier = lambda state: at_pose(state.lenses[name], state.poses[eye.moving] @ eye.rig)
    stop = lambda end: Stop(in_carrier(end.state), levels[eye.level(end.depth)], end.steps)
    parts = problem.parts_of(name)
    covariance = found.covariance_of(parts)
    here = Solution(eye.canonical(state), seen.view, ())
    free = [transported(eye.solver, here, x) for x in free_poses.get(eye.moving, ())]
    if free:  # its covariance is to hold what is free about it
        by_unknowns, place = problem.reports(parts, found.descent)
        own = np.searchsorted(problem.columns(k), place)
        to_reported = by_unknowns @ np.linalg.pinv(seen.moves)[own, : len(seen.view.scale)]
        covariance += widened(to_reported, free, 0.0)
        lost = [to_reported @ f.move for f in free if np.isinf(f.ahead)]
        forget(covariance, np.array(lost).reshape(-1, len(covariance)).T)
    iou, rms = iou_and_rms([end.whole[k] for k in numbers])
    errors = [error for k in numbers if (error := views[k].mask_error) is not None]
    fit = Fit(
        camera=on_film(in_carrier(state), film),
        status="converged",
        names=tuple(label for part in parts for label in part.labels),
        covariance=covariance,
        rms=rms,
        iou=iou,
        steps=found.descent.taken,
        history=tuple(progress_at(stop(end), film) for end in found.descent.way),
        independent_covariance=found.covariance_of(parts, independent=True),
        mask_error=max(errors, key=lambda error: error.px, default=None),
    )
    status, weak = _status(end, numbers, views, fit)
    if free and status == "converged":
        status = "rank_deficient"
    weak = *map(str, free), *weak, *held_words(eye.ended(state))
    return fit._replace(status=status, weak=weak)


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
    counts = [k for k in numbers if found.problem.weights[k] >= COUNTS or len(numbers) == 1]
    if wrong := [str(k) for k in counts if not found.explains(k)]:
        words = f"views {', '.join(wrong)}: the model does not match exact masks closely enough"
        return "misfit", (words,)
    astray = [views[k].astray for k in numbers]
    lost, far = sum(x > LOST for x in astray), float(np.median(astray))
    if lost > MOST_LOST * len(numbers):
        words = f"{lost} of {len(numbers)} masks do not show the model: another object?"
        return "misfit", (words,)
    # (What several masks show alone was compared with all places that it may be seen from; what one
    # mask shows, if there is no other such pose.)
    lone, (k, *_) = end.problem.lone_poses, numbers
    is_compared = any(k in some and (len(some) > 1 or len(lone) == 1) for some in lone.values())
    if far > RULES.astray and not is_compared:
        edges = "the edges of most masks" if len(numbers) > 1 else "the mask's edge"
        return "misfit", (f"{far:.0%} of the outline is far from {edges}: {WRONG}",)
    if found.contradictions:
        return "misfit", found.contradictions
    if len(numbers) == 1 and len(views) > 1 and (sigma := views[k].sigma) > RULES.times:
        return "misfit", (f"its view differs from the others by {sigma:.1f} sigma: {UNLIKE}",)
    if np.any(np.isinf(fit.std)):
        return "rank_deficient", ("the masks leave a direction open (infinite standard errors)",)
    if found.differs and (partly := [k for k in counts if RULES.astray < views[k].astray <= LOST]):
        far = f"view {partly[0]}: {views[partly[0]].astray:.0%} of the outline is far from its mask"
        return "uncertain", (f"{far}, and views differ: one may pull the others along",)
    open_turn = uncertain_rotation(fit.covariance, fit.names, fit.camera)
    return "uncertain" if open_turn else "converged", open_turn


def _scales(found: Agreement) -> dict[str, SceneScale]:
    problem, result = found.problem, {}
    for name in problem.named(SCALE):
        across = {}
        for owner in (*problem.objects(), *problem.cameras):
            poses = [part for part in problem.parts_of(owner) if part.kind in MOTIONS]
            known = found.covariance_of([*poses, Part(name, SCALE)])
            across |= {owner: known[:-1, -1]} if poses else {}
        ((variance,),) = found.covariance_of([Part(name, SCALE)])
        result[name] = SceneScale(found.descent.state.scales[name], float(variance**0.5), across)
    return result


def _zeros(found: Agreement) -> JointZeros | None:
    problem = found.problem
    if not (names := tuple(problem.named(ZERO))):
        return None
    units = joint_units(eye.shot for eye in problem.eyes)
    return JointZeros(
        names=names,
        values=np.array([found.descent.state.zeros[name] for name in names]),
        units=tuple(units[name] for name in names),
        covariance=found.covariance_of([Part(name, ZERO) for name in names]),
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
    apart, astray = [], []
    if found.differs:
        apart.append(
            f"views differ {found.excess:.1f} times as much as their masks' errors explain: check"
            " joint angles, meshes, transforms, the lens, and what cameras share"
        )
    for k, view in enumerate(views):
        if len(views) > 2 and view.off > OFF:
            apart.append(
                f"view {k}: mask and outline are {view.off:.1f} times as far apart as in most"
                f" views; its weight is {view.weight:.2g}"
            )
        if view.astray > LOST:
            astray.append(
                f"view {k}: {view.astray:.0%} of the outline is far from the mask's edge: check"
                " its mask, joint angles and transforms"
            )
    return apart + astray
