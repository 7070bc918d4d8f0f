"""The postures of a robot in which one more mask would determine its camera best."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from .. import Camera, Scene
from .._camera.poses import Pose, at_pose, pose_of
from .._fit.observability import information
from .._solver.parameters import check_free, labels_of

#: The pose's parameters, as a fit names them.
POSE = labels_of(("pose",))
#: A scene, and the pose (4, 4) of the link that carries the camera (None: none does).
Sight = tuple[Scene, Pose | None]
#: A direction is not determined if its information is below this share of the largest.
SINGULAR = 1e-14


def worths(
    camera: Camera,
    covariance: Float[np.ndarray, "n n"],
    free: Sequence[str],
    seen: Sequence[Sight],
    proposed: Sequence[Sight],
) -> list[float]:
    """Return the factor by which one more mask of each proposed sight would reduce the standard
    errors of the camera's pose (their geometric mean).

    One more mask is taken to be as good as those `seen`: the `covariance` of the reported
    parameters says how much less information these gave than masks without errors. The factor is
    infinite if the masks seen do not determine all parameters and one more would.
    """
    names = labels_of(check_free(free, camera))
    information_of = lambda sight: _information(camera, sight[0], sight[1], free, names)
    ideal = np.sum([information_of(sight) for sight in seen], axis=0)
    place = [names.index(name) for name in POSE]
    if not (np.all(np.isfinite(covariance)) and _regular(ideal)):
        return [np.inf if _regular(ideal + information_of(sight)) else 1.0 for sight in proposed]
    size = lambda matrix: np.linalg.slogdet(matrix)[1]
    lost = np.exp((size(covariance) + size(ideal)) / len(covariance))
    before, result = np.linalg.inv(covariance), []
    for sight in proposed:
        after = np.linalg.inv(before + information_of(sight) / lost)
        grown = size(covariance[np.ix_(place, place)]) - size(after[np.ix_(place, place)])
        result.append(float(np.exp(grown / (2 * len(place)))))
    return result


def best_postures(factors: Sequence[float]) -> str:
    """Return a sentence on the proposed postures that would help most, the best first."""
    best = sorted(range(len(factors)), key=lambda k: -factors[k])
    each = ", ".join(f"row {k + 1} {factors[k]:.2f}" for k in best[:5])
    return f"one more mask would divide the standard errors of the pose by: {each}"


def _information(
    camera: Camera, scene: Scene, mount: Pose | None, free: Sequence[str], names: Sequence[str]
) -> Float[np.ndarray, "n n"]:
    """Return a mask's information (inverse covariance) about a camera whose pose is in the frame of
    its link (`mount`), or in the world."""
    if mount is None:
        return information(camera, scene, free)
    known = information(at_pose(camera, mount @ pose_of(camera)), scene, free)
    # Turns are about the camera's own axes, whatever its frame; its eye is in the link's.
    eye = [names.index(name) for name in ("e_x", "e_y", "e_z")]
    frame = np.eye(len(names))
    frame[np.ix_(eye, eye)] = mount[:3, :3]
    return frame.T @ known @ frame


def _regular(total: Float[np.ndarray, "n n"]) -> bool:
    """Return True for information that determines all directions, each in its own unit."""
    size = np.sqrt(np.diagonal(total))
    if not np.all(size > 0):
        return False
    values = np.linalg.eigvalsh(total / np.outer(size, size))
    return bool(values[0] > SINGULAR * values[-1])
