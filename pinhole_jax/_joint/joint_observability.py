"""`joint_observability`: what masks of several views could tell, before any is taken."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from .._camera.camera import Camera
from .._fit.observability import Observability, observability_of
from .._numerics.arrays import ArrayLike, Input
from .._rules import RULES
from .._solver.priors import Pair
from .._solver.problem import UNIT_PX
from .._solver.uncertainty import BLIND, sentence
from .door import joint_problem
from .system import Estimates, JointProblem, ViewRows
from .views import MOTIONS, SCALE, ZERO, JointView, State

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
    """Directions of a joint fit's unknowns that masks can determine, and how well.

    Arguments are those of `fit_joint`, without masks: a view's `target` may be None. Give cameras
    and objects the poses that they will have. `names` have owner and parameter: "left e_x", "part
    x", "part scale"; `noise` is the standard deviation of coverage in a pixel that the outline
    touches, independent (differences between views come on top).

    Raises ValueError for arguments that make no fit.

    ```python
    print(pj.joint_observability([pj.JointView(scene, None)], truth, ("pose", "phi")))
    ```
    """
    blank = [_blank(view, cameras) for view in views]
    given = {"shared": shared, "objects": objects, "rig": rig, "prior": prior}
    problem = joint_problem(blank, cameras, free, joint_zeros=joint_zeros, **given)
    problem = problem.with_zeros() if problem.zeros else problem
    state, seen, size = problem.start, problem.look(problem.start), problem.size

    most = np.zeros(size)
    for k, rows in enumerate(seen):
        columns = problem.columns(k)
        most[columns] = np.maximum(most[columns], np.max(np.abs(rows.moves), axis=0))
    unit = 1 / (UNIT_PX * np.maximum(most, 1e-300))  # moves an outline by about a pixel
    tables = [np.zeros((size, size))]
    for part in problem.parts(state, seen, noise):
        tables.append(part.rows @ (np.eye(size)[part.columns] * unit))
    triangle: Any = np.linalg.qr(np.concatenate(tables), mode="r")
    estimates = _estimates(problem, state, seen)
    reported = estimates.by_unknowns @ (np.eye(size)[estimates.place] * unit)
    blind = BLIND[problem.dtype]
    weak = _weak(problem, triangle, blind)
    return observability_of(estimates.labels, triangle, reported, noise, blind, weak)


def _blank(view: Any, cameras: Any) -> Any:
    """A view with a mask that nobody will look at."""
    if not isinstance(view, JointView):
        return view
    camera = cameras.get(view.camera) if isinstance(cameras, Mapping) else cameras
    if not isinstance(camera, Camera):
        return view
    mask = np.zeros((camera.H, camera.W))
    mask[tuple(slice(n // 4, n - n // 4) for n in mask.shape)] = 1
    return view._replace(target=mask, photo=None)


def _estimates(problem: JointProblem, state: State, seen: list[ViewRows]) -> Estimates:
    """All reported numbers, with the names of their owners before their labels."""
    named = *problem.objects(), *problem.named(SCALE), *problem.named(ZERO)
    owners = dict.fromkeys([*problem.cameras, *named])
    pairs = [(owner, part) for owner in owners for part in problem.parts_of(owner)]
    labels = tuple(f"{owner} {label}" for owner, part in pairs for label in part.labels)
    found = problem.estimates([part for _, part in pairs], state, seen)
    return found._replace(labels=labels)


def _weak(problem: JointProblem, triangle: np.ndarray, blind: float) -> Iterator[str]:
    """Sentences on directions that change masks little, or not at all."""
    _, values, directions = np.linalg.svd(triangle)
    shares = values / max(float(values[0]), 1e-300)
    for share, direction in zip(shares[::-1], directions[::-1], strict=True):
        if share <= RULES.weak:
            yield sentence(_words(problem, direction), share, bool(share <= blind))


def _words(problem: JointProblem, direction: np.ndarray) -> list[str]:
    """The unknowns that move along a direction."""
    sizes: dict[str, float] = {}
    for unknown in problem.unknowns:
        part = direction[problem.place(unknown.name, unknown.kind)]
        parts = {unknown.kind: part}
        if unknown.kind in MOTIONS:
            parts = {"rotation": part[:3], "position": part[3:]}
        if unknown.kind == "position":
            parts = {"position": part}
        for word, numbers in parts.items():
            sizes[f"the {word} of {unknown.name}"] = float(np.linalg.norm(numbers))
    chief = sorted((w for w in sizes if sizes[w] > CHIEF), key=lambda w: -sizes[w])
    return chief or ["a mixture of all unknowns"]
