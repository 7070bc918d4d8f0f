"""Central differences of an image, pixel by pixel, that recognise kinks.

Coverage is smooth in the camera almost everywhere. It has a kink (two slopes) where an edge lies
along a pixel's border or a face is seen edge-on. It bends where an outline passes a pixel's
corner. Both spoil a central difference only within its step. So steps come in pairs of h and h/2,
and each pixel takes the first pair whose differences agree (Richardson's test).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

#: Steps, in multiples of the first one: pairs of h and h/2.
STEPS = (1.0, 1 / 2, 1 / 8, 1 / 16)


class Scales(NamedTuple):
    """Steps and tolerances for the precision of derivatives and differences.

    - `step_px`: the motion of the picture by the first step (px).
    - `tolerance`: of a derivative, relative to the image's largest slope or to `least`.
    - `reverse`: the same for reverse against forward mode.
    - `least`: the least slope that is no rounding, in pixels' value per px of motion.
    - `exact`: the differences are in float64.
    """

    step_px: float
    tolerance: float
    reverse: float
    least: float
    exact: bool

    @classmethod
    def for_precision(
        cls, derivative: np.dtype, difference: np.dtype, size: int, tolerance: float | None
    ) -> "Scales":
        """Return the scales for two float types and the picture's larger side (px)."""
        exact = difference == np.float64
        double = exact and derivative == np.float64
        if tolerance is None:
            tolerance = 1e-6 if double else 1e-3 if exact else 0.1
        # Film coordinates are known to a rounding of the film's width: a step must outweigh that.
        rounding = 4 * float(np.finfo(difference).eps) * size
        step_px = rounding ** (1 / 3)
        least = max(0.02, rounding / (step_px * STEPS[-1]) / tolerance)
        return cls(step_px, tolerance, 1e-9 if double else 1e-4, least, exact)


Image = Float[np.ndarray, "H W"]


def compared(
    derivative: Image,
    middle: Image,
    up: Float[np.ndarray, "K H W"],
    down: Float[np.ndarray, "K H W"],
    step: float,
    allowed: float,
) -> tuple[Image, Bool[np.ndarray, "H W"], Image]:
    """Compare a derivative with images at x, x + h and x - h, for each h of `step * STEPS`.

    Return the central difference at the chosen step; where no pair of steps agrees; and how far the
    derivative is off: at a kink from the slopes to either side over the least step, between which
    it must lie, elsewhere from the central difference.

    Two differences agree if they are within `allowed` (per unit of x). They must agree on the
    slope, and on the gap between the slopes to either side. The gap halves with the step where the
    image is smooth, and stays at a kink at x itself, which central differences would hide.
    """
    h = step * np.asarray(STEPS)[:, None, None]
    right, left = (up - middle) / h, (middle - down) / h
    central, gap = (right + left) / 2, right - left
    slope, kink = central[-1], np.ones(middle.shape, bool)
    for k in range(len(STEPS) - 2, -1, -2):  # larger steps have less rounding
        agree = np.abs(central[k] - central[k + 1]) <= allowed
        agree &= np.abs(gap[k] - 2 * gap[k + 1]) <= allowed
        slope, kink = np.where(agree, central[k + 1], slope), kink & ~agree
    sides = np.where(kink, np.sort([left[-1], right[-1]], axis=0), slope)
    return slope, kink, np.maximum(sides[0] - derivative, derivative - sides[1]).clip(0)
