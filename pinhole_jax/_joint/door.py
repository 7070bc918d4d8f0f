"""The arguments of a joint fit, checked, and the problem that they make.

What is known of cameras, objects and joints is as in `fit_camera`, by their names. A prior of a
number is a residual beside those of the masks, in units in which their noise is its standard
deviation.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._camera.camera import Camera, check_camera
from .._camera.distortion import COEFFICIENTS
from .._camera.poses import Pose, check_pose, inverse, pose_of
from .._fit.fit_camera import check_border, check_px
from .._fit.photo import check_photo
from .._mask.mask import Mask
from .._mask.pyramid import LEAST_CELLS
from .._mask.target import check_target, levelled
from .._numerics.arrays import as_count, check_kind, check_known, check_positive
from .._scene.assembly import Posture
from .._scene.scene import check_scene
from .._solver.moves import Bounds, canonical
from .._solver.parameters import PARAMETERS, as_names, check_free, in_one, with_lens
from .._solver.priors import bounds_of, measured
from .._solver.solver import Solver
from .._solver.subject import Subject
from .system import JointPrior, JointProblem, Part
from .views import MOTIONS, POSE, SCALE, ZERO, Eye, JointView, State, Unknown, joint_units

#: From this many views on, small masks have pyramids of few cells (MB less for each of them, and a
#: program more for all): 14 MB are 14 GB of a thousand.
MANY_VIEWS, FEW_CELLS = 32, 1 << 13
#: What views may share.
SHARED = tuple(name for name, row in PARAMETERS.items() if row.shared)
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
) -> JointProblem:
    """The problem that these arguments of `fit_joint` make; masks are levelled unless taken
    `as_given`. With `search`, cameras are nowhere yet.

    Raises ValueError for arguments that make no fit.
    """
    as_count("max_steps", max_steps)
    check_px(outlier_px=outlier_px)
    _check_views(views)
    cameras = _checked_cameras(cameras)
    poses, places = _poses("objects", objects), _poses("rig", rig)
    _check_names(views, cameras, poses, places)

    scales = {view.scale: 1.0 for view in views if view.scale is not None}
    moving = {name: RIG if name in places else name for name in cameras}
    others = [*((name, POSE) for name in poses), *((name, SCALE) for name in scales)]
    cameras, unknowns = with_unknowns(cameras, free, shared, [*moving.values()], others)
    limits = bounds_by_name(bounds, cameras, unknowns)

    cells = LEAST_CELLS if len(views) < MANY_VIEWS else FEW_CELLS
    # (A scene's arrays are not copied for each view.)
    scenes = {id(view.scene): (view.scene, cameras[view.camera].e.dtype) for view in views}
    subjects = {key: Subject.from_scene(*scene) for key, scene in scenes.items()}
    eyes = []
    for k, view in enumerate(views):
        name, mask = view.camera, _checked_mask(k, view, cameras, search, as_given)
        known = {f"views[{k}].{x}": getattr(view, x) for x in ("mount", "placed")}
        mount, placed = (np.eye(4) if x is None else check_pose(n, x) for n, x in known.items())
        owners, place = owners_of(name, unknowns), places.get(name, np.eye(4))
        own = subjects[id(view.scene)], mask, (POSE, *owners), max_steps, limits[name]
        solver = Solver.on(*own, continued=outlier_px is not None, cells=cells)
        eyes.append(Eye(view, mask, solver, owners, moving[name], mount, placed, place))
        poses.setdefault(moving[name], pose_of(cameras[name]) @ inverse(place))
    problem = JointProblem(
        unknowns=unknowns,
        eyes=eyes,
        start=State(poses, {n: canonical(c) for n, c in cameras.items()}, scales, {}),
        cameras=cameras,
        outlier_px=outlier_px,
        max_steps=max_steps,
        weights=np.ones(len(eyes)),
        zeros=zeros_of(joint_zeros, views),
    )
    priors = priors_of(prior, problem)
    scales |= {part.name: mean for part, _, mean, _ in priors if part.kind == SCALE}
    return replace(problem, priors=priors, start=problem.start._replace(scales=scales))


def with_unknowns(
    cameras: Mapping[str, Camera],
    free: Any,
    shared: Any,
    moving: Sequence[str],
    others: Sequence[tuple[str, str]] = (),
) -> tuple[dict[str, Camera], list[Unknown]]:
    """The cameras, alike in what they share, with a lens that has what is free; and all unknowns:
    poses that cameras go with (`moving`), others by name and kind, then parameters of lenses.

    Raises ValueError for names of no parameter, of one that cannot be shared, and for none.
    """
    groups = _groups_of(shared, cameras)
    names = (*groups, *as_names(free))
    freed = in_one(check_free(names, next(iter(cameras.values())))) if names else ()
    poses = ((name, kind) for name in dict.fromkeys(moving) for kind in freed if kind in MOTIONS)
    unknowns = [Unknown(*key) for key in (*poses, *others)]
    # (A view's columns are then in the order of its solver's moves.)
    for row in (name for name in freed if name not in MOTIONS):
        together = groups.get(row, [])
        alone = [(name,) for name in cameras if not any(name in group for group in together)]
        unknowns += [Unknown(group[0], row, group) for group in (*together, *alone)]
    if not unknowns:
        raise ValueError("`free`: expected something to fit, got none")
    return share_means({n: with_lens(c, freed) for n, c in cameras.items()}, unknowns), unknowns


def owners_of(camera: str, unknowns: Sequence[Unknown]) -> dict[str, str]:
    """The first camera that has each free parameter of a camera's lens in common with it."""
    return {u.kind: u.name for u in unknowns if camera in u.cameras}


def _groups_of(shared: Any, cameras: Mapping[str, Camera]) -> dict[str, list[tuple[str, ...]]]:
    """Groups of cameras that have a parameter in common, by its name.

    `shared` are names (of all cameras), or such groups by names. Raises ValueError for others.
    """
    if not isinstance(shared, Mapping):
        shared = {name: [tuple(cameras)] for name in as_names(shared, "shared")}
    known, first, result = [*SHARED, "distortion"], next(iter(cameras.values())), {}
    check_known("shared", shared, known)
    for name, given in shared.items():
        groups = [(group,) if isinstance(group, str) else (*group,) for group in given if group]
        named = [n for group in groups for n in group]
        for row in check_free((name,), first, argument="shared"):
            check_known("shared", named, cameras, "groups of cameras")
            if len({*named}) < len(named):
                raise ValueError(f"`shared`: expected each camera in one group of {row}, got more")
            result[row] = groups
    return result


def share_means(cameras: Mapping[str, Camera], unknowns: Sequence[Unknown]) -> dict[str, Camera]:
    """The cameras with the mean of each parameter that they share.

    Raises ValueError for coefficients of different distortions.
    """
    result = dict(cameras)
    for _, row, group in (u for u in unknowns if len(u.cameras) > 1):
        some = [result[name] for name in group]
        kinds = {type(camera.distortion).__name__ for camera in some}
        if len(kinds) > 1 and row in COEFFICIENTS:
            words = f"expected distortions of one kind to share, got {' and '.join(sorted(kinds))}"
            raise ValueError(f"`cameras`: {words}")
        for leaf in PARAMETERS[row].leaves:
            mean = np.mean([leaf.of(camera) for camera in some], axis=0)
            for name in group:
                to = result[name].e.dtype
                result[name] = eqx.tree_at(leaf.of, result[name], jnp.asarray(mean, to))
    return result


# --- what is known beforehand ---------------------------------------------------------------------


def priors_of(prior: Any, problem: JointProblem) -> list[JointPrior]:
    """Priors of cameras, objects and scales: one for each unknown that cameras have in common.

    Raises ValueError for what is no prior of these, and for a scale that is not positive.
    """
    others = dict.fromkeys([*problem.objects(), *problem.start.scales])
    result = []
    for name, given in by_name("prior", prior, problem.cameras, others).items():
        parts = problem.parts_of(name)
        # (A small turn has no value that could be known.)
        labels = [x for part in parts for x in part.labels if not x.startswith("rotation")]
        for label, mean, std in zip(given, *measured(given, labels).tolist(), strict=True):
            if label == SCALE:
                check_positive("prior", mean, f"a positive scale of {name!r}")
            part = next(part for part in parts if label in part.labels)
            result.append(JointPrior(part, label, mean, std))
    return [*{str(prior): prior for prior in result}.values()]


def zeros_of(given: Any, views: Sequence[JointView]) -> list[JointPrior]:
    """Priors of the zeros of joints that are sought: about where their readings have them.

    Raises ValueError for what is no standard deviation of a joint.
    """
    if given is None:
        return []
    for k, view in enumerate(views):
        if view.posture is not None and view.mount is not None:
            words = "expected no `mount` with a `posture`, as joints move it too"
            raise ValueError(f"`joint_zeros`: {words}, got both in views[{k}]")
    if not (units := joint_units(views)):
        raise ValueError("`joint_zeros`: expected views with a `posture`, got none")
    if not isinstance(given, Mapping):
        given = {name: given for name, unit in units.items() if unit == "rad"}
    check_known("joint_zeros", given, units, "joints")
    result = []
    for name, std in given.items():
        check_positive("joint_zeros", std, f"a positive deviation of {name!r}")
        result.append(JointPrior(Part(name, ZERO), ZERO, 0.0, float(std)))
    return result


def bounds_by_name(
    bounds: Any, cameras: Mapping[str, Camera], unknowns: Sequence[Unknown]
) -> dict[str, Bounds | None]:
    """Bounds of each camera's parameters. Raises ValueError for what is no bound of these, or not
    the same for cameras that share a parameter."""
    given = by_name("bounds", bounds, cameras)
    freed = tuple(dict.fromkeys(u.kind for u in unknowns if u.kind in PARAMETERS))
    result = {n: bounds_of(given.get(n), camera, freed) for n, camera in cameras.items()}
    for owner, row, group in unknowns:
        for name in group:
            ends = ((given.get(n) or {}).get(row, ()) for n in (name, owner))
            if not np.array_equal(*ends):
                words = f"expected the same of {row} for {owner} and {name}, which share it"
                raise ValueError(f"`bounds`: {words}")
    return result


def by_name(
    argument: str, given: Any, cameras: Iterable[str], objects: Iterable[str] = ()
) -> dict[str, Any]:
    """Values for each camera and object: by their names, or the same for each camera.

    Raises ValueError for names of neither.
    """
    if not given:
        return {}
    if not (isinstance(given, Mapping) and any(isinstance(x, Mapping) for x in given.values())):
        return dict.fromkeys(cameras, given)
    check_known(argument, given, [*cameras, *objects])
    return dict(given)


# --- what is refused ------------------------------------------------------------------------------


def _poses(argument: str, given: Mapping[str, Any] | None) -> dict[str, Pose]:
    return {name: check_pose(f"{argument}[{name!r}]", x) for name, x in (given or {}).items()}


def _checked_cameras(cameras: Any) -> Mapping[str, Camera]:
    cameras = {"camera": cameras} if isinstance(cameras, Camera) else cameras
    check_kind("cameras", cameras, Mapping, "a Camera, or a dict of them")
    for name, camera in cameras.items():
        check_camera(camera, f"cameras[{name!r}]")
    return cameras


def _check_views(views: Any) -> None:
    if not isinstance(views, Sequence) or isinstance(views, JointView):
        raise ValueError(f"`views`: expected JointViews in a list, got {type(views).__name__}")
    if not views:
        raise ValueError("`views`: expected at least one JointView, got none")
    for k, view in enumerate(views):
        check_kind(f"views[{k}]", view, JointView, "a JointView")
        check_scene(view.scene)
        check_kind(f"views[{k}].posture", view.posture, Posture | None, "a Posture or None")


def _check_names(
    views: Sequence[JointView],
    cameras: Mapping[str, Camera],
    objects: Mapping[str, Pose],
    rig: Mapping[str, Pose],
) -> None:
    """Raise ValueError where views name what is not given, or not all of that."""
    taken, shown, sizes = ({getattr(v, x) for v in views} for x in ("camera", "object", "scale"))
    shown, of_cameras = shown - {None}, {*cameras, *([RIG] if rig else [])}
    for kind, known, named in (("cameras", cameras, taken | {*rig}), ("objects", objects, shown)):
        if missing := sorted(named - {*known}):
            have = ", ".join(known) or "none"
            raise ValueError(f"`{kind}`: expected {', '.join(missing)} among them, got {have}")
    for argument, words, wrong in (
        ("cameras", "names that a view uses", {*cameras} - taken - {*rig}),
        ("objects", "names that a view uses", {*objects} - shown),
        ("rig", "cameras that a view names", {*rig} - taken),
        ("cameras", f"names other than {RIG!r} with a rig", {RIG} & {*cameras} if rig else ()),
        ("objects", "names of their own", of_cameras & {*objects}),
        ("views", "names of scales that no camera has", of_cameras & sizes),
    ):
        if wrong:
            raise ValueError(f"`{argument}`: expected {words}, got {', '.join(sorted(wrong))}")


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
