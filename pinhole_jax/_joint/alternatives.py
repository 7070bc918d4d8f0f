"""Other places of a camera (or object) that several views, or one, show by themselves.

What one view alone leaves open, the others tell: guesses are ranked, and followed, together. A pose
that only one view shows is asked for what `fit_camera` asks of its mask: do walks along nearly free
moves, or views that look alike, explain it as well or better? The lens that it shares with others
is held, by residuals that are linear in its parameters.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from .._camera.axes import distinct
from .._camera.camera import Camera
from .._files.progress import say
from .._fit.places import Free, Places, better, separation
from .._fit.refine import Refiner
from .._fit.result import iou_and_rms
from .._fit.strategy import ROUGH_PX, everywhere, looked_alike, looked_round
from .._mask.mask import Mask
from .._mask.search import guesses
from .._outline.statistics import is_explained
from .._rules import RULES
from .._solver.looks import View
from .._solver.moves import canonical, on_film, reported
from .._solver.parameters import components
from .._solver.priors import Prior
from .._solver.solver import Solution, Solver
from .door import share_means
from .levels import descend
from .system import Descent, JointProblem
from .views import SCALE, Eye, State, Unknown

#: Of each view this many guesses are tried, so far apart (rad), and this many of all followed
#: further. (Before an arm 4 and 2 find all of 8 cameras as well, in half the time, 1.6 for 3.0 s;
#: the rest is for parts that look alike from several sides.)
TRIED, FOLLOWED = 12, 4
#: This many views that look alike are tried at most.
ALIKE = 6
#: This many views are looked at before few states are left.
LOOKED_AT = 4
#: Steps on the coarsest level at first; what leaves this many times the least squares is given up.
FIRST_STEPS = 8
#: What covers less than this share of a drawn mask may have come from a wrong start. (An arm's hard
#: masks: right ends have 0.98, of some 55 wrong ones two 0.82 and 0.86. A robot's, by a network,
#: have 0.93 to 0.97.)
LIKELY_IOU = 0.9
#: Poses are compared at most this many times, where one of them is better elsewhere.
ROUNDS = 3


class LonePose(NamedTuple):
    """A pose whose views depend on no other unknown one.

    - `name`, and `numbers` of its views.
    - `problem`: that of these views, in which what others show, too, is held or known.
    - `others`: paths to other places that explain its masks as well as the best.
    - `free`: directions along which the best place may move.
    """

    name: str
    problem: JointProblem
    numbers: list[int]
    others: Sequence[Descent] = ()
    free: Sequence[Free] = ()

    def seen_in(self, path: Descent) -> Descent:
        """A path of all views, as these see it."""
        seen = [path.seen[k] for k in self.numbers]
        return path._replace(seen=seen, squares=sum(s.view.squares for s in seen))

    def apart(self, state: State, other: State) -> float:
        """The distance of two states, as the first view's camera has it."""
        eye = self.problem.eyes[0]
        return separation(eye.solver, eye.canonical(state), eye.canonical(other))

    def distinct(self, paths: Sequence[Descent], apart: float) -> list[Descent]:
        """The paths to states whose cameras look other ways (rad) than those before."""
        camera = lambda path: self.problem.eyes[0].canonical(path.state)
        return [*distinct(paths, apart, camera)]


def compare(problem: JointProblem, path: Descent) -> tuple[Descent, list[LonePose]]:
    """The best path, and what explains the masks as well, a lone pose at a time; if the path saw
    nothing yet all poses are searched.

    Where a pose is better elsewhere, all views descend from there, and are compared again. If that
    is worse for all together they stay, and the place is one of that pose's others.
    """
    start, poses = problem.start if path.seen else None, []
    for turn in range(ROUNDS):
        poses, moved = [], []
        for pose in _lone_poses(problem, path):
            paths, free = _places(pose, path, start)
            if len(pose.numbers) == len(problem.eyes):
                return paths[0], [pose._replace(others=paths[1:], free=free)]
            others = [p for p in paths if pose.apart(p.state, path.state) > RULES.same]
            poses.append(pose._replace(others=others, free=free))
            if (best := paths[0].state) is not path.state:
                moved.append((pose, best))
        if path.seen and (not moved or turn == ROUNDS - 1):
            break
        there = descend(problem, join(problem, path.state, moved), [1])
        if path.seen and there.squares > path.squares + _squares_alike(problem, path):
            break
        path = path.then(there) if path.seen else there
    return path, poses


def join(problem: JointProblem, state: State, moved: list[tuple[LonePose, State]]) -> State:
    """The state with lone poses, and what else their views show, of other states."""
    poses, lenses, scales = dict(state.poses), dict(state.lenses), dict(state.scales)
    for pose, there in moved:
        poses[pose.name] = there.poses[pose.name]
        lenses |= {name: there.lenses[name] for name in pose.problem.cameras}
        scales |= {name: there.scales[name] for name in pose.problem.named(SCALE)}
    return State(poses, share_means(lenses, problem.unknowns), scales, state.zeros)


def _squares_alike(problem: JointProblem, path: Descent) -> float:
    """The most by which the sums of squares of places that are as good differ."""
    pairs = zip(problem.eyes, path.seen, strict=True)
    misfits = [max(e.solver.kind.variance, s.view.touched_misfit) for e, s in pairs]
    return RULES.equal_times * max(misfits)


def _lone_poses(problem: JointProblem, path: Descent) -> list[LonePose]:
    """The poses that views show by themselves. What several of them show is held; a pose of one
    view has the lens that it shares held where the path ends."""
    seen_by = lambda numbers: Counter(u for k in numbers for u in problem.unknowns_of(k))
    number, result = seen_by(range(len(problem.eyes))), []
    for name, numbers in problem.lone_poses.items():
        shown, alone = seen_by(numbers), len(numbers) == 1
        some = [u for u in problem.unknowns if shown[u] and (alone or shown[u] == number[u])]
        part = problem.only(numbers, some)
        if alone and path.seen and any(number[u] > 1 for u in some):
            eye, view = part.eyes[0], path.seen[numbers[0]].view
            if np.all(np.isfinite(view.triangle)):
                held = _held(eye, path.state, view, some)
                part = part.seeing({0: replace(eye.solver, prior=held)})
        result.append(LonePose(name, part, numbers))
    return result


def _held(eye: Eye, state: State, view: View, unknowns: list[Unknown]) -> Prior:
    """What holds the lens's parameters that a view shares with others at a state: it counts as much
    as what the view itself sees best.

    (To that the view compares what it hardly sees: with more it would hardly see anything.)
    """
    freed, triangle = eye.solver.freed, view.triangle
    shared = tuple(u.kind for u in unknowns if len(u.cameras) > 1)
    held, most = np.isin(components(freed), components(shared)), np.linalg.norm(triangle, 2)
    rows = most * held[:, None] * np.linalg.pinv(view.to_reported)
    # (All views' squares are least: the others pull as this one does.)
    left = held * (view.along @ triangle) / -most
    camera = eye.canonical(state)
    at = reported(camera, camera, freed)
    return Prior(*(jnp.asarray(np.array(x, float), eye.solver.dtype) for x in (rows, at, left)))


def _places(
    pose: LonePose, path: Descent, start: State | None
) -> tuple[list[Descent], Sequence[Free]]:
    """Paths of a lone pose that explain its masks as well as the best, which is the first and free
    along some directions."""
    here = pose.seen_in(path) if path.seen else path
    if len(pose.numbers) == 1 and pose.name not in pose.problem.objects():
        return _paths_of_one_view(pose, here, start)
    problem, paths = pose.problem, [here]
    if not (here.seen and _is_content(problem, here)):
        found = _search_together(pose, here.state)
        paths = [f for f in found if f.squares < here.squares or not here.seen] or paths
    paths += _lookalikes(pose, paths[0])
    # The first, if none is better; what explains the masks as well, each once.
    least = min(path.squares for path in paths)
    noise = sum(RULES.equal_times * eye.solver.kind.variance for eye in problem.eyes)
    good = [p for p in paths if p.squares <= (1 + RULES.little) * least + noise] or paths[:1]
    if good[0] is not paths[0]:
        good.sort(key=lambda path: path.squares)
    return pose.distinct(good, RULES.same), ()


def _paths_of_one_view(
    pose: LonePose, here: Descent, start: State | None
) -> tuple[list[Descent], Sequence[Free]]:
    """Paths of the pose of one view, by what `fit_camera` asks of its mask."""
    problem, (eye,) = pose.problem, pose.problem.eyes
    solver, camera = eye.standpoint(here.state)
    begin = None if start is None else eye.canonical(start)
    mask = replace(eye.mask, camera=on_film(camera, eye.mask.camera))
    silent = lambda news: None

    def onward(place: Solution) -> Descent:
        there = eye.with_camera(pose.name, place.camera, here.state)
        return problem.descend(there, problem.max_steps, problem.px)

    if not here.seen:
        places = everywhere(solver, mask, silent)
        found = _keep_agreeing(problem, solver, mask, places, begin)
        return [*map(onward, found)], places.free
    now = Solution(camera, solver.look(camera), ())
    if begin is None:
        places = looked_alike(solver, now, [])
    else:
        places = looked_round(solver, mask, now, begin, silent)
    found = _keep_agreeing(problem, solver, mask, places, begin)
    near = lambda place: separation(solver, place.camera, camera) < RULES.same
    is_here = [near(place) and not better(solver, place.view, now.view) for place in found]
    each = zip(found, is_here, strict=True)
    paths = [here.then(onward(place)) for place, is_known in each if not is_known]
    if not any(is_here) and better(solver, places.best.view, now.view):
        return paths, places.free
    # (From a start, what is as good and nearer to it comes first.)
    is_last = any(is_here) and begin is not None and not is_here[0]
    return [*paths, here] if is_last else [here, *paths], places.free


def _keep_agreeing(
    problem: JointProblem, solver: Solver, mask: Mask, places: Places, start: Camera | None
) -> list[Solution]:
    """The best place, and others: of masks with outliers those that agree with most of the outline,
    as `fit_camera` has it."""
    found, reach = [places.best, *places.others], problem.outlier_px
    if reach is None or places.best.view.touched_misfit <= RULES.exact * mask.usual_weight:
        return found
    refiner = Refiner.on(solver, mask, start, reach, plainly=True)  # (as all views descend)
    candidates = refiner.candidates([*found, *places.rivals])
    kept = refiner.likeliest(candidates, min(len(found), len(candidates)))
    return [c.found._replace(view=c.whole) for c in kept]


def _is_content(problem: JointProblem, path: Descent) -> bool:
    """Whether a descent's end may be right: where masks are exact, whether they are explained, else
    whether it is at rest and the scenes lie on the masks."""
    views = [seen.view for seen in path.seen]
    pairs = zip(problem.eyes, views, strict=True)
    # (Zeros that are not where they are sought explain no mask.)
    if all(eye.solver.kind.exact for eye in problem.eyes) and not problem.zeros:
        return all(is_explained(eye.solver, view) for eye, view in pairs)
    return path.ended and iou_and_rms([v.sums for v in views])[0] >= LIKELY_IOU


def _search_together(pose: LonePose, state: State) -> list[Descent]:
    """Paths from the views' guesses that explain the masks best, the best first."""
    few = pose.problem.few(LOOKED_AT)
    coarsest, tried = replace(few, depth=few.levels), []
    for eye in few.eyes:
        proposed = guesses(eye.mask, eye.solver.subject.scene, eye.solver.subject.ball)
        for guess in islice(distinct(proposed, RULES.start), TRIED):
            there = eye.with_camera(pose.name, canonical(guess), state)
            tried.append(coarsest.stay(there))
    say(f"{len(tried)} guesses of {len(few.eyes)} views")
    best_first = lambda paths: sorted(paths, key=lambda path: path.squares)

    likely = pose.distinct(best_first(tried), RULES.start)[: 2 * FOLLOWED]
    paths = [p.then(coarsest.descend(p.state, FIRST_STEPS, ROUGH_PX)) for p in likely]
    paths = pose.distinct(best_first(paths), RULES.start)[:FOLLOWED]
    for level in range(few.levels, 0, -1):
        # (All views are looked at where few states are left.)
        part = few if level > 2 else pose.problem
        onward = (p.then(descend(part, p.state, [level])) for p in paths)
        best, *others = pose.distinct(best_first(onward), RULES.same)
        most = (RULES.times if level > 1 else 1 + RULES.little) * best.squares
        paths = [best, *(p for p in others if p.squares <= most)]
    return paths


def _lookalikes(pose: LonePose, best: Descent) -> list[Descent]:
    """Paths from views that look like the best one: its object is near its own mirror image, or
    turned into itself."""
    problem, state = pose.problem, best.state
    eye, few = problem.eyes[0], problem.few(LOOKED_AT)
    coarse = replace(few, depth=min(problem.levels, 2))
    noise = RULES.exact * best.total("touched")
    most = RULES.times * sum(seen.view.squares for seen in coarse.look(state)) + noise
    paths = []
    for camera in [*eye.solver.subject.alike.views(eye.canonical(state))][:ALIKE]:
        there = eye.with_camera(pose.name, camera, state)
        begun = coarse.descend(there, FIRST_STEPS, ROUGH_PX)
        if begun.squares <= most:
            paths.append(descend(problem, begun.state, range(coarse.depth, 0, -1)))
    return paths
