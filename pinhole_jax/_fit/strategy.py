"""Which cameras a fit tries, and which of those that it finds it keeps."""

from collections.abc import Callable, Iterable, Iterator
from itertools import tee
from typing import Any

import numpy as np
from jaxtyping import Float

from .._camera.axes import angle, axes_of
from .._camera.camera import Camera
from .._mask.mask import Mask
from .._mask.search import aimed, guesses
from .._solver.looks import View
from .._solver.moves import canonical
from .._solver.outline_errors import OutlineErrors, is_drawn
from .._solver.parameters import components, focal_is_free
from .._solver.problem import COARSE_PX, FINE_PX
from .._solver.solver import Found, Solver, Stop, onward
from .._solver.stretches import area_between, outline_of
from .._solver.uncertainty import free_turns
from .places import (
    DRAWN_TIMES,
    NEAR_START,
    Free,
    Places,
    better,
    equal_views,
    interval,
    mirrored,
    separation,
    settled,
    turned_by,
)

#: A mask that leaves less than this mean square residual of an outline pixel has no outliers.
EXACT = 0.01
#: A start whose intersection over union is below this may have the object beside the mask.
POOR = 0.7
#: Cameras that leave up to this many times the least squares may be right if a part of the mask is
#: not to be believed; this many are looked at.
RIVAL, RIVALS = 6.0, 6
#: ... and near the mask's edge twice as many as its errors leave undecided.
HOPELESS = 2.0
#: An outline that is farther from the mask's than this (px), or this many times the size of the
#: mask's errors, is no farther for it: something else is wrong there.
CAP_PX, CAP_SIZES = 2.0, 2.5
#: How far (rad) a start is off, one standard error, where a mask's errors leave several cameras.
#: (Of 338 such fits, starts 10 to 30 degrees off, 82 of them with a right one, it stands first in
#: 75, as it does with 10 degrees; with 30 in 70, with the smallest errors first in 57, and with the
#: nearest to the start first in 75, but then in 3 a right one that left fewer squares is behind.)
START_RAD = np.deg2rad(15)
#: A camera that is farther from the best so far than this (rad) is another one.
ELSEWHERE = np.deg2rad(10)
#: A fit that ends this far (rad) from its start has lost it, and looks elsewhere too.
ASTRAY = np.deg2rad(40)
#: Two views explain a mask that says nothing exact equally well if their sums of squares differ by
#: less than this share.
EQUAL = 0.05
#: Cameras this close (rad) are one.
SAME = np.deg2rad(1.0)
#: How many guesses a search tries on the coarsest level, how far apart (rad), and how many of the
#: cameras that they lead to it may follow to finer ones.
TRIED, APART, FOLLOWED = 16, np.deg2rad(15), 8
#: A step that is negligible there, in coarse px.
ROUGH_PX = 0.3
#: What leaves this many times the best one's mean square on a level is followed no further; after
#: the first few steps there (hopeless ones take 50, and are still 12 times worse) it is this many
#: times.
WORSE, FIRST_STEPS, HOPELESS_AT_FIRST = 4.0, 8, 16.0
#: Where the focal length is free, a search tries several: this much times the first guess.
FOCAL_FACTORS = (1.0, 1.5, 0.67)

OnStop = Callable[[Stop], None]


def turns_freely(freed: tuple[str, ...]) -> bool:
    """Return whether the whole pose is free."""
    return "pose" in freed


def from_start(solver: Solver, mask: Mask, start: Camera, on_stop: OnStop) -> Places:
    """Return what explains the mask best, the nearest to the start first if several do equally."""
    before = solver.look(start, -1)
    begin = start
    if turns_freely(solver.freed) and float(before.sums.overlap) <= POOR * float(before.sums.union):
        over = canonical(aimed(mask, solver.subject.from_afar, solver.subject.ball))
        begin = min((start, over), key=lambda camera: solver.look(camera, 0).squares)
    found = solver.solve(begin, range(len(solver.levels)), on_stop)
    if not found.view.squares <= before.squares:
        found = found._replace(camera=start, view=before, ended=False)  # never worse than the start
    return looked_round(solver, mask, found, start, on_stop)


def looked_round(
    solver: Solver, mask: Mask, found: Found, start: Camera, on_stop: OnStop
) -> Places:
    """Return what explains the mask best or as well as what a descent from a start found, the
    nearest to the start first."""
    if not turns_freely(solver.freed):
        return settled(solver, found, start)
    places, content = Places(found, [], []), solver.explains(found.view)
    if content or solver.misfit_above_noise(found.view) <= EXACT:
        places = settled(solver, found, start)
        alike = [c for c in mirrored(solver, places.best) if angle(c, start) < NEAR_START]
        places = with_others(solver, places, finished(solver, alike))
        content = solver.explains(places.best.view)
    explained = solver.kind.exact and content
    astray = not explained and angle(places.best.camera, start) > ASTRAY
    if astray or not content or is_drawn(solver.errors(places.best.view)):
        places = _with_the_searched(
            solver, places, searched(solver, mask, on_stop, rounds=1), start
        )
    else:
        places = places._replace(rivals=())  # all of the mask is explained
    return _nearest_first(places, start)


def _with_the_searched(solver: Solver, places: Places, seen: list[Found], start: Camera) -> Places:
    """Return the best of all with what a search found and what it looks like, walked along."""

    def not_copies(found: list[Found], near: Found) -> list[Found]:
        return [f for f in found if not _copied(solver, f, near, start)]

    # The search knew no start, which rules out what is as good only far from it.
    best = seen[0] if better(solver, seen[0].view, places.best.view) else places.best
    alike = finished(solver, mirrored(solver, best))
    places = with_others(solver, places, not_copies([*seen, *alike], places.best), free=[])

    near = angle(places.best.camera, start) < NEAR_START
    walked = settled(solver, places.best, start if near else None)
    more = [*places.others, *places.rivals]
    if walked.best is not places.best:
        more += not_copies(finished(solver, mirrored(solver, walked.best)), walked.best)
    return with_others(solver, walked, more, walked.free)


def _copied(solver: Solver, found: Found, near: Found, start: Camera) -> bool:
    """Return whether a camera is as good as another one, but only far from the start."""
    views = (found.view, near.view), (near.view, found.view)
    equal = not any(better(solver, *pair) for pair in views)
    known = np.isfinite(near.view.squares)
    return bool(
        known and equal and angle(near.camera, start) < NEAR_START <= angle(found.camera, start)
    )


def _nearest_first(places: Places, start: Camera) -> Places:
    """Return the places with the one nearest to the start as the best, if it is as good."""
    best, *others = sorted([places.best, *places.others], key=lambda f: angle(f.camera, start))
    return places._replace(best=best, others=others)


def with_others(
    solver: Solver, places: Places, more: list[Found], free: list[Free] | None = None
) -> Places:
    """Return the best of all, and what explains the mask as well."""
    if not more:
        return places
    found = _one_of_each([places.best, *places.others, *places.rivals, *more], solver.freed)
    best, *others = equally_good(solver, found)
    rivals = [f for f in found if all(f is not g for g in (best, *others))]
    rivals = [f for f in rivals if f.view.squares <= RIVAL * best.view.squares][:RIVALS]
    if best is not places.best:
        places = (
            settled(solver, best)._replace(others=[]) if free is None else Places(best, [], free)
        )
    others = [f for f in others if not _within(places, solver, f)]
    return places._replace(others=others, rivals=tuple(rivals))


def _within(places: Places, solver: Solver, found: Found) -> bool:
    """Return whether a camera is the best one but for a move that is free."""
    turn = turned_by(places.best.camera, found.camera)
    far = float(np.linalg.norm(turn))
    for free in places.free:
        along = free.axis is not None and abs(turn @ free.axis) > 0.95 * far
        if along and far <= max(free.behind, free.ahead):
            return True
    return bool(separation(solver, places.best.camera, found.camera) < SAME)


def everywhere(solver: Solver, mask: Mask, on_stop: OnStop) -> Places:
    """Return the best camera that a search over all views finds, and what is as good."""
    found = searched(solver, mask, on_stop, rounds=3)
    return looked_alike(solver, found[0], found[1:])


def searched(solver: Solver, mask: Mask, on_stop: OnStop, rounds: int) -> list[Found]:
    """Return the cameras that a search over all views leads to, the best first.

    Further rounds try guesses that lie closer together, and other focal lengths where that is free,
    until the mask is explained as its kind allows.
    """
    found: list[Found] = []
    free = focal_is_free(solver.freed)
    source = guesses(mask, solver.subject.from_afar, solver.subject.ball)
    for n in range(rounds):
        if free and n:
            longer = mask.longer(FOCAL_FACTORS[n])
            source = guesses(longer, solver.subject.from_afar, solver.subject.ball)
        source, likely = tee(source)
        apart = APART / (1 if free else 2**n)
        found = _one_of_each([*found, *_followed(solver, likely, apart, on_stop)], solver.freed)
        if solver.explains(found[0].view):
            break
    return found


def looked_alike(solver: Solver, found: Found, others: list[Found]) -> Places:
    """Return the best of a camera, others, and what is as good as it along walks and at views that
    look alike."""
    places = settled(solver, found)
    alike = finished(solver, mirrored(solver, places.best))
    return with_others(solver, places, [*others, *alike])


def finished(solver: Solver, views: Iterable[Camera]) -> list[Found]:
    """Return where views that are nearly right lead to on the last levels, but for those that the
    first of these shows to be far worse than the best. (Coarser ones do not tell a tilt from its
    mirror image, and finer ones do not lead far.)"""
    coarse, *fine = range(max(solver.far - 1, 0), len(solver.levels))
    begun = _finite([solver.solve(view, [coarse], steps=FIRST_STEPS) for view in views])
    further = lambda f: f if f.ended else onward(f, solver.solve(f.camera, [coarse]))
    found = _likely([further(f) for f in _likely(begun, HOPELESS_AT_FIRST)])
    return [onward(f, solver.solve(f.camera, fine)) for f in found] if fine else found


def _likely(found: list[Found], times: float = WORSE) -> list[Found]:
    """Return the cameras that are worth following further."""
    if not found:
        return []
    best = min(found, key=lambda f: f.view.squares)
    return [f for f in found if f is best or f.view.misfit < times * best.view.misfit + EXACT]


def _followed(
    solver: Solver, likely: Iterator[Camera], apart: float, on_stop: OnStop
) -> list[Found]:
    """Return the cameras that the first few guesses, so far apart, lead to."""
    coarsest, *finer = range(len(solver.levels))
    seen: list[Camera] = []
    found: list[Found] = []
    for guess in likely:
        if all(angle(guess, other) > apart for other in seen):
            found.append(solver.solve(canonical(guess), [coarsest], coarse_px=ROUGH_PX))
            seen += [guess, found[-1].camera]
            if len(found) == TRIED:
                break
    found = _one_of_each(found, solver.freed)[:FOLLOWED]
    for level in finer:
        found = [onward(f, solver.solve(f.camera, [level], on_stop)) for f in found]
        found = _likely(_one_of_each(found, solver.freed))
    return found


def equally_good(solver: Solver, found: list[Found]) -> list[Found]:
    """Return those that explain the mask as well as the first, the best, does."""
    best = found[0].view
    share = 0.0 if solver.kind.exact else EQUAL
    return [
        f
        for f in found
        if f is found[0]
        or equal_views(solver, f.view, best)
        or f.view.squares <= (1 + share) * best.squares
    ]


def to_the_end(solver: Solver, found: list[Found]) -> list[Found]:
    """Return cameras, which steps were left out for, as fine as the float type resolves them, and
    looked at."""
    px = FINE_PX[solver.dtype]
    if solver.fine_px <= px:
        look = lambda f: f._replace(view=solver.look(f.camera, solver.finest))
        return [f if f.way else look(f) for f in found]
    return [onward(f, solver.solve(f.camera, [solver.finest], fine_px=px)) for f in found]


def without_outliers(
    solver: Solver, mask: Mask, places: Places, outlier_px: float, start: Camera | None
) -> list[tuple[Found, View]]:
    """Return the cameras fitted to pixels near the mask's edge only, and views of all pixels.

    At first the surroundings are wide, so that what other stretches of the outline pulled away
    comes back; where nothing is far away, they are narrow at once. Rivals that are far worse there
    are left out.
    """
    alike = [(f, f.camera) for f in (places.best, *places.others)]
    rivals = [(f, f.camera) for f in places.rivals]
    alone, near = _is_alone(mask, places, outlier_px), solver
    for reach in (1,) if alone else (8, 4, 2, 1):
        near = solver.weighed(mask.near_edge(reach * outlier_px), only_finest=True)
        # (What comes next moves it by more.)
        px = COARSE_PX if reach > 1 else FINE_PX[solver.dtype]
        # (Where there are rivals their errors are asked for on the way.)
        looks = bool(rivals) or reach == 1
        finer = lambda f, near=near, px=px, looks=looks: onward(
            f, near.solve(f.camera, [near.finest], fine_px=px, looks=looks)
        )
        alike, rivals = ([(finer(f), camera) for f, camera in x] for x in (alike, rivals))
        # (Farther out, what covers the object counts against the right one.)
        if rivals and reach <= 2:
            view = alike[0][0].view
            most = HOPELESS * _times(near.errors(view)) * view.squares
            rivals = [(f, camera) for f, camera in rivals if f.view.squares <= most]
    result = []
    for f, before in (*alike, *rivals):
        # (A descent that began there, with these weights, does not end higher.)
        others = [] if alone else [before]
        for camera in others if start is None else [*others, start]:
            if not near.look(camera, near.finest).squares >= f.view.squares:
                px = FINE_PX[near.dtype]
                f = onward(f, near.solve(camera, [near.finest], fine_px=px))
        result.append(f)
    solver.take_errors(places.best.view, result[0].view)
    return [(f, solver.look(f.camera, solver.finest)) for f in result]


def _is_alone(mask: Mask, places: Places, outlier_px: float) -> bool:
    """Return whether there is one camera, with all of its outline so near to the mask's edge that
    nothing is to come back from farther away."""
    if places.others or places.rivals:
        return False
    view = places.best.view
    row, column = outline_of(view).T
    window = view.level.window()
    distance = mask.distance(window, window.H - 1 - row, column, outlier_px)
    return bool(np.all(distance <= outlier_px / 2))


def _times(errors: OutlineErrors | None) -> float:
    """Return how many times as large as the best one's the errors of a camera may be that the mask
    does not tell from it."""
    # Errors grow like a size: its logarithm, for each independent one, is the odds'.
    return float(np.exp(DRAWN_TIMES / 2 / max(errors.independent, 1))) if errors else 1.0


def most_agreeing(
    solver: Solver,
    mask: Mask,
    described: list[tuple[Found, View]],
    alike: int,
    start: Camera | None,
) -> list[tuple[Found, View]]:
    """Return the cameras whose outline is the mask's but for some of it, the likeliest first: the
    mask does not tell one from the other.

    The first `alike` of them leave equal squares: these stay together, where they are the best,
    unless the mask is a drawn one, whose outliers were among those squares.
    """
    drawn = is_drawn(solver.errors(described[0][0].view))
    if len(described) == alike and not drawn:
        return described
    errors = [e for e in (solver.errors(f.view) for f, _ in described) if e is not None]
    if not errors:
        return described
    cap = max(CAP_PX, CAP_SIZES * min(e.size for e in errors))
    costs = [area_between(view, mask.target, mask.weight, cap) for _, view in described]
    least = int(np.argmin(costs))
    closest = described[least]
    found = solver.errors(closest[0].view)
    limit = _times(found) * costs[least]
    places = [
        k
        for k, cost in enumerate(costs)
        if cost <= limit or k == least or (max(k, least) < alike and not drawn)
    ]
    chosen = [described[k] for k in places]
    if start is None:  # the first left the least squares of all pixels: it stands first if it may
        return (
            chosen if chosen[0] is described[0] else sorted(chosen, key=lambda d: d is not closest)
        )
    if not drawn:
        return sorted(chosen, key=lambda d: angle(d[0].camera, start))
    far = np.array([angle(f.camera, start) for f, _ in chosen])
    agreed = np.array([costs[k] for k in places])
    independent = found.independent if found else 1.0
    return [chosen[k] for k in np.argsort(unlikely(agreed, far, independent), kind="stable")]


def unlikely(
    costs: Float[np.ndarray, " n"], far: Float[np.ndarray, " n"], independent: float
) -> Float[np.ndarray, " n"]:
    """Return how unlikely cameras are, minus a logarithm, from what they and a mask disagree by,
    with this many independent errors, and how far (rad) they are from the start."""
    return max(independent, 1) * np.log(costs) + (far / START_RAD) ** 2 / 2


def free_about(solver: Solver, found: Found, places: Places) -> list[Free]:
    """Return what is free about a camera, one of some places or a rival of these."""
    if separation(solver, found.camera, places.best.camera) > ELSEWHERE:
        return settled(solver, found).free
    return places.free


def with_errors(
    solver: Solver, mask: Mask, found: Found, free: list[Free], reach: float | None
) -> list[Free]:
    """Return what is free about a camera: of a drawn mask, too, how far its errors leave what shows
    least, pixels farther than `reach` (px) from its edge left out."""
    errors = solver.errors(found.view) if turns_freely(solver.freed) else None
    if not is_drawn(errors):
        return free
    near = solver
    if reach is not None:
        near = solver.weighed(mask.near_edge(reach), only_finest=True)
    left = interval(near, found, errors)
    # (Facets make minima along a turn, and a profile sees but the one that it begins in.)
    return [*free, *left]


def _finite(found: list[Found]) -> list[Found]:
    return [f for f in found if np.isfinite(f.view.squares)] or found[:1]


def _one_of_each(found: list[Found], freed: tuple[str, ...]) -> list[Found]:
    """Return the finite ones, the best first, and of those with the same view the best."""
    distinct: list[Found] = []
    for f in sorted(_finite(found), key=lambda f: f.view.squares):
        if not any(_same(k, f, freed) for k in distinct):
            distinct.append(f)
    return distinct


def _same(a: Found, b: Found, freed: tuple[str, ...]) -> bool:
    """Return whether two cameras look the same way, but for a turn that changes no pixel of a's."""
    axes_a, axes_b = (axes_of(f.camera) for f in (a, b))
    turn: Any = axes_a.T @ axes_b - np.eye(3)
    free = free_turns(np.asarray(a.view.triangle, float), components(freed), axes_a)
    if len(free) > 1:
        return True
    return bool(np.linalg.norm(turn @ free[0] if len(free) else turn) < SAME)
