"""Other cameras that see a view's points as well: reversed depths of a plane, poses of three points
of few."""

from typing import NamedTuple

import numpy as np

from .._camera.axes import angle, distinct
from .._rules import RULES
from .._solver.least_squares import levenberg_marquardt
from .._solver.problem import FINE_PX
from .._solver.uncertainty import BLIND
from .noise import Noise, exact_squares
from .reprojection import PointProblem, PointView
from .starts import is_few, reversed_depths, three_point_starts

#: This many descents from other places at most, of this many steps at most.
DESCENTS, STEPS = 4, 50
#: Starts closer than this (rad) lead to the same place; of three points all do that are apart.
CLOSE, APART_OF_THREE = np.deg2rad(3), 1e-3
#: Squares that differ by a smaller share are equal.
EQUAL = 1e-6


class _Rival(NamedTuple):
    view: PointView
    squares: float
    ended: bool


def rivals(view: PointView, noise: Noise, limit: float) -> list[PointView]:
    """The place that sees a view's points best, and others that are as good by chance:
    those that are equal by their turn from the start, then by their squares.

    What is shared is held. More is looked for where points are off by more than the limit (px).
    """
    here = _Rival(view, _squares(view), True)
    is_somewhere = bool(np.isfinite(here.squares))
    explained = is_somewhere and float(view.look().sum_squares) <= limit**2 * view.weight
    begin = view if is_somewhere else view.posed(view.start)
    starts = _starts(begin, explained) if "pose" in view.freed else []
    if not starts or (explained and _is_blind(view._replace(moving=view.alone))):
        return [view]
    near = RULES.same if noise.freedom > 0 else APART_OF_THREE
    places = [here] if is_somewhere else []
    for start in starts if is_somewhere else [begin, *starts]:
        there = _end(start)
        if not np.isfinite(there.squares):
            continue
        same = [k for k, p in enumerate(places) if angle(p.view.camera, there.view.camera) <= near]
        if not same:
            places.append(there)
        elif there.squares + exact_squares(view) < places[same[0]].squares / 2:
            places[same[0]] = there
    return _rank(places, noise, view) if places else [view]


def _rank(places: list[_Rival], noise: Noise, view: PointView) -> list[PointView]:
    """The best places and those that are as good by chance."""
    least = min(place.squares for place in places)
    equal, likely = least * (1 + EQUAL) + exact_squares(view), least + noise.by_chance

    def order(place: _Rival) -> tuple[bool, float]:
        is_worse = place.squares > equal
        return is_worse, place.squares if is_worse else angle(place.view.camera, view.start)

    good = [p for p in places if p.squares <= equal or (p.ended and p.squares <= likely)]
    return [place.view for place in sorted(good, key=order)]


def _squares(view: PointView) -> float:
    """The sum of squares, infinite where points are behind the eye, or that is so far away
    that it looks nowhere."""
    seen = view.look()
    looks = np.any(np.asarray(view.camera.p) != np.asarray(view.camera.e))
    right = looks and float(seen.nearest) > 0 and np.isfinite(seen.squares)
    return seen.squares if right else np.inf


def _starts(view: PointView, explained: bool) -> list[PointView]:
    """Other places to descend from: the reversed depths of a plane; and of few points, or
    where they are not explained, the user's pose and those that meet three points."""
    reverse, of_three = reversed_depths(view), len(view.counts) == 3
    result = [] if reverse is None else [reverse]
    if is_few(view) or not explained:
        result += [view.posed(view.start), *three_point_starts(view)]
    if of_three:
        result.sort(key=_squares)
    # (Those that are close to this view lead to it; those of three points are where they end.)
    close = APART_OF_THREE if of_three else CLOSE
    return [*distinct([view, *result], close, lambda place: place.camera)][1 : 1 + DESCENTS]


def _is_blind(view: PointView) -> bool:
    """Whether points do not show some direction: places along it are the same."""
    values = np.linalg.svd(np.asarray(view.look().triangle, float), compute_uv=False)
    return not values[-1] > BLIND[np.dtype(view.H.dtype)] * values[0]


def _end(start: PointView) -> _Rival:
    """The end of a view's own descent; shared parameters are held."""
    view = start._replace(moving=start.alone)
    problem = PointProblem.from_views([view])
    found = levenberg_marquardt(problem, [view], STEPS, FINE_PX[problem.dtype])
    there = start._replace(camera=found.state[0].camera)
    return _Rival(there, _squares(there), found.ended)
