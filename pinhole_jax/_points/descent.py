"""The way of views of points to where their squares are least, and what they leave open there."""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .._files.progress import say
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


class PointDescent(NamedTuple):
    """Where the squares of all views' points are least.

    - `others`: the ends of other places of each view that are as good, what is shared held.
    - `limits`: by how much each view's points may be off (rms, px).
    """

    problem: PointProblem
    end: Descent
    others: list[list[Descent]]
    limits: list[float]


def descend(given: PointProblem, state: State, reach: float | None) -> PointDescent:
    """Descend with all views together, by the problem's `max_steps` at most each time.

    Points farther than `reach` (px; None: unknown) lose their weight on the way. Views that other
    places fit better, or as well and nearer to the start, go on from there.
    """
    problem, end = given, given.stay(state)
    for times in (1,) if reach is None else REACHES:
        if reach is not None:
            problem = _without_outliers(given, end.state, times * reach)
        problem, end = _descend_together(problem, end)
    jumps = 0
    while True:
        # (Each view is compared, and reported, by what all points err by.)
        noise = problem.shown(end)
        settled = replace(problem, known=noise)
        limits = [rms_limit(matches, given.known, reach) for matches in problem.matches]
        places = [rivals(settled, k, end, noise, limit) for k, limit in enumerate(limits)]
        moved = {k: some[0].state for k, some in enumerate(places) if some[0].steps}
        if jumps == JUMPS or not moved:
            break
        jumps += 1
        problem = replace(problem, known=given.known)
        problem, end = _descend_together(problem, _joined(problem, end, moved))
    others = [[place for place in some if place.steps] for some in places]
    return PointDescent(settled, end, others, limits)


def _joined(problem: PointProblem, end: Descent, moved: Mapping[int, State]) -> Descent:
    """The end, but for views that are where they are in states of their own."""
    names = {k: problem.eyes[k].shot.camera for k in moved}
    cameras = {name: moved[k].lenses[name] for k, name in names.items()}
    return end._replace(state=end.state._replace(lenses={**end.state.lenses, **cameras}))


def _descend_together(problem: PointProblem, path: Descent) -> tuple[PointProblem, Descent]:
    """The problem, and where the squares of all are least, from a path's end on."""
    px, spare = FINE_PX[problem.dtype], problem.left_over
    both = spare + len(problem.priors)
    if problem.known is None and spare <= 0 < both:
        # Where priors hold what is free, points leave no less than they err by.
        widest = max(prior.std / prior.part.H for prior in problem.priors)
        firm = Noise((HOLDS * float(problem.matches[0].H) * widest) ** 2, np.inf)
        path = path.then(replace(problem, known=firm).descend(path.state, problem.max_steps, px))
        problem = replace(problem, known=Noise(squares_of(path) / both, both))
    end = path.then(problem.descend(path.state, problem.max_steps, px))
    weight = sum(matches.weight for matches in problem.matches)
    rms = (squares_of(end) / weight) ** 0.5
    say(f"{len(problem.eyes)} views: {end.steps} steps, {rms:.3g} px")
    return problem, end


def _without_outliers(given: PointProblem, state: State, reach: float) -> PointProblem:
    """The problem in which points count, by their given weights, that are no farther than this from
    where they are seen (px); half of each view's in any case."""
    counted = {}
    for k, (eye, matches) in enumerate(zip(given.eyes, given.matches, strict=True)):
        off = np.asarray(matches.distances(eye.canonical(state)))
        most = max(reach, float(np.median(off[matches.counts])))
        weight = np.where(off <= most, matches.given.weight, 0.0)
        counted[k] = replace(matches, given=matches.given._replace(weight=weight))
    return given.seeing(counted)
