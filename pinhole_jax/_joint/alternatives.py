"""Other places of a camera (or object) that several views, or one, show by themselves.

What one view alone leaves open, the others tell: guesses are ranked, and followed, together. A pose
that only one view shows is asked for what `fit_camera` asks of its mask: do walks along nearly free
moves, or views that look alike, explain it as well or better? What the other views know of the lens
that they share is among its residuals then, linear in its parameters.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np

from .._camera.axes import distinct
from .._camera.camera import Camera
from .._fit.places import (
    Free,
    Places,
    better,
    separation,
)
from .._fit.refine import Refiner, likeliest
from .._fit.result import iou_and_rms
from .._fit.strategy import (
    ROUGH_PX,
    everywhere,
    looked_alike,
    looked_round,
)
from .._mask.mask import Mask
from .._mask.search import guesses
from .._outline.statistics import is_explained
from .._rules import RULES
from .._solver.least_squares import LinearSolution, solve
from .._solver.moves import canonical, on_film
from .._solver.parameters import LABELS, labels_of
from .._solver.priors import OtherViews
from .._solver.solver import Solution, Solver
from .lenses import known_by_others, share_means
from .levels import Path, Tell, descend
from .system import JointProblem, LevelEnd
from .views import SCALE, State

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


P = TypeVar("P", State, Path)


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
    others: Sequence[Path] = ()
    free: Sequence[Free] = ()

    def seen_in(self, path: Path) -> Path:
        """A path of all views, as these see it."""
        seen = [path.descent.seen[k] for k in self.numbers]
        squares = float(sum(s.view.squares for s in seen))
        return path._replace(descent=path.descent._replace(seen=seen, squares=squares))

    def is_at(self, path: Path, state: State) -> bool:
        """True if a path ends where a state has the pose."""
        eye = self.problem.eyes[0]
        cameras = eye.canonical(path.descent.state), eye.canonical(state)
        return bool(separation(eye.solver, *cameras) <= RULES.same)


def compare(problem: JointProblem, path: Path | None, tell: Tell) -> tuple[Path, list[LonePose]]:
    """The best path, and what explains the masks as well, a lone pose at a time; without a path
    from a start all poses are searched.

    Where a pose is better elsewhere, all views descend from there, and are compared again. If that
    is worse for all together they stay, and the place is one of that pose's others.
    """
    start, poses = None if path is None else problem.start, []
    for turn in range(ROUNDS):
        state = problem.start if path is None else path.descent.state
        poses, moved = [], []
        for pose in _lone_poses(problem, path):
            paths, free = _places(pose, path, start, tell)
            if len(pose.numbers) == len(problem.eyes):
                return paths[0], [pose._replace(others=paths[1:], free=free)]
            others = [p for p in paths if not pose.is_at(p, state)]
            poses.append(pose._replace(others=others, free=free))
            if (best := paths[0].descent.state) is not state:
                moved.append((pose, best))
        if path is not None and (not moved or turn == ROUNDS - 1):
            break
        there = descend(problem, join(problem, state, moved), tell, [1])
        if path is None:
            path = there
        elif there.squares <= path.squares + _noise(problem, path):
            path = path.then(there)
        else:
            break
    assert path is not None
    return path, poses


def join(problem: JointProblem, state: State, moved: list[tuple[LonePose, State]]) -> State:
    """The state with lone poses, and what else their views show, of other states."""
    poses, lenses, scales = dict(state.poses), dict(state.lenses), dict(state.scales)
    for pose, there in moved:
        poses[pose.name] = there.poses[pose.name]
        lenses |= {name: there.lenses[name] for name in pose.problem.cameras}
        scales |= {name: there.scales[name] for name in pose.problem.named(SCALE)}
    groups: dict[str, list[tuple[str, ...]]] = {}
    for unknown in problem.unknowns:
        if len(unknown.cameras) > 1:
            groups.setdefault(unknown.kind, []).append(unknown.cameras)
    return State(poses, share_means(lenses, groups), scales, state.zeros)


def _noise(problem: JointProblem, path: Path) -> float:
    """The most by which sums of squares of equal places differ."""
    pairs = zip(problem.eyes, path.descent.seen, strict=True)
    return RULES.equal_times * max(
        max(e.solver.kind.variance, s.view.touched_misfit) for e, s in pairs
    )


def _lone_poses(problem: JointProblem, path: Path | None) -> list[LonePose]:
    """The poses that views show by themselves. What several of them show is held; a pose of one
    view knows of that what the others do at a path's end."""
    groups, solved, result = problem.lone_poses, None, []
    views = [set(problem.unknowns_of(k)) for k in range(len(problem.eyes))]
    number = {unknown: sum(unknown in view for view in views) for unknown in problem.unknowns}
    if path is not None and all(np.all(np.isfinite(s.view.triangle)) for s in path.descent.seen):
        state, seen = path.descent.state, path.descent.seen
        parts = problem.parts(state, seen, problem.noise(seen))
        solved = solve(parts, problem.size, np.zeros(problem.size))
    for name, numbers in groups.items():
        depends = set().union(*(views[k] for k in numbers))
        alone = [u for u in depends if number[u] == sum(u in views[k] for k in numbers)]
        part = problem.only(numbers, [u for u in problem.unknowns if u in alone])
        if len(numbers) == 1 and len(alone) < len(depends):
            unknowns = [u for u in problem.unknowns if u in depends]
            part = replace(part, unknowns=unknowns)
            if path is not None and solved is not None:
                others = _others(problem, numbers[0], path, solved)
                eye = replace(part.eyes[0], solver=part.eyes[0].solver.beside(others))
                part = replace(part, eyes=[eye])
        result.append(LonePose(name, part, numbers))
    return result


def _others(problem: JointProblem, k: int, path: Path, solved: LinearSolution) -> OtherViews:
    """The knowledge that other views have of the lens's parameters that a view shares with them."""
    eye, seen, state = problem.eyes[k], path.descent.seen[k], path.descent.state
    rows = problem.view_rows(k, seen)
    shared = np.concatenate([np.full(u.size, len(u.cameras) > 1) for u in problem.unknowns_of(k)])
    root = known_by_others(solved, rows, shared)
    slope = -(rows.left @ rows.rows)[shared]  # all views' squares are least

    # By moves. None counts more than what the view itself sees best: it is that to which it
    # compares what it hardly sees, and with many others it would hardly see anything.
    by_unknown = np.linalg.pinv(seen.moves[:, shared])
    _, values, directions = np.linalg.svd(root @ by_unknown, full_matrices=False)
    values = np.minimum(values, np.linalg.norm(np.asarray(seen.view.triangle, float), 2))
    by_moves = np.pad(values[:, None] * directions, ((0, len(seen.moves) - len(values)), (0, 0)))
    left = np.linalg.lstsq(by_moves.T, by_unknown.T @ slope, rcond=None)[0]
    of_label = [LABELS[label].value for label in labels_of(eye.solver.freed)]
    here = [0.0 if value is None else float(value(eye.canonical(state))) for value in of_label]
    by_labels = by_moves @ np.linalg.pinv(np.asarray(seen.view.to_reported, float))
    return OtherViews(*(jnp.asarray(x, eye.solver.dtype) for x in (by_labels, here, left)))


def _places(
    pose: LonePose, path: Path | None, start: State | None, tell: Tell
) -> tuple[list[Path], Sequence[Free]]:
    """Paths of a lone pose that explain its masks as well as the best, which is the first and free
    along some directions."""
    here = None if path is None else pose.seen_in(path)
    if len(pose.numbers) == 1 and pose.name not in pose.problem.objects():
        return _paths_of_one_view(pose, here, start)
    problem, paths = pose.problem, [] if here is None else [here]
    if here is None or not _is_content(problem, here):
        state = problem.start if here is None else here.descent.state
        found = _search_together(pose, state, tell)
        paths = [f for f in found if here is None or f.squares < here.squares] or paths
    return _best_paths(problem, [*paths, *_lookalikes(pose, paths[0], tell)]), ()


def _paths_of_one_view(
    pose: LonePose, here: Path | None, start: State | None
) -> tuple[list[Path], Sequence[Free]]:
    """Paths of the pose of one view, by what `fit_camera` asks of its mask."""
    problem, (eye,) = pose.problem, pose.problem.eyes
    state = problem.start if here is None else here.descent.state
    solver, camera = eye.solver_at(state), eye.canonical(state)
    begin = None if start is None else eye.canonical(start)
    mask = replace(eye.mask, camera=on_film(camera, eye.mask.camera))
    silent = lambda news: None
    onward = lambda place: descend(
        problem, eye.with_camera(pose.name, place.camera, state), silent, [1]
    )
    if here is None:
        places = everywhere(solver, mask, silent)
        found = _keep_agreeing(problem, solver, mask, places, begin)
        paths = [onward(place) for place in found]
    else:
        now = Solution(camera, solver.look(camera), ())
        places = (
            looked_alike(solver, now, [])
            if begin is None
            else looked_round(solver, mask, now, begin, silent)
        )
        found = _keep_agreeing(problem, solver, mask, places, begin)
        others = [place for place in found if not _is_same(solver, place, now)]
        paths = [here.then(onward(place)) for place in others]
        # (From a start, what is as good and nearer to it comes first.)
        known = len(others) < len(found)
        first = begin is None or _is_same(solver, found[0], now)
        if first if known else not better(solver, places.best.view, now.view):
            paths = [here, *paths]
        elif known:
            paths.append(here)
    return paths, places.free


def _keep_agreeing(
    problem: JointProblem, solver: Solver, mask: Mask, places: Places, start: Camera | None
) -> list[Solution]:
    """The best place, and others: of masks with outliers those that agree with most of the outline,
    as `fit_camera` has it."""
    found, reach = [places.best, *places.others], problem.outlier_px
    if reach is None or places.best.view.touched_misfit <= RULES.exact * mask.usual_weight:
        return found
    refiner = Refiner.on(solver, mask, reach)
    candidates = refiner.candidates([*found, *places.rivals], start)
    kept = likeliest(candidates, min(len(found), len(candidates)), start)
    return [c.found._replace(view=c.whole) for c in kept]


def _is_same(solver: Solver, place: Solution, other: Solution) -> bool:
    near = separation(solver, place.camera, other.camera) < RULES.same
    return bool(near and not better(solver, place.view, other.view))


def _is_content(problem: JointProblem, path: Path) -> bool:
    """Whether a descent's end may be right: where masks are exact, whether they are explained, else
    whether it is at rest and the scenes lie on the masks."""
    views = [seen.view for seen in path.descent.seen]
    pairs = zip(problem.eyes, views, strict=True)
    # (Zeros that are not where they are sought explain no mask.)
    if all(eye.solver.kind.exact for eye in problem.eyes) and not problem.zeros:
        return all(is_explained(eye.solver, view) for eye, view in pairs)
    return path.descent.ended and iou_and_rms([v.sums for v in views])[0] >= LIKELY_IOU


def _search_together(pose: LonePose, state: State, tell: Tell) -> list[Path]:
    """Paths from the views' guesses that explain the masks best, the best first."""
    problem = pose.problem
    few = problem.few(LOOKED_AT)
    coarsest = replace(few, depth=few.levels)
    tried = _guesses(few, pose.name, state)
    tell(f"{len(tried)} guesses of {len(few.eyes)} views")

    def squares(state: State) -> float:
        total = float(sum(s.view.squares for s in coarsest.look(state)))
        return total if np.isfinite(total) else np.inf

    tried.sort(key=squares)
    paths = []
    for begin in _apart(few, tried, RULES.start)[: 2 * FOLLOWED]:
        there = coarsest.descend(begin, FIRST_STEPS, ROUGH_PX)
        ends = LevelEnd(begin, few.levels, 0), LevelEnd(there.state, few.levels, there.steps)
        paths.append(Path(there, ends))
    paths.sort(key=lambda path: path.squares)
    paths = _apart(few, paths, RULES.start)[:FOLLOWED]
    for level in range(few.levels, 0, -1):
        # (All views are looked at where few states are left.)
        part = few if level > 2 else problem
        paths = [p.then(descend(part, p.descent.state, tell, [level])) for p in paths]
        paths.sort(key=lambda p: p.squares)
        most = (RULES.times if level > 1 else 1 + RULES.little) * paths[0].squares
        best, *others = _apart(problem, paths, RULES.same)
        paths = [best, *(p for p in others if p.squares <= most)]
    return paths


def _best_paths(problem: JointProblem, paths: list[Path]) -> list[Path]:
    """The paths that explain the masks as well as the best of them, which stands first unless the
    first does as well; each once."""
    least = min(path.squares for path in paths)
    noise = sum(RULES.equal_times * eye.solver.kind.variance for eye in problem.eyes)
    good = [p for p in paths if p.squares <= (1 + RULES.little) * least + noise] or paths[:1]
    if good[0] is not paths[0]:
        good.sort(key=lambda p: p.squares)
    return _apart(problem, good, RULES.same)


def _lookalikes(pose: LonePose, best: Path, tell: Tell) -> list[Path]:
    """Paths from views that look like the best one: its object is near its own mirror image, or
    turned into itself."""
    problem, state = pose.problem, best.descent.state
    eye, few = problem.eyes[0], problem.few(LOOKED_AT)
    views = eye.solver.subject.alike.views(eye.canonical(state))
    alike = [eye.with_camera(pose.name, camera, state) for camera in views]
    coarse = replace(few, depth=min(problem.levels, 2))
    here = sum(seen.view.squares for seen in coarse.look(state))
    noise = sum(RULES.exact * float(seen.view.sums.touched) for seen in best.descent.seen)
    begun = [coarse.descend(other, FIRST_STEPS, ROUGH_PX) for other in alike[:ALIKE]]
    likely = [d.state for d in begun if d.squares <= RULES.times * here + noise]
    return [descend(problem, other, tell, range(coarse.depth, 0, -1)) for other in likely]


def _guesses(problem: JointProblem, name: str, state: State) -> list[State]:
    """States in which the searched pose is a guess of one of the views."""
    result = []
    for eye in problem.eyes:
        proposed = guesses(eye.mask, eye.solver.subject.scene, eye.solver.subject.ball)
        for guess in islice(distinct(proposed, RULES.start), TRIED):
            result.append(eye.with_camera(name, canonical(guess), state))
    return result


def _apart(problem: JointProblem, places: Sequence[P], apart: float) -> list[P]:
    """The states, or paths to these, whose cameras look other ways (rad) than those before."""
    state = lambda place: place.descent.state if isinstance(place, Path) else place
    camera = lambda place: problem.eyes[0].canonical(state(place))
    return [*distinct(places, apart, camera)]
