"""`fit_cameras`: many views of one scene with shared intrinsics, in one least-squares problem."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from .._camera.camera import Camera, check_camera
from .._camera.lens import Lens
from .._camera.poses import pose_of
from .._files.progress import say, shown
from .._fit.fit_camera import check_alone, check_border, check_reach, check_steps, fit_camera
from .._fit.places import at
from .._fit.result import Context, Fit, report, with_modes
from .._mask.target import check_target, levelled
from .._numerics.arrays import ArrayLike, Input, is_concrete
from .._scene.scene import Scene, check_scene
from .._solver.looks import View
from .._solver.moves import canonical
from .._solver.parameters import components, with_lens
from .._solver.priors import Pair
from .._solver.problem import FINE_PX
from .._solver.solver import Found
from .among_views import Asked, Begun, asked, known_by_others
from .implicit import Answer, Differentiable, Part, differentiable
from .levels import End, Path, Tell, depth_of, descended, to_the_end
from .problem import JointProblem
from .result import OFF, apart_in_words, history
from .shared_unknowns import SHARED, alike, joint, shared_and_free
from .views import JointView, State


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
    """Return a `Fit` for each mask; what is `free` is each view's own, what is `shared` is one.

    - `targets`: masks, each as in `fit_camera`; their sizes may differ.
    - `cameras`: where to start, one for each mask; what is shared begins at their mean. None: each
      is searched for, with `phi` and `lens` as in `fit_camera`.
    - `weights`: for each mask, or None.
    - `outlier_px`: as in `fit_camera`: pixels farther from a mask's edge lose their weight at the
      end, where masks are not exact. Then views that err by more than most count less, too.
    - `prior`, `bounds`: as in `fit_camera`; of what is shared once, else for each view.
    - `max_steps`: a limit for each level, and for each descent from another place.
    - `progress`: as in `fit_camera`; a function is called with words after each level.

    It is the joint fit (`fit_joint`) of one scene before cameras that stand apart. Then each view
    is asked what `fit_camera` asks, with what the others know of what is shared: are other places
    as good (its `modes`, and the status "ambiguous") or better (then all descend from there), is a
    move free over an interval (`weak`, "rank_deficient", and a covariance that says so)? As there,
    a start rules out what is far from it, and where a mask is explained badly the whole sphere of
    views is searched. `Fit.weak` says how much of a mask is far from the outline, and by how much
    a view that counts less errs.

    The covariance of each fit is that of the joint problem: knowledge of all views is in it. The
    cost of a step grows linearly with the number of views.

    Runs outside `jit` and `vmap`. Cameras of the result are differentiable (once, forward and
    reverse) with respect to scene, targets and weights, by the implicit function theorem, as views
    and pixels count in the end; where nothing is known beforehand.

    Raises ValueError for arguments that make no fit; what the solver met is in each `Fit.status`.

    ```python
    other = truth.replace(e=[4.2, 1.5, 2.5])
    masks = [mask, pj.silhouette(other, scene)]
    fits = pj.fit_cameras(scene, masks, [start, other.replace(e=[4.2, 1.2, 2.8])], shared=("phi",))
    ```
    """
    check_scene(scene)
    check_steps(max_steps)
    check_reach(outlier_px)
    count = _checked_count(targets, cameras, weights)
    if cameras is not None:
        check_alone("cameras", phi=phi, lens=lens)
    weights = [None] * count if weights is None else weights
    freed, common = shared_and_free(shared, free, cameras[0] if cameras else None, lens)
    if not common:
        raise ValueError(f"`shared`: expected at least one of {', '.join(SHARED)}, got none")
    views = [
        JointView(scene, target, camera=str(k), weight=weight)
        for k, (target, weight) in enumerate(zip(targets, weights, strict=True))
    ]
    given = {"phi": phi, "lens": lens, "outlier_px": outlier_px, "max_steps": max_steps}
    concrete = is_concrete(*jax.tree.leaves(views))

    def run(views: Sequence[JointView]) -> tuple[tuple[Fit, ...], list[Part]]:
        with shown(progress, f"fitting {count} views") as tell:
            return among(views, tell or say)

    def among(views: Sequence[JointView], tell: Tell) -> tuple[tuple[Fit, ...], list[Part]]:
        starts, begun = (cameras, None) if cameras is not None else _alone(views, freed, given)
        starts = alike([with_lens(c, freed) for c in starts], common)
        masks = [_mask(*each, as_given=not concrete) for each in zip(views, starts, strict=True)]
        by_name = {view.camera: camera for view, camera in zip(views, starts, strict=True)}
        groups = {name: [(*by_name,)] for name in common}
        of = [*views], masks, by_name, freed, freed, groups, {}, {}, {}
        problem = JointProblem.among(*of, outlier_px, max_steps, prior, bounds)
        return _fit(problem, begun, common, tell)

    refused = {"prior": prior, "bounds": bounds}
    return differentiable(run, views, Differentiable(_answer, _put), refused)


def _fit(
    problem: JointProblem, begun: list[Begun] | None, common: tuple[str, ...], tell: Tell
) -> tuple[tuple[Fit, ...], list[Part]]:
    """Return the fits of a problem in which `common` is shared, and what ended them."""
    freed = problem.freed
    begun = begun or [Begun(start) for start in problem.start.lenses.values()]
    own = np.array([name not in common for name in freed for _ in components((name,))])
    px = FINE_PX[problem.layout.eyes[0].solver.dtype]

    def further(state: State, depths: Sequence[int]) -> Path:
        return descended(problem, state, tell, depths, px)

    path = further(problem.start, range(depth_of(problem), 0, -1))
    onward = lambda cameras_there: further(_state_at(cameras_there, problem, common), [1])
    path, answers = asked(problem.layout, path, begun, own, onward)
    end = to_the_end(problem, path, tell)
    part = Part(end.problem, end.found, [*range(len(end.whole))])
    return _reports(problem, end, answers, own), [part]


def _answer(fits: tuple[Fit, ...]) -> Answer:
    return Answer({str(k): fit.camera for k, fit in enumerate(fits)}, {}, {})


def _put(fits: tuple[Fit, ...], answer: Answer) -> tuple[Fit, ...]:
    """Return the fits with other cameras."""
    cameras = answer.cameras.values()
    return tuple(fit._replace(camera=c) for fit, c in zip(fits, cameras, strict=True))


def _checked_count(targets: Any, cameras: Any, weights: Any) -> int:
    """Return the number of masks, or raise ValueError."""
    if isinstance(cameras, Camera):
        raise ValueError("`cameras`: expected one Camera for each mask, in a list, got one Camera")
    if not isinstance(targets, Sequence | np.ndarray | jax.Array):
        kind = type(targets).__name__
        raise ValueError(f"`targets`: expected masks (H, W) in a list, got {kind}")
    if (count := len(targets)) == 0:
        raise ValueError("`targets`: expected at least one mask, got none")
    for name, given in (("cameras", cameras), ("weights", weights)):
        if given is not None and len(given) != count:
            raise ValueError(f"`{name}`: expected one for each of {count} masks, got {len(given)}")
    for camera in cameras if cameras is not None else ():
        check_camera(camera, "cameras")
    return count


def _alone(
    views: Sequence[JointView], freed: tuple[str, ...], given: Mapping[str, Any]
) -> tuple[list[Camera], list[Begun]]:
    """Return cameras that masks by themselves lead to, and where else each may be."""
    fits = [
        fit_camera(v.scene, np.asarray(v.target), None, freed, weight=v.weight, **given)
        for v in views
    ]
    modes = [[canonical(with_lens(mode.camera, freed)) for mode in f.modes] for f in fits]
    return [fit.camera for fit in fits], [Begun(modes=some) for some in modes]


def _mask(view: JointView, camera: Camera, as_given: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return a view's mask and weights, checked; the mask is levelled unless it is to be taken
    `as_given`."""
    image, weight = check_target(view.target, view.weight, camera.W, camera.H)
    check_border(image, weight, view.scene, camera)
    return (image if as_given else levelled(image, weight)), weight


def _state_at(cameras_there: list[Camera], problem: JointProblem, common: tuple[str, ...]) -> State:
    """Return the state with the views' cameras (canonical), alike in what is common."""
    same = dict(zip(problem.cameras, alike(cameras_there, common), strict=True))
    return State({name: pose_of(unit) for name, unit in same.items()}, same, {}, {})


def _reports(
    problem: JointProblem, end: End, answers: list[Asked], own: np.ndarray
) -> tuple[Fit, ...]:
    found = end.found
    layout = found.layout
    from_others = known_by_others(layout, found.descent, own, found.weights)
    sums = [seen.view.sums for seen in found.descent.seen]
    squares = sum(w * float(s.touched_squares) for w, s in zip(found.weights, sums, strict=True))
    touched = sum(float(s.touched) for s in sums)
    eyes = zip(layout.eyes, found.descent.seen, strict=True)
    designs = [eye.solver.design(seen.view) for eye, seen in eyes]
    noise = squares / max(touched - layout.size, 1), float(np.mean(designs))
    return tuple(
        _report(problem, k, end, joint(one.view, one.others, one.slope, own), answer, noise)
        for k, (one, answer) in enumerate(zip(from_others, answers, strict=True))
    )


def _report(
    problem: JointProblem, k: int, end: End, view: View, answer: Asked, noise: tuple[float, float]
) -> Fit:
    """Return the fit of a view, and those of other places that its mask does not tell from it;
    `noise` is a residual's variance, and the design effect of all views."""
    eye, places, descent = problem.layout.eyes[k], answer.places, end.found.descent
    solver, camera = eye.solver, eye.mask.camera

    def described(f: Found, whole: Any) -> Fit:
        free = [at(solver, f, direction) for direction in places.free]
        context = Context(solver.kind, solver.bounds, free, None, *noise)
        return report(camera, f, whole, solver.freed, context)

    here = Found(eye.canonical(descent.state), view, end.path.steps, ended=descent.ended)
    fit = described(here, end.whole[k])
    fit = fit._replace(history=history(end.path, eye, eye.canonical, camera))
    off, weight = end.found.off[k], end.found.weights[k]
    if off > OFF and len(end.whole) > 2 and weight < 1:
        fit = fit._replace(weak=(*fit.weak, apart_in_words(off, weight)))
    return with_modes(fit, [described(f, f.view.sums) for f in places.others])
