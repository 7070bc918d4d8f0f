"""What residual a right camera leaves in a mask, by the kind of mask.

A mask tells by itself how it was made: computed (each pixel its exact coverage), quantised to 8
bits or to a few samples a pixel, cut to one bit, noisy all over, or with edges wider than a pixel.
Where that settles what is left at a right camera, a fit that leaves more is not at one.
"""

from typing import Any, NamedTuple

import numpy as np

from .problem import FINE_PX
from .target import edge_distance, near_an_edge, shares

#: Quantisation leaves a step's square times this; samples at random leave half a step, times the
#: mean of c (1 - c).
UNIFORM, SAMPLED = 1 / 12, 1 / 6
#: An outline that cuts off pixels' corners leaves less of that: 0.6 to 1 of it was found.
CUT_CORNERS = 0.6
#: Rounding leaves this many machine epsilons in a pixel of the outline.
ROUNDING = 100
#: As many samples a pixel at most are told from 8 bits.
SAMPLES = 64
#: Far from edges: this many px away.
FAR_PX = 3.0
#: Edges are wide if this share of the pixels between 0 and 1 lies in runs of 3 and more both ways.
#: (Exact coverage: 0 to 0.01, a blur of 0.3 px: 0.01 to 0.18, of 0.5 px: 0.98 and more.)
WIDE_SHARE = 0.3
#: A wide edge's residual beside a sharp one: this much for each px of `_edge_width` above the
#: exact edge's. (Blurs of 0.5, 0.8, 1.5 px: 0.011, 0.056, 0.17; widths 0.30, 0.48, 0.86 px.)
PER_WIDTH, SHARP_WIDTH, LEAST_WIDE = 0.3, 0.25, 0.01
#: Noise whose fourth moment is above this many squares of its second is not the same everywhere
#: (Gaussian: 3; what JPEG leaves: tens).
UNEVEN = 8.0
#: A right camera leaves at most this many times the variance.
TIMES = 4.0
#: ... and of a mask that says nothing exact, as much as a hard edge may (1/12 on average).
HARD = 0.1


class Kind(NamedTuple):
    """A kind of mask.

    - `name`: one bit, soft, noisy or wide edges.
    - `variance`: the mean square residual of an outline pixel that a right camera leaves.
    - `most`: what it leaves at most, with samples, filters and thresholds as masks have them.
    - `least`: what it has to leave: quantisation and rounding.
    - `exact`: whether more than `most` says that the camera, the mesh or the mask is wrong; else it
      may be what the mask's maker did to its edges.
    - `far`: the mean weighted square of a pixel far from the mask's edges.
    - `alike`: what quantisation, rounding and the last step leave: less is not told apart.
    - `spread`: of noise that is even, the standard error of the sum of squares of all pixels that
      are not so far; else 0.
    """

    name: str
    variance: float
    most: float
    least: float
    exact: bool
    far: float = 0.0
    spread: float = 0.0
    alike: float = 0.0

    @property
    def hard(self) -> bool:
        """Return whether every pixel is 0 or 1."""
        return self.name == "one bit"

    def explains(self, misfit: float, nearly_free: bool) -> bool:
        """Return whether a right camera may leave this mean square residual of an outline pixel;
        where a turn or shift is nearly free, no more than the kind has to leave."""
        strict = nearly_free and self.exact
        return misfit <= (TIMES * self.variance if strict else self.most)


def kind_of(target: np.ndarray, weights: np.ndarray, dtype: Any) -> Kind:
    """Return the kind of a mask (see `check_target`) that is fitted in a float type."""
    image = shares(target)
    if np.all((image == 0) | (image == 1)):
        uniform = (scale := _weight_at_edges(image, weights)) * UNIFORM
        return Kind("one bit", uniform, scale * HARD, CUT_CORNERS * uniform, False)
    noise, far, even, spread = _noise_far_from_edges(image, weights)
    threshold = max(4 * noise, 1e-3)
    between = (image > threshold) & (image < 1 - threshold) & (weights > 0)
    counted = image[between]
    scale = float(np.mean(weights[between])) if counted.size else 1.0
    # The least is rounding; the solver's last step may leave more.
    rounding = ROUNDING * float(np.finfo(dtype).eps)
    if np.issubdtype(target.dtype, np.floating):
        rounding = max(rounding, float(np.finfo(target.dtype).eps))
    variance, step = _quantisation(counted)
    least = scale * max(rounding**2, UNIFORM * step**2)
    variance = scale * max(variance, rounding**2, FINE_PX[np.dtype(dtype)] ** 2)
    if counted.size and np.mean(_shorter_run(between)[between] > 2) > WIDE_SHARE:
        width = _edge_width(image, between)
        left = (max(PER_WIDTH * (width - SHARP_WIDTH), LEAST_WIDE) + noise**2) * scale
        return Kind("wide edges", left, max(HARD * scale, 1.5 * left), least, False, far)
    if noise > 0:
        variance = scale * noise**2 + least
        most = TIMES * variance if even else HARD * scale
        return Kind("noisy", variance, most, least, even, far, spread)
    # A renderer's 8 bits: some hundred samples a pixel, or its filter.
    most = TIMES * (SAMPLED / 1024 * scale if step == 1 / 255 else variance)
    alike = max(least, scale * FINE_PX[np.dtype(dtype)] ** 2)
    return Kind("soft", variance, most, least, True, alike=alike)


def _weight_at_edges(image: np.ndarray, weights: np.ndarray) -> float:
    """Return the mean weight of pixels at the mask's edge that have one, 1 if there are none."""
    if weights.strides == (0, 0):
        return float(weights.flat[0])
    counted = weights[(weights > 0) & (near_an_edge(edge_distance(image), 1.0) > 0)]
    return float(np.mean(counted)) if counted.size else 1.0


def _noise_far_from_edges(
    image: np.ndarray, weights: np.ndarray
) -> tuple[float, float, bool, float]:
    """Return the standard deviation of pixels that are 0 or 1 for certain, the mean of their
    weighted squares, whether the noise is the same everywhere, and if it is the standard error of
    the sum of as many as are not certain."""
    away = (weights > 0) & (near_an_edge(edge_distance(image), FAR_PX) == 0)
    off = (image - np.round(image))[away]
    squares = off**2
    if not np.any(squares):
        return 0.0, 0.0, True, 0.0
    mean = float(np.mean(squares))
    even = float(np.mean(squares**2)) < UNEVEN * mean**2
    inside = np.round(image)[away] > 0
    clipped = np.all(off[inside] <= 0) and np.all(off[~inside] >= 0)
    weighted = weights[away] * squares
    near = np.count_nonzero(weights) - squares.size
    spread = float(np.std(weighted)) * (near * (1 + near / squares.size)) ** 0.5
    deviation = (2 * mean if clipped else mean) ** 0.5
    return deviation, float(np.mean(weighted)), even, float(even * spread)


def _shorter_run(between: np.ndarray) -> np.ndarray:
    """Return for each pixel the length of the run of marked ones that it is in: the shorter one of
    its row's and its column's."""
    return np.minimum(_runs(between), _runs(between.T).T)


def _runs(marked: np.ndarray) -> np.ndarray:
    """Return the length of each pixel's run of marked pixels in its row, 0 outside."""
    flat = np.pad(marked, ((0, 0), (0, 1))).ravel().astype(np.int8)
    change = np.diff(flat, prepend=0)
    start, stop = np.flatnonzero(change > 0), np.flatnonzero(change < 0)
    result = np.zeros(flat.shape, int)
    result[flat > 0] = np.repeat(stop - start, stop - start)
    return result.reshape(marked.shape[0], -1)[:, :-1]


def _edge_width(image: np.ndarray, between: np.ndarray) -> float:
    """Return the integral of m (1 - m) across an edge, in px: 1/6 for a sharp one."""
    slope = np.hypot(*np.gradient(image))
    return float(np.sum((image * (1 - image))[between]) / max(float(np.sum(slope[between])), 1e-9))


def _quantisation(values: np.ndarray) -> tuple[float, float]:
    """Return the variance that steps between a mask's possible values leave, and the step."""
    if not values.size:
        return 0.0, 0.0
    sample = values[:: max(values.size // 2000, 1)]
    if sample.size > 32:
        for n in (*range(2, SAMPLES + 1), 128, 256, 512, 1024):
            # 8 bits may have rounded a small number of samples once more.
            slack = 0.6 * n / 255 if n <= SAMPLES else 0
            if np.all(np.abs(n * sample - np.round(n * sample)) < slack + 1e-3):
                return SAMPLED / n, 1 / n
    for steps in (255, 65535):
        if np.all(np.abs(steps * values - np.round(steps * values)) < 1e-2):
            return UNIFORM / steps**2, 1 / steps
    return 0.0, 0.0
