"""What one view's mask leaves open, where other views share unknowns with it.

After a joint descent each view is asked what a fit of its own asks: whether walks along nearly free
moves, or views that look alike, explain its mask as well or better. What the other views know of
the shared unknowns is among its residuals then, linear in these: so no place counts that other
intrinsics alone make as good.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from .._camera.camera import Camera
from .._fit.places import APART, EQUAL_TIMES, Places, better, separation, settled
from .._fit.strategy import finished, looked_alike, looked_round, with_others
from .._solver.least_squares import Descent, Rows
from .._solver.looks import View
from .._solver.moves import on_film
from .._solver.parameters import LABELS, labels_of
from .._solver.priors import Others
from .._solver.solver import Found, Solver, Stop
from .descent import Layout
from .levels import Path
from .shared_unknowns import Reduced, in_few, others, reduced, with_rows
from .views import MOTIONS, Eye

#: So often at most all views are asked again, since one of them is better elsewhere.
ROUNDS = 3


class Begun(NamedTuple):
    """Where a view began: its start (canonical), if it has one, and other cameras that a fit of its
    own found."""

    start: Camera | None = None
    modes: Sequence[Camera] = ()


class FromOthers(NamedTuple):
    """A view, with the priors of its own unknowns, and what the others tell it.

    - `view`, and `part`: what it leaves of the shared unknowns.
    - `from_prior`: residuals (b, n) of its moves, and their values, among those of the view.
    - `others` (r, k): what the others, and priors, know of the shared unknowns; `slope`
      (k,): half the derivative of all residuals' squares by these.
    """

    view: View
    part: Reduced
    from_prior: tuple[np.ndarray, np.ndarray]
    others: np.ndarray
    slope: np.ndarray


class Asked(NamedTuple):
    """Where a view's camera `camera` may be."""

    camera: Camera
    places: Places


def known_by_others(
    layout: Layout, found: Descent, own: np.ndarray, weights: np.ndarray
) -> list[FromOthers]:
    """Return views of weights (V,), a camera each, and what the others tell each of them; `own`
    (n,) of a view's moves are its own."""
    known: dict[int, list[Rows]] = {}
    for rows in layout.prior_rows(found.state, found.seen, layout.noise(found.seen)):
        known.setdefault(rows.columns[0], []).append(rows)
    of = lambda columns: [rows for column in columns for rows in known.get(column, ())]

    views, from_priors = [], []
    for k, seen in enumerate(found.seen):
        columns = layout.columns(k)
        from_prior = _of_moves(of(columns[own]), columns, np.linalg.pinv(seen.moves))
        views.append(with_rows(_weighed(seen.view, weights[k]), *from_prior))
        from_priors.append(from_prior)

    parts, shared = [reduced(view, own) for view in views], layout.columns(0)[~own]
    rows, left = _of_moves(of(shared), shared, np.eye(len(shared)))
    rests = others([*(part.rest for part in parts), rows])[: len(views)]
    slope = sum((part.slope for part in parts), rows.T @ left)
    each = zip(views, parts, from_priors, rests, strict=True)
    return [FromOthers(*one, slope) for one in each]


def _weighed(view: View, weight: float) -> View:
    by = weight**0.5
    triangle, along = (by * np.asarray(x, float) for x in (view.triangle, view.along))
    return view._replace(triangle=triangle, along=along)


def _of_moves(
    known: list[Rows], columns: np.ndarray, by_moves: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals of unknowns as such of moves that these follow (b, n), and their values."""
    rows = [r.rows @ by_moves[np.searchsorted(columns, r.columns)] for r in known]
    none = np.zeros((0, by_moves.shape[1]))
    return np.concatenate([none, *rows]), np.concatenate([np.zeros(0), *(r.left for r in known)])


def asked(
    layout: Layout,
    path: Path,
    begun: list[Begun],
    own: np.ndarray,
    onward: Callable[[list[Camera]], Path],
) -> tuple[Path, list[Asked]]:
    """Return where views, a camera each, are after a descent, and each view's answer.

    Where one is better elsewhere, all descend `onward` from there together, and are asked again. If
    that is worse for all together, they stay, and the place is one of that view's others.
    """
    answers = _answers(layout, path.descent, begun, own)
    for _ in range(ROUNDS):
        if all(answer.places.best.camera is answer.camera for answer in answers):
            break
        there = onward([answer.places.best.camera for answer in answers])
        most = path.descent.squares + _noise(layout, path.descent)
        if not there.descent.squares <= most:
            break
        path = path.then(there)
        answers = _answers(layout, path.descent, begun, own)
    seen = zip(answers, path.descent.seen, strict=True)
    return path, [_held(answer, one.view) for answer, one in seen]


def _noise(layout: Layout, found: Descent) -> float:
    """Return by how much sums of squares of equal places may differ."""
    pairs = zip(layout.eyes, found.seen, strict=True)
    return EQUAL_TIMES * max(max(e.solver.kind.variance, s.view.touched_misfit) for e, s in pairs)


def _held(answer: Asked, view: View) -> Asked:
    """Return the answer with the view's camera as the best, and another best among the others."""
    best, others, free, _ = answer.places
    if best.camera is answer.camera:
        return answer
    return answer._replace(places=Places(Found(answer.camera, view, ()), [best, *others], free))


def _answers(layout: Layout, found: Descent, begun: list[Begun], own: np.ndarray) -> list[Asked]:
    cameras = [eye.canonical(found.state) for eye in layout.eyes]
    if not all(np.all(np.isfinite(seen.view.triangle)) for seen in found.seen):
        here = zip(cameras, found.seen, strict=True)
        return [
            Asked(camera, Places(Found(camera, seen.view, ()), [], [])) for camera, seen in here
        ]
    from_others = known_by_others(layout, found, own, np.ones(len(cameras)))
    views = [seen.view for seen in found.seen]
    given = zip(layout.eyes, cameras, views, begun, from_others, strict=True)
    return [_answer(*each, own) for each in given]


def _answer(
    eye: Eye, camera: Camera, view: View, begun: Begun, from_others: FromOthers, own: np.ndarray
) -> Asked:
    """Return where a view's camera may be, given what the others tell."""
    solver = eye.solver
    rows, left = _beside(view, from_others, own)
    found = Found(camera, with_rows(view, rows, left), ())
    solver = solver.beside(_of_values(solver, camera, view, rows, left))
    if begun.start is None:
        places = looked_alike(solver, found, finished(solver, begun.modes))
    else:
        mask = replace(eye.mask, camera=on_film(camera, eye.mask.camera))
        places = looked_round(solver, mask, found, begun.start, _untold)
    places = _stayed(solver, places, found, begun.start)
    return Asked(camera, places)


def _beside(view: View, from_others: FromOthers, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what the others tell a view, and its priors, as residuals of its moves."""
    scale = np.asarray(view.scale, float)[~own]
    shared = np.zeros((len(from_others.others), len(own)))
    shared[:, ~own] = from_others.others * scale
    from_prior, left = from_others.from_prior
    slope = from_prior.T @ left
    slope[~own] += (from_others.slope - from_others.part.slope) * scale
    return in_few(view, np.concatenate([shared, from_prior]), slope)


def _of_values(
    solver: Solver, camera: Camera, view: View, rows: np.ndarray, left: np.ndarray
) -> Others:
    """Return residuals that are linear in a view's moves as such that are linear in what is
    reported of the camera."""
    known = np.any(rows != 0, axis=0)
    rigid = np.array([name in MOTIONS for name in solver.freed for _ in labels_of((name,))])
    known |= rigid & np.any(known & rigid)  # (a pose is told as a whole)
    values = [LABELS[label].value for label in labels_of(solver.freed)]
    at = [float(of(camera)) if of and k else 0.0 for of, k in zip(values, known, strict=True)]
    by_moves = np.where(np.outer(known, known), np.asarray(view.to_reported, float), 0.0)
    to = lambda x: jnp.asarray(x, solver.dtype)
    return Others(to(rows @ np.linalg.pinv(by_moves)), to(at), to(left))


def _stayed(solver: Solver, places: Places, found: Found, start: Camera | None) -> Places:
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
    near = separation(solver, place.camera, found.camera) < APART
    return bool(near and not better(solver, place.view, found.view))


def _untold(stop: Stop) -> None:
    del stop
