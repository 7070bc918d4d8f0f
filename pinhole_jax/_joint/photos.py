"""Views of a joint fit refined on their photos: all learn their colours beside outlines that all
views' camera gives, and the mattes are fitted together."""

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._fit.photo import COLOURS, OF_MASK, Images, Outline, refine_on_photos
from .._solver.problem import COARSE_PX
from .agreement import Agreement, agree
from .system import JointProblem, LevelEnd
from .views import State


@dataclass(frozen=True, eq=False)
class _ManyViews:
    """The problem of masks and that of colours, where the unknowns are, and the way there."""

    of_masks: JointProblem
    own: JointProblem
    state: State
    way: list[LevelEnd]

    def outline(self, k: int) -> Outline:
        return Outline.from_view(self.own.eyes[k].look(self.state))

    def descended(
        self, images: Images, depths: Sequence[int], px: float, steps: int
    ) -> "_ManyViews":
        eyes, state, way = {}, self.state, self.way
        for k, image in images.items():
            eye = self.of_masks.eyes[k]
            colours = replace(eye, solver=eye.solver.like(COLOURS))
            eyes[k] = colours.weighed(*image, only_finest=max(depths) == 1)
        weights = _counts(self.of_masks, images) * self.of_masks.weights
        own = replace(self.of_masks.seeing(eyes), weights=weights)
        for depth in depths:
            least = px if depth == 1 else COARSE_PX
            there = replace(own, depth=depth).descend(state, steps, least)
            state, way = there.state, [*way, LevelEnd(there.state, depth, there.steps)]
        return replace(self, own=own, state=state, way=way)


def _counts(problem: JointProblem, photos: Container[int]) -> np.ndarray:
    """How much each view counts beside photos: a mask little."""
    return np.array([1.0 if k in photos else OF_MASK for k in range(len(problem.eyes))])


def agreement_on_photos(
    before: Agreement, px: float, tell: Callable[[str], None]
) -> tuple[Agreement, list[LevelEnd], tuple[str, ...]]:
    """The agreement of photos, with the way to it and a note on each photo; that of masks, where
    no photo is better founded than its mask. Steps of `px` are negligible."""
    problem, eyes = before.problem, before.problem.eyes
    photos = {k: np.asarray(e.shot.photo) for k, e in enumerate(eyes) if e.shot.photo is not None}
    views = _ManyViews(problem, problem, before.descent.state, [])
    masks = {k: eyes[k].mask for k in photos}
    views, trusted, notes = refine_on_photos(views, masks, photos, px, tell)
    found, way = before, views.way
    if trusted:
        counts = _counts(problem, trusted)
        own = replace(views.own, weights=counts)
        found = agree(own, own.descend(views.state, own.max_steps, px), px, counts)
        way = [*way, LevelEnd(found.descent.state, 1, found.descent.steps)]
    return found, way, tuple(f"view {k}: {notes[k]}" for k in sorted(notes))
