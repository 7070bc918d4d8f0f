"""How likely a mask is if a camera saw it: one number for all of its edge.

Let y (px, outwards) be the offsets of N blocks of the mask's edge from the outline that a camera
sees. They are X t + b + g + q, as in `outline_errors`, but for runs of blocks that are gross: an
occluder, a hole, a part that the mesh lacks. What y is there does not count (the nearest outline
may change sides); a run costs what a smooth curve as large as the object takes to describe, and
each of its ends log N, since it may be at any block. Outline that the mask has no edge beside, and
that nothing hides, costs as much.
"""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from .._mask.edges import SparseImage
from .._outline.outline_errors import ErrorFit, ErrorModel, Evidence
from .._rules import RULES
from .edge import EXACT_PX, Edge, OutlinePoints, matched

#: Runs are tried this many blocks longer at both ends.
WIDER = (1, 2, 4)


@dataclass(frozen=True, eq=False)
class Account:
    """What a mask's edge is to a camera.

    - `log`: the logarithm of its likelihood, up to a constant of the mask.
    - `errors`: how the edge errs where it is believed. Its `move` goes where the camera is
      likelier; that is a `shift` of the outline by as much as this (px).
    - `gross` (n,): which points of the edge are not believed; `inside` (n,): which lie inside the
      outline, where something may hide the rest; `outside` (n,): which lie farther out of it than
      an edge errs.
    - `missing`: which share of the outline has no edge beside it, and nothing hides it; `covered`:
      which share something hides.
    """

    log: float
    errors: ErrorFit
    gross: np.ndarray
    inside: np.ndarray
    outside: np.ndarray
    missing: float
    covered: float
    shift: float

    def knowing(self, off: np.ndarray, by_move: np.ndarray) -> "Account":
        """The account with a prior: how many standard deviations parameters are off (k,), and by
        the moves (k, n)."""
        precise = np.linalg.pinv(self.errors.covariance)
        covariance = np.linalg.inv(precise + by_move.T @ by_move)
        move = covariance @ (precise @ self.errors.move - by_move.T @ off)
        errors = self.errors._replace(move=move, covariance=covariance)
        return replace(self, log=self.log - float(off @ off) / 2, errors=errors)

    @property
    def far(self) -> float:
        """How many standard errors the `move` is."""
        move, covariance = self.errors.move, self.errors.covariance
        return float(move @ np.linalg.pinv(covariance) @ move) ** 0.5

    @property
    def is_drawn(self) -> bool:
        """Whether the mask's edge errs by more than quantisation."""
        return self.errors.size > 0

    def unbelieved(self, edge: Edge) -> float:
        """The share of a mask's edge that is not believed."""
        return float(np.sum(edge.step[self.gross]) / edge.length)

    def astray(self, edge: Edge) -> float:
        """The share of edge and outline that no occluder explains."""
        return self.missing + float(np.sum(edge.step[self.gross & self.outside]) / edge.length)

    def words(self, edge: Edge, height: int) -> tuple[np.ndarray, tuple[str, ...]]:
        """The points (n, 2) of the edge that are not believed, and a sentence on them; a few are
        no matter."""
        some = edge.at[self.gross]
        share = self.unbelieved(edge)
        if share < RULES.little:
            return some[:0], ()
        x, y = some[np.argmin(np.linalg.norm(some - np.median(some, axis=0), axis=1))]
        place = f"near column {int(x)}, row {height - 1 - int(y)}"
        why = "something may be in front of the object"
        return some, (f"{share:.0%} of the mask's edge ({place}) was ignored: {why}",)

    def hidden(self, edge: Edge, least: float) -> float:
        """The share of a mask's edge that may be an occluder's: of curves that are no crumbs."""
        whole = np.bincount(edge.curve, edge.step)
        large = whole[edge.curve] > least * np.sum(whole)
        return float(np.sum(edge.step[self.gross & self.inside & large]) / np.sum(whole))


class _EdgeReading(NamedTuple):
    """A way to read an edge.

    - `log`: the logarithm of its likelihood; `evidence`: by a `model` of where it is believed.
    - `gross` (N,): which of its blocks are not; `reach`: how far out the others may be (px).
    - `missing`, `covered`: shares of the outline, as an `Account` has them.
    """

    log: float
    model: ErrorModel
    evidence: Evidence
    gross: np.ndarray
    reach: float
    missing: float
    covered: float


class Likelihood:
    """The likelihood of a mask's edge, whose pixels' quantisation leaves them this mean square; the
    mask may be computed or drawn."""

    def __init__(self, edge: Edge, quantisation: float):
        self.edge, self._computed = edge, None
        self._blocks = edge.blocks(RULES.stretches, RULES.stretch)
        self._rounding = max(quantisation, EXACT_PX**2)

    @cached_property
    def _middles(self) -> np.ndarray:
        return self._blocks.mean(self.edge.at)

    @cached_property
    def _rough(self) -> ErrorModel:
        return self._model(RULES.lengths[1:2], RULES.shapes[:1])

    @cached_property
    def _fine(self) -> ErrorModel:
        return self._model(RULES.lengths, RULES.shapes)

    def _model(self, lengths: Any, shapes: Any) -> ErrorModel:
        variance = self._rounding / float(np.mean(self._blocks.length))
        return ErrorModel(self._middles, variance, lengths, shapes)

    def knowing(self, computed: float) -> "Likelihood":
        """The likelihood if so likely the mask is computed, by the same models."""
        known = copy(self)
        known._computed = computed
        return known

    def account(self, outline: OutlinePoints | None, roughly: bool = False) -> Account | None:
        """The account by a camera that sees an outline; None where there is none, or nearly all of
        it is elsewhere. `roughly`: with few hypotheses on how the edge errs."""
        edge, blocks = self.edge, self._blocks
        if outline is None or len(blocks.length) < outline.by_move.shape[1] + 4:
            return None
        pairs, (away, nearest) = matched(edge, outline), edge.nearest(outline.at)
        limit = edge.size / 2
        offset = blocks.mean(np.clip(pairs.off, -limit, limit))
        by_move, ends = blocks.mean(pairs.by_move), float(np.log(len(offset)))

        def read(gross: np.ndarray, model: ErrorModel) -> _EdgeReading:
            found = model.evidence(offset, by_move, gross, self._computed)
            likeliest = int(np.argmax(found.log))
            size, bias = float(model.size[likeliest]), float(found.bias[likeliest])
            # As dense as what lies about a smooth curve within a pixel.
            log = found.total - np.sum(gross) / 2
            runs = np.count_nonzero(gross != np.roll(gross, 1)) / 2
            px = float(np.sum(blocks.length[gross]))
            log -= 2 * ends * runs + _price(px, runs, edge.size, 1.0)
            reach = max(RULES.within * size, RULES.beside) + abs(bias)
            # What sticks out of an edge is no error of it, however far errors are smooth.
            beside = np.where(gross, 0, np.abs(offset))[blocks.of[nearest]]
            differing = RULES.within * model.between(likeliest, away)
            alone = away > beside + np.maximum(differing, RULES.beside)
            whole, hides = np.mean(alone), (gross & (offset < 0))[blocks.of]
            alone[alone] = ~_is_hidden(edge, hides, outline.at[alone], away[alone])
            missing = float(np.mean(alone))
            px, covered = missing * outline.length, float(whole) - missing
            rough = float(model.between(likeliest, RULES.smooth * edge.size))
            log -= _price(px, min(px / 3, 1.0), edge.size, max(rough, 0.3))
            log -= covered / RULES.small  # (how much an occluder hides: exponential)
            return _EdgeReading(float(log), model, found, gross, reach, missing, covered)

        found = self._likeliest(read, self._runs(offset), roughly)
        if found is None or found.missing > 1 - RULES.small:
            return None
        errors = found.model.fit(found.evidence)
        gross, inside, outside = (
            x[blocks.of] for x in (found.gross, offset < 0, offset > found.reach)
        )
        shift = float(np.max(np.abs(pairs.by_move @ errors.move)))
        shares = found.missing, found.covered
        return Account(found.log, errors, gross, inside, outside, *shares, shift)

    def _likeliest(
        self,
        read: Callable[[np.ndarray, ErrorModel], _EdgeReading],
        runs: list[np.ndarray],
        roughly: bool,
    ) -> _EdgeReading | None:
        """The likeliest reading by runs of gross errors (N,), or by longer ones; None without."""
        if not runs:
            return None
        if len(runs) == 1 and not roughly:
            return read(runs[0], self._fine)
        tried = [read(x, self._rough) for x in runs]
        # Where an occluder meets the outline, a camera can be turned onto a part of it.
        gross = max(tried, key=lambda x: x.log).gross
        wider = [_widened(gross, by) for by in WIDER] if np.any(gross) else []
        tried += [read(x, self._rough) for x in wider if np.mean(x) <= 1 - RULES.small]
        first, *others = sorted(tried, key=lambda x: -x.log)
        if roughly:
            return first
        # (More hypotheses make readings that differ by so much no more alike.)
        near = [x for x in others[:1] if x.log > first.log - 2 * RULES.as_likely]
        return max((read(x.gross, self._fine) for x in [first, *near]), key=lambda x: x.log)

    def _runs(self, offset: np.ndarray) -> list[np.ndarray]:
        """None, and the cheapest runs (N,) of gross offsets for each size of the others; nothing if
        nearly all are gross."""
        length, size = self._blocks.length, np.hypot(RULES.sizes, self._rounding**0.5)[:, None]
        price = np.log(np.maximum(RULES.gross * self.edge.size / size, 1.5))
        share = np.clip(length / (2 * RULES.lengths[0]), 0, 1)
        fits = share * ((offset / size) ** 2 - 1) / 2
        numbers = length / (RULES.smooth * self.edge.size)
        runs = _cheapest(fits, numbers * price, np.log(len(offset)) + price[:, 0] / 2)
        several = {x.tobytes(): x for x in runs if np.mean(x) <= 1 - RULES.small}
        none = np.zeros(len(offset), bool)
        return list({none.tobytes(): none, **several}.values()) if several else []


def _widened(gross: np.ndarray, by: int) -> np.ndarray:
    """Runs (N,) round a closed curve, this much longer at both ends."""
    return np.any([np.roll(gross, k) for k in range(-by, by + 1)], axis=0)


def _is_hidden(edge: Edge, hides: np.ndarray, points: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Which points (k, 2) of an outline, so far from an edge, an occluder may hide: one whose edge
    is about as near as any."""
    if not (np.any(hides) and len(points)):
        return np.zeros(len(points), bool)
    return edge.where(hides).nearest(points)[0] < 1.5 * away + 2


def _price(px: float, runs: float, size: float, precision: float) -> float:
    """The cost of describing smooth curves of this length (px) in all to a precision (px)."""
    numbers = runs + px / (RULES.smooth * size)
    return float(numbers * max(np.log(RULES.gross * size / precision), 0.0))


def _cheapest(zero: np.ndarray, one: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The cheapest ways (K, N) of zeros and ones round a closed curve of N blocks (Viterbi).

    Costs: `zero` and `one` (K, N) of a block, `change` (K,) from block to block.
    """
    zero, one, more = zero.T[..., None], one.T[..., None], change[:, None]
    # Each way begins as 0 or as 1, and has to end where it began: (N, K, first). By how much a one
    # at a block costs more than a zero there, with all before it:
    excess = np.empty((len(zero), len(change), 2))
    excess[0] = np.inf, -np.inf
    for k in range(1, len(zero)):
        excess[k] = np.maximum(np.minimum(excess[k - 1], more), -more) + (one[k] - zero[k])
    ways = np.empty(excess.shape, bool)
    state = excess[-1] < more * [-1, 1]
    for k in range(len(zero) - 1, -1, -1):
        ways[k] = state
        state = excess[k - 1] < np.where(state, more, -more)
    costs = np.sum(np.where(ways, one, zero), axis=0)
    costs += more * np.sum(ways != np.roll(ways, 1, axis=0), axis=0)
    return np.where(costs[:, 0] <= costs[:, 1], *np.moveaxis(ways, 2, 0)).T


def believed(near: SparseImage, edge: Edge, gross: np.ndarray) -> SparseImage:
    """Weights of pixels near a mask's edge, 0 where its nearest point is not believed, and in some
    room about such points: else the camera that they were taken from is confirmed."""
    if not np.any(gross):
        return near
    row, column = np.divmod(near.place, near.shape[1])
    at = np.column_stack([column + 0.5, near.shape[0] - row - 0.5])
    close = edge.where(gross).nearest(at)[0] < max(RULES.room * edge.size, RULES.beside)
    return near._replace(value=np.where(gross[edge.nearest(at)[1]] | close, 0.0, near.value))
