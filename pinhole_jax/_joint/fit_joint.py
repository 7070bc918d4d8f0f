"""`fit_joint`: many masks, one problem: a robot's postures, a rig's eyes, an object's views; and
`fit_cameras`: the same of one scene, a camera a view."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from .._camera.camera import Camera, check_camera
from .._camera.lens import Lens
from .._files.progress import listening, shown
from .._fit.fit_camera import anywhere, check_alone
from .._fit.implicit import check_plain, through
from .._fit.result import Fit, with_modes
from .._numerics.arrays import ArrayLike, Input, check_kind, is_concrete
from .._scene.scene import Scene, check_scene
from .._solver.parameters import as_names, check_free
from .._solver.priors import Pair
from .agreement import Agreement
from .alternatives import compare
from .door import SHARED, joint_problem
from .joint_fit import JointFit, report
from .levels import descend, finish
from .system import JointProblem
from .velocities import answer_of, velocity
from .views import POSE, JointView


def fit_joint(
    views: Sequence[JointView],
    cameras: Camera | Mapping[str, Camera],
    free: str | Sequence[str] = ("pose",),
    *,
    shared: str | Sequence[str] | Mapping[str, Sequence[Sequence[str]]] = (),
    objects: Input[Mapping[str, ArrayLike] | None, "4 4 each"] = None,
    rig: Input[Mapping[str, ArrayLike] | None, "4 4 each"] = None,
    search: bool = False,
    outlier_px: float | None = 2.0,
    prior: Input[Mapping[str, Pair | Mapping[str, Pair]] | None, "mean, sigma"] = None,
    bounds: Input[Mapping[str, Pair | Mapping[str, Pair]] | None, "low, high"] = None,
    joint_zeros: float | Mapping[str, float] | None = None,
    max_steps: int = 64,
    progress: bool | Callable[[str], None] | None = None,
) -> JointFit:
    """The cameras and objects that match all masks best, with error bars.

    - `views`: `JointView`s: each names its scene, mask and camera, and the transforms that are
      known. All masks of one camera have its size. If views bring photos, the fit is refined on
      these (`weak` has a sentence on each).
    - `cameras`: the cameras to start from, by name; a single one is named "camera". Poses are in
      the world, or, for views with a `mount`, in the mount's frame: x right, y down, z forward.
    - `free`: "pose" ("position", "orientation"; without it cameras stay put), phi or d,
      principal_point, aspect and the lens's coefficients: of each camera, the same in all its
      views.
    - `shared`: parameters that are free and the same for all cameras: phi, principal_point, aspect,
      the lens's coefficients ("distortion": all of these). Or groups of cameras by parameter:
      {"phi": [("left", "right"), ("front", "back")]}. Each begins at the mean.
    - `objects`: poses (4, 4) of unknown objects to start from, by the names in the views.
    - `rig`: poses (4, 4) of cameras on a rig, by name: they move as one, starting from the first
      camera's pose.
    - `search`: no pose is known, of cameras, rig or objects: all views of a pose are searched
      together. Without it they are searched only if the start leads to no match.
    - `outlier_px`: as in `fit_camera`: pixels farther from a mask's edge lose their weight at the
      end, where masks are not exact.
    - `prior`, `bounds`: as in `fit_camera`, the same for each camera, or by the names of cameras
      (and objects): {"left": {"phi": (0.6, 0.01)}}. An object's prior is on its position x, y, z; a
      `JointView.scale`'s, by its name, on "scale", which begins there (or at 1). A prior on a
      shared parameter counts once. Where masks err along stretches, priors count for more.
    - `joint_zeros`: standard deviations of the zeros of a robot's joints, by joint (rad; world
      units for sliding ones), or one number for all that turn. The zeros are the same in all views
      with a `posture`, and are fitted with the rest. None: they are exact.

    Each view is reduced to a few rows by the program of a single fit; unknowns of few views are
    eliminated there. So the cost is linear in views and cameras, and nothing is compiled that
    `fit_camera` does not compile (one program more from 32 small masks on, or for `joint_zeros`).
    Levenberg-Marquardt goes from coarse to fine. Then views with larger residuals than most count
    less (`JointFit.views`). The error bars follow from the masks' errors, and grow if views differ
    by more than these explain.

    Runs outside `jit` and `vmap`. Cameras, objects' poses and scales of the result are
    differentiable (once, forward and reverse) with respect to views' scenes, targets, weights,
    mounts and places. The implicit function theorem takes views and pixels as they count in the
    end. Priors and photos are refused then.

    Raises ValueError for arguments that make no fit; the solver's troubles are in
    `JointFit.status`.

    ```python
    views = [pj.JointView(scene, mask)]
    joint = pj.fit_joint(views, start, ("pose", "phi"), prior={"phi": (0.6, 0.01)})
    print(joint)
    cameras = {"here": start, "there": other.replace(e=[4.2, 1.2, 2.8])}
    views = [pj.JointView(scene, m, camera=name) for m, name in zip(masks, cameras)]
    joint = pj.fit_joint(views, cameras, shared="phi")
    ```
    """
    return _joint_fit(
        views,
        cameras,
        free,
        search=search,
        progress=progress,
        shared=shared,
        objects=objects,
        rig=rig,
        outlier_px=outlier_px,
        prior=prior,
        bounds=bounds,
        joint_zeros=joint_zeros,
        max_steps=max_steps,
    )


def fit_cameras(
    scene: Scene,
    targets: Input[Sequence[ArrayLike], "H W each"],
    cameras: Sequence[Camera] | None,
    shared: str | Sequence[str] = ("phi",),
    free: str | Sequence[str] = ("pose",),
    *,
    phi: Input[ArrayLike | None, "rad"] = None,
    lens: Lens | None = None,
    weights: Input[Sequence[ArrayLike | None] | None, "H W each"] = None,
    outlier_px: float | None = 2.0,
    prior: Input[Mapping[str, Pair] | None, "mean, sigma"] = None,
    bounds: Input[Mapping[str, Pair] | None, "low, high"] = None,
    max_steps: int = 64,
    progress: bool | Callable[[str], None] | None = None,
) -> tuple[Fit, ...]:
    """A `Fit` for each mask; what is `free` is each view's own, what is `shared` is one.

    - `targets`: masks, each as in `fit_camera`; their sizes may differ.
    - `cameras`: where to start, one for each mask; what is shared begins at their mean. None: each
      is searched for, with `phi` and `lens` as in `fit_camera`.
    - `weights`: for each mask, or None.
    - `outlier_px`: as in `fit_camera`: pixels farther from a mask's edge lose their weight at the
      end, where masks are not exact. Then views that err by more than most count less, too.
    - `prior`, `bounds`: as in `fit_camera`; once for shared parameters, else for each view.
    - `max_steps`: a limit for each level, and for each descent from another place.
    - `progress`: as in `fit_camera`; a function is called with words after each level.

    It is `fit_joint` of one scene before separate cameras. Each view is searched as in
    `fit_camera`, shared parameters held where all views have them. Places that fit as well are its
    `modes` ("ambiguous"); from better ones all descend. Moves that are free over an interval widen
    the covariance (`weak`, "rank_deficient"). A start rules out what is far from
    it; where a mask matches badly, the whole sphere of views is searched.

    The covariance of each fit is that of the joint problem: knowledge of all views is in it. The
    cost of a step grows linearly with the number of views.

    Runs outside `jit` and `vmap`. Cameras of the result are differentiable (once, forward and
    reverse) with respect to scene, targets and weights, by the implicit function theorem, as views
    and pixels count in the end; where nothing is known beforehand.

    Raises ValueError for arguments that make no fit; the solver's troubles are in each
    `Fit.status`.

    ```python
    other = truth.replace(e=[4.2, 1.5, 2.5])
    masks = [mask, pj.silhouette(other, scene)]
    fits = pj.fit_cameras(scene, masks, [start, other.replace(e=[4.2, 1.2, 2.8])], shared=("phi",))
    ```
    """
    check_scene(scene)
    count = _checked_count(targets, cameras, weights)
    if not as_names(shared, "shared"):
        raise ValueError(f"`shared`: expected at least one of {', '.join(SHARED)}, got none")
    if cameras is None:
        common = check_free(shared, None, lens, "shared")
        freed = check_free((*as_names(free), *common), None, lens)
        starts = [anywhere(scene, target, freed, phi, lens) for target in targets]
    else:
        check_alone("cameras", phi=phi, lens=lens)
        starts = cameras
    names = [str(k) for k in range(count)]
    each = zip(targets, names, [None] * count if weights is None else weights, strict=True)
    fit = _joint_fit(
        [JointView(scene, target, name, weight) for target, name, weight in each],
        dict(zip(names, starts, strict=True)),
        free,
        shared=shared,
        search=cameras is None,
        outlier_px=outlier_px,
        prior=prior,
        bounds=bounds,
        max_steps=max_steps,
        progress=progress,
    )
    return tuple(f._replace(weak=(*f.weak, *fit.weak)) for f in fit.cameras.values())


def _joint_fit(
    views: Sequence[JointView],
    cameras: Any,
    free: Any,
    *,
    search: bool,
    progress: Any,
    **given: Any,
) -> JointFit:
    """The fit of views, differentiable by what is traced of them; `given` as `joint_problem`."""
    concrete = is_concrete(*jax.tree.leaves(views))

    def run(views: Sequence[JointView]) -> tuple[JointFit, Agreement]:
        with shown(progress, f"fitting {len(views)} views", in_words=True):
            # 1 Check, and bring to canonical form.
            problem = joint_problem(
                views, cameras, free, search=search, as_given=not concrete, **given
            )
            return _fit(problem, search)

    if concrete:
        return run(views)[0]
    named = ("prior", "bounds", "joint_zeros")
    photos = any(view.photo is not None for view in views)
    check_plain(photo=photos, **{name: given.get(name) for name in named})
    return through(run, views, answer_of, velocity)


def _fit(problem: JointProblem, search: bool) -> tuple[JointFit, Agreement]:
    """The fit of a problem, and the agreement of its views."""
    # 2 Propose cameras: the start, or those that a search finds.
    poses = problem.lone_poses
    if search and not (poses and {*poses} == {*problem.named(POSE)}):
        words = "expected one unknown pose that each view shows, got several or none"
        raise ValueError(f"`search`: {words}")
    # 3 Descend from the start, coarse to fine.
    depths = () if search else range(problem.levels, 0, -1)
    path = descend(problem, problem.start, depths)
    # 4 Weigh what else explains the masks.
    path, poses = compare(problem, path)
    # 5 Keep the best, and its modes.
    end = finish(problem, path, photos=True)
    with listening(str):  # (A caller hears of the best alone.)
        modes = [
            (pose.name, report(finish(pose.problem, other), {}))
            for pose in poses
            for other in pose.others
        ]
    # 6 Status, covariance, words.
    fit = report(end, {pose.name: pose.free for pose in poses})
    return _with_modes(fit, modes), end.found


def _with_modes(fit: JointFit, modes: list[tuple[str, JointFit]]) -> JointFit:
    """The fit, and its cameras, with modes by the names of poses that are elsewhere in these."""
    cameras = {}
    for name, found in fit.cameras.items():
        own = [
            x.cameras[name] for pose, x in modes if name in x.cameras and pose not in fit.objects
        ]
        cameras[name] = with_modes(found, own)
    return with_modes(fit._replace(cameras=cameras), [mode for _, mode in modes])


def _checked_count(targets: Any, cameras: Any, weights: Any) -> int:
    """The number of masks. Raises ValueError where other arguments have not as many."""
    if isinstance(cameras, Camera):
        raise ValueError("`cameras`: expected one Camera for each mask, in a list, got one Camera")
    check_kind("targets", targets, Sequence | np.ndarray | jax.Array, "masks (H, W) in a list")
    if (count := len(targets)) == 0:
        raise ValueError("`targets`: expected at least one mask, got none")
    for name, given in (("cameras", cameras), ("weights", weights)):
        if given is not None and len(given) != count:
            raise ValueError(f"`{name}`: expected one for each of {count} masks, got {len(given)}")
    for camera in cameras if cameras is not None else ():
        check_camera(camera, "cameras")
    return count
