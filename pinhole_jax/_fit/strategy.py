"""Which cameras a fit tries, and which of those that it finds it keeps."""

from collections.abc import Callable, Iterable
from functools import partial
from itertools import islice, tee
from typing import Any

import numpy as np

from .._camera.axes import angle, axes_of, distinct, one_of_each
from .._camera.camera import Camera
from .._mask.mask import Mask
from .._mask.search import aimed, guesses
from .._outline.outline_errors import is_drawn
from .._outline.statistics import is_explained, mask_errors, misfit_above_noise
from .._rules import RULES
from .._solver.moves import canonical
from .._solver.parameters import components, focal_is_free
from .._solver.problem import FINE_PX
from .._solver.solver import Solution, Solver, Stop, onward
from .._solver.uncertainty import free_turns
from .places import (
    Free,
    Places,
    aside,
    better,
    equal_views,
    separation,
    settled,
    turned_by,
)

#: A step that is negligible while proposals are compared, in coarse px.
ROUGH_PX = 0.3

OnStop = Callable[[Stop], None]


def turns_freely(freed: tuple[str, ...]) -> bool:
    """True if the whole pose is free."""
    return "pose" in freed


def from_start(solver: Solver, mask: Mask, start: Camera, on_stop: OnStop) -> Places:
    """The places that explain the mask best, the nearest to the start first among equals."""
    before = solver.look(start, -1)
    begin = start
    sums = before.sums
    if turns_freely(solver.freed) and float(sums.overlap) <= RULES.overlap * float(sums.union):
        over = canonical(aimed(mask, solver.subject.from_afar, solver.subject.ball))
        begin = min((start, over), key=lambda camera: solver.look(camera, 0).squares)
    found = solver.solve(begin, range(len(solver.levels)), on_stop)
    if not found.view.squares <= before.squares:
        found = found._replace(camera=start, view=before, ended=False)  # never worse than the start
    return looked_round(solver, mask, found, start, on_stop)


def looked_round(
    solver: Solver, mask: Mask, found: Solution, start: Camera, on_stop: OnStop
) -> Places:
    """The places that explain the mask best, or as well as a descent from a start, the
    nearest to the start first."""
    if not turns_freely(solver.freed):
        return settled(solver, found, start)
    places, content = Places(found, [], []), is_explained(solver, found.view)
    nearly = misfit_above_noise(solver, found.view) <= RULES.exact * mask.usual_weight
    # (A start may be a tooth of a gear off.)
    if content or nearly or solver.subject.alike.lines:
        places = settled(solver, found, start)
        views = solver.subject.alike.views(places.best.camera)
        alike = [c for c in views if angle(c, start) < RULES.too_far]
        places = with_others(solver, places, finished(solver, alike))
        content = is_explained(solver, places.best.view)
    explained = solver.kind.exact and content
    astray = not explained and angle(places.best.camera, start) > RULES.too_far
    if astray or not content or is_drawn(mask_errors(solver, places.best.view)):
        places = _with_the_searched(
            solver, places, searched(solver, mask, on_stop, rounds=1), start
        )
    else:
        places = places._replace(rivals=())  # all of the mask is explained
    return _nearest_first(solver, places, start)


def _with_the_searched(
    solver: Solver, places: Places, seen: list[Solution], start: Camera
) -> Places:
    """Return the best of all with what a search found and what it looks like, walked along."""

    def not_copies(found: list[Solution], near: Solution) -> list[Solution]:
        return [f for f in found if not _copied(solver, f, near, start)]

    # The search knew no start, which rules out what is as good only far from it.
    best = seen[0] if better(solver, seen[0].view, places.best.view) else places.best
    alike = finished(solver, solver.subject.alike.views(best.camera))
    places = with_others(solver, places, not_copies([*seen, *alike], places.best), free=[])

    near = angle(places.best.camera, start) < RULES.too_far
    walked = settled(solver, places.best, start if near else None)
    more = [*places.others, *places.rivals]
    if walked.best is not places.best:
        alike = finished(solver, solver.subject.alike.views(walked.best.camera))
        more += not_copies(alike, walked.best)
    return with_others(solver, walked, more, walked.free)


def _copied(solver: Solver, found: Solution, near: Solution, start: Camera) -> bool:
    """True if a camera is as good as another one, but only far from the start."""
    views = (found.view, near.view), (near.view, found.view)
    equal = not any(better(solver, *pair) for pair in views)
    known = np.isfinite(near.view.squares)
    return bool(
        known and equal and angle(near.camera, start) < RULES.too_far <= angle(found.camera, start)
    )


def _nearest_first(solver: Solver, places: Places, start: Camera) -> Places:
    """Return the places with the one nearest to the start as the best, if it is as good."""
    away = lambda f: separation(solver, f.camera, start)
    best, *others = sorted([places.best, *places.others], key=away)
    return places._replace(best=best, others=others)


def with_others(
    solver: Solver, places: Places, more: list[Solution], free: list[Free] | None = None
) -> Places:
    """Return the best of all, and what explains the mask as well."""
    if not more:
        return places
    found = _one_of_each([places.best, *places.others, *places.rivals, *more], solver)
    best, *others = equally_good(solver, found)
    if best is not places.best:
        places = (
            settled(solver, best)._replace(others=[]) if free is None else Places(best, [], free)
        )
    others = [f for f in others if not _within(places, solver, f)]
    rivals = [f for f in found if all(f is not g for g in (best, *others))]
    most = RULES.times * best.view.squares
    rivals = [f for f in rivals if f.view.squares <= most][: RULES.followed]
    return places._replace(others=others, rivals=tuple(rivals))


def _within(places: Places, solver: Solver, found: Solution) -> bool:
    """True if a camera is the best one but for a move that is free."""
    turn = turned_by(places.best.camera, found.camera)
    far = float(np.linalg.norm(turn))
    for free in places.free:
        along = free.axis is not None and abs(turn @ free.axis) > 0.95 * far
        if along and far <= max(free.behind, free.ahead):
            return True
    return bool(separation(solver, places.best.camera, found.camera) < RULES.same)


def everywhere(solver: Solver, mask: Mask, on_stop: OnStop) -> Places:
    """Return the best camera that a search over all views finds, and what is as good."""
    found = searched(solver, mask, on_stop, rounds=3)
    return looked_alike(solver, found[0], found[1:])


def searched(solver: Solver, mask: Mask, on_stop: OnStop, rounds: int) -> list[Solution]:
    """Return the cameras that a search over all views leads to, the best first.

    Further rounds try guesses that lie closer together, and other focal lengths where that is free,
    until the mask is explained as its kind allows.
    """
    found: list[Solution] = []
    free = focal_is_free(solver.freed)
    source = guesses(mask, solver.subject.from_afar, solver.subject.ball)
    tried: list[np.ndarray] = []
    for n in range(rounds):
        if free and n:
            longer = mask.longer((1.0, RULES.focal_factor, 1 / RULES.focal_factor)[n])
            source, tried = guesses(longer, solver.subject.from_afar, solver.subject.ball), []
        source, likely = tee(source)
        apart = RULES.start / (1 if free else 2**n)
        new = islice(distinct(likely, apart, tried=tried), RULES.tried)
        found = _one_of_each([*found, *_raced(solver, new, on_stop)], solver)
        if is_explained(solver, found[0].view):
            break
    return found


def looked_alike(solver: Solver, found: Solution, others: list[Solution]) -> Places:
    """Return the best of a camera, others, and what is as good as it along walks and at views that
    look alike."""
    places = settled(solver, found)
    alike = finished(solver, solver.subject.alike.views(places.best.camera))
    return with_others(solver, places, [*others, *alike])


def finished(solver: Solver, views: Iterable[Camera]) -> list[Solution]:
    """The ends of descents from views that are nearly right, on the last levels, but for those that
    the first of these shows to be far worse than the best. (Coarser ones do not separate a tilt
    from its mirror image, and finer ones do not lead far.)"""
    coarse, *fine = range(max(solver.far - 1, 0), len(solver.levels))
    begun = _finite(solver.solve_each(views, [coarse], steps=RULES.steps))
    likely = _likely(begun, RULES.times**2)
    further = iter(solver.continued([f for f in likely if not f.ended], [coarse]))
    found = _likely([f if f.ended else next(further) for f in likely])
    return solver.continued(found, fine) if fine else found


def _likely(found: list[Solution], times: float | None = None) -> list[Solution]:
    """Return the cameras that are worth following further."""
    if not found:
        return []
    best = min(found, key=lambda f: f.view.squares)
    most = (times or RULES.times) * best.view.misfit + RULES.exact
    return [f for f in found if f is best or f.view.misfit < most]


def _raced(solver: Solver, cameras: Iterable[Camera], on_stop: OnStop) -> list[Solution]:
    """The ends of descents from the few of some cameras that are best after some steps on the
    coarsest level, the best first."""
    coarsest, *finer = range(len(solver.levels))
    rough = partial(solver.solve_each, levels=[coarsest], coarse_px=ROUGH_PX)
    begun = rough(map(canonical, cameras), steps=RULES.steps // 2)
    likely = _one_of_each(begun, solver)[: RULES.followed]
    ends = rough([f.camera for f in likely])
    found = _one_of_each([onward(*pair) for pair in zip(likely, ends, strict=True)], solver)
    for level in finer:
        found = _likely(_one_of_each(solver.continued(found, [level], on_stop), solver))
    return found


def equally_good(solver: Solver, found: list[Solution]) -> list[Solution]:
    """The cameras that explain the mask as well as the first, the best, does."""
    best = found[0].view
    share = 0.0 if solver.kind.exact else RULES.little
    return [
        f
        for f in found
        if f is found[0]
        or equal_views(solver, f.view, best)
        or f.view.squares <= (1 + share) * best.squares
    ]


def to_the_end(solver: Solver, found: list[Solution]) -> list[Solution]:
    """Return cameras, which steps were left out for, as fine as the float type resolves them, and
    looked at."""
    px = FINE_PX[solver.dtype]
    if solver.fine_px <= px:
        look = lambda f: f._replace(view=solver.look(f.camera, solver.finest))
        return [f if f.way else look(f) for f in found]
    return solver.continued(found, [solver.finest], fine_px=px)


def free_about(solver: Solver, found: Solution, places: Places) -> list[Free]:
    """The free directions of a camera, one of some places or a rival of these."""
    if separation(solver, found.camera, places.best.camera) > RULES.start:
        return settled(solver, found).free
    return places.free


def _finite(found: list[Solution]) -> list[Solution]:
    known = lambda view: np.isfinite(view.squares) and np.all(np.isfinite(view.triangle))
    return [f for f in found if known(f.view)] or found[:1]


def _one_of_each(found: list[Solution], solver: Solver) -> list[Solution]:
    """Return the finite ones, the best first, and of those with the same view the best."""
    best_first = sorted(_finite(found), key=lambda f: f.view.squares)
    return [*one_of_each(best_first, lambda a, b: _same(a, b, solver))]


def _same(a: Solution, b: Solution, solver: Solver) -> bool:
    """True if two cameras look the same way at the same part of the body, but for a turn that
    changes no pixel of a's."""
    axes_a, axes_b = (axes_of(f.camera) for f in (a, b))
    turn: Any = axes_a.T @ axes_b - np.eye(3)
    free = free_turns(a.view.triangle, components(solver.freed), axes_a)
    if len(free) > 1:
        return True
    turned = np.linalg.norm(turn @ free[0] if len(free) else turn)
    return bool(turned < RULES.same and aside(solver, a.camera, b.camera) < RULES.little)
