"""The way of views of points: where it begins, and leads where squares are least; and other cameras
that see points as well: reversed depths of a plane, poses of three points of few."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np

from .._camera.axes import angle, axes_of, distinct
from .._camera.camera import Camera
from .._files.progress import say
from .._joint.levels import REACHES
from .._joint.system import Descent
from .._joint.views import POSE, State
from .._numerics.arrays import evenly
from .._rules import RULES
from .._solver.problem import FINE_PX
from .._solver.uncertainty import BLIND
from .noise import Noise
from .reprojection import Matches, PointProblem, exact_squares, rms_limit
from .resection import lines_of_sight, plane_of, resect, shift, triangles, turn

#: A prior holds what is free where an error of a film height is not worth a thousandth of it.
HOLDS = 1e3
#: How often the views may go on from other places.
JUMPS = 3
#: Draws of three points. Where 40 % are outliers 14 of them have none.
DRAWS = 64
#: Up to this many points are few: several poses may explain them; and by this many, spread evenly
#: among many, there are direct solutions, from this many triangles at most.
SCANT, TRIANGLES = 8, 6
#: What finds a part of the pose, the rest being known.
PARTS = {"position": shift, "orientation": turn}
#: This many descents from other places at most, of this many steps at most.
DESCENTS, STEPS = 4, 50
#: Starts closer than this (rad) lead to the same place; of three points all do that are apart.
CLOSE, APART_OF_THREE = np.deg2rad(3), 1e-3
#: Squares that differ by a smaller share are equal.
EQUAL = 1e-6


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
        each = zip(problem.cameras, places, strict=True)
        moved = {name: some[0].state.lenses[name] for name, some in each if some[0].steps}
        if jumps == JUMPS or not moved:
            break
        jumps += 1
        problem = replace(problem, known=given.known)
        there = end.state._replace(lenses={**end.state.lenses, **moved})
        problem, end = _descend_together(problem, end._replace(state=there))
    others = [[place for place in some if place.steps] for some in places]
    return PointDescent(settled, end, others, limits)


def _descend_together(problem: PointProblem, path: Descent) -> tuple[PointProblem, Descent]:
    """The problem, and where the squares of all are least, from a path's end on."""
    px, spare = FINE_PX[problem.dtype], problem.left_over
    both = spare + len(problem.priors)
    if problem.known is None and spare <= 0 < both:
        # Where priors hold what is free, points leave no less than they err by.
        widest = max(prior.std / prior.part.H for prior in problem.priors)
        firm = Noise((HOLDS * float(problem.matches[0].H) * widest) ** 2, np.inf)
        path = path.then(replace(problem, known=firm).descend(path.state, problem.max_steps, px))
        problem = replace(problem, known=Noise(path.total("squares") / both, both))
    end = path.then(problem.descend(path.state, problem.max_steps, px))
    weight = sum(matches.weight for matches in problem.matches)
    rms = (end.total("squares") / weight) ** 0.5
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


# --- where views begin, and other places ----------------------------------------------------------


def begin(matches: Matches, start: Camera, robust: bool) -> Camera:
    """The start, or the camera that direct solutions say, what is nearer; if `robust` by half of
    the points (least median of squares, Rousseeuw 1984), else by all."""

    def distance(camera: Camera) -> float:
        off = np.asarray(matches.distances(camera))[matches.counts]
        return float(np.median(off) if robust else np.sum(off**2))

    return min([start, *_direct(matches, start, robust)], key=distance)


def _direct(matches: Matches, start: Camera, robust: bool) -> list[Camera]:
    """Cameras that direct solutions find, of large triangles, and of some drawn at random."""
    points, seen_at = matches.in_heights(matches.counts)
    by_part = [way for name, way in PARTS.items() if name in matches.freed]
    if by_part or POSE not in matches.freed:
        return [way(start, points, seen_at) for way in by_part]
    found = three_point_cameras(matches, start)
    if robust:
        random = np.random.default_rng(0)
        draws = (random.permutation(len(points))[:3] for _ in range(DRAWS))
        found += resect(start, points, lines_of_sight(start, seen_at), draws)
    return found


def three_point_cameras(matches: Matches, camera: Camera) -> list[Camera]:
    """A camera in all poses that three of the points have, of large triangles; of many
    points, some that are spread evenly among them."""
    counts = matches.different()
    points, seen_at = matches.in_heights(counts[evenly(len(counts), SCANT)])
    rays = lines_of_sight(camera, seen_at)
    return resect(camera, points, rays, triangles(points, rays, TRIANGLES))


def reversed_depths(matches: Matches, camera: Camera) -> Camera | None:
    """The camera from where points of a plane look the same but for their perspective, their
    depths reversed (Necker's cube), by the plane nearest to the points; None of nearly a line.

    Half a turn about the plane's normal, then half a turn about the line of sight, leave each point
    where it is seen from far away.
    """
    plane = plane_of(matches.in_heights(matches.counts)[0])
    if plane is None:
        return None
    middle, normal = plane
    away = np.asarray(camera.e, float) - middle
    sight = away / np.linalg.norm(away)
    about_normal, about_sight = (2 * np.outer(x, x) - np.eye(3) for x in (normal, sight))
    turned = about_normal @ about_sight
    return camera.with_pose(middle + turned @ away, axes_of(camera) @ turned.T)


def rivals(
    problem: PointProblem, k: int, end: Descent, noise: Noise, limit: float
) -> list[Descent]:
    """The place that sees a view's points best, and others that are as good by chance:
    those that are equal by their turn from the start, then by their squares.

    What is shared is held; of where the views `end`, no steps are taken. More is looked for where
    points are off by more than the limit (px).
    """
    alone = [u for u in problem.unknowns_of(k) if len(u.cameras) < 2]
    if POSE not in [u.kind for u in alone]:
        return [end._replace(steps=0)]
    view, px = problem.only([k], alone), FINE_PX[problem.dtype]
    (matches,), user = view.matches, _camera(view, view.start)
    here = _checked(view, view.stay(end.state))
    lost = not np.isfinite(here.squares)
    begin = _camera(view, _posed(view, end.state, user) if lost else here.state)
    explained = not lost and matches.squares(begin) <= limit**2 * matches.weight
    starts = _other_starts(matches, begin, user, explained)
    if not starts or (explained and _is_blind(view, here)):
        return [here]
    near = RULES.same if noise.freedom > 0 else APART_OF_THREE
    places = [here]
    for start in [begin] * lost + starts:
        there = _checked(view, view.descend(_posed(view, end.state, start), STEPS, px))
        if not np.isfinite(there.squares):
            continue
        camera = _camera(view, there.state)
        same = [j for j, p in enumerate(places) if angle(_camera(view, p.state), camera) <= near]
        if not same:
            places.append(there)
        elif there.squares + exact_squares(matches) < places[same[0]].squares / 2:
            places[same[0]] = there
    return _ranked(view, places, user, noise)


# --- one view of a problem by itself, what is shared held -----------------------------------------


def _camera(view: PointProblem, state: State) -> Camera:
    """Its camera at a state."""
    return view.eyes[0].canonical(state)


def _posed(view: PointProblem, state: State, camera: Camera) -> State:
    """The state in which it has a camera's pose."""
    pose = lambda c: (c.e, c.p, c.u)
    name = view.eyes[0].shot.camera
    here = eqx.tree_at(pose, state.lenses[name], pose(camera))
    return state._replace(lenses={**state.lenses, name: here})


def _checked(view: PointProblem, place: Descent) -> Descent:
    """The place, its squares infinite where points are behind the eye or nowhere."""
    squares = view.matches[0].squares(_camera(view, place.state))
    return place if np.isfinite(place.squares + squares) else place._replace(squares=np.inf)


def _is_blind(view: PointProblem, here: Descent) -> bool:
    """Whether points do not show some direction: places along it are the same."""
    seen, moves = here.seen[0]
    values = np.linalg.svd(seen.triangle[:, np.any(moves, axis=1)], compute_uv=False)
    return not values[-1] > BLIND[view.dtype] * values[0]


def _other_starts(matches: Matches, begin: Camera, user: Camera, explained: bool) -> list[Camera]:
    """Other places to descend from: the reversed depths of a plane; and of few points, or where
    they are not explained, the user's pose and those that meet three points."""
    reverse = reversed_depths(matches, begin)
    result, of_three = [] if reverse is None else [reverse], len(matches.counts) == 3
    if len(matches.different()) <= SCANT or not explained:
        of_points = three_point_cameras(matches, begin)
        result += [user, *sorted(of_points, key=matches.squares)]
    if of_three:
        result.sort(key=matches.squares)
    # (Those that are close to it lead to it; those of three points are where they end.)
    close = APART_OF_THREE if of_three else CLOSE
    return [*distinct([begin, *result], close)][1 : 1 + DESCENTS]


def _ranked(view: PointProblem, places: list[Descent], user: Camera, noise: Noise) -> list[Descent]:
    """The best places and those that are as good by chance."""
    least, exact = min(place.squares for place in places), exact_squares(view.matches[0])
    equal, likely = least * (1 + EQUAL) + exact, least + noise.by_chance

    def order(place: Descent) -> tuple[bool, float]:
        is_worse = place.squares > equal
        return is_worse, place.squares if is_worse else angle(_camera(view, place.state), user)

    good = [p for p in places if p.squares <= equal or (p.ended and p.squares <= likely)]
    return sorted(good, key=order)
