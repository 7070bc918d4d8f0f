"""By how much a mask's outline is off, over which length: read from where a fit's outline lies.

People and networks draw outlines that are off by stretches, and all outwards or inwards. Pixels of
one stretch err together, so they say less about the camera than as many by themselves, and the sum
of squares tells two cameras apart less well. The offset of the mask's outline from the fit's,
stretch by stretch, shows how large such errors are and how far they reach.

The offsets y (px, outwards) at N stretches are taken as X t + b + g + q: the camera's own error t
by the derivatives X, a bias b of the whole outline, errors g, and quantisation q. A share of g is
each stretch's own; the rest has covariance exp(-(distance/length)^power), rough or smooth. What
the camera absorbs does not show, so sizes, lengths and shapes are weighed by their restricted
likelihood (Patterson and Thompson 1971: t and b integrated out). The hypothesis that the mask is
computed (q alone) is among them; a covariance is the mean of the hypotheses'.
"""

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
#: Each stretch errs by itself by at least this share of the variance: where errors are smooth
#: rounding would decide.
NUGGET = 1e-6


class OutlineErrors(NamedTuple):
    """How a mask's outline errs, as a fit's own outline shows it.

    - `size`: standard deviation of its offset (px), `length`: over which it is correlated (px),
      both as the likeliest hypothesis has them; 0 for a mask that is computed.
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


class _Hypotheses(NamedTuple):
    log_likelihood: np.ndarray
    move: np.ndarray
    offset: np.ndarray
    covariance: np.ndarray
    gradient: np.ndarray
    independent: np.ndarray
    size: np.ndarray
    length: np.ndarray


def outline_errors(
    view: View, target: np.ndarray, weights: Weights, quantisation: float, hard: bool
) -> OutlineErrors | None:
    """The errors of the mask's outline, None if too little of an outline is seen.

    `target` and `weights` are (H, W), `quantisation` is the mean square residual that quantisation
    leaves in an outline pixel of weight 1; a mask is `hard` whose pixels are 0 or 1.
    """
    stretches = stretches_of(view, target, weights)
    if stretches is None or len(stretches.offset) < 2 * stretches.by_move.shape[1] + 4:
        return None
    odds = _odds_of_computed(stretches.beyond, stretches.pixels) if hard else 0.0
    return _weighed(stretches, quantisation, odds)


def _odds_of_computed(beyond: int, pixels: int) -> float:
    """The logarithm of the odds that a mask of one bit is computed, by the number of an outline's
    pixels on the wrong side: a drawn one may have any share of them, up to a half.

    Where an outline is drawn, offsets of whole stretches may be those of a camera that is wrong,
    and what is left no larger than quantisation; but not its single pixels.
    """
    from scipy.special import logsumexp

    shares = np.geomspace(RULES.strays, 0.5, 100)
    likely = lambda share: beyond * np.log(share) + (pixels - beyond) * np.log1p(-share)
    drawn = logsumexp(likely(shares)) - np.log(len(shares))
    return float(likely(RULES.strays) - drawn)


def _weighed(stretches: Stretches, quantisation: float, odds: float) -> OutlineErrors:
    """Return the mean of the hypotheses, each as likely as the offsets are under it, and as the
    mask is of being computed (by logarithmic `odds`)."""
    felt, offset = _felt(stretches.offset, stretches.share)
    model = _Model(stretches, quantisation, offset)
    together = _hypotheses(model, RULES.lengths, RULES.rough)
    together.independent[0] = np.sum(stretches.length)
    logs = together.log_likelihood
    logs[0] += odds
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    if weights[0] > RULES.sure:
        weights = np.where(np.arange(len(weights)), 0.0, 1.0)
    likeliest = int(np.argmax(weights))
    return OutlineErrors(
        size=float(together.size[likeliest]),
        length=float(together.length[likeliest]),
        computed=float(weights[0]),
        independent=float(weights @ together.independent),
        gradient=np.tensordot(weights[1:], together.gradient[1:], axes=1),
        felt=float(weights[0] + (1 - weights[0]) * felt),
    )


def _hypotheses(
    model: "_Model", lengths: tuple[float, ...], shapes: tuple[tuple[float, float, float], ...]
) -> _Hypotheses:
    """The hypotheses on a mask's errors: that it is computed, and all sizes, biases, lengths and
    shapes."""
    none, even = np.zeros(1), 0.5  # (computed or drawn: nothing speaks for one beforehand)
    found = [model.hypotheses(0.0, (1.0, 0.0, 0.0), none, none, np.full(1, even))]
    times, px, likely = np.array(RULES.biases).T
    sizes, bias = np.repeat(RULES.sizes, len(px)), np.tile([times, px], len(RULES.sizes))
    bias = np.hypot(bias[0] * sizes, bias[1])
    several = [(length, shape) for length in lengths for shape in shapes]
    prior = even * np.tile(likely, len(RULES.sizes)) / (len(RULES.sizes) * len(several))
    found += [model.hypotheses(*one, sizes, bias, prior) for one in several]
    return _Hypotheses(*map(np.concatenate, zip(*found, strict=True)))


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


class Offsets(NamedTuple):
    """Offsets (N,) of a mask's edge at blocks of a `length` (N,) in px, and their derivatives
    `by_move` (N, n) of the solver."""

    at: np.ndarray
    length: np.ndarray
    offset: np.ndarray
    by_move: np.ndarray


class ErrorFit(NamedTuple):
    """A likelihood's logarithm; the errors' size and length at the likeliest hypothesis, and by how
    much all of the edge is off there (`bias`). Of all hypotheses, each as likely as it is: the
    `move` (n,) by generalised least squares, damped where it hardly shows, and the camera's
    `covariance` (n, n)."""

    log: float
    size: float
    length: float
    bias: float
    move: np.ndarray
    covariance: np.ndarray


def weigh(offsets: Offsets, quantisation: float, roughly: bool = False) -> ErrorFit:
    """How likely offsets are, all hypotheses on the mask's errors together, or some of them."""
    from scipy.special import logsumexp

    stretches = Stretches(*offsets, np.zeros(len(offsets.offset)), 0, 0)
    model = _Model(stretches, quantisation, stretches.offset)
    few = RULES.lengths[1:2], RULES.shapes[:1]
    grid = few if roughly else (RULES.lengths, RULES.shapes)
    together = _hypotheses(model, *grid)
    logs = together.log_likelihood
    total: Any = logsumexp(logs)
    share, likeliest = np.exp(logs - total), int(np.argmax(logs))
    move = _likeliest_move(logs, together.move, together.covariance)
    apart = together.move - move
    return ErrorFit(
        log=float(total),
        size=float(together.size[likeliest]),
        length=float(together.length[likeliest]),
        bias=float(together.offset[likeliest]),
        move=move,
        covariance=np.tensordot(share, together.covariance, axes=1) + (share * apart.T) @ apart,
    )


def _likeliest_move(logs: np.ndarray, moves: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """The mode (n,), uphill from 0, of a mixture of normal distributions: of logarithms (h,) of
    weights, means (h, n) and covariances (h, n, n). It climbs by expectation-maximisation."""
    precise = np.linalg.inv(covariances)
    logs = logs + np.linalg.slogdet(precise)[1] / 2
    move = np.zeros(moves.shape[1])
    for _ in range(20):
        apart = moves - move
        density = logs - np.einsum("hi,hij,hj->h", apart, precise, apart) / 2
        near = np.exp(density - np.max(density))
        total = np.tensordot(near, precise, axes=1)
        move = np.linalg.solve(total, np.einsum("h,hij,hj->i", near, precise, moves))
    return move


class _Model:
    """Offsets (N,) at stretches, and what hypotheses make of them."""

    def __init__(self, stretches: Stretches, quantisation: float, offset: np.ndarray):
        X, self.count = stretches.by_move, len(offset)
        between = stretches.at[:, None] - stretches.at[None]
        self._distance = np.sqrt(np.sum(between**2, axis=-1))
        self._reach = float(np.sqrt(np.mean(self._distance**2)))
        crowded = max(1.0, stretches.pixels / float(np.sum(stretches.length)) / STRAIGHT)
        self._quantisation = RULES.alike * quantisation * crowded / float(np.mean(stretches.length))
        self._scale = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        units = X / self._scale
        self._columns = np.column_stack([units, np.ones(self.count), offset])
        self._pull = X.T * stretches.share

    def hypotheses(
        self,
        length: float,
        shape: tuple[float, float, float],
        size: np.ndarray,
        bias: np.ndarray,
        prior: np.ndarray,
    ) -> _Hypotheses:
        """The hypotheses of errors of sizes (h,), over a length, with biases.

        A shape is a power, a share and a number. Errors fall off by that power of the distance;
        the share is each stretch's own. The number says how many times as much errs over as far as
        the outline reaches.
        """
        power, own, whole = shape
        correlation = np.eye(self.count)
        if length:
            fall = lambda length: np.exp(-((self._distance / length) ** power))
            correlation = (fall(length) + whole * fall(self._reach)) / (1 + whole)
        far = size**2 * (1 - own)
        near = np.maximum(size**2 * own + self._quantisation, NUGGET * far)

        # (The same errors with another bias have the same covariance.)
        _, once, which = np.unique(size, return_index=True, return_inverse=True)
        own_errors = near[once, None, None] * np.eye(self.count)
        covariance = far[once, None, None] * correlation + own_errors
        white, log_determinant = _whitened(covariance, self._columns, near[once])
        products = (white @ np.swapaxes(white, 1, 2))[which]

        # The camera's error and the bias integrated out: by their normal equations.
        inner, right, squares = products[:, :-1, :-1], products[:, :-1, -1], products[:, -1, -1]
        tight = np.maximum(bias, 1e-6)
        inner[:, -1, -1] += tight**-2
        trace = np.trace(inner[:, :-1, :-1], axis1=1, axis2=2)[:, None, None]
        eye = np.eye(inner.shape[1])
        inner += 1e-12 * (1 + trace) * eye
        damped = inner + RULES.weak**2 * trace / max(len(eye) - 1, 1) * eye
        moved = np.linalg.solve(damped, right[..., None])[..., 0]
        move, offset = moved[:, :-1] / self._scale, moved[:, -1]
        covariance = np.linalg.inv(inner)[:, :-1, :-1] / np.outer(self._scale, self._scale)
        left = squares - np.sum(right * np.linalg.solve(inner, right[..., None])[..., 0], axis=1)
        logs = log_determinant[which] + 2 * np.log(tight)
        logs += np.linalg.slogdet(inner)[1]

        pull = self._pull
        total = pull.sum(axis=1)
        parts = pull @ correlation @ pull.T, pull @ pull.T, np.outer(total, total)
        gradient = np.tensordot(np.stack([far, near, bias**2], axis=1), np.stack(parts), axes=1)
        # How much sums of squares vary: correlations count by their squares.
        alike = far**2 * np.sum(correlation**2) + (2 * far * near + near**2) * self.count
        independent = (self.count * (far + near)) ** 2 / alike
        lengths = np.full(size.shape, length)
        log = np.log(prior) - (logs + left) / 2
        return _Hypotheses(log, move, offset, covariance, gradient, independent, size, lengths)


def _whitened(
    covariance: np.ndarray, columns: np.ndarray, least: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return columns (n, k) as rows (h, k, n) that have unit covariance under each of covariances
    (h, n, n), and the logarithms of their determinants (h,). No eigenvalue is below `least` (h,).

    Cholesky's factor of the covariance with the columns as further rows holds both. (An
    eigendecomposition serves all sizes of a length, and costs the same; but BLAS spreads it over
    threads, and those wait for one another: beside other work 0.5 ms became 250.)
    """
    count, rows = columns.shape
    whole = np.zeros((len(covariance), count + rows, count + rows))
    whole[:, :count, :count] = covariance
    whole[:, count:, :count] = columns.T
    # So large that the whole is positive definite, too: what is wanted does not depend on it.
    last = np.arange(count, count + rows)
    whole[:, last, last] = (1 + 2 * np.sum(columns**2) / least)[:, None]
    factor = np.linalg.cholesky(whole)
    diagonal = np.diagonal(factor, axis1=1, axis2=2)[:, :count]
    return factor[:, count:, :count], 2 * np.sum(np.log(diagonal), axis=1)
