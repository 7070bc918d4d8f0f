"""What residual a right camera leaves in a mask, by the kind of mask.

A mask shows how it was made: computed (each pixel its exact coverage), quantised to 8 bits or a
few samples a pixel, cut to one bit, noisy all over, or with edges wider than a pixel.
Where that settles what is left at a right camera, a fit that leaves more is not at one.
"""

from typing import Any, NamedTuple

import numpy as np

from .._rules import RULES
from .edges import SparseImage, edge_band
from .target import as_coverage, beside, inside_of

#: What of coverage is not resolved in a float type: a fit's last step leaves this much, and a sum
#: along a row of a fine mesh's mask is 1 to within it.
RESOLVED = {np.dtype(np.float32): 3e-4, np.dtype(np.float64): 1e-7}
#: Quantisation leaves a step's square times this; samples at random leave half a step, times the
#: mean of c (1 - c).
UNIFORM, SAMPLED = 1 / 12, 1 / 6
#: An outline that cuts off pixels' corners leaves less of that: 0.6 to 1 of it was found.
CUT_CORNERS = 0.6
#: Rounding leaves this many machine epsilons in a pixel of the outline.
ROUNDING = 100
#: As many samples a pixel at most are told from 8 bits.
SAMPLES = 64
#: A pixel of an exact mask is off if its residual is this many standard deviations.
OFF_TIMES = 3.0


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
        """True if every pixel is 0 or 1."""
        return self.name == "one bit"

    @property
    def explained(self) -> float | None:
        """The largest residual of a pixel that is not off; None if the kind does not say."""
        return OFF_TIMES * self.variance**0.5 if self.exact else None

    def explains(self, misfit: float, nearly_free: bool) -> bool:
        """True if a right camera may leave this mean square residual of an outline pixel;
        where a turn or shift is nearly free, no more than the kind has to leave."""
        strict = nearly_free and self.exact
        return bool(misfit <= (RULES.times * self.variance if strict else self.most))


def kind_of(target: np.ndarray, weights: np.ndarray, dtype: Any) -> Kind:
    """Return the kind of a mask (see `check_target`) that is fitted in a float type."""
    grey, edge = _grey_pixels(target), beside(inside_of(target))
    if not grey.place.size or grey.place.size < RULES.grey_share * len(edge):
        uniform = (scale := _usual(weights[np.divmod(edge, target.shape[1])])) * UNIFORM
        return Kind("one bit", uniform, scale * RULES.hard, CUT_CORNERS * uniform, False)
    # A sum along a row of a fine mesh's mask is 1 to rounding only: one such pixel in an image is
    # not to make a computed mask a noisy one.
    floats = [np.dtype(x) for x in (dtype, target.dtype) if np.issubdtype(x, np.floating)]
    single = any(x.itemsize < 8 for x in floats)
    quiet, resolved = RESOLVED[np.dtype(np.float32 if single else np.float64)], RESOLVED[floats[0]]
    noise, far, even, spread = _noise_far_from_edges(target, weights, grey, quiet)
    threshold = max(4 * noise, 1e-3)
    weight = weights[grey.rows_columns]
    used = (grey.value > threshold) & (grey.value < 1 - threshold) & (weight > 0)
    between = SparseImage(grey.shape, grey.place[used], grey.value[used])
    scale = _usual(weight[used])
    # The least is rounding; the solver's last step may leave more.
    rounding = max(ROUNDING * float(np.finfo(dtype).eps), *(float(np.finfo(x).eps) for x in floats))
    variance, step = _quantisation(between.value)
    least = scale * max(rounding**2, UNIFORM * step**2)
    variance = scale * max(variance, rounding**2, resolved**2)
    if np.any(used) and np.mean(_in_threes(between)) > RULES.wide_share:
        width = _edge_width(target, between)
        # (Widths of 0.30, 0.48, 0.86 px, blurs of 0.5, 0.8, 1.5 px, leave 0.011, 0.056, 0.17.)
        left = (width**2 / 4 + noise**2) * scale
        return Kind("wide edges", left, max(RULES.hard * scale, 1.5 * left), least, False, far)
    if noise > 0:
        variance = scale * noise**2 + least
        most = RULES.times * variance if even else RULES.hard * scale
        return Kind("noisy", variance, most, least, even, far, spread)
    few = step >= 1 / SAMPLES
    # A renderer's 8 bits: some hundred samples a pixel, or its filter. Few samples may be a larger
    # mask's pixels, which anybody may have drawn: they leave as little as one bit does.
    times = RULES.hard / UNIFORM if few else RULES.times
    most = times * (SAMPLED / 1024 * scale if step == 1 / 255 else variance)
    return Kind("soft", variance, most, least, not few, alike=max(least, scale * resolved**2))


def _grey_pixels(target: np.ndarray) -> SparseImage:
    """Return the pixels of a mask that are neither 0 nor 1."""
    if target.dtype == bool:
        place = np.zeros(0, int)
    elif target.dtype == np.uint8:
        place = np.flatnonzero(target - np.uint8(1) < 254)  # (0 becomes 255)
    else:
        place = np.flatnonzero((target != 0) & (target != 1))
    return SparseImage(target.shape, place, as_coverage(target[np.divmod(place, target.shape[1])]))


def _usual(weights: np.ndarray) -> float:
    """Return the mean weight of pixels that have one, 1 if there are none."""
    some = weights[weights > 0]
    return float(np.mean(some)) if some.size else 1.0


def _noise_far_from_edges(
    target: np.ndarray, weights: np.ndarray, grey: SparseImage, quiet: float
) -> tuple[float, float, bool, float]:
    """Return the standard deviation of pixels that are 0 or 1 for certain, the mean of their
    weighted squares, and whether the noise is the same everywhere. Last, if it is, the standard
    error of the sum of as many pixels as are not certain.

    Pixels that are not `grey` are off by nothing. What is off by `quiet` at most is no noise.
    """
    band = edge_band(inside_of(target), RULES.beside)
    weight = weights[grey.rows_columns]
    away = (weight > 0) & ~np.isin(grey.place, band.place)
    nearest = np.round(grey.value[away])
    off = grey.value[away] - nearest
    off[np.abs(off) <= quiet] = 0
    squares = off**2
    if not np.any(squares):
        return 0.0, 0.0, True, 0.0
    beside = int(np.count_nonzero(weights[band.rows_columns]))
    number = np.count_nonzero(weights) - beside
    mean = float(np.sum(squares)) / number
    even = float(np.sum(squares**2)) / number < 2 * RULES.times * mean**2
    clipped = np.all(off[nearest > 0] <= 0) and np.all(off[nearest <= 0] >= 0)
    weighted = weight[away] * squares
    far = float(np.sum(weighted)) / number
    rest = number - weighted.size
    deviation = float((np.sum((weighted - far) ** 2) + rest * far**2) / number) ** 0.5
    spread = deviation * (beside * (1 + beside / number)) ** 0.5
    return (2 * mean if clipped else mean) ** 0.5, far, bool(even), float(even * spread)


def _in_threes(some: SparseImage) -> np.ndarray:
    """Return which pixels stand among three or more in their row, and in their column."""
    (row, column), width = some.rows_columns, some.shape[1] + 2
    place, both = row * width + column, np.ones(len(row), bool)
    for step in (1, width):
        a, b, c, d = (np.isin(place + k * step, place) for k in (-2, -1, 1, 2))
        both &= (a & b) | (b & c) | (c & d)
    return both


def _edge_width(target: np.ndarray, some: SparseImage) -> float:
    """Return the integral of m (1 - m) across an edge, in px: 1/6 for a sharp one."""
    slopes, limit = [], np.array(target.shape)[:, None] - 1
    for step in np.eye(2, dtype=int)[..., None]:  # as `np.gradient` has it
        before, after = (np.clip(some.rows_columns + k * step, 0, limit) for k in (-1, 1))
        rise = as_coverage(target[tuple(after)]) - as_coverage(target[tuple(before)])
        slopes.append(rise / np.maximum(np.sum(after - before, axis=0), 1))
    slope = float(np.sum(np.hypot(*slopes)))
    return float(np.sum(some.value * (1 - some.value)) / max(slope, 1e-9))


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
