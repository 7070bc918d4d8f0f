"""Cameras that see the object behind something that nobody told of.

An occluder only takes away from a mask. Where it ends, the mask has an edge that is no edge of the
object's, and lies inside the object's outline. So the mask's edge is brought to the outline that a
camera sees (iterative closest points, Besl and McKay 1992), in and out by stretches: what lies far
inside loses its weight, and the more so the nearer the fit has come (graduated non-convexity, Blake
and Zisserman 1987); what lies outside keeps its weight, since nothing that hides can put it there.
Each camera is a proposal: the likelihood decides (`likelihood`).
"""

from collections.abc import Iterable
from itertools import islice
from typing import Any

import numpy as np

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .._files.progress import say
from .._mask.mask import Mask
from .._mask.search import partly_hidden
from .._rules import RULES
from .._solver.moves import canonical
from .._solver.solver import Solver
from .edge import Edge, OutlinePoints, Pairs, matched, outline_seen

#: This many of its points are brought to the outline.
POINTS = 400

Window = np.ndarray | None


def near_starts(solver: Solver, edge: Edge, cameras: Iterable[Camera]) -> list[Camera]:
    """Where cameras lead to if the object is hidden on any side."""
    some = edge.thinned(POINTS)
    begins = [(camera, w) for camera in cameras for w in (None, *_sectors(some))]
    return _followed(solver, some, begins)


def from_all_sides(solver: Solver, mask: Mask, edge: Edge) -> list[Camera]:
    """Where views from all sides lead to if the object is hidden on any side."""
    some = edge.thinned(POINTS)
    directions = [None, *(2 * np.pi * np.arange(RULES.sectors) / RULES.sectors)]
    views = partly_hidden(mask, solver.subject.from_afar, solver.subject.ball, directions)
    begins = [
        (canonical(guess), window)
        for guesses, window in zip(views, [None, *_sectors(some)], strict=True)
        for guess in islice(guesses, RULES.tried)
    ]
    return _followed(solver, some, begins)


def _sectors(edge: Edge) -> list[np.ndarray]:
    """Weights (n,) of the mask's edge, each without the part on one side."""
    away = edge.at - edge.at.mean(axis=0)
    turns = 2 * np.pi * np.arange(RULES.sectors) / RULES.sectors
    along = [away @ [np.cos(turn), np.sin(turn)] for turn in turns]
    return [(far < np.quantile(far, 1 - RULES.taken)) * 1.0 for far in along]


def _followed(solver: Solver, edge: Edge, begins: list[tuple[Camera, Window]]) -> list[Camera]:
    """Where the closest of some cameras lead to."""
    level = min(solver.far, max(solver.finest - 1, 0))
    scales = np.geomspace(max(RULES.room * edge.size, 1.0), 1.0, 2 * RULES.steps)
    stretch = _stretches(edge)
    for number in RULES.rounds:
        say(f"looking for something in front of the object: {len(begins)} guesses")
        some, scales = scales[:2], scales[2:]
        ended = [_brought(solver, edge, stretch, c, level, some, w) for c, w in begins]
        found = [(*e, w) for e, (_, w) in zip(ended, begins, strict=True) if e is not None]
        found.sort(key=lambda f: -f[1])
        begins = _apart([(camera, w) for camera, _, w in found])[:number]
    ended = [_brought(solver, edge, stretch, c, level, scales) for c, _ in begins]
    closest = sorted((e for e in ended if e is not None), key=lambda e: -e[1])
    return [camera for camera, _ in _apart(closest)]


def _apart(found: list[tuple[Camera, Any]]) -> list[tuple[Camera, Any]]:
    """The first of each place, a turn by `APART` being another one."""
    if not found:
        return []
    axes = np.stack([axes_of(camera) for camera, _ in found])
    cosine = (np.einsum("aij,bij->ab", axes, axes) - 1) / 2
    kept: list[int] = []
    for k in range(len(found)):
        if np.all(cosine[k, kept] < np.cos(4 * RULES.same)):
            kept.append(k)
    return [found[k] for k in kept]


def _brought(
    solver: Solver,
    edge: Edge,
    stretch: Any,
    camera: Camera,
    level: int,
    scales: np.ndarray,
    window: Window = None,
) -> tuple[Camera, float] | None:
    """The camera whose outline the mask's edge was brought to, counting as far as `scales` (px)
    say step by step, and how close the edge is; None where no outline is seen."""
    outline = outline_seen(solver, camera, level)
    for scale in scales:
        if outline is None:
            return None
        pairs = matched(edge, outline)
        weight = _weights(pairs, stretch, scale) * (1.0 if window is None else window)
        rows = pairs.by_move * np.sqrt(weight)[:, None]
        normal = rows.T @ rows
        damping = 1e-3 * np.trace(normal) / len(normal) + 1e-12
        right = rows.T @ (np.sqrt(weight) * pairs.off)
        step = np.linalg.solve(normal + damping * np.eye(len(normal)), right)
        if not np.all(np.isfinite(step)):
            return None
        far = max(float(np.max(np.abs(pairs.by_move @ step))), 1e-9)
        camera = solver.step(camera, level, step * min(1.0, RULES.smooth * edge.size / far))
        outline = outline_seen(solver, camera, level)
    return None if outline is None else (camera, _closeness(edge, outline, stretch))


def _closeness(edge: Edge, outline: OutlinePoints, stretch: Any) -> float:
    """How close an edge is to an outline: 1 where it lies on it, less where it is outside."""
    pairs, near = matched(edge, outline), max(RULES.close * edge.size, 2.0)
    close = np.clip(1 - (pairs.off / near) ** 2, 0, 1) * pairs.faces
    return float(np.mean((stretch @ close) * close) - 0.5 * np.mean(pairs.off > 2 * near))


def _weights(pairs: Pairs, stretch: Any, scale: float) -> np.ndarray:
    """What points of an edge count for: by stretches, and those outside in any case."""
    off = pairs.off / scale
    weight = (1 + off**2) ** -2 * np.where(pairs.faces, 1, 0.1)
    weight = (stretch @ weight) / (1 + off**2 / 9)
    return np.where(off > 0, np.maximum(weight, 1 / (1 + np.abs(off))), weight)


def _stretches(edge: Edge) -> Any:
    """The mean over the stretch about each point, as a sparse matrix (n, n)."""
    from scipy.sparse import csr_matrix
    from scipy.spatial import KDTree

    radius = max(RULES.room * edge.size, 3.0)
    place = np.column_stack([edge.at, radius * edge.out])
    pairs = KDTree(place).query_pairs(radius, output_type="ndarray")
    own = np.arange(len(edge.at))
    a, b = (np.concatenate([*x, own]) for x in (pairs.T, pairs.T[::-1]))
    near = csr_matrix((np.ones(len(a)), (a, b)), shape=(len(own), len(own)))
    return csr_matrix(near.multiply(1 / (near @ np.ones(len(own)))[:, None]))
