"""`fit_joint`: many masks, one problem: a robot's postures, a rig's eyes, an object's views."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from .._camera.camera import Camera
from .._files.progress import say, shown
from .._numerics.arrays import ArrayLike, Input, is_concrete
from .._solver.priors import Pair
from .implicit import Answer, Differentiable, Part, differentiable
from .levels import Path, Tell, depth_of, descended, to_the_end
from .problem import JointProblem
from .result import JointFit, as_one, reported
from .search import equally_good, looking_alike, searched_jointly
from .views import JointView, State

#: With the zeros of joints a fit goes on from this many levels before the finest. (Zeros off by 3
#: degrees, one sigma, six robots: from 1 to 4 all are found, in the same time to a tenth.)
ZEROS_FROM = 3
#: What covers less than this share of a drawn mask may have come from a wrong start. (An arm's hard
#: masks: right ends have 0.98, of some 55 wrong ones two 0.82 and 0.86. A robot's, by a network,
#: have 0.93 to 0.97.)
LIKELY_IOU = 0.9


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
    """Return the cameras and objects whose masks are closest to all those given, with error bars.

    - `views`: `JointView`s: each names its scene, mask and camera, and where both are in the world
      (see there). All masks seen by one camera have its size. Where they bring photos, the fit is
      refined on these (`weak` says what each was found to say).
    - `cameras`: where to start, by name; one alone is named "camera". Its pose is on what carries
      it: in the world where a view has no `mount`, else in the mount's frame, x right, y down, z
      forward (a hand's camera).
    - `free`: "pose" (without it, the cameras stay where they are), phi, principal_point, aspect and
      the lens's coefficients, of each camera, the same in all of its views.
    - `shared`: what of phi, principal_point, aspect and the lens's coefficients ("distortion": all)
      is free, too, and the same for all cameras; or by such names groups of cameras that have one
      in common: {"phi": [("left", "right"), ("front", "back")]}. It begins at the mean.
    - `objects`: where unknown objects are at first (4, 4), by the names that views give.
    - `rig`: poses (4, 4) of cameras on a rig, by name: they move as one, from where the first of
      them is.
    - `search`: the one pose that views have in common, a camera's (or rig's) or an object's, is not
      known at all: its views are searched, all together. Without it that is done where the start
      leads to what does not explain the masks.
    - `outlier_px`: as in `fit_camera`: pixels farther from a mask's edge lose their weight at the
      end, where masks are not exact.
    - `prior`, `bounds`: as in `fit_camera`, the same for each camera, or by the names of cameras
      (and objects): {"left": {"phi": (0.6, 0.01)}}. An object's prior is of its place: x, y, z;
      that of a `JointView.scale`, by its name, of "scale" (which begins there, without one at 1).
      Of what cameras share a prior counts once.
      Where masks err along stretches, what is known beforehand counts for as much more.
    - `joint_zeros`: how surely the zeros of a robot's joints are known: standard deviations, by the
      joints' names (rad; of sliding ones in world units), or one number for all that turn. They are
      the same in all views that have a `posture`, and are found with the rest. None: exactly.

    Each view is reduced to a few rows by the program that a single fit has; what few views depend
    on is eliminated there. So the cost is linear in views and cameras, and nothing is compiled that
    `fit_camera` has not (but for 32 small masks and more, one program). Levenberg-Marquardt leads
    from coarse to fine; then a view whose residuals are larger than most views' counts less
    (`JointFit.views`). The error bars are what the masks' errors make of all unknowns together, and
    grow where views differ by more.

    Runs outside `jit` and `vmap`. Cameras, objects' poses and scales of the result are
    differentiable (once, forward and reverse) with respect to views' scenes, targets, weights,
    mounts and places, by the implicit function theorem, as views and pixels count in the end; where
    nothing is known beforehand, and there are no photos.

    Raises ValueError for arguments that make no fit; what the solver met is in `JointFit.status`.

    ```python
    views = [pj.JointView(scene, mask)]
    joint = pj.fit_joint(views, start, ("pose", "phi"), prior={"phi": (0.6, 0.01)})
    print(joint)
    cameras = {"here": start, "there": other.replace(e=[4.2, 1.2, 2.8])}
    views = [pj.JointView(scene, m, camera=name) for m, name in zip(masks, cameras)]
    joint = pj.fit_joint(views, cameras, shared="phi")
    ```
    """
    settings = outlier_px, max_steps, prior, bounds, joint_zeros, shared
    concrete = is_concrete(*jax.tree.leaves(views))

    def run(views: Any) -> tuple[JointFit, list[Part]]:
        asked = views, cameras, free, objects, rig, *settings
        with shown(progress, f"fitting {len(views)} views") as tell:
            problem = JointProblem.of(*asked, as_given=not concrete)
            return _fit(problem, search, tell or say)

    photos = not concrete and any(view.photo is not None for view in views)
    refused = {"prior": prior, "bounds": bounds, "joint_zeros": joint_zeros, "photo": photos}
    return differentiable(run, views, Differentiable(_answer, _put), refused)


def _answer(fit: JointFit) -> Answer:
    number: Any = jnp.asarray
    return Answer(
        {name: one.camera for name, one in fit.cameras.items()},
        {name: number(one.pose) for name, one in fit.objects.items()},
        {name: number(one.value) for name, one in fit.scales.items()},
    )


def _put(fit: JointFit, answer: Answer) -> JointFit:
    """Return the fit with another answer."""
    cameras, poses, scales = answer
    return fit._replace(
        cameras={n: one._replace(camera=cameras[n]) for n, one in fit.cameras.items()},
        objects={n: one._replace(pose=poses[n]) for n, one in fit.objects.items()},
        scales={n: one._replace(value=scales[n]) for n, one in fit.scales.items()},
    )


def _fit(problem: JointProblem, search: bool, tell: Tell) -> tuple[JointFit, list[Part]]:
    """Return the fit, and what ended those of views that hang together."""
    parts = problem.parts()
    if search and not all(part.searchable() for part, _ in parts):
        raise ValueError(
            "`search`: expected one unknown pose in views that hang together, got several or none"
        )
    led = [(_led(part, search, tell), numbers) for part, numbers in parts]
    if problem.zeros:
        fits = _with_zeros(problem, led, tell)
    else:
        pairs = zip(parts, led, strict=True)
        fits = [_ended(part, paths, tell, numbers) for (part, _), (paths, numbers) in pairs]
    ends = [end for _, end in fits]
    several = [(fit, end.numbers) for fit, end in fits]
    return several[0][0] if len(several) == 1 else as_one(several), ends


def _led(problem: JointProblem, search: bool, tell: Tell) -> list[Path]:
    """Return where the start, or a search, leads to in a problem whose views hang together, the
    best first, then what explains the masks as well."""
    starts = []
    if not search:
        starts = [descended(problem, problem.start, tell, range(depth_of(problem), 0, -1))]
    if search or (problem.searchable() and not _is_content(problem, starts[0])):
        found = searched_jointly(problem, tell)
        better = [f for f in found if not starts or f.descent.squares < starts[0].descent.squares]
        starts = better or starts
    alike = looking_alike(problem, starts[0], tell)
    return equally_good(problem, [*starts, *alike])


def _with_zeros(
    problem: JointProblem, led: list[tuple[list[Path], list[int]]], tell: Tell
) -> list[tuple[JointFit, Part]]:
    """Return the fits in which the zeros of joints are sought, from where views led to without."""
    result = []
    for part, numbers in problem.with_zeros().parts():
        within = [(paths, seen) for paths, seen in led if seen[0] in numbers]
        best = _merged(problem, [(paths[0], seen) for paths, seen in within])
        states = [best]
        for k, (paths, seen) in enumerate(within):
            for other in paths[1:]:
                bests = [(p[0], n) for p, n in within]
                bests[k] = other, seen
                states.append(_merged(problem, bests))
        depths = range(min(depth_of(part), ZEROS_FROM), 0, -1)
        paths = [descended(part, state, tell, depths) for state in states]
        result.append(_ended(part, paths, tell, numbers))
    return result


def _merged(problem: JointProblem, found: list[tuple[Path, list[int]]]) -> State:
    """Return the state in which each view's poses, lens and scale are where its own path led."""
    poses, lenses = dict(problem.start.poses), dict(problem.start.lenses)
    scales = dict(problem.start.scales)
    for path, numbers in found:
        state = path.descent.state
        for k in numbers:
            eye = problem.layout.eyes[k]
            poses[eye.moving] = state.poses[eye.moving]
            lenses[eye.camera] = state.lenses[eye.camera]
            if eye.object is not None:
                poses[eye.object] = state.poses[eye.object]
            if eye.sized is not None:
                scales[eye.sized] = state.scales[eye.sized]
    return problem.start._replace(poses=poses, lenses=lenses, scales=scales)


def _ended(
    problem: JointProblem, paths: list[Path], tell: Tell, numbers: list[int]
) -> tuple[JointFit, Part]:
    """Return the fit of views of these numbers that the first path leads to, and what ended it; the
    others are its modes."""
    best, *others = paths
    end = to_the_end(problem, best, tell, photos=True)
    fit = reported(end.problem, end)
    ends = [to_the_end(problem, other, tell) for other in others]
    modes = [reported(other.problem, other) for other in ends]
    if modes and fit.status in ("converged", "rank_deficient", "uncertain"):
        fit = fit._replace(status="ambiguous")
    return fit._replace(modes=tuple(modes)), Part(end.problem, end.found, numbers)


def _is_content(problem: JointProblem, path: Path) -> bool:
    """Return whether a descent's end may be right: where masks are exact, whether they are
    explained, else whether it is at rest and the scenes lie on the masks."""
    solvers = [eye.solver for eye in problem.layout.eyes]
    views = [seen.view for seen in path.descent.seen]
    # (Zeros that are not where they are sought explain no mask.)
    if all(solver.kind.exact for solver in solvers) and not problem.zeros:
        return all(s.explains(view) for s, view in zip(solvers, views, strict=True))
    overlap, union = (sum(float(getattr(v.sums, x)) for v in views) for x in ("overlap", "union"))
    return path.descent.ended and overlap >= LIKELY_IOU * union
