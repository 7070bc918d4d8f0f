"""Cameras that see the object behind something that nobody told of.

An occluder only takes away from a mask. Where it ends, the mask has an edge that is no edge of the
object's, and lies inside the object's outline. So the mask's edge is brought to the outline that a
camera sees (iterative closest points, Besl and McKay 1992), in and out by stretches: what lies far
inside loses its weight, and the more so the nearer the fit has come (graduated non-convexity, Blake
and Zisserman 1987); what lies outside keeps its weight, since nothing that hides can put it there.
Each camera is a proposal: the likelihood decides (`likelihood`).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from .._camera.axes import angle, distinct
from .._camera.camera import Camera
from .._files.progress import say
from .._mask.mask import Mask
from .._mask.search import partly_hidden
from .._numerics.threads import in_threads
from .._rules import RULES
from .._solver.moves import canonical
from .._solver.solver import Solver
from .edge import Edge, Pairs, matched, outline_seen

#: This many of its points are brought to the outline.
POINTS = 400

Window = np.ndarray | None


def near_starts(solver: Solver, edge: Edge, cameras: Iterable[Camera]) -> list[Camera]:
    """Where cameras lead to if the object is hidden on any side."""
    bringing = _Bringing.on(solver, edge)
    windows = (None, *_sectors(bringing.edge))
    return bringing.followed([(camera, w) for camera in cameras for w in windows])


def from_all_sides(
    solver: Solver, mask: Mask, edge: Edge, start: Camera | None = None
) -> list[Camera]:
    """Where views from all sides, or a few of those that a start does not rule out, lead to if the
    object is hidden on any side."""
    allowed = lambda guess: start is None or angle(guess, start) < RULES.too_far
    few = 1 if start is None else 4  # (a quarter of the sphere)
    bringing = _Bringing.on(solver, edge)
    directions = [None, *(2 * np.pi * np.arange(RULES.sectors) / RULES.sectors)]
    views = partly_hidden(mask, solver.subject.from_afar, solver.subject.ball, directions)
    windows = (None, *_sectors(bringing.edge))
    return bringing.followed(
        [
            (canonical(guess), window)
            for guesses, window in zip(views, windows, strict=True)
            for guess in islice(filter(allowed, guesses), RULES.tried // few)
        ],
        few,
    )


def _sectors(edge: Edge) -> list[np.ndarray]:
    """Weights (n,) of the mask's edge, each without the part on one side."""
    away = edge.at - edge.at.mean(axis=0)
    turns = 2 * np.pi * np.arange(RULES.sectors) / RULES.sectors
    along = [away @ [np.cos(turn), np.sin(turn)] for turn in turns]
    return [(far < np.quantile(far, 1 - RULES.taken)) * 1.0 for far in along]


class _Brought(NamedTuple):
    """A camera that the mask's edge was brought to, and the edge beside the outline that it
    sees."""

    camera: Camera
    pairs: Pairs


@dataclass(frozen=True, eq=False)
class _Bringing:
    """How an edge is brought to the outlines that cameras see on a level; `stretch` (n, n) takes
    means over stretches of it."""

    solver: Solver
    edge: Edge
    stretch: Any
    level: int

    @classmethod
    def on(cls, solver: Solver, edge: Edge) -> "_Bringing":
        some, level = edge.thinned(POINTS), min(solver.far, max(solver.finest - 1, 0))
        return cls(solver, some, _stretches(some), level)

    def followed(self, begins: list[tuple[Camera, Window]], few: int = 1) -> list[Camera]:
        """Where the closest of some cameras lead to, a part of as many as usual go on."""
        first = RULES.room * self.edge.size
        scales = np.geomspace(max(first, 1.0), 1.0, 2 * RULES.steps)
        found = [(seen, w) for camera, w in begins if (seen := self._seen(camera)) is not None]
        for number in RULES.rounds:
            say(f"looking for something in front of the object: {len(found)} guesses")
            found = self._brought(found, scales[:2])[: number // few]
            scales = scales[2:]
        return [
            seen.camera for seen, _ in self._brought([(seen, None) for seen, _ in found], scales)
        ]

    def _brought(
        self, found: list[tuple[_Brought, Window]], scales: np.ndarray
    ) -> list[tuple[_Brought, Window]]:
        """Where cameras are brought to, the closest first, and of each place that one: one turned
        by four times `RULES.same` is another."""
        solver, level = self.solver, self.level
        bring = lambda given: self._onward(given[0], given[1], scales)
        program = lambda given: solver.program(given[0].camera, level)
        ended = zip(in_threads(bring, found, program), (w for _, w in found), strict=True)
        found = sorted(((e, w) for e, w in ended if e), key=lambda f: -self._closeness(f[0]))
        return [*distinct(found, 4 * RULES.same, lambda f: f[0].camera)]

    def _onward(self, seen: _Brought, window: Window, scales: np.ndarray) -> _Brought | None:
        """The camera whose outline the edge was brought to, counting as far as `scales` (px) say
        step by step; None where no outline is seen."""
        solver = self.solver
        for scale in scales:
            pairs = seen.pairs
            weight = _weights(pairs, self.stretch, scale) * (1.0 if window is None else window)
            rows = pairs.by_move * np.sqrt(weight)[:, None]
            normal = rows.T @ rows
            damping = 1e-3 * np.trace(normal) / len(normal) + 1e-12
            right = rows.T @ (np.sqrt(weight) * pairs.off)
            step = np.linalg.solve(normal + damping * np.eye(len(normal)), right)
            if not np.all(np.isfinite(step)):
                return None
            far = max(float(np.max(np.abs(pairs.by_move @ step))), 1e-9)
            step *= min(1.0, RULES.smooth * self.edge.size / far)
            if (after := self._seen(solver.step(seen.camera, self.level, step))) is None:
                return None
            seen = after
        return seen

    def _seen(self, camera: Camera) -> _Brought | None:
        """A camera, if it sees an outline."""
        outline = outline_seen(self.solver, camera, self.level)
        return None if outline is None else _Brought(camera, matched(self.edge, outline))

    def _closeness(self, seen: _Brought) -> float:
        """How close the edge is to an outline: 1 where it lies on it, less where it is outside."""
        pairs, near = seen.pairs, max(RULES.close * self.edge.size, 2.0)
        close = np.clip(1 - (pairs.off / near) ** 2, 0, 1) * pairs.faces
        inside = float(np.mean((self.stretch @ close) * close))
        return inside - 0.5 * float(np.mean(pairs.off > 2 * near))


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
