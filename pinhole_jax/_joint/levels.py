"""The way of many views from coarse to fine, and to the end, where outliers lose their weight."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from .._fit.strategy import EXACT
from .._solver.least_squares import Descent
from .._solver.looks import Sums
from .._solver.problem import COARSE_PX, FINE_PX
from .agreement import Agreement, agreed, priors_weighed
from .descent import descend
from .photo import OnPhotos, on_photos
from .problem import JointProblem
from .views import Eye, State

#: This many steps at most on a level that leads to finer ones. (An arm in three postures, 24 fits:
#: with 6 to 48 all end at the right place; most levels take 1 to 12, now and then one all of them.)
COARSE_STEPS = 24
#: An outline may lie this many times `outlier_px` from the mask's at first, then less.
REACHES = (8, 4, 2, 1)
#: A step that is negligible (px) at the end where masks err by more.
DRAWN_PX = 5e-3

Tell = Callable[[str], None]


class Passed(NamedTuple):
    """Where steps on a level ended: how far it is from the finest, and how many they were."""

    state: State
    depth: int
    steps: int


class Path(NamedTuple):
    """A state that steps led to, how many on each level, and the way there."""

    descent: Descent
    steps: tuple[int, ...]
    way: tuple[Passed, ...] = ()

    def then(self, further: "Path") -> "Path":
        """Return a further descent, with the steps of both."""
        return Path(further.descent, self.steps + further.steps, self.way + further.way[1:])


def depth_of(problem: JointProblem) -> int:
    """Return the number of levels of the view that has most."""
    return max(len(eye.solver.levels) for eye in problem.layout.eyes)


def descended(
    problem: JointProblem,
    state: State,
    tell: Tell,
    depths: Sequence[int],
    px: float | None = None,
) -> Path:
    """Return where a descent from level to level leads to, steps on the finest of which are
    negligible below this many px (None: as many as tell such masks apart)."""
    layout, steps, way = problem.layout, [], [Passed(state, depths[0], 0)]
    ones = np.ones(len(layout.eyes))
    found = Descent(state, [], np.inf, 0, False)
    for depth in depths:
        least = (px or problem.px) if depth == 1 else COARSE_PX
        most = problem.max_steps if depth == 1 else min(problem.max_steps, COARSE_STEPS)
        found = descend(layout, found.state, depth, ones, most, least)
        steps.append(found.steps)
        way.append(Passed(found.state, depth, found.steps))
        left = depth - 1
        tell(f"{len(ones)} views: {found.steps} steps, {left} level{'s' * (left != 1)} left")
    return Path(found, tuple(steps), tuple(way))


class End(NamedTuple):
    """Where a path ends, and how far the views agree there.

    - `problem`: whose views look at their masks, or at their photos where these decided.
    - `whole`: the sums over all pixels of each mask.
    - `astray`: the share of each outline that is far from the mask's edge.
    - `said`: what photos say, as sentences.
    """

    problem: JointProblem
    path: Path
    found: Agreement
    whole: list[Sums]
    astray: list[float]
    said: tuple[str, ...]


def to_the_end(problem: JointProblem, path: Path, tell: Tell, photos: bool = False) -> End:
    """Return where a path to the finest level ends: where masks are not exact, pixels far from
    their edges lose their weight, and views that err by more than most count less. Then views are
    refined on `photos`, if that is asked for."""
    eyes, reach, near = problem.layout.eyes, problem.outlier_px, problem
    misfits = [seen.view.touched_misfit for seen in path.descent.seen]
    inexact = [k for k, misfit in enumerate(misfits) if misfit > EXACT]
    px = DRAWN_PX if inexact else FINE_PX[eyes[0].solver.dtype]
    if reach is None or not inexact:
        path = path.then(descended(problem, path.descent.state, tell, [1], px))
    else:
        for times in REACHES:
            edges = {k: eyes[k].mask.near_edge(times * reach) for k in inexact}
            near = problem.seeing({k: eyes[k].weighed(edges[k], only_finest=True) for k in inexact})
            last = px if times == 1 else COARSE_PX
            if times == 1:
                near = near._replace(layout=priors_weighed(near.layout, path.descent))
            path = path.then(descended(near, path.descent.state, tell, [1], last))

    found = agreed(near.layout, path.descent, problem.max_steps, px)
    on = on_photos(near, found, px, tell) if photos else OnPhotos(near, found, (), ())
    whole = _over_masks(eyes, found.descent.state)
    astray = _astray(found, whole)
    if on.found is not found:
        whole = _over_masks(eyes, on.found.descent.state)
    path = path._replace(steps=path.steps + on.steps)
    again = {k: eyes[k] for k in inexact if on.problem.layout.eyes[k] is near.layout.eyes[k]}
    return End(on.problem.seeing(again), path, on.found, whole, astray, on.words)


def _over_masks(eyes: list[Eye], state: State) -> list[Sums]:
    """Return the sums over all pixels of each mask."""
    return [eye.look(state).sums for eye in eyes]


def _astray(found: Agreement, whole: list[Sums]) -> list[float]:
    """Return the share of each outline that is far from the mask's edge, so that the fit did not
    look at it."""
    near = [float(seen.view.sums.touched) for seen in found.descent.seen]
    touched = [float(sums.touched) for sums in whole]
    return [1 - n / t if t else 0.0 for n, t in zip(near, touched, strict=True)]
