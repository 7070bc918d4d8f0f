"""Where outline and mask go apart, as sentences: what is cut off by the film, what lost or added.

A perfect mask, one of an object that the film's edge cuts off, and one that is itself cut off can
all lead to the right camera. They are told apart here.
"""

import numpy as np

from .._camera.camera import Camera
from .._mask.target import as_coverage, check_image, edge_distance
from .._scene.scene import Scene, check_view
from .outline import outline

#: An outline farther from the mask's edge than this (px) is apart from it.
APART_PX = 3.0
#: Less of an outline or of an edge than this share is not worth a word: thin parts between pixels'
#: centres.
LEAST = 0.02


def disagreement(camera: Camera, scene: Scene, target: np.ndarray) -> tuple[str, ...]:
    """Return a sentence that says where the outline that a camera sees and a mask (H, W) go apart;
    nothing where they do not.

    ```python
    for sentence in pj.plot.disagreement(fit.camera, scene, mask):
        print(sentence)
    ```
    """
    check_view(camera, scene)
    mask = as_coverage(check_image("target", target, camera.W, camera.H)) > 0.5
    lines = outline(camera, scene)
    if not len(lines) or np.all(mask) or not np.any(mask):
        return ()
    middle, length = lines.mean(axis=1), np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    inside = np.all((middle > 0) & (middle < [camera.W, camera.H]), axis=1)
    words = []
    if (share := np.sum(length[~inside]) / np.sum(length)) > LEAST:
        words.append(f"the film's edge cuts the object off: {share:.0%} of its outline is outside")
    if not np.any(inside):
        return tuple(words)

    column, row = np.floor(middle[inside]).astype(int).T
    row = camera.H - 1 - row
    away = edge_distance(mask)[row, column] > APART_PX
    if (share := np.sum(length[inside][away]) / np.sum(length[inside])) > LEAST:
        words.append(
            f"{share:.0%} of the outline, about {_place(column[away], row[away])}, is more than"
            f" {APART_PX:g} px from the mask's edge: the mask is cut off or covered there, or wrong"
        )
    there, apart = _edge_apart(mask, column, row)
    if (share := np.count_nonzero(apart) / max(np.count_nonzero(there), 1)) > LEAST:
        y, x = np.nonzero(apart)
        words.append(
            f"{share:.0%} of the mask's edge, about {_place(x, y)}, is more than {APART_PX:g} px"
            " from the outline: it is no edge of the object's"
        )
    return tuple(words)


def _edge_apart(
    mask: np.ndarray, column: np.ndarray, row: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (H, W) beside the mask's edge, and those of them apart from the outline."""
    from scipy.ndimage import distance_transform_edt

    free = np.ones(mask.shape, bool)
    free[row, column] = False
    there = edge_distance(mask) == 0
    distance = np.asarray(distance_transform_edt(free))
    return there, there & (distance > APART_PX)


def _place(x: np.ndarray, y: np.ndarray) -> str:
    """Return the pixel in the midst of some: that one of them which is nearest to their median."""
    middle = np.median(x), np.median(y)
    nearest = np.argmin(np.hypot(x - middle[0], y - middle[1]))
    return f"column {x[nearest]}, row {y[nearest]}"
