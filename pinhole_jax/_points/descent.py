"""The way of views of points to where their squares are least, and what they leave open there."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np

from .._camera.axes import angle
from .._fit.places import APART
from .._joint.levels import REACHES
from .._solver.least_squares import levenberg_marquardt
from .._solver.parameters import components, labels_of
from .._solver.priors import Prior
from .._solver.problem import FINE_PX
from .starts import seen_from_behind
from .views import PointProblem, PointView

#: How often a prior is weighed anew by what the points err by.
ROUNDS = 3
#: A place is as good as the best where its squares are no larger than chance makes them with this
#: probability (an F test). Then a plane's wrong pose passes for the only one at most once in 2000
#: times.
CHANCE = 1e-3

Tell = Callable[[str], None]


class Descended(NamedTuple):
    """Views where the squares of all are least.

    - `own` (n,): which of a view's moves are its own, not shared.
    - `steps`: how many it took.
    - `others`: other places of each view that are as good, what is shared held.
    - `way`: the views at the start, and where each descent ended, with its steps.
    """

    views: list[PointView]
    own: np.ndarray
    steps: int
    others: list[list[PointView]]
    way: list[tuple[list[PointView], int]]


def descended(
    views: list[PointView], own: np.ndarray, reach: float | None, most: int, tell: Tell
) -> Descended:
    """Return where views descend to together, this many steps at most each time; points farther
    than `reach` (px) lose their weight on the way (None: none do)."""
    given, way = [view.weight for view in views], [(views, 0)]
    for reach_px in [None] if reach is None else [times * reach for times in REACHES]:
        views = views if reach_px is None else _near(views, given, reach_px)
        views, steps = _together(views, own, most, tell)
        way.append((views, steps))
    others = [_other(view, views, own, most) for view in views]
    if any(other is not None and other.is_better for other in others):
        pairs = zip(views, others, strict=True)
        begin = [other.place if other and other.is_better else view for view, other in pairs]
        views, steps = _together(begin, own, most, tell)
        way.append((views, steps))
        others = [_other(view, views, own, most) for view in views]
    places = [[] if other is None else [other.place] for other in others]
    return Descended(views, own, sum(steps for _, steps in way), places, way)


def _together(
    views: list[PointView], own: np.ndarray, most: int, tell: Tell
) -> tuple[list[PointView], int]:
    """Return views where the squares of all are least, and the number of steps."""
    steps, problem = 0, PointProblem.of(views, own)
    for _ in range(ROUNDS if views[0].prior is not None else 1):
        views = _prior_weighed(views, problem.size)
        found = levenberg_marquardt(problem, views, most, FINE_PX[problem.dtype])
        views, steps = found.state, steps + found.steps
    tell(f"{len(views)} views: {steps} steps, {variance(views, problem.size) ** 0.5:.3g} px")
    return views, steps


class _Other(NamedTuple):
    place: PointView
    is_better: bool


def _other(view: PointView, views: list[PointView], own: np.ndarray, most: int) -> _Other | None:
    """Return the place to which a view of a plane descends by itself with the depths of its points
    reversed, if it sees them as well as from where it is, or better; what is shared is held."""
    start = seen_from_behind(view) if "pose" in view.freed else None
    if start is None:
        return None
    alone = _alone(start, own)
    problem = PointProblem.of([alone], np.ones(int(own.sum()), bool))
    found = levenberg_marquardt(problem, [alone], most, FINE_PX[problem.dtype])
    there = view._replace(camera=found.state[0].camera)
    before, after = view.look(), there.look()
    if angle(view.camera, there.camera) < APART or not float(after.nearest) > 0:
        return None
    size = PointProblem.of(views, own).size
    chance = _by_chance(_freedom(views, size)) * variance(views, size)
    if not after.squares <= before.squares + chance:
        return None
    return _Other(there, after.squares < before.squares)


def _alone(view: PointView, own: np.ndarray) -> PointView:
    """Return the view in which what is shared is held."""
    moves = components(view.freed)
    held = {move for move, is_own in zip(moves, own, strict=True) if not is_own}
    freed = tuple(name for name in view.freed if held.isdisjoint(components((name,))))
    return view._replace(freed=freed, prior=_of_labels(view.prior, labels_of(freed)))


def _near(views: list[PointView], given: list[np.ndarray], reach: float) -> list[PointView]:
    """Return views in which points count that are no farther than this from where they are seen
    (px), of their given weights; half of them in any case."""
    result = []
    for view, weight in zip(views, given, strict=True):
        off = view._replace(weight=weight).distances()
        middle = float(np.median(off[weight > 0]))
        result.append(view._replace(weight=np.where(off <= max(reach, middle), weight, 0.0)))
    return result


def _freedom(views: list[PointView], unknowns: int) -> int:
    """Return how many more coordinates count than there are unknowns, at least 1."""
    return max(2 * sum(view.number for view in views) - unknowns, 1)


def variance(views: list[PointView], unknowns: int) -> float:
    """Return the variance of a coordinate (px^2) that views' residuals show."""
    squares = sum(float(view.look().sum_squares) for view in views)
    return squares / _freedom(views, unknowns)


def _prior_weighed(views: list[PointView], unknowns: int) -> list[PointView]:
    """Return the views with their priors weighed by what the points of all err by."""
    if views[0].prior is None:
        return views
    noise = np.asarray(variance(views, unknowns) ** 0.5, views[0].film.e.dtype)
    put = lambda view: eqx.tree_at(lambda p: p.noise, view.prior, noise)
    return [view._replace(prior=put(view)) for view in views]


def _by_chance(freedom: int) -> float:
    """Return how many variances a place's squares may be larger by chance."""
    from scipy.stats import f

    return float(f.ppf(1 - CHANCE, 1, freedom))


def _of_labels(prior: Prior | None, labels: tuple[str, ...]) -> Prior | None:
    """Return what a prior says of these labels, None if that is nothing."""
    if prior is None:
        return None
    which = [k for k, label in enumerate(prior.labels) if label in labels]
    if not which:
        return None
    some = np.array(which)
    names = tuple(prior.labels[k] for k in which)
    return Prior(names, prior.mean[some], prior.std[some], prior.noise)
