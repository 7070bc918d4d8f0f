"""The way of many views from coarse to fine, and to the end, where outliers lose their weight, and
photos refine: all learn their colours beside outlines that all views' camera gives."""

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from .._fit.photo import COLOURS, OF_MASK, Images, Outline, refine_on_photos
from .._rules import RULES
from .._solver.least_squares import Descent
from .._solver.looks import Sums
from .._solver.problem import COARSE_PX, FINE_PX
from .agreement import Agreement, agree, weigh_priors
from .system import JointProblem, LevelEnd
from .views import State

#: This many steps at most on a level that leads to finer ones. (An arm in three postures, 24 fits:
#: with 6 to 48 all end at the right place; most levels take 1 to 12, now and then one all of them.)
COARSE_STEPS = 24
#: An outline may lie this many times `outlier_px` from the mask's at first, then less.
REACHES = (8, 4, 2, 1)
#: A step that is negligible (px) at the end where masks err by more.
DRAWN_PX = 5e-3

Tell = Callable[[str], None]


class Path(NamedTuple):
    """A descent's end, and the way there from the start (0 steps)."""

    descent: Descent
    way: tuple[LevelEnd, ...]

    @property
    def steps(self) -> tuple[int, ...]:
        """The number of steps on each level."""
        return tuple(end.steps for end in self.way[1:])

    @property
    def squares(self) -> float:
        """The sum of squares, infinite where it is none."""
        return self.descent.squares if np.isfinite(self.descent.squares) else np.inf

    def then(self, further: "Path") -> "Path":
        """A further descent, with the steps of both."""
        return further._replace(way=self.way + further.way[1:])


def descend(
    problem: JointProblem,
    state: State,
    tell: Tell,
    depths: Sequence[int],
    px: float | None = None,
) -> Path:
    """The path from level to level; steps on the finest are negligible below this many px (None: as
    `problem.px` has it)."""
    way = [LevelEnd(state, depths[0], 0)]
    found = Descent(state, [], np.inf, 0, False)
    for depth in depths:
        least = (px or problem.px) if depth == 1 else COARSE_PX
        most = problem.max_steps if depth == 1 else min(problem.max_steps, COARSE_STEPS)
        found = replace(problem, depth=depth).descend(found.state, most, least)
        way.append(LevelEnd(found.state, depth, found.steps))
        left = f"{depth - 1} level{'s' * (depth != 2)} left"
        tell(f"{len(problem.eyes)} views: {found.steps} steps, {left}")
    return Path(found, tuple(way))


@dataclass(frozen=True, eq=False)
class _ManyViews:
    """The problem of masks and that of colours, and the path to where the unknowns are."""

    of_masks: JointProblem
    own: JointProblem
    path: Path

    def outline(self, k: int) -> Outline:
        return Outline.from_view(self.own.eyes[k].look(self.path.descent.state))

    def descended(
        self, images: Images, depths: Sequence[int], px: float, steps: int
    ) -> "_ManyViews":
        eyes = {}
        for k, image in images.items():
            eye = self.of_masks.eyes[k]
            colours = replace(eye, solver=eye.solver.like(COLOURS))
            eyes[k] = colours.weighed(*image, only_finest=max(depths) == 1)
        weights = _counts(self.of_masks, images) * self.of_masks.weights
        own = replace(self.of_masks.seeing(eyes), weights=weights)
        brief, silent = replace(own, max_steps=steps), lambda words: None
        further = descend(brief, self.path.descent.state, silent, depths, px)
        return replace(self, own=own, path=self.path.then(further))


def _counts(problem: JointProblem, photos: Container[int]) -> np.ndarray:
    """How much each view counts beside photos: a mask little."""
    return np.array([1.0 if k in photos else OF_MASK for k in range(len(problem.eyes))])


def agreement_on_photos(
    before: Agreement, path: Path, px: float, tell: Tell
) -> tuple[Agreement, Path, tuple[str, ...]]:
    """The agreement of photos, with the path to it and a note on each photo; that of masks, where
    no photo is better founded than its mask. Steps of `px` are negligible."""
    problem, eyes = before.problem, before.problem.eyes
    photos = {k: np.asarray(e.shot.photo) for k, e in enumerate(eyes) if e.shot.photo is not None}
    views = _ManyViews(problem, problem, path._replace(descent=before.descent))
    masks = {k: eyes[k].mask for k in photos}
    views, trusted, notes = refine_on_photos(views, masks, photos, px, tell)
    found, path = before, views.path
    if trusted:
        counts = _counts(problem, trusted)
        own = replace(views.own, weights=counts)
        end = own.descend(path.descent.state, own.max_steps, px)
        found = agree(own, end, px, counts)
        last = LevelEnd(found.descent.state, 1, found.descent.steps)
        path = path._replace(way=(*path.way, last))
    return found, path, tuple(f"view {k}: {notes[k]}" for k in sorted(notes))


class Outcome(NamedTuple):
    """The end of a path, and the views' agreement there.

    - `problem`: whose views look at their masks, or at their photos where these decided.
    - `whole`: the sums over all pixels of each mask.
    - `astray`: the share of each outline that is far from the mask's edge: no fit looked at it.
    - `notes`: what photos say, as sentences.
    """

    problem: JointProblem
    path: Path
    found: Agreement
    whole: list[Sums]
    astray: list[float]
    notes: tuple[str, ...]


def finish(problem: JointProblem, path: Path, tell: Tell, photos: bool = False) -> Outcome:
    """The end of a path to the finest level: where masks are not exact, pixels far from their edges
    lose their weight, and views that err by more than most count less. Then views are refined on
    `photos`, if that is asked for."""
    eyes, reach, near = problem.eyes, problem.outlier_px, problem
    misfits = [seen.view.touched_misfit for seen in path.descent.seen]
    inexact = [k for k, misfit in enumerate(misfits) if misfit > RULES.exact]
    px = DRAWN_PX if inexact else FINE_PX[problem.dtype]
    if reach is None or not inexact:
        path = path.then(descend(problem, path.descent.state, tell, [1], px))
    else:
        for times in REACHES:
            edges = {k: eyes[k].mask.near_edge(times * reach) for k in inexact}
            near = problem.seeing({k: eyes[k].weighed(edges[k], only_finest=True) for k in inexact})
            near = weigh_priors(near, path.descent) if times == 1 else near
            last = px if times == 1 else COARSE_PX
            path = path.then(descend(near, path.descent.state, tell, [1], last))

    by_masks = agree(near, path.descent, px)
    whole = [eye.look(by_masks.descent.state).sums for eye in eyes]
    counted = [float(seen.view.sums.touched) for seen in by_masks.descent.seen]
    touched = [float(sums.touched) for sums in whole]
    astray = [1 - n / t if t else 0.0 for n, t in zip(counted, touched, strict=True)]
    if not photos:
        return Outcome(problem, path, by_masks, whole, astray, ())

    found, path, notes = agreement_on_photos(by_masks, path, px, tell)
    if found is not by_masks:
        whole = [eye.look(found.descent.state).sums for eye in eyes]
    kept = zip(found.problem.eyes, near.eyes, eyes, strict=True)
    decided = [mask if eye is looked else eye for eye, looked, mask in kept]
    return Outcome(replace(problem, eyes=decided), path, found, whole, astray, notes)
