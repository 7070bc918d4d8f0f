"""The postures of a robot in which one more mask would determine its camera best."""

from collections.abc import Sequence

import numpy as np

from .. import Camera, JointView, joint_observability


def worths(
    views: Sequence[JointView],
    camera: Camera,
    free: str,
    proposed: Sequence[JointView],
    joint_zeros: float | None = None,
) -> list[float]:
    """Return the factor by which one more mask of each proposed view would reduce the standard
    errors of the camera's pose (their geometric mean), by `joint_observability`.

    It is infinite if the masks of `views` do not determine the pose and one more would.
    """

    def size(views: Sequence[JointView]) -> float:
        found = joint_observability(views, camera, free, joint_zeros=joint_zeros)
        pose = [name.startswith(("camera rotation_", "camera e_")) for name in found.names]
        covariance = found.covariance[np.ix_(pose, pose)]
        if not np.all(np.isfinite(covariance)):
            return np.inf
        return float(np.linalg.slogdet(covariance)[1]) / (2 * len(covariance))

    before, after = size(views), [size([*views, view]) for view in proposed]
    return [float(np.exp(before - x)) if x < before else 1.0 for x in after]


def best_postures(factors: Sequence[float]) -> str:
    """Return a sentence on the proposed postures that would help most, the best first."""
    best = sorted(range(len(factors)), key=lambda k: -factors[k])
    each = ", ".join(f"row {k + 1} {factors[k]:.2f}" for k in best[:5])
    return f"one more mask would divide the standard errors of the pose by: {each}"
