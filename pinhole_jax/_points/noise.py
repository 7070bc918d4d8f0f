"""What points err by: given, or shown by the coordinates that are left over."""

from typing import NamedTuple

import numpy as np

from .._joint.agreement import width_by_few
from .._solver.least_squares import LinearSolution

#: Squares may be larger by chance with this probability (an F test). Then a plane's wrong pose
#: passes for the only one at most once in 2000 times.
CHANCE = 1e-3
#: Intervals are widened where up to `FEW` coordinates show the variance (by 4 % then); from
#: `MANY` on it is known.
FEW, MANY = 30, 1e9
#: Views disagree more than by chance with this probability. What a view alone knows but for a
#: share `OTHERS` no other can contradict.
CHANCE_OF_VIEWS, OTHERS = 1e-2, 1e-3


class Noise(NamedTuple):
    """How points err.

    - `shown`: the variance (px^2) of a coordinate of weight 1, infinite where none is left over.
    - `freedom`: how many coordinates show it; infinite where it is given.
    """

    shown: float
    freedom: float

    @property
    def variance(self) -> float:
        """The variance with which 95 % intervals hold the truth, also where few coordinates
        show it."""
        return self.shown * _widening(1.0 * self.freedom) ** 2

    @property
    def by_chance(self) -> float:
        """The increase of the sum of squares (px^2) that chance may cause, 0 where nothing is
        known."""
        from scipy.stats import f

        if not self.freedom > 0:
            return 0.0
        return self.shown * float(f.ppf(1 - CHANCE, 1, min(self.freedom, MANY)))

    @property
    def at_most(self) -> float:
        """The factor by which standard errors may exceed those by `variance`, by chance."""
        from scipy.stats import chi2

        if not np.isfinite(self.freedom):
            return 1.0
        least = float(chi2.ppf(CHANCE, self.freedom)) / self.freedom
        return least**-0.5 / _widening(1.0 * self.freedom)


def _widening(freedom: float) -> float:
    """The width of a 95 % interval where this many coordinates show the variance, in that of one
    where it is known."""
    return width_by_few(freedom) if 0 < freedom <= FEW else 1.0


def beyond_noise(solved: LinearSolution, views: int, noise: Noise) -> np.ndarray:
    """The root B (s, s) by which views that disagree widen the covariance of shared moves: by
    B B^T times the noise's variance, 0 where independent errors explain it by chance. The first
    parts that were solved are those of `views`.

    Each view is a cluster: the sandwich of Bell and McCaffrey (2002), which has no bias where
    errors are independent. Of few views it is noisy, so it is drawn towards its mean.
    """
    from scipy.stats import f

    back, pulls, shares, against = solved.back, [], [], []
    nothing = np.zeros_like(back)
    if not (nothing.size and 0 < noise.shown < np.inf and noise.freedom < np.inf):
        return nothing
    for part in solved.reduced[:views]:
        left = part.rows @ solved.x[solved.shared] + part.left
        by_shared = part.rows @ back  # moves whose covariance is 1
        share, vectors = np.linalg.eigh(by_shared.T @ by_shared)
        counts = share < 1 - OTHERS
        share = share * counts
        pulls.append(vectors @ (counts * (vectors.T @ by_shared.T @ left) / (1 - share) ** 0.5))
        shares.append(share)
        against.append(vectors * (share**2 / (1 - share)) @ vectors.T)
    if not (mean := float(np.sum(shares))) > 0:
        return nothing

    # Were errors independent, the squares would be `mean` times chi2 / `freedom` (Satterthwaite).
    spread = np.sum(np.sum(against, axis=0) ** 2) - np.sum(np.square(against))
    freedom = mean**2 / (spread + np.sum(np.square(shares)))
    middle = np.transpose(pulls) @ np.array(pulls) / noise.shown
    excess, even = float(np.trace(middle)) / mean, mean**2 / (mean**2 + freedom)
    if not excess > f.ppf(1 - CHANCE_OF_VIEWS, freedom, noise.freedom):
        return nothing
    values, vectors = np.linalg.eigh((1 - even) * middle + even * excess * np.eye(len(middle)))
    return back @ vectors * np.sqrt(np.maximum(values - 1, 0))
