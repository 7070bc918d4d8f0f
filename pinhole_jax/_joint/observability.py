"""`joint_observability`: what masks of several views could tell, before any is taken."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._camera.camera import Camera
from .._fit.observability import Observability
from .._numerics.arrays import ArrayLike, Input
from .._solver.least_squares import solve
from .._solver.priors import Pair
from .._solver.problem import UNIT_PX
from .._solver.uncertainty import BLIND, WEAK
from .problem import JointProblem
from .reported import Reported, of_camera, of_object, of_scale, together
from .views import MOTIONS, SCALE, ZERO, JointView
from .zeros import Seen

#: An unknown's part in a direction is named if it is no smaller.
CHIEF = 0.35


def joint_observability(
    views: Sequence[JointView],
    cameras: Camera | Mapping[str, Camera],
    free: str | Sequence[str] = ("pose",),
    *,
    shared: str | Sequence[str] | Mapping[str, Sequence[Sequence[str]]] = (),
    objects: Input[Mapping[str, ArrayLike] | None, "4 4 each"] = None,
    rig: Input[Mapping[str, ArrayLike] | None, "4 4 each"] = None,
    prior: Input[Mapping[str, Pair | Mapping[str, Pair]] | None, "mean, sigma"] = None,
    joint_zeros: float | Mapping[str, float] | None = None,
    noise: float = 0.1,
) -> Observability:
    """Return which directions of a joint fit's unknowns masks can determine, and how well.

    All is as in `fit_joint`, but for the masks: nobody looks at a view's `target` (None will do).
    Cameras and objects are where they will be. `names` are those of the unknowns' owners and of the
    parameters: "left e_x", "part x", "part scale"; `noise` is the standard deviation of coverage in
    a pixel that the outline touches, independent (what views differ by comes to that).

    Raises ValueError for arguments that make no fit.

    ```python
    print(pj.joint_observability([pj.JointView(scene, None)], truth, ("pose", "phi")))
    ```
    """
    if not noise > 0:
        raise ValueError(f"`noise`: expected a positive standard deviation, got {noise}")
    views = [_blank(view, cameras) for view in views]
    asked = views, cameras, free, objects, rig, None, 1, prior, None, joint_zeros, shared
    problem = JointProblem.of(*asked)
    problem = problem.with_zeros() if problem.zeros else problem
    layout, state = problem.layout, problem.start
    seen = layout.look(state, 1)
    parts = [
        *layout.least_squares(seen, np.ones(len(seen))),
        *layout.prior_rows(state, seen, noise),
    ]
    solved = solve(parts, layout.size, np.zeros(layout.size))
    unseen = solved.unseen(BLIND[layout.eyes[0].solver.dtype])
    told = _reported(problem, seen)
    covariance = told.covariance(lambda at: noise**2 * solved.inverse(at, at), unseen)

    table = np.zeros((sum(len(part.rows) for part in parts), layout.size))
    begin, unit = 0, _pixels(problem, seen)
    for part in parts:
        table[begin : begin + len(part.rows), part.columns] = part.rows * unit[part.columns]
        begin += len(part.rows)
    _, values, directions = np.linalg.svd(table, full_matrices=len(table) < layout.size)
    values = np.append(values, np.zeros(layout.size - len(values)))
    return Observability(
        names=told.labels,
        rank=layout.size - unseen.shape[1],
        of=layout.size,
        values=values,
        std=np.sqrt(np.diag(covariance)),
        covariance=covariance,
        weak=tuple(_weak(problem, values, directions, unseen.shape[1])),
    )


def _blank(view: Any, cameras: Any) -> Any:
    """Return a view with a mask that nobody will look at."""
    if not isinstance(view, JointView):
        return view
    camera = cameras.get(view.camera) if isinstance(cameras, Mapping) else cameras
    if not isinstance(camera, Camera):
        return view
    mask = np.zeros((camera.H, camera.W))
    mask[camera.H // 4 : -(camera.H // 4) or None, camera.W // 4 : -(camera.W // 4) or None] = 1
    return view._replace(target=mask, photo=None)


def _reported(problem: JointProblem, seen: list[Seen]) -> Reported:
    """Return all that is reported, with the names of whose it is."""
    layout, state, parts = problem.layout, problem.start, {}
    for eye, one in zip(layout.eyes, seen, strict=True):
        parts[eye.camera] = of_camera(problem, eye.camera, state, one.view)
    result = [*parts.items()]
    objects = dict.fromkeys(eye.object for eye in layout.eyes if eye.object is not None)
    result += [(name, of_object(problem, name, state)) for name in objects]
    for unknown in layout.unknowns:
        place = layout.place(unknown.name, unknown.kind)
        if unknown.kind == SCALE:
            result.append((unknown.name, of_scale(problem, unknown.name, state)))
        elif unknown.kind == ZERO and place is not None:
            result.append((unknown.name, Reported((ZERO,), place, np.eye(1))))
    return together(
        [
            part._replace(labels=tuple(f"{name} {label}" for label in part.labels))
            for name, part in result
        ]
    )


def _pixels(problem: JointProblem, seen: list[Seen]) -> np.ndarray:
    """Return how much of each unknown (size,) moves an outline by about a pixel."""
    most = np.zeros(problem.layout.size)
    for k, one in enumerate(seen):
        place = problem.layout.columns(k)
        most[place] = np.maximum(most[place], np.max(np.abs(one.moves), axis=0))
    return 1 / (UNIT_PX * np.maximum(most, 1e-300))


def _weak(
    problem: JointProblem, values: np.ndarray, directions: np.ndarray, hidden: int
) -> list[str]:
    """Return the directions that change masks little, or not at all (this many of them), as
    sentences."""
    top, result = max(float(values[0]), 1e-300), []
    for k, (value, direction) in enumerate(zip(values[::-1], directions[::-1], strict=True)):
        if k >= hidden and value > WEAK * top:
            break
        how = f"is nearly free ({value / top:.1%} as visible as the best-seen move)"
        result.append(f"{_words(problem, direction)} {'is not visible' if k < hidden else how}")
    return result


def _words(problem: JointProblem, direction: np.ndarray) -> str:
    """Return what moves along a direction of the unknowns."""
    sizes: dict[str, float] = {}
    for unknown in problem.layout.unknowns:
        place = problem.layout.place(unknown.name, unknown.kind)
        assert place is not None
        whole = np.zeros(6)
        whole[MOTIONS.get(unknown.kind, slice(0, unknown.size))] = direction[place]
        if unknown.kind in MOTIONS:
            sizes[f"the turn of {unknown.name}"] = float(np.linalg.norm(whole[:3]))
            sizes[f"the place of {unknown.name}"] = float(np.linalg.norm(whole[3:]))
        else:
            sizes[f"the {unknown.kind} of {unknown.name}"] = float(np.linalg.norm(whole))
    chief = sorted((w for w in sizes if sizes[w] > CHIEF), key=lambda w: -sizes[w])
    return " against ".join(chief) if chief else "a mixture of all unknowns"
