"""`fit_cameras`: many views of one scene with shared intrinsics, in one least-squares problem."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from .._camera.camera import Camera, check_camera
from .._camera.lens import Lens
from .._numerics.arrays import Numbers
from .._scene.scene import Scene, check_scene
from .among_views import Answer, OneView, asked
from .fit_camera import check_alone, check_border, check_steps, fit_camera
from .mask import Mask
from .moves import canonical
from .parameters import components, with_lens
from .places import at
from .priors import bounds_of, prior_of
from .problem import View
from .residuals import Capacity
from .result import Fit, Known, report, with_modes
from .shared_unknowns import SHARED, alike, descend, joint, others, reduced, shared_and_free
from .solver import Found, Solver
from .target import check_target, levelled


def fit_cameras(
    scene: Scene,
    targets: Sequence[Numbers],
    cameras: Sequence[Camera] | None,
    shared: str | Sequence[str] = ("phi",),
    free: str | Sequence[str] = ("pose",),
    *,
    phi: Numbers = None,
    lens: Lens | None = None,
    weights: Sequence[Numbers] | None = None,
    prior: Mapping[str, Any] | None = None,
    bounds: Mapping[str, Any] | None = None,
    max_steps: int = 64,
) -> tuple[Fit, ...]:
    """Return a `Fit` for each mask; what is `free` is each view's own, what is `shared` is one.

    - `targets`: masks, each as in `fit_camera`; their sizes may differ.
    - `cameras`: where to start, one for each mask; what is shared begins at their mean. None: each
      is searched for, with `phi` and `lens` as in `fit_camera`.
    - `weights`: for each mask, or None.
    - `prior`, `bounds`: as in `fit_camera`; of what is shared once, else for each view.
    - `max_steps`: a limit for each level, and for each descent from another place.

    At the end each view is asked what `fit_camera` asks, with what the others know of what is
    shared: are other places as good (its `modes`, and the status "ambiguous") or better (then all
    descend from there), is a move free over an interval (`weak`, "rank_deficient", and a covariance
    that says so)? As there, a start rules out what is far from it, and where a mask is explained
    badly the whole sphere of views is searched. Outliers keep their weight.

    The covariance of each fit is that of the joint problem: knowledge of all views is in it. The
    cost of a step grows linearly with the number of views.

    Raises ValueError for arguments that make no fit; what the solver met is in each `Fit.status`.
    """
    check_scene(scene)
    if isinstance(cameras, Camera):
        raise ValueError("`cameras`: expected one Camera for each mask, in a list, got one Camera")
    count = len(targets) if isinstance(targets, Sequence | np.ndarray | jax.Array) else -1
    if count < 0:
        kind = type(targets).__name__
        raise ValueError(f"`targets`: expected masks (H, W) in a list, got {kind}")
    if count == 0:
        raise ValueError("`targets`: expected at least one mask, got none")
    weights = [None] * count if weights is None else weights
    check_steps(max_steps)
    for name, given in (("cameras", cameras), ("weights", weights)):
        if given is not None and len(given) != count:
            raise ValueError(f"`{name}`: expected one for each of {count} masks, got {len(given)}")
    if cameras is not None:
        check_alone("cameras", phi=phi, lens=lens)
    for camera in cameras or ():
        check_camera(camera, "cameras")
    names, common = shared_and_free(shared, free, cameras[0] if cameras else None, lens)
    if not common:
        raise ValueError(f"`shared`: expected at least one of {', '.join(SHARED)}, got none")
    modes: list[list[Camera]] = [[] for _ in targets]
    anywhere = cameras is None
    if cameras is None:
        pairs = zip(targets, weights, strict=True)
        given = {"phi": phi, "lens": lens}
        alone = [fit_camera(scene, t, None, names, weight=w, **given) for t, w in pairs]
        cameras = [fit.camera for fit in alone]
        modes = [[canonical(with_lens(mode.camera, names)) for mode in fit.modes] for fit in alone]

    views = []
    cameras = alike([with_lens(c, names) for c in cameras], common)
    for camera, target, weight, more in zip(cameras, targets, weights, modes, strict=True):
        image, w = check_target(target, weight, camera.W, camera.H)
        check_border(image, w, scene, camera)
        image = levelled(image, w)
        known = bounds_of(bounds, camera, names), prior_of(prior, camera, names, common, count)
        solver = Solver(scene, image, w, camera.e.dtype, names, max_steps, *known)
        unit = canonical(camera)
        start = None if anywhere else unit
        views.append(OneView(Mask(image, w, camera), solver, unit, start, more))
    largest = Capacity(*np.max([v.solver.capacity for v in views], axis=0).tolist())
    for one in views:
        one.solver.capacity = largest
    own = np.array([name not in common for name in names for _ in components((name,))])
    seen: list[View] = []
    steps: list[int] = []
    for depth in range(max(len(v.solver.levels) for v in views), 0, -1):
        if prior:
            _believe(views, depth)
        views, seen, n = descend(views, depth, own, max_steps, views[0].solver.dtype)
        steps.append(n)
    if prior:
        _believe(views, 1)
        seen = [one.look(1) for one in views]
    views, seen, answers = asked(views, seen, own, common, max_steps)
    if prior:
        _believe(views, 1)
        views, seen, n = descend(views, 1, own, max_steps, views[0].solver.dtype)
        steps.append(n)
    return _reports(views, seen, answers, own, tuple(steps))


def _believe(views: list[OneView], depth: int) -> None:
    """Weigh the priors by what the residuals of all views err by on a level."""
    sums = [v.look(depth).sums for v in views]
    squares, touched = (
        sum(float(x) for x in xs)
        for xs in zip(*((s.touched_squares, s.touched) for s in sums), strict=True)
    )
    for one in views:
        one.solver.believe(squares / max(touched, 1.0))


def _reports(
    views: list[OneView],
    seen: list[View],
    answers: list[Answer],
    own: np.ndarray,
    steps: tuple[int, ...],
) -> tuple[Fit, ...]:
    parts = [reduced(v, own, 0.0) for v in seen]
    squares, touched = (
        sum(float(x) for x in xs)
        for xs in zip(*((v.sums.touched_squares, v.sums.touched) for v in seen), strict=True)
    )
    unknowns = len(views) * int(own.sum()) + int((~own).sum())
    variance = squares / max(touched - unknowns, 1)
    designs = [one.solver.design(view) for one, view in zip(views, seen, strict=True)]
    noise = variance, float(np.mean(designs))
    slope: Any = sum(p.rest.T @ p.left + p.across.T @ p.known for p in parts)
    rests = others([p.rest for p in parts])
    return tuple(
        _report(one, Found(one.unit, joint(view, known, slope, own), steps), answer, noise)
        for one, view, known, answer in zip(views, seen, rests, answers, strict=True)
    )


def _report(one: OneView, found: Found, answer: Answer, noise: tuple[float, float]) -> Fit:
    """Return the fit of a view, and those of other places that its mask does not tell from it;
    `noise` is a residual's variance, and the design effect of all views."""
    solver, places = one.solver, answer.places

    def told(f: Found) -> Fit:
        free = [at(solver, f, direction) for direction in places.free]
        known = Known(solver.kind, solver.problem.bounds, free, None, *noise)
        fit = report(one.mask.camera, f, f.view.sums, solver.names, known)
        return fit._replace(history=())

    return with_modes(told(found), [told(mode) for mode in places.others])
