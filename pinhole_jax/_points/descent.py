"""The way of views of points to where their squares are least, and what they leave open there."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .._joint.levels import REACHES
from .._joint.system import Descent
from .._joint.views import State
from .._solver.problem import FINE_PX
from .noise import Noise
from .reprojection import PointProblem, rms_limit, squares_of
from .starts import rivals

#: A prior holds what is free where an error of a film height is not worth a thousandth of it.
HOLDS = 1e3
#: How often the views may go on from other places.
JUMPS = 3

Tell = Callable[[str], None]


class PointDescent(NamedTuple):
    """Where the squares of all views' points are least.

    - `others`: the ends of other places of each view that are as good, what is shared held.
    - `way`: the start, and where each descent ended, with its steps.
    - `noise`: what the points err by; `limits`: by how much each view's may (rms, px).
    """

    problem: PointProblem
    end: Descent
    others: list[list[Descent]]
    way: list[tuple[State, int]]
    noise: Noise
    limits: list[float]


def descend(
    problem: PointProblem, state: State, reach: float | None, variance: float | None, tell: Tell
) -> PointDescent:
    """Descend with all views together, by the problem's `max_steps` at most each time.

    Points farther than `reach` (px) lose their weight on the way; `variance` (px^2) is that of a
    coordinate of weight 1; both None if unknown. Views that other places fit better, or as well and
    nearer to the start, go on from there.
    """
    given, end, way = problem, problem.stay(state), [(state, 0)]
    for times in (1,) if reach is None else REACHES:
        if reach is not None:
            problem = _without_outliers(given, end.state, times * reach)
        problem, end = _descend_together(problem, end.state, variance, tell)
        way.append((end.state, end.steps))
    jumps = 0
    while True:
        # (Each view is compared, and reported, by what all points err by.)
        noise = problem.shown(end.seen)
        settled = replace(problem, known=noise)
        limits = [rms_limit(matches, variance, reach) for matches in problem.matches]
        places = [rivals(settled, k, end, noise, limit) for k, limit in enumerate(limits)]
        moved = {k: some[0].state for k, some in enumerate(places) if some[0].steps}
        if jumps == JUMPS or not moved:
            break
        jumps += 1
        problem, end = _descend_together(problem, _joined(problem, end, moved), variance, tell)
        way.append((end.state, end.steps))
    others = [[place for place in some if place.steps] for some in places]
    return PointDescent(settled, end, others, way, noise, limits)


def _joined(problem: PointProblem, end: Descent, moved: Mapping[int, State]) -> State:
    """The state in which some views are where they are in states of their own."""
    names = {k: problem.eyes[k].shot.camera for k in moved}
    cameras = {name: moved[k].lenses[name] for k, name in names.items()}
    return end.state._replace(lenses={**end.state.lenses, **cameras})


def _descend_together(
    problem: PointProblem, state: State, variance: float | None, tell: Tell
) -> tuple[PointProblem, Descent]:
    """The problem, and where the squares of all are least."""
    px, steps, spare = FINE_PX[problem.dtype], 0, problem.left_over
    both = spare + len(problem.priors)
    known = None if variance is None else Noise(variance, np.inf)
    if known is None and spare <= 0 < both:
        # Where priors hold what is free, points leave no less than they err by.
        widest = max(prior.std / prior.part.H for prior in problem.priors)
        firm = Noise((HOLDS * float(problem.matches[0].H) * widest) ** 2, np.inf)
        held = replace(problem, known=firm).descend(state, problem.max_steps, px)
        known = Noise(squares_of(held.seen) / both, both)
        state, steps = held.state, held.steps
    problem = replace(problem, known=known)
    further = problem.descend(state, problem.max_steps, px)
    end = further._replace(steps=steps + further.steps)
    weight = sum(matches.weight for matches in problem.matches)
    rms = (squares_of(end.seen) / weight) ** 0.5
    tell(f"{len(problem.eyes)} views: {end.steps} steps, {rms:.3g} px")
    return problem, end


def _without_outliers(given: PointProblem, state: State, reach: float) -> PointProblem:
    """The problem in which points count, by their given weights, that are no farther than this from
    where they are seen (px); half of each view's in any case."""
    weights = []
    for eye, matches in zip(given.eyes, given.matches, strict=True):
        off = np.asarray(matches.distances(eye.canonical(state)))
        most = max(reach, float(np.median(off[matches.counts])))
        weights.append(np.where(off <= most, matches.given.weight, 0.0))
    return given.weighed(weights)
