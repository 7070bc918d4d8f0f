"""Errors that neighbouring points share: of a lens, of a bent board."""

from typing import Any

import numpy as np

from .._camera.camera import Camera
from .._numerics.arrays import evenly
from .._rules import RULES
from .noise import Noise
from .reprojection import Matches, exact_squares

#: Errors may be alike over these shares of how far points spread on the film, and have this many
#: times the noise's variance. (Of 13 poses of chessboards by a lens without its distortion
#: the median is 2.8 sigma off in 6 numbers; by independent errors 23.)
LENGTHS, SIZES = (0.25, 0.5, 1.0), 4.0 ** np.arange(-2, 9)
#: By this many points, spread evenly among all, one sees whether errors are alike.
SAMPLE = 100


def alike(matches: Matches, camera: Camera, noise: Noise) -> np.ndarray:
    """The covariance (n, n) of J^T r, in the noise's variance, by errors that are alike where
    points are neighbours on the film: of a lens, of a bent board. 0 where independent errors
    explain the residuals r, or these are not to show how points err.

    Errors are noise and a smooth Gaussian process (in x, and in y), of the size and length whose
    restricted likelihood is largest (Patterson and Thompson 1971).
    """
    some = matches.different(and_seen=True)
    some = some[evenly(len(some), SAMPLE)]
    by_point, left = matches.rows(camera, some)
    J = by_point.reshape(2 * len(some), -1)
    spare, result = len(J) - J.shape[1], np.zeros((J.shape[1], J.shape[1]))
    shows = 0 < noise.freedom < np.inf and np.sum(left**2) > exact_squares(matches)
    if spare <= 0 or not shows:
        return result
    root = np.sqrt(np.asarray(matches.given.weight[some], float))[:, None]
    # (Where the camera sees them: where they are said to be seen is off by what is asked about.)
    at = np.asarray(matches.given.seen_at[some], float) + left / root
    spread = max(np.sum(np.var(at, axis=0)), np.finfo(float).tiny)
    away = np.sum((at[:, None] - at) ** 2, axis=2) / spread
    across: Any = np.linalg.qr(J, mode="complete")[0][:, J.shape[1] :]
    rest = across.T @ left.ravel()
    best = independent = spare * np.log(np.mean(rest**2))
    for length in LENGTHS:
        smooth = np.kron(root * root.T * np.exp(-away / (2 * length**2)), np.eye(2))
        values, vectors = np.linalg.eigh(across.T @ smooth @ across)
        for times in SIZES:
            variances = 1 + times * np.maximum(values, 0)
            variance = np.mean((vectors.T @ rest) ** 2 / variances)
            unlikely = spare * np.log(variance) + np.sum(np.log(variances))
            if unlikely < min(best, independent - RULES.times**2):
                best, result = unlikely, times * variance / noise.shown * J.T @ smooth @ J
    return result * (len(matches.counts) / len(some)) ** 2
