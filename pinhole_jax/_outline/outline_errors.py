"""By how much a mask's outline is off, over which length: read from where a fit's outline lies.

People and networks draw outlines that are off by stretches, and all outwards or inwards. Pixels of
one stretch err together, so they say less about the camera than as many by themselves, and the sum
of squares tells two cameras apart less well. The offset of the mask's outline from the fit's,
stretch by stretch, shows how large such errors are and how far they reach.

The offsets y (px, outwards) at N stretches are taken as X t + b + g + q: the camera's own error t
by the derivatives X, a bias b of the whole outline, errors g, and quantisation q. The covariance of
g is exp(-(distance/length)^power), rough or smooth. What the camera absorbs does not show, so
sizes, lengths and shapes are weighed by their restricted likelihood (Patterson and Thompson 1971: t
and b integrated out). The hypothesis that the mask is computed (q alone) is among them; a
covariance is the mean of the hypotheses'.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .._mask.edges import Weights
from .._rules import RULES
from .._solver.looks import View
from .stretches import Stretches, stretches_of

#: A px of a straight edge touches at most this many pixels; an outline that touches more has
#: several edges in a pixel, and each errs. (Smooth outlines and scans: 1.25; a hedgehog: 1.4,
#: soup: 2.2.)
STRAIGHT = 2**0.5
#: At least so much of an outline is within a pixel of the mask's.
LEAST_RATE = 0.1
#: The shape that stretches show: how areas are shared out among them is rough.
ROUGH = ((1, 0),)
#: Each stretch errs by itself by at least this share of the variance: where errors are smooth
#: rounding would decide.
NUGGET = 1e-6
#: Steps to a mixture's mode at most; one of fewer standard errors is the last.
CLIMB, REST = 20, 0.01


class OutlineErrors(NamedTuple):
    """How a mask's outline errs, as a fit's own outline shows it.

    - `size`: standard deviation of its offset (px), `length`: over which it is correlated (px),
      both the hypotheses' geometric mean; 0 for a mask that is likely computed.
    - `computed`: how likely it is that it has no errors but quantisation.
    - `independent`: as many offsets that are independent would tell sums of squares apart as well.
    - `gradient` (n, n): the covariance of half the gradient of the sum of squares by the solver's
      moves if the mask is not computed, times how likely that is; larger by `felt`^-2.
    - `felt`: the share of a small move that the gradient feels: an outline farther than a pixel
      from the mask's pulls no more than one a pixel away. 1 for a mask that is computed.
    """

    size: float
    length: float
    computed: float
    independent: float
    gradient: np.ndarray
    felt: float = 1.0


def is_drawn(errors: OutlineErrors | None) -> bool:
    """True if a person or a network made the mask, not a program."""
    return errors is not None and errors.computed < 1 - RULES.sure


def is_computed(errors: OutlineErrors | None) -> bool:
    """True if surely a program made the mask."""
    return errors is None or errors.computed > RULES.sure


def outline_errors(
    view: View,
    target: np.ndarray,
    weights: Weights,
    quantisation: float,
    hard: bool,
    believed: bool = True,
) -> OutlineErrors | None:
    """The errors of the mask's outline, None if too little of an outline is seen.

    `target` and `weights` are (H, W), `quantisation` is the mean square residual that quantisation
    leaves in an outline pixel of weight 1; a mask is `hard` whose pixels are 0 or 1. Unless all of
    it is `believed`, pixels say less surely that it is computed.
    """
    stretches = stretches_of(view, target, weights)
    if stretches is None or len(stretches.offset) < 2 * stretches.by_move.shape[1] + 4:
        return None
    odds = _odds_of_computed(stretches.beyond, stretches.pixels) if hard else 0.0
    return _weighed(stretches, quantisation, odds if believed else min(odds, RULES.partly))


def _odds_of_computed(beyond: int, pixels: int) -> float:
    """The logarithm of the odds that a mask of one bit is computed, by the number of an outline's
    pixels on the wrong side: a drawn one may as well have any share of them, up to a half.

    Where an outline is drawn, offsets of whole stretches may be those of a camera that is wrong,
    and what is left no larger than quantisation; but not its single pixels.
    """
    from scipy.special import betainc, betaln

    right = pixels - beyond
    computed = beyond * np.log(RULES.strays) + right * np.log1p(-RULES.strays)
    parts = beyond + 1.0, right + 1.0
    drawn = betaln(*parts) + np.log(2 * betainc(*parts, 0.5))
    return float(computed - drawn)


def _weighed(stretches: Stretches, quantisation: float, odds: float) -> OutlineErrors:
    """Return the mean of the hypotheses, each as likely as the offsets are under it, and as the
    mask is of being computed (by logarithmic `odds`)."""
    felt, offset = _felt(stretches.offset, stretches.share)
    px = float(np.sum(stretches.length))
    crowded = max(1.0, stretches.pixels / px / STRAIGHT)
    rounding = quantisation * crowded / float(np.mean(stretches.length))
    model = ErrorModel(stretches.at, rounding, RULES.lengths, ROUGH)
    logs = model.evidence(offset, stretches.by_move).log
    logs[0] += odds
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    if weights[0] > RULES.sure:
        weights = np.where(np.arange(len(weights)), 0.0, 1.0)
    independent = model.independent()
    independent[0] = px
    pull = stretches.by_move.T * stretches.share
    drawn = np.where(np.arange(len(weights)), weights, 0.0)
    mean = lambda values: float(np.exp(drawn[1:] @ np.log(values[1:]) / np.sum(drawn)))
    errs = np.argmax(weights) > 0
    return OutlineErrors(
        size=mean(model.size) if errs else 0.0,
        length=mean(model.length) if errs else 0.0,
        computed=float(weights[0]),
        independent=float(weights @ independent),
        gradient=pull @ model.covariance(drawn) @ pull.T,
        felt=float(weights[0] + (1 - weights[0]) * felt),
    )


def _felt(offset: np.ndarray, share: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the share of a small move that the gradient feels, and the offsets (px) that would
    move the camera as these do if it felt all.

    An outline that is farther than a pixel away pulls no more than one that is a pixel away: a
    pixel's residual d - d |d| / 2 grows no further, in the mean of where the outline crosses it.
    """
    near = np.clip(offset, -1, 1)
    rate = np.sum(share * (1 - np.abs(near))) / max(np.sum(share), 1e-300)
    rate = max(float(rate), LEAST_RATE)
    return rate, (near - near * np.abs(near) / 2) / rate


class Evidence(NamedTuple):
    """By hypotheses (h,): the likelihoods' logarithms, the camera's `move` (h, n) by generalised
    least squares, the `bias` (h,) of all offsets, and the camera's `covariance` (h, n, n). Moves
    are damped where they hardly show."""

    log: np.ndarray
    move: np.ndarray
    bias: np.ndarray
    covariance: np.ndarray

    @property
    def total(self) -> float:
        """The logarithm of the likelihood, all hypotheses together."""
        return float(np.logaddexp.reduce(self.log))


class ErrorFit(NamedTuple):
    """A likelihood's logarithm; the errors' size (px) at the likeliest hypothesis, and by how much
    all of the edge is off there (`bias`). Of all hypotheses, each as likely as it is: the likeliest
    `move` (n,), and the camera's `covariance` (n, n) about it."""

    log: float
    size: float
    bias: float
    move: np.ndarray
    covariance: np.ndarray

    @property
    def spread(self) -> np.ndarray:
        """The mean square error (n, n) of a camera that stays where it is."""
        return self.covariance + np.outer(self.move, self.move)


class ErrorModel:
    """Hypotheses on how a mask's edge errs at N places: that it is computed, and all sizes, biases,
    lengths and shapes.

    - `size`, `length` (h,): of each hypothesis (px).
    """

    def __init__(
        self,
        at: np.ndarray,
        quantisation: float,
        lengths: Sequence[float],
        shapes: Sequence[tuple[int, int]],
    ):
        """Places (N, 2) in px, and the variance that quantisation leaves in an offset."""
        kinds = [(length, *shape) for length in lengths for shape in shapes]
        distance = np.linalg.norm(at[:, None] - at, axis=-1)
        extent = float(np.sqrt(np.mean(distance**2)))
        self._alike = [partial(_correlation, extent, *kind) for kind in kinds]
        correlations = [np.eye(len(at)), *(alike(distance) for alike in self._alike)]
        self._correlation = np.stack(correlations)

        # Covariances: a kind and a size. (The same errors with another bias have the same.)
        sizes = len(RULES.sizes)
        kind = np.concatenate([[0], np.repeat(1 + np.arange(len(kinds)), sizes)])
        size = np.concatenate([[0], np.tile(RULES.sizes, len(kinds))])
        far = size**2
        near = np.maximum(RULES.alike * quantisation, NUGGET * far)
        covariances = far[:, None, None] * self._correlation[kind]
        covariances += near[:, None, None] * np.eye(len(at))
        self._precision = np.linalg.inv(covariances)
        self._determinant = np.linalg.slogdet(covariances)[1]

        # Hypotheses: a covariance and a bias. (Computed or drawn: nothing speaks for one.)
        times, px, likely = np.array(RULES.biases).T
        self._of = of = np.repeat(np.arange(len(size)), [1] + [len(px)] * (len(size) - 1))
        bias = np.hypot(times * size[1:, None], px).ravel()
        self._kind, self._far, self._near = kind[of], far[of], near[of]
        self._bias = np.concatenate([[0], bias])
        self._prior = np.concatenate([[1], np.tile(likely, len(size) - 1) / (len(size) - 1)]) / 2
        self.size = size[of]
        self.length = np.array([0.0, *(length for length, *_ in kinds)])[self._kind]

    def evidence(
        self,
        offset: np.ndarray,
        by_move: np.ndarray,
        gross: np.ndarray | None = None,
        computed: float | None = None,
    ) -> Evidence:
        """The evidence of offsets (N,) with derivatives (N, n), without those that are gross (N,):
        the camera's error, the bias and gross offsets integrated out, by normal equations.
        `computed`: how likely it is that the mask is, if more than offsets tells."""
        scale = np.maximum(np.linalg.norm(by_move, axis=0), 1e-300)
        columns = np.column_stack([by_move / scale, np.ones(len(offset)), offset])
        inner, right, squares, determinant = self._normal(columns, gross)
        tight = np.maximum(self._bias, 1e-6)
        inner[:, -1, -1] += tight**-2
        trace = np.trace(inner[:, :-1, :-1], axis1=1, axis2=2)[:, None, None]
        eye = np.eye(inner.shape[1])
        inner += 1e-12 * (1 + trace) * eye
        damped = inner + RULES.weak**2 * trace / max(len(eye) - 1, 1) * eye
        moved = np.linalg.solve(damped, right[..., None])[..., 0]
        inverse = np.linalg.inv(inner)
        left = squares - np.einsum("hi,hij,hj->h", right, inverse, right)
        logs = determinant + 2 * np.log(tight) + np.linalg.slogdet(inner)[1]
        logs = np.log(self._prior) - (logs + left) / 2
        if computed is not None:
            with np.errstate(divide="ignore"):
                odds = np.log(computed) - np.log1p(-computed)
            logs[0] = np.logaddexp.reduce(logs[1:]) + odds
        return Evidence(
            log=logs,
            move=moved[:, :-1] / scale,
            bias=moved[:, -1],
            covariance=inverse[:, :-1, :-1] / np.outer(scale, scale),
        )

    def _normal(
        self, columns: np.ndarray, gross: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Normal equations (h, k, k), (h, k) and squares (h,) of columns (N, k + 1), the last the
        offsets, and the logarithms (h,) of the covariances' determinants."""
        weighed = self._precision @ columns
        products, determinant = columns.T @ weighed, self._determinant
        if gross is not None and np.any(gross):
            # Of the others, by Schur's complement.
            some = self._precision[:, gross][:, :, gross]
            part = weighed[:, gross]
            products = products - np.swapaxes(part, 1, 2) @ np.linalg.solve(some, part)
            determinant = determinant + np.linalg.slogdet(some)[1]
        products = products[self._of]
        inner, right, squares = products[:, :-1, :-1], products[:, :-1, -1], products[:, -1, -1]
        return inner, right, squares, determinant[self._of]

    def fit(self, found: Evidence) -> ErrorFit:
        """What the evidence says, all hypotheses together, and where the camera is likeliest."""
        share, likeliest = np.exp(found.log - found.total), int(np.argmax(found.log))
        move = _mode(found)
        apart = found.move - move
        return ErrorFit(
            log=found.total,
            size=float(self.size[likeliest]),
            bias=float(found.bias[likeliest]),
            move=move,
            covariance=np.tensordot(share, found.covariance, axes=1) + (share * apart.T) @ apart,
        )

    def covariance(self, weights: np.ndarray) -> np.ndarray:
        """The covariance (N, N) of the errors and their bias: the hypotheses' (h,) weighed sum."""
        far = np.bincount(self._kind, weights * self._far, len(self._correlation))
        covariance = np.tensordot(far, self._correlation, axes=1) + weights @ self._bias**2
        return covariance + weights @ self._near * np.eye(len(covariance))

    def between(self, hypothesis: int, distance: Any) -> Any:
        """By how much (px, standard deviation) errors differ at places this far (k,) apart."""
        kind = self._kind[hypothesis]
        alike = self._alike[kind - 1](distance) if kind else 1.0
        return self.size[hypothesis] * np.sqrt(2 * (1 - alike))

    def independent(self) -> np.ndarray:
        """As many offsets that are independent have sums of squares that vary as much, by
        hypotheses (h,): correlations count by their squares."""
        far, near, count = self._far, self._near, self._correlation.shape[1]
        alike = far**2 * np.sum(self._correlation**2, axis=(1, 2))[self._kind]
        return (count * (far + near)) ** 2 / (alike + (2 * far * near + near**2) * count)


def _correlation(extent: float, length: float, power: int, whole: int, distance: Any) -> Any:
    """The correlation of errors at places these distances apart: they fall off by that power of the
    distance, over a length; and `whole` times as much errs over an outline's extent."""
    fall = lambda length: np.exp(-((distance / length) ** power))
    return (fall(length) + whole * fall(extent)) / (1 + whole)


def _mode(found: Evidence) -> np.ndarray:
    """The likeliest move (n,), uphill from none: hypotheses are a mixture of normal distributions
    (expectation-maximisation)."""
    precise = np.linalg.inv(found.covariance)
    logs = found.log + np.linalg.slogdet(precise)[1] / 2
    pull = (precise @ found.move[..., None])[..., 0]
    # (As products of matrices, squares multiplied out, this takes half the time.)
    logs, squares = logs - np.sum(pull * found.move, axis=1) / 2, precise.reshape(len(logs), -1)
    move = np.zeros(found.move.shape[1])
    for _ in range(CLIMB):
        density = logs + pull @ move - squares @ np.outer(move, move).ravel() / 2
        near = np.exp(density - np.max(density))
        by_move = (near @ squares).reshape(precise.shape[1:])
        before, move = move, np.linalg.solve(by_move, near @ pull)
        change = move - before
        if change @ by_move @ change < REST**2 * np.sum(near):
            break
    return move
