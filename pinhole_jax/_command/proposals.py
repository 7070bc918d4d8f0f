"""Which further posture of a robot would tell most of where its camera is."""

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
#: Information whose smallest share is below this one of its largest tells nothing of a direction.
SINGULAR = 1e-14


def worths(
    camera: Camera,
    covariance: Float[np.ndarray, "n n"],
    free: Sequence[str],
    seen: Sequence[Sight],
    proposed: Sequence[Sight],
) -> list[float]:
    """Return by how many times one more mask would shrink the standard errors of the camera's pose,
    in the (geometric) mean, for each of the proposed sights.

    A further mask is taken to be as good as those of what was `seen`: their information is that of
    masks without errors, less what the `covariance` of the reported parameters says they have lost.
    Infinite where these masks do not determine all parameters, and with one more they would.
    """
    names = labels_of(check_free(free, camera))
    tells = lambda sight: _tells(camera, sight[0], sight[1], free, names)
    ideal = np.sum([tells(sight) for sight in seen], axis=0)
    place = [names.index(name) for name in POSE]
    if not (np.all(np.isfinite(covariance)) and _regular(ideal)):
        return [np.inf if _regular(ideal + tells(one)) else 1.0 for one in proposed]
    size = lambda matrix: np.linalg.slogdet(matrix)[1]
    lost = np.exp((size(covariance) + size(ideal)) / len(covariance))
    before, result = np.linalg.inv(covariance), []
    for one in proposed:
        after = np.linalg.inv(before + tells(one) / lost)
        grown = size(covariance[np.ix_(place, place)]) - size(after[np.ix_(place, place)])
        result.append(float(np.exp(grown / (2 * len(place)))))
    return result


def in_words(numbers: Sequence[float]) -> str:
    """Return which of the proposed postures tell most, the best first."""
    best = sorted(range(len(numbers)), key=lambda k: -numbers[k])
    each = ", ".join(f"row {k + 1} {numbers[k]:.2f}" for k in best[:5])
    return f"a mask more would make the standard errors of the pose this many times smaller: {each}"


def _tells(
    camera: Camera, scene: Scene, mount: Pose | None, free: Sequence[str], names: Sequence[str]
) -> Float[np.ndarray, "n n"]:
    """Return what a mask tells of the camera in its own frame: the world, or the link it is on."""
    if mount is None:
        return information(camera, scene, free)
    known = information(at_pose(camera, mount @ pose_of(camera)), scene, free)
    # Turns are about the camera's own axes, in whatever frame it is; its eye is in the link's.
    eye = [names.index(name) for name in ("e_x", "e_y", "e_z")]
    frame = np.eye(len(names))
    frame[np.ix_(eye, eye)] = mount[:3, :3]
    return frame.T @ known @ frame


def _regular(total: Float[np.ndarray, "n n"]) -> bool:
    """Whether information tells all directions, each in its own unit."""
    size = np.sqrt(np.diagonal(total))
    if not np.all(size > 0):
        return False
    values = np.linalg.eigvalsh(total / np.outer(size, size))
    return bool(values[0] > SINGULAR * values[-1])
