"""Where one camera (or object) of many views may be, with no start: guesses of all views, held to
all masks.

What one view alone leaves open, the others tell: guesses are ranked, and followed, together.
"""

import numpy as np

from .._camera.axes import angle
from .._camera.camera import Camera
from .._camera.poses import pose_of
from .._fit.places import EQUAL_TIMES, mirrored
from .._fit.strategy import EQUAL, EXACT, ROUGH_PX, SAME
from .._mask.search import guesses
from .._solver.solver import Found
from .descent import Layout, descend
from .levels import Path, Tell, depth_of, descended
from .problem import JointProblem
from .views import State

#: Of each view this many guesses are tried, so far apart (rad), and this many of all followed
#: further. (Before an arm 4 and 2 find all of 8 cameras as well, in half the time, 1.6 for 3.0 s;
#: the rest is for parts that look alike from several sides.)
TRIED, APART, FOLLOWED = 12, np.deg2rad(15), 4
#: This many views that look alike are tried at most.
ALIKE = 6
#: This many views are looked at before few states are left.
LOOKED_AT = 4
#: Steps on the coarsest level at first; what leaves this many times the least squares is given up.
FIRST_STEPS, WORSE = 8, 4.0


def searched_jointly(problem: JointProblem, tell: Tell) -> list[Path]:
    """Return where the views' guesses lead to that explain the masks best, the best first."""
    few = problem.few(LOOKED_AT)
    depth, ones = depth_of(few), np.ones(len(few.layout.eyes))
    tried = _guessed(few)
    tell(f"{len(tried)} guesses of {len(ones)} views")

    def squares(state: State) -> float:
        seen = few.layout.look(state, depth)
        return _or_infinite(float(sum(s.view.squares for s in seen)))

    likely = _apart(few.layout, sorted(tried, key=squares))[: 2 * FOLLOWED]
    begun = [descend(few.layout, state, depth, ones, FIRST_STEPS, ROUGH_PX) for state in likely]
    begun = sorted(begun, key=lambda d: _or_infinite(d.squares))
    distinct = _apart(few.layout, [d.state for d in begun])[:FOLLOWED]
    paths = [Path(d, (d.steps,)) for d in begun if any(d.state is s for s in distinct)]
    for level in range(depth, 0, -1):
        # (All views are looked at where few states are left.)
        part = few if level > 2 else problem
        further = [descended(part, p.descent.state, tell, [level]) for p in paths]
        paths = [p.then(f) for p, f in zip(paths, further, strict=True)]
        paths = sorted(paths, key=lambda p: _or_infinite(p.descent.squares))
        least = paths[0].descent.squares
        times = WORSE if level > 1 else 1 + EQUAL
        distinct = _apart(problem.layout, [p.descent.state for p in paths], SAME)
        likely = [p for p in paths if any(p.descent.state is s for s in distinct)]
        paths = [p for p in likely if p is paths[0] or p.descent.squares <= times * least]
    return paths


def equally_good(problem: JointProblem, paths: list[Path]) -> list[Path]:
    """Return the ends of descents that explain the masks as well as the best of them, which stands
    first unless the first does as well; each once."""
    least = min(_or_infinite(p.descent.squares) for p in paths)
    noise = sum(EQUAL_TIMES * eye.solver.kind.variance for eye in problem.layout.eyes)
    limit = (1 + EQUAL) * least + noise
    good = [p for p in paths if _or_infinite(p.descent.squares) <= limit] or paths[:1]
    if good[0] is not paths[0]:
        good.sort(key=lambda p: p.descent.squares)
    distinct = _apart(problem.layout, [p.descent.state for p in good], SAME)
    return [p for p in good if any(p.descent.state is state for state in distinct)]


def looking_alike(problem: JointProblem, best: Path, tell: Tell) -> list[Path]:
    """Return where views lead to that look like the best one: its object is near its own mirror
    image, or turned into itself."""
    moving = problem.searchable()
    if moving is None:
        return []
    eye, state = problem.layout.eyes[0], best.descent.state
    found = Found(eye.canonical(state), best.descent.seen[0].view, ())
    alike = [eye.at(moving, pose_of(c), state) for c in mirrored(eye.solver, found)]
    few, depth = problem.few(LOOKED_AT), min(depth_of(problem), 2)
    ones = np.ones(len(few.layout.eyes))
    here = sum(seen.view.squares for seen in few.layout.look(state, depth))
    noise = sum(EXACT * float(seen.view.sums.touched) for seen in best.descent.seen)
    likely = []
    for other in alike[:ALIKE]:
        begun = descend(few.layout, other, depth, ones, FIRST_STEPS, ROUGH_PX)
        if _or_infinite(begun.squares) <= WORSE * here + noise:
            likely.append(begun.state)
    depths = range(depth, 0, -1)
    return [descended(problem, other, tell, depths) for other in likely]


def _guessed(problem: JointProblem) -> list[State]:
    """Return states in which the searched pose is a guess of one of the views."""
    moving, start = problem.searchable(), problem.start
    assert moving is not None
    result = []
    for eye in problem.layout.eyes:
        seen: list[Camera] = []
        for guess in guesses(eye.mask, eye.solver.subject.scene, eye.solver.subject.ball):
            if len(seen) == TRIED:
                break
            if all(angle(guess, other) > APART for other in seen):
                seen.append(guess)
                result.append(eye.at(moving, pose_of(guess), start))
    return result


def _or_infinite(x: float) -> float:
    return x if np.isfinite(x) else np.inf


def _apart(layout: Layout, states: list[State], apart: float = APART) -> list[State]:
    """Return the states whose cameras look other ways than those before them."""
    distinct: list[tuple[State, Camera]] = []
    for state in states:
        camera = layout.eyes[0].canonical(state)
        if all(angle(camera, other) > apart for _, other in distinct):
            distinct.append((state, camera))
    return [state for state, _ in distinct]
