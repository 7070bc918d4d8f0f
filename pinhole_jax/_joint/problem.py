"""What is sought in many views, checked at the door."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._camera.camera import Camera, check_camera
from .._camera.poses import Pose, check_pose, inverse, pose_of
from .._fit.fit_camera import check_border, check_reach, check_steps
from .._fit.photo import check_photo
from .._mask.mask import Mask
from .._mask.pyramid import LEAST_CELLS
from .._mask.target import check_target, levelled
from .._scene.assembly import Posture
from .._scene.scene import check_scene
from .._solver.moves import Bounds, canonical
from .._solver.parameters import as_names, check_free, components, in_one, with_lens
from .._solver.problem import COARSE_PX, FINE_PX
from .._solver.solver import Solver
from .._solver.subject import Subject
from .descent import Layout
from .priors import bounds_by_name, prior_of_zero, priors_of, scales_of, zeros_of
from .shared_unknowns import alike_in_groups, groups_of
from .views import MOTIONS, POSE, SCALE, TWIST, ZERO, Eye, JointView, State, Unknown

#: From this many views on, small masks have pyramids of few cells (MB less for each of them, and a
#: program more for all): 14 MB are 14 GB of a thousand.
MANY_VIEWS, FEW_CELLS = 32, 1 << 13
#: The name of the pose that all cameras of a rig share.
RIG = "rig"


class JointProblem(NamedTuple):
    """Unknowns and views, where to start, and the cameras as they are given.

    `freed` is what is free of a view's own camera, `moving` the name of the pose that each camera
    goes with, `rig` the cameras' places there, `zeros` how surely those of joints are known that
    are sought in the end.
    """

    layout: Layout
    start: State
    cameras: Mapping[str, Camera]
    freed: tuple[str, ...]
    moving: Mapping[str, str]
    rig: Mapping[str, Pose]
    outlier_px: float | None
    max_steps: int
    zeros: Mapping[str, float]

    @classmethod
    def of(
        cls,
        views: Any,
        cameras: Any,
        free: Any,
        objects: Any,
        rig: Any,
        outlier_px: float | None,
        max_steps: int,
        prior: Any = None,
        bounds: Any = None,
        joint_zeros: Any = None,
        shared: Any = (),
        as_given: bool = False,
    ) -> "JointProblem":
        """Return the problem, or raise ValueError; masks are levelled unless they are to be taken
        `as_given`."""
        check_steps(max_steps)
        check_reach(outlier_px)
        given = _checked_views(views)
        zeros = zeros_of(joint_zeros, given)
        cameras = {"camera": cameras} if isinstance(cameras, Camera) else cameras
        if not isinstance(cameras, Mapping):
            raise ValueError(
                f"`cameras`: expected a Camera, or a dict of them, got {type(cameras).__name__}"
            )
        for name, camera in cameras.items():
            check_camera(camera, f"cameras[{name!r}]")
        poses = {n: check_pose(f"objects[{n!r}]", x) for n, x in (objects or {}).items()}
        fixed = {n: check_pose(f"rig[{n!r}]", x) for n, x in (rig or {}).items()}
        _check_names(given, cameras, poses, fixed)
        groups = groups_of(shared, cameras)
        free = (*as_names(free), *groups)
        freed = in_one(check_free(free, next(iter(cameras.values())))) if free else ()
        if {"position", "orientation", "d"} & {*freed}:
            raise ValueError(f"`free`: expected pose, phi or a lens's, got {', '.join(freed)}")
        own = ("pose", *(n for n in freed if n != "pose"))
        settings = outlier_px, max_steps, prior, bounds
        masks = [_checked_mask(k, view, cameras[view.camera]) for k, view in enumerate(given)]
        if not as_given:
            masks = [(levelled(image, weight), weight) for image, weight in masks]
        asked = given, masks, cameras, freed, own, groups, poses, fixed, zeros
        return cls.among(*asked, *settings)

    @classmethod
    def among(
        cls,
        views: list[JointView],
        masks: list[tuple[np.ndarray, np.ndarray]],
        cameras: Mapping[str, Camera],
        freed: tuple[str, ...],
        own: tuple[str, ...],
        groups: Mapping[str, list[tuple[str, ...]]],
        objects: Mapping[str, Pose],
        rig: Mapping[str, Pose],
        zeros: Mapping[str, float],
        outlier_px: float | None,
        max_steps: int,
        prior: Any,
        bounds: Any,
    ) -> "JointProblem":
        """Return the problem of views that were checked, with their masks and weights, in which
        `freed` are free, some of them the same for `groups` of cameras; `own` is what a view's own
        solver moves."""
        cameras = alike_in_groups({n: with_lens(c, freed) for n, c in cameras.items()}, groups)
        moving = {n: RIG if n in rig else n for n in cameras}
        rows = [name for name in freed if name not in MOTIONS]
        leader = {row: {n: some[0] for some in of for n in some} for row, of in groups.items()}
        owners = {n: {row: leader.get(row, {}).get(n, n) for row in rows} for n in cameras}
        within = bounds_by_name(bounds, cameras, freed, owners)
        scales = scales_of(prior, views)
        known = prior, cameras, freed, owners, moving, rig, [*objects], [*scales]
        priors = priors_of(*known)
        eyes, cells = [], LEAST_CELLS if len(views) < MANY_VIEWS else FEW_CELLS
        subjects: dict[int, Subject] = {}  # (a scene's arrays are not copied for each view)
        for k, (view, mask) in enumerate(zip(views, masks, strict=True)):
            of = cameras[view.camera], own, owners[view.camera], moving, rig, within[view.camera]
            if id(view.scene) not in subjects:
                dtype = cameras[view.camera].e.dtype
                subjects[id(view.scene)] = Subject.of(view.scene, dtype)
            subject, settings = subjects[id(view.scene)], (max_steps, outlier_px, cells)
            eyes.append(_eye(k, view, subject, mask, *of, settings))
        layout = Layout(_unknowns(freed, owners, moving, objects, scales), eyes, priors)
        if still := [k for k in range(len(eyes)) if not layout.of(k)]:
            raise ValueError(f"`views[{still[0]}]`: expected a view of something unknown, got none")
        poses = {**objects}
        for name, camera in cameras.items():
            poses.setdefault(moving[name], pose_of(camera) @ inverse(rig.get(name, np.eye(4))))
        lenses = {n: canonical(c) for n, c in cameras.items()}
        start = State(poses, lenses, scales, dict.fromkeys(zeros, 0.0))
        return cls(layout, start, cameras, own, moving, rig, outlier_px, max_steps, zeros)

    def with_zeros(self) -> "JointProblem":
        """Return the problem in which the zeros of joints are sought, too."""
        unknowns = [Unknown(name, ZERO, 1) for name in self.zeros]
        of_zeros = [prior_of_zero(name, std) for name, std in self.zeros.items()]
        before = self.layout
        layout = Layout([*before.unknowns, *unknowns], before.eyes, [*before.priors, *of_zeros])
        return self._replace(layout=layout)

    def seeing(self, others: Mapping[int, Eye]) -> "JointProblem":
        """Return the problem with other eyes in place of some."""
        return self._replace(layout=self.layout.seeing(others))

    def parts(self) -> list[tuple["JointProblem", list[int]]]:
        """Return the problems that have no unknown in common, and the numbers of their views."""
        groups: list[tuple[set[Unknown], list[int]]] = []
        for k in range(len(self.layout.eyes)):
            linked, views = set(self.layout.of(k)), [k]
            apart = []
            for unknowns, others in groups:
                if unknowns & linked:
                    linked, views = linked | unknowns, others + views
                else:
                    apart.append((unknowns, others))
            groups = [*apart, (linked, views)]
        if len(groups) == 1:
            return [(self, groups[0][1])]
        result = []
        for linked, views in groups:
            eyes = [self.layout.eyes[k] for k in views]
            own = [u for u in self.layout.unknowns if u in linked]
            layout = Layout(own, eyes, self.layout.priors)
            names = {eye.camera for eye in eyes}
            cameras = {n: c for n, c in self.cameras.items() if n in names}
            result.append((self._replace(layout=layout, cameras=cameras), views))
        return result

    def few(self, most: int) -> "JointProblem":
        """Return the problem with this many views at most, spread among all."""
        eyes = self.layout.eyes
        chosen = np.unique(np.linspace(0, len(eyes) - 1, most).round().astype(int))
        if len(chosen) == len(eyes):
            return self
        some = [eyes[k] for k in chosen]
        return self._replace(layout=Layout(self.layout.unknowns, some, self.layout.priors))

    @property
    def px(self) -> float:
        """Return the size of steps that are negligible before it is asked what explains the masks
        as well: exact masks tell what errs by little."""
        solvers = [eye.solver for eye in self.layout.eyes]
        exact = all(solver.kind.exact for solver in solvers)
        return FINE_PX[solvers[0].dtype] if exact else COARSE_PX

    def searchable(self) -> str | None:
        """Return the name of the one pose that a search may find, if there is one."""
        poses = [u.name for u in self.layout.unknowns if u.kind == POSE]
        return poses[0] if len(poses) == 1 else None


def _check_names(
    views: list[JointView],
    cameras: Mapping[str, Camera],
    objects: Mapping[str, Pose],
    rig: Mapping[str, Pose],
) -> None:
    """Raise ValueError where views name what is not given, or not all of that."""
    for kind, known, asked in (
        ("cameras", cameras, {v.camera for v in views} | set(rig)),
        ("objects", objects, {v.object for v in views if v.object is not None}),
    ):
        if missing := sorted(asked - set(known)):
            have = ", ".join(known) or "none"
            raise ValueError(f"`{kind}`: expected {', '.join(missing)} among them, got {have}")
        if idle := sorted(set(known) - asked):
            raise ValueError(f"`{kind}`: expected what a view names, got {', '.join(idle)}")
    if rig and RIG in cameras:
        raise ValueError(f"`cameras`: expected names other than {RIG!r} beside a rig, got it")
    of_cameras = {*cameras, *([RIG] if rig else [])}
    if both := sorted(of_cameras & set(objects)):
        raise ValueError(f"`objects`: expected names of their own, got {', '.join(both)}")
    for k, view in enumerate(views):
        if view.scale in of_cameras:
            words = f"expected a name that no camera has, got {view.scale!r}"
            raise ValueError(f"`views[{k}].scale`: {words}")


def _unknowns(
    freed: tuple[str, ...],
    owners: Mapping[str, Mapping[str, str]],
    moving: Mapping[str, str],
    objects: Mapping[str, Pose],
    scales: Mapping[str, float],
) -> list[Unknown]:
    """Return what is sought, or raise ValueError where that is nothing."""
    size = lambda name: len(components((name,)))
    motions = [name for name in freed if name in MOTIONS]
    result = [
        Unknown(n, kind, size(kind)) for n in dict.fromkeys(moving.values()) for kind in motions
    ]
    result += [Unknown(n, POSE, TWIST) for n in objects]
    result += [Unknown(n, SCALE, 1) for n in scales]
    for row in (name for name in freed if name not in MOTIONS):
        having: dict[str, list[str]] = {}
        for name, of in owners.items():
            having.setdefault(of[row], []).append(name)
        # (A view's columns are then in the order of its solver's moves.)
        result += [Unknown(n, row, size(row), tuple(some)) for n, some in having.items()]
    if not result:
        raise ValueError("`free`: expected something to fit, got none")
    return result


def _checked_views(views: Any) -> list[JointView]:
    if not isinstance(views, Sequence) or isinstance(views, JointView):
        raise ValueError(f"`views`: expected JointViews in a list, got {type(views).__name__}")
    if not views:
        raise ValueError("`views`: expected at least one JointView, got none")
    for k, view in enumerate(views):
        if not isinstance(view, JointView):
            raise ValueError(f"`views[{k}]`: expected a JointView, got {type(view).__name__}")
        check_scene(view.scene)
        if view.posture is not None and not isinstance(view.posture, Posture):
            kind = type(view.posture).__name__
            raise ValueError(f"`views[{k}].posture`: expected a Posture or None, got {kind}")
    return list(views)


def _checked_mask(k: int, view: JointView, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return a view's mask and weights, or raise ValueError (also for its photo)."""
    try:
        image, weight = check_target(view.target, view.weight, camera.W, camera.H)
        check_border(image, weight, view.scene, None)
        if view.photo is not None:
            check_photo(view.photo, camera.W, camera.H)
    except ValueError as error:
        raise ValueError(f"`views[{k}]`: {error}") from error
    return image, weight


def _eye(
    k: int,
    view: JointView,
    subject: Subject,
    given: tuple[np.ndarray, np.ndarray],
    camera: Camera,
    freed: tuple[str, ...],
    owners: Mapping[str, str],
    moving: Mapping[str, str],
    rig: Mapping[str, Pose],
    bounds: Bounds | None,
    settings: tuple[int, float | None, int],
) -> Eye:
    place = lambda what, x: np.eye(4) if x is None else check_pose(f"views[{k}].{what}", x)
    image, weight = given
    max_steps, outlier_px, cells = settings
    of_view = subject, image, weight, freed, max_steps, bounds
    solver = Solver.on(*of_view, continued=outlier_px is not None, cells=cells)
    mask = Mask(image, weight, camera)
    mount, placed = place("mount", view.mount), place("placed", view.placed)
    pose = rig.get(view.camera, np.eye(4))
    names_of = view.camera, owners, moving[view.camera], view.object, view.scale
    photo = None if view.photo is None else np.asarray(view.photo)
    of_view = mount, pose, placed, view.posture, photo
    return Eye(mask, solver, *names_of, *of_view)
