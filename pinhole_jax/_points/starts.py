"""Where views of points begin, and other cameras that see their points as well: reversed depths of
a plane, poses of three points of few."""

from typing import NamedTuple

import numpy as np

from .._camera.axes import angle, axes_of, distinct
from .._camera.camera import Camera
from .._rules import RULES
from .._solver.least_squares import levenberg_marquardt
from .._solver.problem import FINE_PX
from .._solver.uncertainty import BLIND
from .noise import Noise, exact_squares
from .reprojection import PointProblem, PointView
from .resection import plane_of, resect, resect_three, shift, turn

#: Draws of few points. Where 40 % are outliers 1 draw of 6 points in 21 has none, so 95 % of
#: searches meet one; with draws of 4, or fewer outliers, all do.
DRAWS = 64
#: Points of a draw that are not of a plane, and that are.
FEW, FEW_OF_PLANE = 6, 4
#: Up to this many points are few: direct solutions by all of them may fail, and solutions by three
#: are added, from this many triangles at most.
SCANT, TRIANGLES = 8, 6
#: What finds a part of the pose, the rest being known.
PARTS = {"position": shift, "orientation": turn}
#: This many descents from other places at most, of this many steps at most.
DESCENTS, STEPS = 4, 50
#: Starts closer than this (rad) lead to the same place; of three points all do that are apart.
CLOSE, APART_OF_THREE = np.deg2rad(3), 1e-3
#: Squares that differ by a smaller share are equal.
EQUAL = 1e-6


def begin(view: PointView, robust: bool) -> PointView:
    """The view from its own camera, or from where direct solutions say, what is nearer; if
    `robust` by half of the points (least median of squares, Rousseeuw 1984), else by all."""
    if view.bounds is not None:
        view = view.stepped(np.zeros(view.moves))
    places = [view, *map(view.posed, _direct(view, robust))]
    return min(places, key=lambda place: _distance(place, robust))


def _distance(view: PointView, robust: bool) -> float:
    """The distance of points (px) from where they are seen: of the middle one, or all together."""
    off = view.distances()[view.counts]
    return float(np.median(off) if robust else np.sum(off**2))


def _direct(view: PointView, robust: bool) -> list[Camera]:
    """Cameras that direct solutions find, of all points, and of few drawn at random."""
    points, seen_at = view.in_heights(view.counts)
    by_part = [way for name, way in PARTS.items() if name in view.freed]
    if by_part or "pose" not in view.freed:
        return [way(view.start, points, seen_at) for way in by_part]
    draws = [np.arange(len(points))]
    if robust:
        few = FEW if plane_of(points) is None else FEW_OF_PLANE
        random = np.random.default_rng(0)
        draws += [random.permutation(len(points))[:few] for _ in range(DRAWS)]
    found = [resect(view.start, points[some], seen_at[some]) for some in draws]
    if is_few(view):
        found += three_point_cameras(view, view.start)
    return [camera for camera in found if camera is not None]


def is_few(view: PointView) -> bool:
    """Whether few different points count, so that poses of three of them are starts, too."""
    return len(view.different(view.counts, and_seen=False)) <= SCANT


def three_point_starts(view: PointView) -> list[PointView]:
    """The view from where three of its points are met, its lens as it is, the best first."""
    places = map(view.posed, three_point_cameras(view, view.camera))
    return sorted(places, key=lambda place: _distance(place, False))


def three_point_cameras(view: PointView, camera: Camera) -> list[Camera]:
    """A camera in all poses that three of the points have, of large triangles; of many
    points, some that are spread evenly among them."""
    counts = view.different(view.counts, and_seen=False)
    some = counts[np.unique(np.linspace(0, len(counts) - 1, SCANT).round().astype(int))]
    return resect_three(camera, *view.in_heights(some), TRIANGLES) if len(some) > 2 else []


def reversed_depths(view: PointView) -> PointView | None:
    """The view from where a plane's points look the same but for their perspective, their
    depths reversed (Necker's cube); None where points are of no plane.

    Half a turn about the plane's normal, then half a turn about the line of sight, leave each point
    where it is seen from far away.
    """
    plane = plane_of(view.in_heights(view.counts)[0])
    if plane is None:
        return None
    middle, normal = plane
    away = np.asarray(view.camera.e, float) - middle
    sight = away / np.linalg.norm(away)
    about_normal, about_sight = (2 * np.outer(x, x) - np.eye(3) for x in (normal, sight))
    turned = about_normal @ about_sight
    axes = axes_of(view.camera) @ turned.T
    return view._replace(camera=view.camera.with_pose(middle + turned @ away, axes))


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
