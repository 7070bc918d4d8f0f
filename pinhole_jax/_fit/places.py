"""Where else the camera may be: along turns and shifts that hardly show.

A derivative speaks for the neighbourhood of one camera. Facets of a round body give a turn that
the mask hardly shows sharp minima, one beside the other; symmetric bodies look alike from several
sides. So a fit whose Jacobian calls a turn or shift nearly free walks along it, in steps that leave
such a minimum. It descends again at each, and asks whether the mask's own noise forbids the place.
"""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from .._camera.axes import angle, axes_of, one_of_each
from .._camera.camera import Camera
from .._numerics.threads import some_at_once
from .._outline.outline_errors import is_drawn
from .._outline.statistics import mask_errors, residual_variance
from .._rules import RULES
from .._scene.alike import Revolution, rotated
from .._solver.looks import View
from .._solver.parameters import components
from .._solver.solver import Solution, Solver
from .._solver.uncertainty import in_words, weak_moves


class Free(NamedTuple):
    """A direction along which the mask does not tell cameras apart.

    `move` (n,) is the move by one rad of it, in the solver's units; it is free from `-behind` to
    `ahead` (rad), both infinite if all places looked at are equal; `axis` (3,) of the turn in the
    world, None for a shift.
    """

    move: np.ndarray
    behind: float
    ahead: float
    axis: np.ndarray | None

    def __str__(self) -> str:
        """Return it as a sentence."""
        name = "a shift" if self.axis is None else f"rotation about the axis {in_words(self.axis)}"
        if np.isinf(self.ahead):
            return f"{name} is not visible"
        low, high = -np.rad2deg(self.behind), np.rad2deg(self.ahead)
        return f"{name} may be off by {low:.0f} to {high:+.0f} degrees: the mask fits equally well"


class Places(NamedTuple):
    """The best camera found, others that explain the mask as well, what is free about it, and
    rivals: others that explain it worse, but may be right if a part of it is not to be believed."""

    best: Solution
    others: list[Solution]
    free: list[Free]
    rivals: tuple[Solution, ...] = ()


class _Direction(NamedTuple):
    """A turn about an axis (3,) in the world, or a shift (None).

    - `move` (n,): by one rad of it, in the solver's units; `sigma`: its standard error (rad) by
      the Jacobian.
    - `line`: what the body is round about, if it turns about that.
    """

    move: np.ndarray
    axis: np.ndarray | None
    sigma: float
    line: Revolution | None = None


def settled(solver: Solver, best: Solution, start: Camera | None = None) -> Places:
    """Return the best camera along all that is nearly free, and what else is as good.

    No place takes over that is far from a `start`. A mask that a person or a network drew is left
    to the likelihood: its errors, not its squares, say what hardly shows.
    """
    if is_drawn(mask_errors(solver, best.view)):
        return Places(best, [], [])
    seen, last = [], []
    directions = _worth_a_walk(solver, best)
    while directions:
        last = directions
        places = [p for d in directions for p in _along(solver, best, d)]
        seen += [best, *places]
        place = _likeliest(solver, best, places, start)
        if not better(solver, place.view, best.view):
            break
        view = solver.look(place.camera, solver.finest)
        best = place._replace(view=view, steps=best.steps + place.steps, way=best.way)
        directions = _nearly_free(solver, best)
    if not seen:
        return Places(best, [], [])
    if solver.kind.exact and not solver.kind.spread:
        seen += _alike(solver, best)
    # What is as good, but only far from the start, the start rules out.
    near = [p for p in seen if start is None or angle(p.camera, start) < RULES.too_far]
    places = _as_good(solver, best, near, last)
    return _as_good(solver, best, seen, last) if places.others or places.free else places


def _likeliest(
    solver: Solver, best: Solution, places: list[Solution], start: Camera | None
) -> Solution:
    """Return the best of some places that are not far from a start; where there are none, the best
    so far."""
    near = (p for p in places if start is None or angle(p.camera, start) < RULES.too_far)
    return min(near, key=lambda p: _surplus(solver, p.view), default=best)


def _worth_a_walk(solver: Solver, best: Solution) -> list[_Direction]:
    """Return the directions along which another camera may be as good.

    Facets bend what the Jacobian says of a round body's axis: what turns nearly about that turns
    about it.
    """
    round_about = _round(solver, best)
    other = _nearly_free(solver, best) or _doubtful(solver, best)
    if len(round_about) == 1:
        axis = solver.subject.alike.lines[0].axis
        other = [d for d in other if d.axis is None or abs(d.axis @ axis) < np.cos(2 * RULES.start)]
    elif any(d.axis is not None for d in other):
        return other
    return other + round_about


def equal_views(solver: Solver, view: View, best: View, most: float = np.inf) -> bool:
    """True if the mask's own noise allows a view as well as the best, within this many variances at
    `most`."""
    times = RULES.drawn_times if is_drawn(mask_errors(solver, best)) else RULES.equal_times
    allowed = min(times, most) * residual_variance(solver, best)
    return bool(_surplus(solver, view) - _surplus(solver, best) <= allowed)


def _surplus(solver: Solver, view: View) -> float:
    """Return the sum of squares above what a right camera leaves, the outline being so long.

    What quantisation and rounding may leave is not told apart below that.
    """
    kind, touched = solver.kind, float(view.sums.touched)
    squares = max(view.squares, kind.alike * touched) - kind.variance * touched
    return squares if np.isfinite(squares) else np.inf


def better(solver: Solver, view: View, best: View) -> bool:
    """True if a view explains the mask better than the best so far, not by rounding only."""
    have, now = _surplus(solver, best), _surplus(solver, view)
    return bool(now < have - max(0.01 * abs(have), 2 * solver.kind.variance))


def _nearly_free(solver: Solver, found: Solution, share: float | None = None) -> list[_Direction]:
    """The turns and shifts that show less than a share of the best-seen move, the least last."""
    triangle = found.view.triangle
    if not np.all(np.isfinite(triangle)):
        return []
    weak = weak_moves(triangle, components(solver.freed), share)
    return [_direction(solver, found, *pair) for pair in weak]


def _direction(solver: Solver, found: Solution, value: float, vector: np.ndarray) -> _Direction:
    """Return a direction of moves that shows this much (a singular value) as a turn or a shift."""
    turns = np.array([name.startswith("turn") for name in components(solver.freed)])
    radian = _radian(solver, found)
    axis, move = None, vector
    if np.linalg.norm(vector[turns]) > 0.3:  # a large turn is a turn alone
        move = np.where(turns, vector, 0) / np.linalg.norm(vector[turns])
        axis = move[turns] @ axes_of(found.camera)
    sigma = residual_variance(solver, found.view) ** 0.5 / max(value, 1e-300) / radian
    return _Direction(move * radian, axis, min(sigma, np.pi))


def _round(solver: Solver, found: Solution) -> list[_Direction]:
    """Return the turns about lines that the body is round about: facets, teeth or sections there
    repeat, and each place where they fit is a minimum."""
    parts = components(solver.freed)
    turns = np.array([name.startswith("turn") for name in parts])
    if np.sum(turns) < 3:
        return []
    result, triangle = [], found.view.triangle
    if not np.all(np.isfinite(triangle)):
        return []
    deviations = np.linalg.pinv(triangle).T
    for line in solver.subject.alike.lines:
        move = np.zeros(len(parts))
        move[turns] = axes_of(found.camera) @ line.axis
        value = 1 / max(float(np.linalg.norm(deviations @ move)), 1e-300)
        direction = _direction(solver, found, value, move)
        result.append(direction._replace(line=line))
    return result


def _doubtful(solver: Solver, found: Solution) -> list[_Direction]:
    """The turn or shift that shows least, if it does not show well: where a part of the object is
    just about to show, the mask says more on one side than the Jacobian does."""
    kind = solver.kind
    sharp = kind.exact and not kind.spread and found.view.touched_misfit <= kind.most
    return [] if sharp else _nearly_free(solver, found, RULES.small)[-1:]


def _radian(solver: Solver, found: Solution) -> float:
    """Return the size of a move, in the solver's units, that is as large as a turn by one rad."""
    parts, scale = components(solver.freed), found.view.scale
    for name, size in zip(parts, scale, strict=True):
        if name.startswith("turn"):
            return 1 / size
    reach = np.linalg.norm(np.asarray(found.camera.e, float) - solver.subject.ball.centre)
    size = next(
        s for n, s in zip(parts, scale, strict=True) if n.split("_")[0] in ("spin", "shift")
    )
    return float(np.clip(solver.subject.ball.radius / reach, 1e-3, 1) / size)


def shelf(solver: Solver, found: Solution) -> tuple[np.ndarray, float] | None:
    """The move (n,) that shows least, and the share left of the squares that the Jacobian foretells
    four standard errors along it: on the flatter side, with all else fitted. None where no turn is
    free, or errors reach half round."""
    triangle = found.view.triangle
    turns = any(name.startswith(("turn", "spin")) for name in components(solver.freed))
    if not (turns and np.all(np.isfinite(triangle))):
        return None
    _, values, moves = np.linalg.svd(triangle)
    others, move = moves[:-1], moves[-1]
    foretold = RULES.times**2 * residual_variance(solver, found.view)
    far = foretold**0.5 / max(values[-1], 1e-300)
    if not far < np.pi * _radian(solver, found):
        return None

    def left(stride: float) -> float:
        """The squares more than those of the camera found."""
        view = solver.look(solver.step(found.camera, solver.finest, stride * move), solver.finest)
        rows = view.triangle @ others.T
        if not (np.all(np.isfinite(rows)) and np.all(np.isfinite(view.along))):
            return np.inf
        fitted = np.linalg.qr(rows)[0].T @ view.along
        return view.squares - float(fitted @ fitted) - found.view.squares

    return move, float(np.clip(min(left(far), left(-far)) / foretold, RULES.times**-2, 1.0))


def _along(solver: Solver, best: Solution, direction: _Direction) -> list[Solution]:
    """The ends of descents from both sides of a camera."""
    if direction.line is not None:
        return _around(solver, best, direction.line)
    return _strides(solver, best, direction, [s * x for s in (1, -1) for x in RULES.strides])


def _strides(
    solver: Solver, best: Solution, direction: _Direction, far: list[float]
) -> list[Solution]:
    """The ends of descents from distances (rad) along a direction."""
    starts = (solver.step(best.camera, solver.finest, x * direction.move) for x in far)
    return _finite(p for p in _led_to(solver, best, starts) if p is not None)


def _around(solver: Solver, best: Solution, line: Revolution) -> list[Solution]:
    """The ends of descents from likely cameras all round a line, and this many more while
    those are as good."""
    for camera, other, places in solver.walked:
        if other is line and separation(solver, camera, best.camera) < RULES.same / 2:
            return places
    pitch = line.pitch or RULES.uncertain
    parts = int(np.ceil(pitch / RULES.uncertain))
    if line.pitch is not None and pitch > RULES.uncertain:
        parts = max(parts, 2)  # minima are on facets, some between them
    count = round(2 * np.pi / pitch) * parts
    cameras = turned_about(best.camera, line, count)
    surplus = _glances(solver, cameras, _walked_on(solver))
    lower = (surplus <= np.roll(surplus, 1)) & (surplus <= np.roll(surplus, -1))
    lower[0] = False
    places, worse = [], 0
    # (The golden ratio: where many are as good as one another, some all round.)
    order = np.lexsort((np.arange(count) * 0.618034 % 1, surplus))
    likely = [cameras[k] for k in order[lower[order]][: RULES.turns]]
    for place in _led_to(solver, best, likely):
        places += [] if place is None else [place]
        worse += place is None or not equal_views(solver, place.view, best.view)
        if worse == RULES.followed:
            break
    places = _finite(places)
    solver.walked.append((best.camera, line, places))
    return places


def turned_about(camera: Camera, line: Revolution, count: int) -> list[Camera]:
    """This many cameras all round a line, the given one first."""
    turns = 2 * np.pi * np.arange(count) / count
    return [_turned(camera, turn * line.axis, line.centre) for turn in turns]


def tilted(camera: Camera, centre: np.ndarray) -> list[Camera]:
    """Cameras tilted every way about a centre: by half of a start's error, and by all of it."""
    right, up, _ = axes_of(camera)
    ways = 2 * np.pi * np.arange(RULES.sectors) / RULES.sectors
    lines = [np.cos(way) * right + np.sin(way) * up for way in ways]
    return [
        _turned(camera, far * x, centre) for far in (RULES.start / 2, RULES.start) for x in lines
    ]


def _turned(camera: Camera, turn: np.ndarray, centre: np.ndarray) -> Camera:
    """Return a camera turned about a centre by a rotation vector."""
    rotation = _rotation(turn)
    return rotated(camera, rotation, centre - rotation @ centre)


def _led_to(solver: Solver, best: Solution, starts: Iterable[Camera]) -> Iterator[Solution | None]:
    """Yield where descents lead to: first a few steps on a level where steps lead far, and from
    another place there on the finest one; None for one that leads to a place that is known, or
    stays far too bad."""
    number, known = _walked_on(solver), [best.camera]
    steps = RULES.steps // 3 if number == solver.finest else RULES.steps
    most = np.inf if solver.kind.exact else RULES.times**2 * best.view.misfit
    for some in some_at_once(_descended(solver, starts, number, steps)):
        further: list[Camera] = []
        for found in some:
            away = (separation(solver, found.camera, camera) for camera in known)
            if found.view.misfit < most and min(away) >= RULES.same / 2:
                known.append(found.camera)
                further.append(found.camera)
        yield from [None] * (len(some) - len(further))
        yield from _descended(solver, further)


def _walked_on(solver: Solver) -> int:
    """Return the number of the level that walks are on: an exact mask tells facets apart that
    coarser ones do not show."""
    return solver.finest if solver.kind.exact else solver.far


def _alike(solver: Solver, best: Solution) -> list[Solution]:
    """The ends of descents from the likeliest cameras that see the facets alike."""
    cameras = [rotated(best.camera, *turn) for turn in solver.subject.alike.turns]
    surplus = _glances(solver, cameras, solver.finest)
    nearest = [cameras[k] for k in np.argsort(surplus)[: RULES.tried] if np.isfinite(surplus[k])]
    return _finite(_descended(solver, nearest))


def _glances(solver: Solver, cameras: list[Camera], number: int) -> np.ndarray:
    """The misfit of cameras, on a level."""
    views = solver.looks(cameras, number)
    if number == solver.finest:
        return np.array([_surplus(solver, view) for view in views])
    return np.array([view.squares if np.isfinite(view.squares) else np.inf for view in views])


def _descended(
    solver: Solver, cameras: Iterable[Camera], number: int = -1, steps: int = RULES.steps
) -> Iterator[Solution]:
    return solver.descents(cameras, min(steps, solver.max_steps), number)


def _finite(places: Iterable[Solution]) -> list[Solution]:
    return [p for p in places if np.isfinite(p.view.squares)]


def _as_good(
    solver: Solver, best: Solution, seen: list[Solution], directions: list[_Direction]
) -> Places:
    """Return the best, and those seen that are other places and as good: a few, or free
    directions."""
    directions = [transported(solver, best, d) for d in directions]
    sigma = max(min(d.sigma for d in directions), 1e-12)
    apart = max(RULES.same, sigma)
    exact = solver.kind.exact and solver.kind.explains(best.view.touched_misfit, True)

    def others(places: list[Solution]) -> list[Solution]:
        as_good = []
        for place in places:
            far = separation(solver, place.camera, best.camera)
            # (What the Jacobian foretells so far away is no other place: a descent on its way.)
            foretold = float(RULES.foretold * (far / sigma) ** 2)
            if far > apart and equal_views(solver, place.view, best.view, foretold):
                as_good.append(place)
        return _distinct(solver, as_good, apart)

    equal = others(seen)
    if exact and len(equal) < RULES.many:
        return Places(best, equal, [])
    return Places(best, [], _intervals(solver, best, equal, directions), tuple(equal))


def transported(solver: Solver, found: Solution, direction: Any) -> Any:
    """Return a `_Direction`, or a `Free` one, as moves of a camera that it was not taken at."""
    if direction.axis is None:
        return direction
    turns = np.array([name.startswith("turn") for name in components(solver.freed)])
    move = np.zeros(len(turns))
    move[turns] = axes_of(found.camera) @ direction.axis * _radian(solver, found)
    return direction._replace(move=move)


def _intervals(
    solver: Solver, best: Solution, equal: list[Solution], directions: list[_Direction]
) -> list[Free]:
    """The free intervals of directions if these places are as good as the best."""
    turns = [turned_by(best.camera, p.camera) for p in equal]
    far: list[list[float]] = [[] for _ in directions]
    for place, turn in zip(equal, turns, strict=True):
        along = [separation(solver, place.camera, best.camera)] * len(directions)
        for k, d in enumerate(directions):
            along[k] = along[k] if d.axis is None else float(turn @ d.axis)
        chief = int(np.argmax(np.abs(along)))
        far[chief] += (
            [along[chief]] if directions[chief].axis is not None else [along[chief], -along[chief]]
        )
    result = []
    for d, reached in zip(directions, far, strict=True):
        if reached:
            # What was looked at next, and is forbidden, bounds the interval: strides double, all
            # round a line they are equal.
            times, least = (2, RULES.strides[0] / 2) if d.line is None else (1.1, RULES.uncertain)
            behind, ahead = (times * max(*(s * x for x in reached), least) for s in (-1, 1))
            if behind + ahead > 1.05 * np.pi:
                behind = ahead = np.inf
            result.append(Free(d.move, behind, ahead, d.axis))
    return result


def _distinct(solver: Solver, places: list[Solution], apart: float) -> list[Solution]:
    near = lambda before, place: separation(solver, place.camera, before.camera) <= apart
    return [*one_of_each(sorted(places, key=lambda p: _surplus(solver, p.view)), near)]


def separation(solver: Solver, a: Camera, b: Camera) -> float:
    """The distance of two cameras: the angle between them, or how far aside they see the
    object, in its radii."""
    return max(angle(a, b), aside(solver, a, b))


def is_alike(solver: Solver, a: Camera, b: Camera) -> bool:
    """Whether two cameras look the same way, and at the same part of the body."""
    return angle(a, b) < RULES.same and aside(solver, a, b) < RULES.little


def aside(solver: Solver, a: Camera, b: Camera) -> float:
    """How far aside one camera sees the object of where another does, in its radii."""
    centre = np.asarray(solver.subject.ball.centre, float)
    seen = [axes_of(c) @ (centre - np.asarray(c.e, float)) for c in (a, b)]
    return float(np.linalg.norm((seen[0] - seen[1])[:2]) / solver.subject.ball.radius)


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) by a rotation vector."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vector).as_matrix()


def turned_by(a: Camera, b: Camera) -> np.ndarray:
    """Return the rotation vector (3,), in the world, that turns a's axes into b's."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(axes_of(b).T @ axes_of(a)).as_rotvec()
