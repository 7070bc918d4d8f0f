"""Where one camera of many views may be, with no start: guesses of all views, held to all masks.

What one view alone leaves open, the others tell: guesses are ranked, and followed, together.
"""

import numpy as np

from .._camera.axes import angle
from .._camera.camera import Camera
from .._camera.poses import pose_of
from .joint_descent import Layout, descend
from .joint_problem import JointProblem, Path, Tell, depth_of, descended
from .joint_views import State
from .problem import COARSE_PX
from .search import guesses
from .strategy import EQUAL, SAME

#: Of each view so many guesses are tried, so far apart (rad), and so many of all followed further.
TRIED, APART, FOLLOWED = 12, np.deg2rad(15), 6
#: Steps on the coarsest level at first; what leaves so many times the least squares is given up.
FIRST_STEPS, WORSE = 8, 4.0


def searched_jointly(problem: JointProblem, tell: Tell) -> list[Path]:
    """Return where the views' guesses lead to that explain the masks best, the best first."""
    layout = problem.layout
    moving = problem.searchable()
    assert moving is not None
    tried: list[State] = []
    for eye in layout.eyes:
        of_view: list[Camera] = []
        for guess in guesses(eye.mask, eye.solver.problem.scene, eye.solver.ball):
            if all(angle(guess, other) > APART for other in of_view):
                of_view.append(guess)
                pose = eye.carried(pose_of(guess), problem.start)
                tried.append(problem.start._replace(poses={**problem.start.poses, moving: pose}))
            if len(of_view) == TRIED:
                break
    depth, ones = depth_of(problem), np.ones(len(layout.eyes))
    tell(f"{len(tried)} guesses")
    squares = lambda seen: float(sum(s.view.squares for s in seen))
    likely = sorted(tried, key=lambda state: _or_infinite(squares(layout.look(state, depth))))
    begun = [
        descend(layout, state, depth, ones, FIRST_STEPS, COARSE_PX)
        for state in _apart(layout, likely)[: 2 * FOLLOWED]
    ]
    begun = sorted(begun, key=lambda d: _or_infinite(d.squares))
    distinct = _apart(layout, [d.state for d in begun])[:FOLLOWED]
    paths = [Path(d, (d.steps,)) for d in begun if any(d.state is s for s in distinct)]
    for level in range(depth, 0, -1):
        further = [descended(problem, p.descent.state, tell, [level]) for p in paths]
        paths = [p.then(f) for p, f in zip(paths, further, strict=True)]
        paths = sorted(paths, key=lambda p: _or_infinite(p.descent.squares))
        least = paths[0].descent.squares
        times = WORSE if level > 1 else 1 + EQUAL
        kept = _apart(layout, [p.descent.state for p in paths], SAME)
        paths = [
            p
            for k, p in enumerate(paths)
            if k == 0
            or (any(p.descent.state is s for s in kept) and p.descent.squares <= times * least)
        ]
    return paths


def _or_infinite(x: float) -> float:
    return x if np.isfinite(x) else np.inf


def _apart(layout: Layout, states: list[State], apart: float = APART) -> list[State]:
    """Return the states whose cameras look other ways than those before them."""
    kept: list[State] = []
    for state in states:
        of = lambda s: layout.eyes[0].unit(s)
        if all(angle(of(state), of(other)) > apart for other in kept):
            kept.append(state)
    return kept
