"""The way of views of points to where their squares are least, and what they leave open there."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np

from .._joint.levels import REACHES
from .._solver.least_squares import levenberg_marquardt
from .._solver.problem import FINE_PX
from .noise import Noise, left_over, noise_of, prior_rows, rms_limit, squares_of
from .reprojection import PointProblem, PointView
from .starts import rivals

#: How often a prior is weighed anew by what the points err by.
ROUNDS = 3
#: A prior holds what is free where an error of a film height is not worth a thousandth of it.
HOLDS = 1e3
#: How often the views may go on from other places.
JUMPS = 3

Tell = Callable[[str], None]


class PointDescent(NamedTuple):
    """Views where the squares of all are least.

    - `others`: other places of each view that are as good, what is shared held.
    - `way`: the views at the start, and where each descent ended, with its steps.
    - `noise`: what the points err by; `limits`: by how much each view's may (rms, px).
    """

    problem: PointProblem
    views: list[PointView]
    others: list[list[PointView]]
    way: list[tuple[list[PointView], int]]
    noise: Noise
    limits: list[float]


def descend(
    views: list[PointView],
    reach: float | None,
    variance: float | None,
    most: int,
    tell: Tell,
) -> PointDescent:
    """Descend with all views together, by this many steps at most each time.

    Points farther than `reach` (px) lose their weight on the way; `variance` (px^2) is that of a
    coordinate of weight 1; both None if unknown. Views that other places fit better, or as well and
    nearer to the start, go on from there.
    """
    problem = PointProblem.from_views(views)
    given, way = [view.given.weight for view in views], [(views, 0)]
    for times in (1,) if reach is None else REACHES:
        if reach is not None:
            pairs = zip(views, given, strict=True)
            views = [_without_outliers(*pair, times * reach) for pair in pairs]
        views, steps = _descend_together(problem, views, variance, most, tell)
        way.append((views, steps))
    jumps = 0
    while True:
        noise = noise_of(problem, views, variance)
        limits = [rms_limit(view, variance, reach) for view in views]
        each = zip(views, limits, strict=True)
        places = [rivals(view, noise, limit) for view, limit in each]
        first = [best for best, *_ in places]
        if jumps == JUMPS or all(a is b for a, b in zip(first, views, strict=True)):
            break
        jumps += 1
        views, steps = _descend_together(problem, first, variance, most, tell)
        way.append((views, steps))
    pairs = zip(places, views, strict=True)
    others = [[place for place in some if place is not view] for some, view in pairs]
    return PointDescent(problem, views, others, way, noise, limits)


def _descend_together(
    problem: PointProblem, views: list[PointView], variance: float | None, most: int, tell: Tell
) -> tuple[list[PointView], int]:
    """Views where the squares of all are least, and the number of steps."""
    steps = 0
    for k in range(1 if views[0].prior is None else ROUNDS):
        views = _weigh_prior(problem, views, variance, k)
        found = levenberg_marquardt(problem, views, most, FINE_PX[problem.dtype])
        views, steps = found.state, steps + found.steps
    rms = (squares_of(views) / sum(view.weight for view in views)) ** 0.5
    tell(f"{len(views)} views: {steps} steps, {rms:.3g} px")
    return views, steps


def _without_outliers(view: PointView, weight: np.ndarray, reach: float) -> PointView:
    """The view in which points count, by their given weight, that are no farther than this from
    where they are seen (px); half of them in any case."""
    view = view.weighed(weight)
    off = view.distances()
    middle = float(np.median(off[view.counts]))
    return view.weighed(np.where(off <= max(reach, middle), weight, 0.0))


def _weigh_prior(
    problem: PointProblem, views: list[PointView], given: float | None, round_number: int
) -> list[PointView]:
    """The views with their priors weighed by the points' noise.

    If only priors leave coordinates over, they hold the free parameters in round 0: the noise that
    round 1 estimates is then no less than the true one.
    """
    prior, left = views[0].prior, left_over(problem, views)
    if prior is None:
        return views
    with_priors = left + prior_rows(views)
    if given is not None or left > 0:
        px = noise_of(problem, views, given).variance ** 0.5
    elif with_priors <= 0 or round_number > 1:
        return views
    elif round_number == 0:
        px = HOLDS * float(views[0].H) * float(np.max(prior.std))
    else:
        px = Noise(squares_of(views) / with_priors, with_priors).variance ** 0.5
    noise = np.asarray(px, problem.dtype)
    return [v._replace(prior=eqx.tree_at(lambda p: p.noise, v.prior, noise)) for v in views]
