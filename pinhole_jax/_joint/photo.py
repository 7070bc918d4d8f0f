"""Views of a joint fit refined on their photos: what colours tell stands in for the masks.

Each view learns its own colours beside its own outline, where all views' camera puts it; the mattes
that they make are fitted together, and learned again closer to the outline. A view whose colours
tell too little, or whose photo is no better founded than its mask, keeps the mask.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

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
from .agreement import Agreement, agreed
from .descent import Layout, descend
from .problem import JointProblem
from .views import Eye, State

#: Beside a photo that tells as much as one alone has to, others tell of the camera where they do so
#: along this share of the outline: of something else they would not fit the other's camera.
LEAST_BESIDE = LEAST_RESOLVED / 2
#: The first round begins on the level that is this many from the finest (1: that one itself).
FIRST_DEPTH = 3


class OnPhotos(NamedTuple):
    """What photos lead to: the problem whose views look at them, how far these agree, the steps,
    and what each photo says, as sentences."""

    problem: JointProblem
    found: Agreement
    steps: tuple[int, ...]
    words: tuple[str, ...]


def on_photos(
    problem: JointProblem, before: Agreement, px: float, tell: Callable[[str], None]
) -> OnPhotos:
    """Return what photos make of the answer `before`, that of masks; steps of `px` are negligible.

    The problem is the one that was given where no photo is better founded than its mask.
    """
    of_masks, begun = problem.layout, before.descent.state
    photos = {k: eye.photo for k, eye in enumerate(of_masks.eyes) if eye.photo is not None}
    first = _outlines(of_masks, begun, photos)
    resolved = {
        k: first[k].resolved(first[k].read(photo, of_masks.eyes[k].mask, ROUNDS[0]))
        for k, photo in photos.items()
    }
    alone = max(resolved.values(), default=0.0) < LEAST_RESOLVED
    least = LEAST_RESOLVED if alone else LEAST_BESIDE
    telling = {k: photos[k] for k, share in resolved.items() if share >= least}
    words = {k: unresolved(share) for k, share in resolved.items() if k not in telling}
    found, steps = before, ()
    while telling:
        layout = of_masks.seeing({k: _on_photo(of_masks.eyes[k]) for k in telling})
        counts = np.array([1.0 if k in telling else OF_MASK for k in range(len(layout.eyes))])
        weights = counts * before.weights
        given = layout, telling, first, begun
        layout, state, now, further = _followed(*given, weights, px, tell)
        steps += further
        left = _trusted(layout, telling, first, now, least, words)
        if len(left) == len(telling):
            problem = problem._replace(layout=layout)
            there = descend(layout, state, 1, counts, problem.max_steps, px)
            found = agreed(layout, there, problem.max_steps, px, counts)
            steps += (found.descent.steps,)
            break
        telling = left
    said = tuple(f"view {k}: {words[k]}" for k in sorted(words))
    return OnPhotos(problem, found, steps, said)


def _trusted(
    layout: Layout,
    photos: dict[int, np.ndarray],
    first: dict[int, Outline],
    now: dict[int, Outline],
    least: float,
    words: dict[int, str],
) -> dict[int, np.ndarray]:
    """Return the photos that are better founded than their masks, or may be without others; say
    why in `words`."""
    wrong = {}
    for k, photo in photos.items():
        mask = layout.eyes[k].mask
        better, words[k] = judged(mask, photo, first[k], now[k], least)
        if not better:
            wrong[k] = now[k].off(now[k].read(photo, mask, ROUNDS[-1]))
    # (Photos of something else pull at the others: these may be right without them.)
    strange = sorted((k for k in wrong if wrong[k] >= STRANGE_PX), key=wrong.__getitem__)
    out = strange[len(strange) // 2 :] or wrong
    return {k: photo for k, photo in photos.items() if k not in out}


def _followed(
    layout: Layout,
    photos: dict[int, np.ndarray],
    now: dict[int, Outline],
    state: State,
    weights: np.ndarray,
    px: float,
    tell: Callable[[str], None],
) -> tuple[Layout, State, dict[int, Outline], tuple[int, ...]]:
    """Return where colours lead to, learned round by round: the layout that looks at the last of
    them, the state, the outlines there, and the steps."""
    steps = []
    depths = range(FIRST_DEPTH, 0, -1)
    for number, band in enumerate(ROUNDS):
        last = number == len(ROUNDS) - 1
        looking = {}
        for k, photo in photos.items():
            eye = layout.eyes[k]
            read = now[k].read(photo, eye.mask, band)
            looking[k] = eye.weighed(*whole(eye.mask, now[k].window, read))
        layout = layout.seeing(looking)
        for depth in (1,) if number else depths:
            least = COARSE_PX if depth > 1 else px if last else max(px, ROUGH_PX)
            most = LAST_STEPS if last else STEPS
            there = descend(layout, state, depth, weights, most, least)
            state = there.state
            steps.append(there.steps)
        now = _outlines(layout, state, photos)
        tell(f"{len(photos)} photos: round {number + 1} of {len(ROUNDS)}")
    return layout, state, now, tuple(steps)


def _on_photo(eye: Eye) -> Eye:
    """Return an eye for the photo's matte."""
    return replace(eye, solver=eye.solver.like(COLOURS))


def _outlines(layout: Layout, state: State, photos: dict[int, np.ndarray]) -> dict[int, Outline]:
    """Return what views with photos show near their outlines."""
    result = {}
    for k in photos:
        eye = layout.eyes[k]
        result[k] = Outline.of(eye.solver, eye.look(state))
    return result
