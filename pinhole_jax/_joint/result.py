"""What a joint fit found, as a user reads it."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .._camera.poses import Pose, at_pose
from .._fit.result import (
    ASTRAY,
    LEAST_IOU,
    UNCERTAIN,
    WRONG,
    Fit,
    MaskError,
    Progress,
    progress_at,
    widest_turn,
)
from .._fit.words import UNIT, Estimate
from .._scene.scene import Scene
from .._solver.looks import Sums
from .._solver.moves import on_film
from .._solver.parameters import labels_of
from .._solver.solver import Stop
from .._solver.uncertainty import in_words
from ..names import STATUSES
from .agreement import Agreement
from .descent import Layout
from .levels import End, Path
from .problem import JointProblem
from .reported import HARDLY, of_camera, of_object, of_scale, together
from .views import POSE, SCALE, ZERO, Eye, State

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


class ViewFit(NamedTuple):
    """One view of a joint fit.

    - `camera`: its camera in its scene's own frame: `silhouette(camera, scene)` is what it shows.
    - `iou`, `rms`: of its mask, as in `Fit`.
    - `off`: how far mask and outline go apart, beside the middle one of all views.
    - `weight`: how much it counts, at most 1: less where they go farther apart.
    - `astray`: which share of the outline is far (more than `outlier_px`) from the mask's edge.
    - `mask_error`: how the mask's outline errs; None where it is exact, and explained.
    - `scene`: what it shows, the zeros of joints where they were found.
    - `sigma`: how surely it disagrees with the other views, in standard errors.
    - `worth`: by how many times the standard errors of its camera's pose would grow without it, in
      the (geometric) mean; infinite where the other views do not determine that.
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


class JointZeros(NamedTuple):
    """What is to be added to joints' readings: of each of `names` its value and `unit` ("rad", of a
    joint that slides "world", of a body that grows "scale"), and their covariance (n, n)."""

    names: tuple[str, ...]
    values: Float[np.ndarray, "n"]
    units: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]

    @property
    def std(self) -> Float[np.ndarray, "n"]:
        """Return the standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def rows(self) -> list[Estimate]:
        """The zeros for people, angles in degrees."""
        rows = zip(self.names, self.values, self.std, self.units, strict=True)
        in_degrees = lambda name, value, std, unit: (
            Estimate(name, np.rad2deg(value), np.rad2deg(std), "deg", "")
            if unit == "rad"
            else Estimate(name, value, std, unit, "")
        )
        return [in_degrees(*row) for row in rows]

    def __str__(self) -> str:
        """Return it as a table."""
        lines = ["joint         zero off   one sigma  unit"]
        for name, value, std, unit, _ in self.rows:
            lines.append(f"{name:<12}{value:>+10.3g}{std:>12.2g}  {unit}")
        return "\n".join(lines)


class ObjectPose(NamedTuple):
    """An object's `pose` in the world (4, 4); the `covariance` (6, 6) of a small rotation about the
    object's own axes x, y, z (rad) and of its place (world units)."""

    pose: Pose
    covariance: Float[np.ndarray, "6 6"]

    @property
    def std(self) -> Float[np.ndarray, "6"]:
        """Return the standard deviations."""
        return np.sqrt(np.diag(self.covariance))


class SceneScale(NamedTuple):
    """By how many times a scene is larger than it was given: the `value`, its standard deviation,
    and `across` (k,), its covariances with the pose of each unknown camera and object, by name, as
    these report it."""

    value: float
    std: float
    across: Mapping[str, Float[np.ndarray, "k"]]


class JointFit(NamedTuple):
    """The result of `fit_joint`.

    - `status`: as in `Fit`; trust the answer only where it is "converged".
    - `cameras`: for each camera's name a `Fit`: its camera's pose is on what carries it (in the
      world, if nothing does), its covariance is that of all views together.
    - `objects`: for each unknown object an `ObjectPose`.
    - `views`: what became of each mask, in their order.
    - `excess`: by how many times views differ more than their masks' errors say (1: no more): joint
      angles, meshes or lenses err. The covariances have grown by its square.
    - `weak`: sentences on what the masks determine badly, and which views disagree.
    - `modes`: other answers that explain the masks as well.
    - `steps`: on each level, coarse to fine.
    - `scales`: for each scale that views name a `SceneScale`.
    - `joint_zeros`: those of the joints whose zeros were sought, a `JointZeros`; None of none.

    ```python
    joint.status, joint.cameras
    ```
    """

    status: str
    cameras: Mapping[str, Fit]
    objects: Mapping[str, ObjectPose]
    views: tuple[ViewFit, ...]
    excess: float
    weak: tuple[str, ...]
    modes: tuple["JointFit", ...]
    steps: tuple[int, ...]
    scales: Mapping[str, SceneScale]
    joint_zeros: JointZeros | None = None

    @property
    def camera(self) -> Camera:
        """Return the camera, where there is one."""
        if len(self.cameras) != 1:
            known = ", ".join(self.cameras)
            raise ValueError(f"`camera`: expected one camera, got {known}: see `cameras`")
        return next(iter(self.cameras.values())).camera

    def __str__(self) -> str:
        """Return it as tables."""
        lines = [f"{self.status}: {len(self.views)} views"]
        lines += [f"  {words}" for words in self.weak]
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
            lines.append(f"{k:4d}  {v.iou:.4f}  {v.rms:.4f}  {v.off:11.1f}  {v.weight:.2f}")
        return "\n".join(lines)


def _independent_variance(layout: Layout, found: Agreement) -> float:
    """Return a residual's variance, were all of them independent and of one."""
    sums = [s.view.sums for s in found.descent.seen]
    squares = sum(float(s.touched_squares) for s in sums)
    count = sum(float(s.touched) for s in sums)
    least = max(eye.solver.kind.least for eye in layout.eyes)
    return max(squares / max(count - layout.size, 1), least)


def reported(problem: JointProblem, end: End) -> JointFit:
    """Return the end of a fit as a user reads it."""
    found, sums = end.found, end.whole
    independent = _independent_variance(problem.layout, found)
    layout = problem.layout
    pairs = zip(sums, end.astray, strict=True)
    views = tuple(_view_fit(problem, k, found, *pair) for k, pair in enumerate(pairs))
    cameras = {
        name: _camera_fit(problem, name, end, independent, views) for name in problem.cameras
    }
    objects, state = {}, found.descent.state
    for name in dict.fromkeys(eye.object for eye in layout.eyes if eye.object is not None):
        told = of_object(problem, name, state)
        covariance = told.covariance(found.covariance, found.unseen)
        objects[name] = ObjectPose(state.poses[name], covariance)
    scales = _scales(problem, found)
    return JointFit(
        status=_worst(
            [
                *(fit.status for fit in cameras.values()),
                *(_determined(part.std) for part in (*objects.values(), *scales.values())),
            ]
        ),
        cameras=cameras,
        objects=objects,
        views=views,
        excess=found.excess,
        weak=(*_untold(scales), *_words(found, views), *end.said),
        modes=(),
        steps=end.path.steps,
        scales=scales,
        joint_zeros=_zeros(problem, found),
    )


def _zeros(problem: JointProblem, found: Agreement) -> JointZeros | None:
    layout = problem.layout
    names = tuple(u.name for u in layout.unknowns if u.kind == ZERO)
    if not names:
        return None
    units = {}
    for eye in layout.eyes:
        if eye.posture is not None:
            units |= dict(zip(eye.posture.joints, eye.posture.units, strict=True))
    places: Any = [layout.place(name, ZERO) for name in names]
    place = np.concatenate(places)
    values = np.array([found.descent.state.zeros[name] for name in names])
    covariance = found.covariance(place)
    return JointZeros(names, values, tuple(units[name] for name in names), covariance)


def _scales(problem: JointProblem, found: Agreement) -> dict[str, SceneScale]:
    layout, state, result = problem.layout, found.descent.state, {}
    seen = zip(layout.eyes, found.descent.seen, strict=True)
    poses = {
        eye.camera: of_camera(problem, eye.camera, state, one.view).part(labels_of((POSE,)))
        for eye, one in seen
    }
    objects = [eye.object for eye in layout.eyes if eye.object is not None]
    poses |= {name: of_object(problem, name, state) for name in objects}
    for name in (u.name for u in layout.unknowns if u.kind == SCALE):
        told = of_scale(problem, name, state)
        variance = told.covariance(found.covariance, found.unseen)
        across = {
            of: together([pose, told]).covariance(found.covariance, found.unseen)[:-1, -1]
            for of, pose in poses.items()
            if pose.labels
        }
        result[name] = SceneScale(state.scales[name], float(variance[0, 0] ** 0.5), across)
    return result


def _untold(scales: Mapping[str, SceneScale]) -> list[str]:
    """Return which scales the masks do not tell, as sentences."""
    return [
        f"the scale of {name!r} and how far it is away are one: larger and farther it looks the"
        " same; a camera more at a known place, a known distance or scale (`prior`) would tell"
        for name, found in scales.items()
        if np.isinf(found.std)
    ]


def _determined(std: Any) -> str:
    """Return how well something is determined, as a status."""
    return "converged" if np.all(np.isfinite(std)) else "rank_deficient"


def as_one(fits: list[tuple[JointFit, list[int]]]) -> JointFit:
    """Return fits that have nothing in common, and the numbers of their views, as one."""
    views = {k: v for fit, numbers in fits for k, v in zip(numbers, fit.views, strict=True)}
    return JointFit(
        status=_worst([fit.status for fit, _ in fits]),
        cameras={n: c for fit, _ in fits for n, c in fit.cameras.items()},
        objects={n: o for fit, _ in fits for n, o in fit.objects.items()},
        views=tuple(views[k] for k in sorted(views)),
        excess=max(fit.excess for fit, _ in fits),
        weak=tuple(words for fit, _ in fits for words in fit.weak),
        modes=tuple(mode for fit, _ in fits for mode in fit.modes),
        steps=max((fit.steps for fit, _ in fits), key=sum),
        scales={n: s for fit, _ in fits for n, s in fit.scales.items()},
        joint_zeros=_all_zeros([fit.joint_zeros for fit, _ in fits]),
    )


def _all_zeros(parts: list[JointZeros | None]) -> JointZeros | None:
    some = [part for part in parts if part is not None]
    if not some:
        return None
    from scipy.linalg import block_diag

    whole: Any = block_diag(*(part.covariance for part in some))
    return JointZeros(
        sum((part.names for part in some), ()),
        np.concatenate([part.values for part in some]),
        sum((part.units for part in some), ()),
        whole,
    )


def _view_fit(
    problem: JointProblem, k: int, found: Agreement, sums: Sums, astray: float
) -> ViewFit:
    eye = problem.layout.eyes[k]
    camera = on_film(eye.canonical(found.descent.state), problem.cameras[eye.camera])
    total: Any = jax.tree.map(float, sums)
    errors = found.errors[k]
    return ViewFit(
        camera=camera,
        iou=total.overlap / total.union if total.union > 0 else 0.0,
        rms=float(np.sqrt(total.squares / total.weight)) if total.weight > 0 else float("nan"),
        off=float(found.off[k]),
        weight=float(found.weights[k]),
        astray=astray,
        mask_error=None if errors is None else MaskError(errors.size, errors.length),
        scene=eye.scene(found.descent.state),
        sigma=float(found.sigma[k]),
        worth=_worth(problem, k, found),
    )


def _worth(problem: JointProblem, k: int, found: Agreement) -> float:
    """Return by how many times a view's camera is known worse without the view."""
    layout = problem.layout
    place = layout.place(moving := layout.eyes[k].moving, POSE)
    if place is None:
        return float("nan")
    known = [*(eye.moving for eye in layout.eyes), *(prior.name for prior in layout.priors)]
    if known.count(moving) == 1:
        return float("inf")
    less = found.without(k)
    if np.any(np.abs(less.unseen[place]) > HARDLY):
        return float("inf")
    with np.errstate(all="ignore"):
        before, after = (np.linalg.slogdet(x.covariance(place))[1] for x in (found, less))
        return float(np.exp((after - before) / (2 * len(place))))


def _camera_fit(
    problem: JointProblem,
    name: str,
    end: End,
    independent: float,
    views: tuple[ViewFit, ...],
) -> Fit:
    layout = problem.layout
    found, sums = end.found, end.whole
    seen_by = [k for k, eye in enumerate(layout.eyes) if eye.camera == name]
    back = problem.rig.get(name, np.eye(4))
    state = found.descent.state
    moving, lens = problem.moving[name], problem.cameras[name]
    seen_from = lambda state: at_pose(state.lenses[name], state.poses[moving] @ back)
    camera = on_film(seen_from(state), lens)

    told = of_camera(problem, name, state, found.descent.seen[seen_by[0]].view)
    covariance = told.covariance(found.covariance, found.unseen)
    classical = told.covariance(partial(found.independent, variance=independent), found.unseen)

    of: Any = [jax.tree.map(float, sums[k]) for k in seen_by]
    overlap, union = sum(s.overlap for s in of), sum(s.union for s in of)
    squares, weight = sum(s.squares for s in of), sum(s.weight for s in of)
    errors = [views[k].mask_error for k in seen_by]
    known = [e for e in errors if e is not None]
    iou = overlap / union if union > 0 else 0.0
    status, weak = _status(problem, found, covariance, told.labels, iou, seen_by, views, camera)
    ended = layout.eyes[seen_by[0]].ended(found.descent.state)
    weak += tuple(f"{label} is held at an end of its bounds" for label in ended)
    return Fit(
        camera=camera,
        status=status,
        names=told.labels,
        covariance=covariance,
        std=np.sqrt(np.diag(covariance)),
        rms=float(np.sqrt(squares / weight)) if weight > 0 else float("nan"),
        iou=iou,
        steps=end.path.steps,
        weak=weak,
        history=history(end.path, layout.eyes[seen_by[0]], seen_from, lens),
        independent_covariance=classical,
        mask_error=max(known, key=lambda e: e.px) if known else None,
    )


def history(
    path: Path, eye: Eye, seen_from: Callable[[State], Camera], camera: Camera
) -> tuple[Progress, ...]:
    """Return the way of a camera, canonical from `seen_from`, by the levels of one of its views."""
    levels = eye.solver.levels
    stops = (Stop(seen_from(p.state), levels[eye.level(p.depth)], p.steps) for p in path.way)
    return tuple(progress_at(stop, camera) for stop in stops)


def _status(
    problem: JointProblem,
    found: Agreement,
    covariance: np.ndarray,
    labels: tuple[str, ...],
    iou: float,
    seen_by: list[int],
    views: tuple[ViewFit, ...],
    camera: Camera,
) -> tuple[str, tuple[str, ...]]:
    """Return the status of a camera, and what its masks determine badly, as sentences."""
    layout = problem.layout
    squares = found.descent.squares
    if not np.isfinite(squares) or np.any(np.isnan(np.diag(covariance))):
        return "non_finite", ()
    if iou < LEAST_IOU:
        return "no_overlap", ()
    if not found.descent.ended:
        return "max_steps", ()
    explained = [
        layout.eyes[k].solver.kind.explains(found.descent.seen[k].view.touched_misfit, False)
        or not layout.eyes[k].solver.kind.exact
        or found.weights[k] < COUNTS
        for k in seen_by
    ]
    if not all(explained):
        which = ", ".join(str(k) for k, ok in zip(seen_by, explained, strict=True) if not ok)
        return "misfit", (f"the masks of views {which} are not explained as exact ones would be",)
    lost = [k for k in seen_by if views[k].astray > LOST]
    if len(lost) > MOST_LOST * len(seen_by):
        return "misfit", (f"{len(lost)} of {len(seen_by)} masks show something else",)
    far = float(np.median([views[k].astray for k in seen_by]))
    # (A search has compared the places that such a mask may be seen from.)
    if far > ASTRAY and not problem.searchable():
        return "misfit", (f"{far:.0%} of the outline is far from the edges of most masks: {WRONG}",)
    if np.any(np.isinf(np.diag(covariance))):
        return "rank_deficient", ("some move changes no mask",)
    turn, about = widest_turn(covariance, labels)
    if turn > UNCERTAIN:
        axis, degrees = in_words(about @ axes_of(camera)), np.rad2deg(turn)
        words = f"the turn about the axis {axis} is told to {degrees:.0f} degrees (one sigma)"
        return "uncertain", (words,)
    return "converged", ()


def _worst(statuses: list[str]) -> str:
    """Return the status that is the least to be trusted."""
    order = list(STATUSES)
    return max(statuses, key=order.index)


def apart_in_words(off: float, weight: float) -> str:
    """Return that a view counts less since mask and outline go this many times as far apart."""
    return (
        f"mask and outline go {off:.1f} times as far apart as in most views: it counts {weight:.2g}"
    )


def _words(found: Agreement, views: tuple[ViewFit, ...]) -> list[str]:
    result = []
    if found.excess > TELLING:
        result.append(
            f"the views differ by {found.excess:.1f} times what their masks' errors say: joint"
            " angles, meshes, transforms or the lens are off"
        )
    if len(views) > 2:
        result += [
            f"view {k}: {apart_in_words(view.off, view.weight)}"
            for k, view in enumerate(views)
            if view.off > OFF
        ]
    result += [
        f"view {k}: {view.astray:.0%} of the outline is far from the mask's edge: there its mask,"
        " joint angles or transforms are wrong"
        for k, view in enumerate(views)
        if view.astray > LOST
    ]
    return result
