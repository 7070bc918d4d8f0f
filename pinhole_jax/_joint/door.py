"""The arguments of a joint fit, checked, and the problem that they make."""

from collections.abc import Mapping, Sequence
from typing import Any

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
from .._solver.moves import canonical
from .._solver.parameters import components
from .._solver.solver import Solver
from .._solver.subject import Subject
from .knowledge import bounds_by_name, priors_of, scales_of, zeros_of
from .lenses import with_shared
from .system import JointProblem
from .views import MOTIONS, POSE, SCALE, TWIST, Eye, JointView, State, Unknown

#: From this many views on, small masks have pyramids of few cells (MB less for each of them, and a
#: program more for all): 14 MB are 14 GB of a thousand.
MANY_VIEWS, FEW_CELLS = 32, 1 << 13
#: The name of the pose that all cameras of a rig share.
RIG = "rig"


def joint_problem(
    views: Sequence[JointView],
    cameras: Camera | Mapping[str, Camera],
    free: Any,
    *,
    shared: Any = (),
    objects: Any = None,
    rig: Any = None,
    outlier_px: float | None = None,
    prior: Any = None,
    bounds: Any = None,
    joint_zeros: Any = None,
    max_steps: int = 64,
    search: bool = False,
    as_given: bool = False,
    widens: bool = True,
) -> JointProblem:
    """The problem that these arguments of `fit_joint` make; masks are levelled unless taken
    `as_given`. With `search`, cameras are nowhere yet.

    Raises ValueError for arguments that make no fit.
    """
    check_steps(max_steps)
    check_reach(outlier_px)
    _check_views(views)
    cameras = _checked_cameras(cameras)
    poses, places = _poses("objects", objects), _poses("rig", rig)
    _check_names(views, cameras, poses, places)

    parts = [*poses]
    freed, groups, cameras = with_shared(cameras, free, shared)
    lens = [name for name in freed if name not in MOTIONS]
    first = {row: {n: g[0] for g in groups[row] for n in g} for row in groups}
    owners = {n: {row: first.get(row, {}).get(n, n) for row in lens} for n in cameras}
    limits = bounds_by_name(bounds, cameras, freed, owners)

    moving = {n: RIG if n in places else n for n in cameras}
    cells = LEAST_CELLS if len(views) < MANY_VIEWS else FEW_CELLS
    options = {"continued": outlier_px is not None, "cells": cells}
    # (A scene's arrays are not copied for each view.)
    scenes = {id(view.scene): (view.scene, cameras[view.camera].e.dtype) for view in views}
    subjects = {key: Subject.from_scene(*scene) for key, scene in scenes.items()}
    eyes = []
    for k, view in enumerate(views):
        name, mask = view.camera, _checked_mask(k, view, cameras, search, as_given)
        own = subjects[id(view.scene)], mask, (POSE, *lens), max_steps, limits[name]
        solver, place = Solver.on(*own, **options), places.get(name, np.eye(4))
        on = owners[name], moving[name], *_transforms(k, view), place
        eyes.append(Eye(view, mask, solver, *on))

    scales = scales_of(prior, views)
    for eye in eyes:
        poses.setdefault(eye.moving, pose_of(eye.mask.camera) @ inverse(eye.rig))
    return JointProblem(
        unknowns=_unknowns(freed, owners, moving, parts, [*scales]),
        eyes=eyes,
        priors=priors_of(prior, cameras, freed, eyes, parts, [*scales]),
        zeros=zeros_of(joint_zeros, views),
        start=State(poses, {n: canonical(c) for n, c in cameras.items()}, scales, {}),
        cameras=cameras,
        outlier_px=outlier_px,
        max_steps=max_steps,
        weights=np.ones(len(eyes)),
        widens=widens,
    )


def _transforms(k: int, view: JointView) -> tuple[Pose, Pose]:
    """Where a view's camera is carried, and its scene placed. Raises ValueError for these."""
    pose = lambda name, x: np.eye(4) if x is None else check_pose(f"views[{k}].{name}", x)
    return pose("mount", view.mount), pose("placed", view.placed)


def _unknowns(
    freed: tuple[str, ...],
    owners: Mapping[str, Mapping[str, str]],
    moving: Mapping[str, str],
    objects: Sequence[str],
    scales: Sequence[str],
) -> list[Unknown]:
    size = lambda name: len(components((name,)))
    motions = [name for name in freed if name in MOTIONS]
    poses = dict.fromkeys(moving.values())
    result = [Unknown(name, kind, size(kind)) for name in poses for kind in motions]
    result += [Unknown(name, POSE, TWIST) for name in objects]
    result += [Unknown(name, SCALE, 1) for name in scales]
    for row in (name for name in freed if name not in MOTIONS):
        having: dict[str, list[str]] = {}
        for name, owner_of in owners.items():
            having.setdefault(owner_of[row], []).append(name)
        # (A view's columns are then in the order of its solver's moves.)
        result += [Unknown(name, row, size(row), tuple(x)) for name, x in having.items()]
    if not result:
        raise ValueError("`free`: expected something to fit, got none")
    return result


def _poses(argument: str, given: Mapping[str, Any] | None) -> dict[str, Pose]:
    return {n: check_pose(f"{argument}[{n!r}]", x) for n, x in (given or {}).items()}


def _checked_cameras(cameras: Any) -> Mapping[str, Camera]:
    cameras = {"camera": cameras} if isinstance(cameras, Camera) else cameras
    if not isinstance(cameras, Mapping):
        kind = type(cameras).__name__
        raise ValueError(f"`cameras`: expected a Camera, or a dict of them, got {kind}")
    for name, camera in cameras.items():
        check_camera(camera, f"cameras[{name!r}]")
    return cameras


def _check_views(views: Any) -> None:
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


def _check_names(
    views: Sequence[JointView],
    cameras: Mapping[str, Camera],
    objects: Mapping[str, Pose],
    rig: Mapping[str, Pose],
) -> None:
    """Raise ValueError where views name what is not given, or not all of that."""
    for kind, known, named in (
        ("cameras", cameras, {v.camera for v in views} | set(rig)),
        ("objects", objects, {v.object for v in views if v.object is not None}),
    ):
        if missing := sorted(named - set(known)):
            have = ", ".join(known) or "none"
            raise ValueError(f"`{kind}`: expected {', '.join(missing)} among them, got {have}")
        if idle := sorted(set(known) - named):
            raise ValueError(f"`{kind}`: expected names that a view uses, got {', '.join(idle)}")
    if blind := sorted(set(rig) - {v.camera for v in views}):
        raise ValueError(f"`rig`: expected cameras that a view names, got {', '.join(blind)}")
    if rig and RIG in cameras:
        raise ValueError(f"`cameras`: expected names other than {RIG!r} with a rig, got it")
    of_cameras = {*cameras, *([RIG] if rig else [])}
    if both := sorted(of_cameras & set(objects)):
        raise ValueError(f"`objects`: expected names of their own, got {', '.join(both)}")
    for k, view in enumerate(views):
        if view.scale in of_cameras:
            words = f"expected a name that no camera has, got {view.scale!r}"
            raise ValueError(f"`views[{k}].scale`: {words}")


def _checked_mask(
    k: int, view: JointView, cameras: Mapping[str, Camera], search: bool, as_given: bool
) -> Mask:
    """A view's mask. Raises ValueError for this, and for its photo."""
    camera = cameras[view.camera]
    is_world = view.mount is None and view.object is None and view.placed is None
    try:
        image, weight = check_target(view.target, view.weight, camera.W, camera.H)
        check_border(image, weight, view.scene, camera if is_world and not search else None)
        if view.photo is not None:
            check_photo(view.photo, camera.W, camera.H)
    except ValueError as error:
        raise ValueError(f"`views[{k}]`: {error}") from error
    return Mask(image if as_given else levelled(image, weight), weight, camera)
