"""What one view's mask leaves open, where other views share unknowns with it.

After a joint descent each view is asked what a fit of its own asks: whether walks along nearly free
moves, or views that look alike, explain its mask as well or better. What the other views know of
the shared unknowns is among its residuals then, linear in these: so no place counts that other
intrinsics alone make as good.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from .._camera.camera import Camera
from .mask import Mask
from .moves import on_film
from .parameters import LABELS, labels_of
from .places import APART, EQUAL_TIMES, Places, better, separation, settled
from .priors import Others, no_others
from .problem import View
from .shared_unknowns import alike, beside, descend, others, reduced, with_rows
from .solver import Found, Solver, Stop
from .strategy import finished, looked_alike, looked_round, with_others

#: So often at most all views are asked again, since one of them is better elsewhere.
ROUNDS = 3


class OneView(NamedTuple):
    """One view: its mask (with the camera as given), the mask's solver, and the camera so far; the
    start (canonical), if it has one, and other cameras that a fit of its own found."""

    mask: Mask
    solver: Solver
    unit: Camera
    start: Camera | None = None
    modes: Sequence[Camera] = ()

    def level(self, depth: int) -> int:
        """Return the number of the level this far from the last, or of the first."""
        return max(len(self.solver.levels) - depth, 0)

    def look(self, depth: int) -> View:
        """Return the view on a level."""
        return self.solver.look(self.unit, self.level(depth))

    def stepped(self, depth: int, y: np.ndarray) -> "OneView":
        """Return the view after a step in its own units."""
        return self._replace(unit=self.solver.step(self.unit, self.level(depth), y))


class Answer(NamedTuple):
    """Where a view's camera may be, and what the others knew when it was asked."""

    places: Places
    others: Others


def asked(
    views: list[OneView],
    seen: list[View],
    own: np.ndarray,
    common: tuple[str, ...],
    max_steps: int,
) -> tuple[list[OneView], list[View], list[Answer]]:
    """Return the views after a descent, what is seen on the last level, and each view's answer.

    Where one is better elsewhere, all descend from there together, and are asked again. If that is
    worse for all together, they stay, and the place is one of that view's others.
    """
    answers = _answers(views, seen, own)
    for _ in range(ROUNDS):
        best = [answer.places.best.unit for answer in answers]
        if all(unit is one.unit for unit, one in zip(best, views, strict=True)):
            break
        units = alike(best, common)
        moved = [one._replace(unit=unit) for one, unit in zip(views, units, strict=True)]
        moved, there, _ = descend(moved, 1, own, max_steps, views[0].solver.dtype)
        if not _squares(there) <= _squares(seen) + _noise(views, seen):
            break
        views, seen = moved, there
        answers = _answers(views, seen, own)
    held = [_held(*each) for each in zip(answers, views, seen, strict=True)]
    return views, seen, held


def _squares(seen: list[View]) -> float:
    return sum(view.squares for view in seen)


def _noise(views: list[OneView], seen: list[View]) -> float:
    """Return by how much sums of squares of equal places may differ."""
    pairs = zip(views, seen, strict=True)
    variances = (max(one.solver.kind.variance, view.touched_misfit) for one, view in pairs)
    return EQUAL_TIMES * max(variances)


def _held(answer: Answer, one: OneView, view: View) -> Answer:
    """Return the answer with the view's camera as the best, and another best among the others."""
    best, others, free, _ = answer.places
    if best.unit is one.unit:
        return answer
    return answer._replace(places=Places(Found(one.unit, view, ()), [best, *others], free))


def _answers(views: list[OneView], seen: list[View], own: np.ndarray) -> list[Answer]:
    if not all(np.all(np.isfinite(view.triangle)) for view in seen):
        names, dtype = views[0].solver.names, views[0].solver.dtype
        found = (Found(one.unit, view, ()) for one, view in zip(views, seen, strict=True))
        return [Answer(Places(f, [], []), no_others(names, dtype)) for f in found]
    parts = [reduced(view, own, 0.0) for view in seen]
    slopes = [part.rest.T @ part.left for part in parts]
    total: Any = sum(slopes)
    rests = others([part.rest for part in parts])
    return [
        _answer(one, view, *beside(view, rest, total - slope, own))
        for one, view, rest, slope in zip(views, seen, rests, slopes, strict=True)
    ]


def _answer(one: OneView, view: View, rows: np.ndarray, left: np.ndarray) -> Answer:
    """Return where a view's camera may be, given residuals `rows y + left` of the others."""
    solver, known = one.solver, _of_values(one, view, rows, left)
    found = Found(one.unit, with_rows(view, rows, left), ())
    solver.hear(known)
    if one.start is None:
        places = looked_alike(solver, found, finished(solver, one.modes))
    else:
        mask = replace(one.mask, camera=on_film(one.unit, one.mask.camera))
        places = looked_round(solver, mask, found, one.start, _untold)
    places = _kept(solver, places, found, one.start)
    solver.hear(None)
    return Answer(places, known)


def _of_values(one: OneView, view: View, rows: np.ndarray, left: np.ndarray) -> Others:
    """Return residuals that are linear in a view's moves as such that are linear in what is
    reported of the camera."""
    shared = np.any(rows != 0, axis=0)
    values = [LABELS[label].value for label in labels_of(one.solver.names)]
    at = [float(of(one.unit)) if of and s else 0.0 for of, s in zip(values, shared, strict=True)]
    by_moves = np.where(np.outer(shared, shared), np.asarray(view.to_reported, float), 0.0)
    to = lambda x: jnp.asarray(x, one.solver.dtype)
    return Others(to(rows @ np.linalg.pinv(by_moves)), to(at), to(left))


def _kept(solver: Solver, places: Places, found: Found, start: Camera | None) -> Places:
    """Return the places with the camera so far as the best, unless another one is better, or as
    good and nearer to the start."""
    best, *others = places.best, *places.others
    here = [f for f in (best, *others) if _is(solver, f, found)]
    if not here:
        if better(solver, best.view, found.view):
            return places
        return with_others(solver, settled(solver, found, start), [best, *others])
    if start is not None and here[0] is not best:
        return places
    elsewhere = [f for f in (best, *others) if f is not here[0]]
    return places._replace(best=found, others=elsewhere)


def _is(solver: Solver, place: Found, found: Found) -> bool:
    """Return whether a place is where a view is, and no better."""
    near = separation(solver, place.unit, found.unit) < APART
    return bool(near and not better(solver, place.view, found.view))


def _untold(stop: Stop) -> None:
    del stop
