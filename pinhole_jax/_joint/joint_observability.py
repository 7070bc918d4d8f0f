"""`joint_observability`: what masks of several views could tell, before any is taken."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from .._camera.camera import Camera
from .._fit.observability import Observability, observability_of
from .._numerics.arrays import ArrayLike, Input
from .._solver.priors import Pair
from .._solver.problem import UNIT_PX
from .._solver.uncertainty import BLIND, chief_words, weak_directions
from .door import joint_problem
from .system import JointProblem
from .views import MOTIONS, SCALE, ZERO, JointView

#: What the numbers of a rigid motion are called.
TWIST_WORDS = ["rotation"] * 3 + ["position"] * 3


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
    problem = joint_problem(
        [_blank(view, cameras) for view in views],
        cameras,
        free,
        shared=shared,
        objects=objects,
        rig=rig,
        prior=prior,
        joint_zeros=joint_zeros,
        as_given=True,
    ).with_zeros()
    here, each = problem.stay(problem.start), np.eye(problem.size)

    moves = [rows.moves @ each[problem.columns(k)] for k, rows in enumerate(here.seen)]
    most = np.max(np.abs(np.concatenate(moves)), axis=0)
    each /= UNIT_PX * np.maximum(most, 1e-300)  # (They move an outline by about a pixel.)
    tables = [part.rows @ each[part.columns] for part in problem.parts(here, noise)]
    triangle: Any = np.linalg.qr(np.concatenate([*tables, 0 * each]), mode="r")
    others = *problem.objects(), *problem.named(SCALE), *problem.named(ZERO)
    parts = {name: problem.parts_of(name) for name in (*problem.cameras, *others)}
    labels = (f"{name} {x}" for name, some in parts.items() for part in some for x in part.labels)
    by_unknowns, place = problem.reports([*chain(*parts.values())], here)
    reported = by_unknowns @ each[place]
    blind = BLIND[problem.dtype]
    _, weak = weak_directions(triangle, partial(_words, problem), blind)
    return observability_of(tuple(labels), triangle, reported, noise, blind, weak)


def _blank(view: Any, cameras: Any) -> Any:
    """A view with a mask that nobody will look at."""
    if not isinstance(view, JointView):
        return view
    camera = cameras.get(view.camera) if isinstance(cameras, Mapping) else cameras
    if not isinstance(camera, Camera):
        return view
    return view._replace(target=np.full((camera.H, camera.W), 0.5), photo=None)


def _words(problem: JointProblem, direction: np.ndarray) -> list[str]:
    """The unknowns that move along a direction."""
    words = []
    for u in problem.unknowns:
        each = TWIST_WORDS[MOTIONS[u.kind]] if u.kind in MOTIONS else [u.kind] * u.size
        words += [f"the {word} of {u.name}" for word in each]
    return chief_words(words, direction) or ["a mixture of all unknowns"]
