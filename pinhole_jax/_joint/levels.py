"""The way of many views from coarse to fine, and to the end, where outliers lose their weight, and
photos refine: all learn their colours beside outlines that all views' camera gives."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from .._files.progress import say
from .._fit.photo import COLOURS, OF_MASK, Images, Outline, refine_on_photos
from .._fit.result import share_astray
from .._rules import RULES
from .._solver.looks import Sums
from .._solver.problem import COARSE_PX, FINE_PX
from .agreement import Agreement, agree, weigh_priors
from .system import Descent, JointProblem, LevelEnd
from .views import State

#: This many steps at most on a level that leads to finer ones. (An arm in three postures, 24 fits:
#: with 6 to 48 all end at the right place; most levels take 1 to 12, now and then one all of them.)
COARSE_STEPS = 24
#: An outline may lie this many times `outlier_px` from the mask's at first, then less.
REACHES = (8, 4, 2, 1)
#: A step that is negligible (px) at the end where masks err by more.
DRAWN_PX = 5e-3
#: With the zeros of joints a fit goes on from this many levels before the finest. (Zeros off by 3
#: degrees, one sigma, six robots: from 1 to 4 all are found, in the same time to a tenth.)
ZEROS_FROM = 3


def descend(
    problem: JointProblem, state: State, depths: Sequence[int], px: float | None = None
) -> Descent:
    """The descent from level to level, nothing seen yet where there is none; steps on the finest
    are negligible below this many px (None: as `problem.px` has it)."""
    found = Descent(state, [], np.inf, 0, False, (LevelEnd(state, max(depths, default=0), 0),))
    for depth in depths:
        least = (px or problem.px) if depth == 1 else COARSE_PX
        most = problem.max_steps if depth == 1 else min(problem.max_steps, COARSE_STEPS)
        found = found.then(replace(problem, depth=depth).descend(found.state, most, least))
        left = f"{depth - 1} level{'s' * (depth != 2)} left"
        say(f"{len(problem.eyes)} views: {found.steps} steps, {left}")
    return found


def agreement_on_photos(before: Agreement, px: float) -> tuple[Agreement, tuple[str, ...]]:
    """The agreement of photos, with a note on each; that of masks, where no photo is better founded
    than its mask. Steps of `px` are negligible."""
    problem, eyes = before.problem, before.problem.eyes
    photos = {k: np.asarray(e.shot.photo) for k, e in enumerate(eyes) if e.shot.photo is not None}
    # (Beside photos a mask counts little.)
    counts = lambda some: np.array([1.0 if k in some else OF_MASK for k in range(len(eyes))])

    def outline(there: tuple[JointProblem, Descent], k: int) -> Outline:
        return Outline.from_view(there[0].eyes[k].look(there[1].state))

    def descended(
        there: tuple[JointProblem, Descent],
        images: Images,
        depths: Sequence[int],
        px: float,
        steps: int,
    ) -> tuple[JointProblem, Descent]:
        colours = {k: replace(eyes[k].solver, kind=COLOURS) for k in images}
        is_fine = max(depths) == 1
        own = problem.seeing({k: x.weighed(*images[k], is_fine) for k, x in colours.items()})
        own = replace(own, weights=counts(images) * problem.weights)
        brief = replace(own, max_steps=steps)
        return own, there[1].then(descend(brief, there[1].state, depths, px))

    begin, masks = (problem, before.descent), {k: eyes[k].mask for k in photos}
    (own, end), trusted, notes = refine_on_photos(begin, outline, descended, masks, photos, px, say)
    found = before
    if trusted:
        own = replace(own, weights=counts(trusted))
        end = end.then(own.descend(end.state, own.max_steps, px))
        found = agree(own, end, px)
    return found, tuple(f"view {k}: {notes[k].words}" for k in sorted(notes))


class Outcome(NamedTuple):
    """The end of a descent, and the views' agreement there.

    - `problem`: whose views look at all of their masks.
    - `whole`: the sums over all pixels of each mask.
    - `astray`: the share of each outline that is far from the mask's edge: no fit looked at it.
    - `notes`: what photos say, as sentences.
    """

    problem: JointProblem
    found: Agreement
    whole: list[Sums]
    astray: list[float]
    notes: tuple[str, ...] = ()


def finish(problem: JointProblem, path: Descent, photos: bool = False) -> Outcome:
    """The end of a descent to the finest level: zeros of joints are sought, too; where masks are
    not exact, pixels far from their edges lose their weight, and views that err by more than most
    count less. Then views are refined on `photos`, if that is asked for."""
    if problem.zeros:
        problem = problem.with_zeros()
        state = path.state._replace(zeros=problem.start.zeros)
        depths = range(min(problem.levels, ZEROS_FROM), 0, -1)
        path = path.then(descend(problem, state, depths))
    eyes, reach, near = problem.eyes, problem.outlier_px, problem
    inexact = [k for k, seen in enumerate(path.seen) if seen.view.touched_misfit > RULES.exact]
    exact = any(eye.solver.kind.exact for k, eye in enumerate(eyes) if k not in inexact)
    px = FINE_PX[problem.dtype] if exact or not inexact else DRAWN_PX
    if reach is None or not inexact:
        path = path.then(descend(problem, path.state, [1], px))
    else:
        for times in REACHES:
            edges = {k: eyes[k].mask.near_edge(times * reach) for k in inexact}
            weighed = {k: eyes[k].solver.weighed(x, only_finest=True) for k, x in edges.items()}
            near = problem.seeing(weighed)
            near = weigh_priors(near, path) if times == 1 else near
            path = path.then(descend(near, path.state, [1], px if times == 1 else COARSE_PX))

    by_masks = agree(near, path, px)
    whole = [eye.look(by_masks.descent.state).sums for eye in eyes]
    near = (seen.view.sums for seen in by_masks.descent.seen)
    astray = [*map(share_astray, near, whole)]
    if not photos:
        return Outcome(problem, by_masks, whole, astray)

    found, notes = agreement_on_photos(by_masks, px)
    if found is not by_masks:
        whole = [eye.look(found.descent.state).sums for eye in eyes]
    return Outcome(problem, found, whole, astray, notes)
