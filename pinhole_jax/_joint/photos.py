"""Views of a joint fit refined on their photos: colours stand in for the masks.

Each view learns its own colours beside its own outline, where all views' camera puts it; the mattes
that they make are fitted together, and learned again closer to the outline. A view whose colours
tell too little, or whose photo is no better founded than its mask, keeps the mask.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .._fit.photo import (
    COLOURS,
    LAST_STEPS,
    LEAST_RESOLVED,
    OF_MASK,
    ROUGH_PX,
    ROUNDS,
    STEPS,
    STRANGE_PX,
    Outline,
    judged,
    unresolved,
    whole,
)
from .._solver.problem import COARSE_PX
from .agreement import Agreement, agree
from .system import JointProblem, LevelEnd
from .views import State

#: Beside a photo that tells as much as one alone has to, others tell of the camera where they do so
#: along this share of the outline: of something else they would not fit the other's camera.
LEAST_BESIDE = LEAST_RESOLVED / 2
#: The first round begins on the level that is this many from the finest (1: that one itself).
FIRST_DEPTH = 3


Photos = dict[int, np.ndarray]
Outlines = dict[int, Outline]


def refine_on_photos(
    before: Agreement, px: float, tell: Callable[[str], None]
) -> tuple[Agreement, list[LevelEnd], tuple[str, ...]]:
    """The agreement of photos, with the way to it and a note on each photo; that of masks, where
    no photo is better founded than its mask. Steps of `px` are negligible."""
    of_masks, begin = before.problem, before.descent.state
    eyes = of_masks.eyes
    photos = {k: np.asarray(e.shot.photo) for k, e in enumerate(eyes) if e.shot.photo is not None}
    first = _outlines(of_masks, begin, photos)
    shares = {
        k: first[k].resolved(first[k].read(photo, eyes[k].mask, ROUNDS[0]))
        for k, photo in photos.items()
    }
    alone = max(shares.values(), default=0.0) < LEAST_RESOLVED
    least = LEAST_RESOLVED if alone else LEAST_BESIDE
    notes = {k: unresolved(share) for k, share in shares.items() if share < least}
    photos = {k: photo for k, photo in photos.items() if k not in notes}

    found, way = before, []
    while photos:
        on_photo = {k: replace(eyes[k], solver=eyes[k].solver.like(COLOURS)) for k in photos}
        counts = np.array([1.0 if k in photos else OF_MASK for k in range(len(eyes))])
        weights = counts * of_masks.weights
        problem = replace(of_masks.seeing(on_photo), weights=weights)
        problem, now, further = _learn(problem, photos, first, begin, px, tell)
        way += further
        trusted = _trust(problem, photos, first, now, least, notes)
        if len(trusted) == len(photos):
            alike = replace(problem, weights=counts)
            there = alike.descend(way[-1].state, problem.max_steps, px)
            found = agree(problem, there, px, counts)
            way.append(LevelEnd(found.descent.state, 1, found.descent.steps))
            break
        photos = trusted
    return found, way, tuple(f"view {k}: {notes[k]}" for k in sorted(notes))


def _trust(
    problem: JointProblem,
    photos: Photos,
    first: Outlines,
    now: Outlines,
    least: float,
    notes: dict[int, str],
) -> Photos:
    """The photos that are better founded than their masks, or may be without others; `notes` say
    why."""
    wrong = {}
    for k, photo in photos.items():
        mask = problem.eyes[k].mask
        better, notes[k] = judged(mask, photo, first[k], now[k], least)
        if not better:
            wrong[k] = now[k].off(now[k].read(photo, mask, ROUNDS[-1]))
    # (Photos of something else pull at the others: these may be right without them.)
    strange = sorted((k for k in wrong if wrong[k] >= STRANGE_PX), key=wrong.__getitem__)
    out = strange[len(strange) // 2 :] or wrong
    return {k: photo for k, photo in photos.items() if k not in out}


def _learn(
    problem: JointProblem,
    photos: Photos,
    now: Outlines,
    state: State,
    px: float,
    tell: Callable[[str], None],
) -> tuple[JointProblem, Outlines, list[LevelEnd]]:
    """The problem that looks at the last of the colours that are learned round by round; the
    outlines where they lead to, and the way there."""
    way = []
    for number, band in enumerate(ROUNDS):
        last = number == len(ROUNDS) - 1
        looking = {}
        for k, photo in photos.items():
            eye = problem.eyes[k]
            read = now[k].read(photo, eye.mask, band)
            looking[k] = eye.weighed(*whole(eye.mask, now[k].window, read))
        problem = problem.seeing(looking)
        for depth in (1,) if number else range(FIRST_DEPTH, 0, -1):
            least = COARSE_PX if depth > 1 else px if last else max(px, ROUGH_PX)
            level, most = replace(problem, depth=depth), LAST_STEPS if last else STEPS
            there = level.descend(state, most, least)
            state = there.state
            way.append(LevelEnd(state, depth, there.steps))
        now = _outlines(problem, state, photos)
        tell(f"{len(photos)} photos: round {number + 1} of {len(ROUNDS)}")
    return problem, now, way


def _outlines(problem: JointProblem, state: State, photos: Photos) -> Outlines:
    eyes = {k: problem.eyes[k] for k in photos}
    return {k: Outline.from_view(eye.solver, eye.look(state)) for k, eye in eyes.items()}
