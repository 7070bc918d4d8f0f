"""What a joint fit found, as a user reads it."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .._camera.poses import Pose, adjoint, at_pose, inverse
from .._names import STATUSES
from .._scene.scene import Scene
from .agreement import Agreement
from .joint_descent import Layout
from .joint_levels import End, Path
from .joint_problem import JointProblem
from .joint_views import POSE, TO_B, TWIST, ZERO, Eye, State, lens_reported
from .moves import on_film
from .parameters import LABELS, labels_of
from .residuals import Sums
from .result import LEAST_IOU, UNCERTAIN, Fit, MaskError, Progress, progress_at, widest_turn
from .solver import Stop
from .uncertainty import in_words

#: A view this many times farther off than is usual is named.
OFF = 2.5
#: Views that differ by so many times what their masks' errors say do not do so by chance.
TELLING = 2.0
#: A view with more than this share of its outline far from the mask's edge shows something else; a
#: fit to more than this share of such views is none.
LOST, MOST_LOST = 0.25, 1 / 3
#: A view with less weight than this decides nothing.
COUNTS = 0.1
#: A parameter moves along a direction if by more than this share of what moves most.
HARDLY = 1e-6


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
    """What is to be added to joints' readings: of each of `names` its value and `unit` ("rad", or
    "world" of a joint that slides), and their covariance (n, n)."""

    names: tuple[str, ...]
    values: Float[np.ndarray, "n"]
    units: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]

    @property
    def std(self) -> Float[np.ndarray, "n"]:
        """Return the standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    def __str__(self) -> str:
        """Return it as a table."""
        lines = ["joint         zero off   one sigma  unit"]
        rows = zip(self.names, self.values, self.std, self.units, strict=True)
        for name, value, std, unit in rows:
            turns = unit == "rad"
            value, std = (np.rad2deg(x) if turns else x for x in (value, std))
            unit = "deg" if turns else unit
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


class JointFit(NamedTuple):
    """The result of `fit_joint`.

    - `status`: as in `Fit`; trust the answer only where it is "converged".
    - `cameras`: for each camera's name a `Fit`: its camera's pose is on what carries it (in the
      world, if nothing does), its covariance is that of all views together.
    - `objects`: for each unknown object an `ObjectPose`.
    - `views`: what became of each mask, in their order.
    - `excess`: by how many times views differ more than their masks' errors say (1: no more): joint
      angles, meshes or lenses err. The covariances have grown by its square.
    - `weak`: in words, what the masks determine badly, and which views disagree.
    - `modes`: other answers that explain the masks as well.
    - `steps`: on each level, coarse to fine.
    - `joint_zeros`: those of the joints whose zeros were sought, a `JointZeros`; None of none.
    """

    status: str
    cameras: Mapping[str, Fit]
    objects: Mapping[str, ObjectPose]
    views: tuple[ViewFit, ...]
    excess: float
    weak: tuple[str, ...]
    modes: tuple["JointFit", ...]
    steps: tuple[int, ...]
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
            lines.append(f"{name}: at ({place})")
        if self.joint_zeros is not None:
            lines.append(str(self.joint_zeros))
        lines.append("view   IoU     rms     off  weight")
        for k, v in enumerate(self.views):
            lines.append(f"{k:4d}  {v.iou:.4f}  {v.rms:.4f}  {v.off:4.1f}  {v.weight:.2f}")
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
    objects = {}
    for name in dict.fromkeys(eye.object for eye in layout.eyes if eye.object is not None):
        pose, place = found.descent.state.poses[name], layout.place(name, POSE)
        assert place is not None
        turned = np.eye(TWIST)
        turned[3:, 3:] = pose[:3, :3]
        covariance = turned @ found.covariance(place) @ turned.T
        _forget(covariance, turned @ found.unseen[place])
        objects[name] = ObjectPose(pose, covariance)
    return JointFit(
        status=_worst(
            [*(fit.status for fit in cameras.values()), *map(_of_object, objects.values())]
        ),
        cameras=cameras,
        objects=objects,
        views=views,
        excess=found.excess,
        weak=(*_words(found, views), *end.said),
        modes=(),
        steps=end.path.steps,
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


def _of_object(found: ObjectPose) -> str:
    """Return how well a pose is determined, as a status."""
    return "converged" if np.all(np.isfinite(found.std)) else "rank_deficient"


def together(fits: list[tuple[JointFit, list[int]]]) -> JointFit:
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
    camera = on_film(eye.unit(found.descent.state), problem.cameras[eye.camera])
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
    known = [*(eye.moving for eye in layout.eyes), *(belief.name for belief in layout.beliefs)]
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
    layout, names = problem.layout, problem.names
    found, sums = end.found, end.whole
    seen_by = [k for k, eye in enumerate(layout.eyes) if eye.camera == name]
    view = found.descent.seen[seen_by[0]].view
    back = problem.rig.get(name, np.eye(4))
    state = found.descent.state
    pose = state.poses[problem.moving[name]] @ back
    unit = lambda state: at_pose(state.lenses[name], state.poses[problem.moving[name]] @ back)
    camera = on_film(unit(state), problem.cameras[name])

    # What is reported, by the unknowns.
    place, columns, labels = [], [], []
    if (at := layout.place(problem.moving[name], POSE)) is not None:
        twisted = np.zeros((TWIST, TWIST))
        twisted[:3, :3], twisted[3:, 3:] = TO_B, pose[:3, :3]
        place.append(at)
        columns.append(twisted @ adjoint(inverse(back)))
        labels += labels_of(("pose",))
    owners = layout.eyes[seen_by[0]].owners
    for row, owner in owners.items():
        at = layout.place(owner, row)
        assert at is not None
        place.append(at)
        columns.append(lens_reported(view, names, row))
        columns[-1][[LABELS[label].unit == "px" for label in labels_of((row,))]] *= camera.H
        labels += labels_of((row,))
    by_unknowns = np.zeros((len(labels), len(labels)))
    row = 0
    for block in columns:
        by_unknowns[row : row + len(block), row : row + len(block)] = block
        row += len(block)
    places = np.concatenate(place) if place else np.zeros(0, int)
    covariance = by_unknowns @ found.covariance(places) @ by_unknowns.T
    classical = by_unknowns @ found.independent(places, independent) @ by_unknowns.T
    for table in (covariance, classical):
        _forget(table, by_unknowns @ found.unseen[places])

    of: Any = [jax.tree.map(float, sums[k]) for k in seen_by]
    overlap, union = sum(s.overlap for s in of), sum(s.union for s in of)
    squares, weight = sum(s.squares for s in of), sum(s.weight for s in of)
    errors = [views[k].mask_error for k in seen_by]
    known = [e for e in errors if e is not None]
    iou = overlap / union if union > 0 else 0.0
    status, weak = _status(problem, found, covariance, labels, iou, seen_by, views, camera)
    ended = layout.eyes[seen_by[0]].ended(found.descent.state)
    weak += tuple(f"{label} is held at an end of its bounds" for label in ended)
    return Fit(
        camera=camera,
        status=status,
        names=tuple(labels),
        covariance=covariance,
        std=np.sqrt(np.diag(covariance)),
        rms=float(np.sqrt(squares / weight)) if weight > 0 else float("nan"),
        iou=iou,
        steps=end.path.steps,
        weak=weak,
        history=history(end.path, layout.eyes[seen_by[0]], unit, problem.cameras[name]),
        independent_covariance=classical,
        mask_error=max(known, key=lambda e: e.px) if known else None,
    )


def history(
    path: Path, eye: Eye, unit: Callable[[State], Camera], camera: Camera
) -> tuple[Progress, ...]:
    """Return the way of a camera, canonical as `unit` has it, by the levels of one of its views."""
    levels = eye.solver.levels
    stops = (Stop(unit(p.state), levels[eye.level(p.depth)], p.steps) for p in path.way)
    return tuple(progress_at(stop, camera) for stop in stops)


def _forget(covariance: np.ndarray, unseen: np.ndarray) -> None:
    """Put infinite variances, and no covariances, where parameters move along directions (p, d)
    that change no mask."""
    most = np.max(np.abs(unseen), axis=0, initial=0)
    lost = np.any(np.abs(unseen) > HARDLY * np.maximum(most, 1e-300), axis=1)
    covariance[lost, :] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf


def _status(
    problem: JointProblem,
    found: Agreement,
    covariance: np.ndarray,
    labels: list[str],
    iou: float,
    seen_by: list[int],
    views: tuple[ViewFit, ...],
    camera: Camera,
) -> tuple[str, tuple[str, ...]]:
    """Return the status of a camera, and what its masks determine badly, in words."""
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
    if np.any(np.isinf(np.diag(covariance))):
        return "rank_deficient", ("some move changes no mask",)
    turn, about = widest_turn(covariance, tuple(labels))
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
    """Return that a view counts less since mask and outline go so many times as far apart."""
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
