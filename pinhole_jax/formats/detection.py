"""`detect`: the convention of a camera of unknown origin is the one that explains a mask."""

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np

from .._camera.camera import Camera
from .._camera.lens import Lens
from .._camera.poses import Pose, inverse, rigid
from .._files.fields import Fields
from .._mask.target import check_image
from .._numerics.arrays import ArrayLike, Input
from .._scene.scene import Scene
from .._silhouette.silhouette import silhouette
from .pinhole import (
    LEFT_UP_FORWARD,
    OPENCV,
    OPENGL,
    Pinhole,
    camera_from_pinhole,
    focal_from_fov,
    pose_from_matrix,
    read_matrix,
)

#: Axes of the camera frame, and who has them.
AXES: dict[str, np.ndarray] = {
    "x right, y down, z forward (OpenCV, COLMAP)": OPENCV,
    "x right, y up, z backward (OpenGL, Blender, NeRF, glTF)": OPENGL,
    "x left, y up, z forward (PyTorch3D, Mitsuba)": LEFT_UP_FORWARD,
    "x left, y down, z backward": np.diag([-1.0, 1.0, -1.0, 1.0]),
}
#: A reading of the numbers: what it takes them for (`LABELS`), world_from_camera in OpenCV's axes,
#: and the intrinsics.
Reading = tuple[tuple[str, ...], Pose, Pinhole]
LABELS = ("axes", "direction", "pixel_centres", "fov_axis")
#: Whose IoU is less than this share of the best one's is no rival.
RIVAL = 0.5
#: A mask decides between two hypotheses where, of the pixels that differ, the target takes
#: one's side in this share, and in more than chance would by this many standard deviations.
SHARE = 0.6
SIGMAS = 4.0


class Hypothesis(NamedTuple):
    """A reading of the numbers, the camera that it gives, and how well that explains the mask.

    - `direction`: "camera_from_world" or "world_from_camera", and whether vectors are rows.
    - `pixel_centres`: "integer" or "half", of the principal point given.
    - `fov_axis`: "vertical", "horizontal" or "diagonal"; empty where no angle was given.

    Readings that come to the same camera are one hypothesis, their words joined by "or".

    ```python
    pj.formats.Hypothesis._fields
    ```
    """

    iou: float
    axes: str
    direction: str
    pixel_centres: str
    fov_axis: str
    camera: Camera

    def __str__(self) -> str:
        """Return the reading as text."""
        fov = f", {self.fov_axis} field of view" if self.fov_axis else ""
        return f"{self.axes}; {self.direction}; pixel centres at {self.pixel_centres}{fov}"


class Detection(NamedTuple):
    """Hypotheses, best first; a sentence that says which one it is; whether the mask tells.

    ```python
    detection.sentence, detection.hypotheses[0].camera
    ```
    """

    hypotheses: tuple[Hypothesis, ...]
    sentence: str
    certain: bool


def detect(
    scene: Scene,
    mask: Input[ArrayLike, "H W"],
    pose: Input[ArrayLike, "3 4 or 4 4"],
    *,
    K: Input[ArrayLike | None, "3 3"] = None,
    focal_px: Input[ArrayLike | None, "px"] = None,
    fov: Input[ArrayLike | None, "rad"] = None,
) -> Detection:
    """Return which convention a camera's numbers follow, by agreement with a mask of the scene.

    `mask` (H, W) is bool, uint8 or float, row 0 on top, of the image that the numbers belong to.
    `pose` is (3, 4) or (4, 4), rotation and translation, world units. Its direction may be either,
    its vectors columns or rows, its axes any of `AXES`. The intrinsics are `K` (3, 3) in px, y
    down; or `focal_px`; or `fov`, rad, of the vertical, the horizontal or the diagonal. Without `K`
    the principal point is taken for (W/2, H/2).

    All readings are rendered. Scale, skew and distortion are not tried.

    Raises ValueError where the mask is empty or full, the pose no rigid transform, or the
    intrinsics are none or several.

    ```python
    K, R, t = pj.formats.to_opencv(camera, pixel_centres="half")
    pose = np.block([[R, t[:, None]], [np.zeros(3), 1]])
    detection = pj.formats.detect(scene, pj.silhouette(camera, scene), pose, K=K)
    print(detection)
    ```
    """
    target = check_image("mask", mask)
    if not 0 < target.sum() < target.size:
        raise ValueError("`mask`: expected one that covers some pixels, got none or all")
    H, W = target.shape
    given = {"pose": pose, "K": K, "focal_px": focal_px, "fov": fov}
    fields = Fields({name: x for name, x in given.items() if x is not None}, "the arguments")
    readings: dict[tuple[float, ...], list[Reading]] = {}
    for (pose_words, place), (view_words, view) in product(_poses(fields), _views(fields, W, H)):
        numbers = np.r_[np.ravel(place / np.max(np.abs(place))), view[:6]]
        reading = (*pose_words, *view_words), place, view
        readings.setdefault(tuple(np.round(numbers, 6) + 0.0), []).append(reading)
    hypotheses = (_hypothesis(scene, target, group) for group in readings.values())
    return _verdict(scene, target, sorted(hypotheses, key=lambda hypothesis: -hypothesis.iou))


def _hypothesis(scene: Scene, target: np.ndarray, group: list[Reading]) -> Hypothesis:
    """Return the answers of readings of the same camera."""
    _, place, view = group[0]
    camera = camera_from_pinhole(view, place, OPENCV, Fields({}, "the arguments"))
    # With a lens, needed or not: then one compiled program serves all.
    camera = camera.replace(lens=camera.lens or Lens([camera.W / 2, camera.H / 2]))
    image = np.asarray(silhouette(camera, scene), float)
    if np.all((target == 0) | (target == 1)):
        image = image > 0.5
    iou = float(np.minimum(image, target).sum() / np.maximum(image, target).sum())
    columns = zip(*(words for words, _, _ in group), strict=True)
    joined = (" or ".join(dict.fromkeys(column)) for column in columns)
    return Hypothesis(iou, *joined, camera=camera)


def _views(fields: Fields, W: int, H: int) -> Iterator[tuple[tuple[str, str], Pinhole]]:
    """Yield every reading of the intrinsics: pixel centres, axis of the field of view."""
    data = [name for name in ("K", "focal_px", "fov") if name in fields]
    if len(data) != 1:
        raise ValueError(f"expected one of `K`, `focal_px`, `fov`, got {', '.join(data) or 'none'}")
    for centres, half in (("half", 0.0), ("integer", 0.5)):
        if "K" in fields:
            yield (centres, ""), read_matrix(fields, "K", W, H, half)
            continue
        focals = (
            {"": fields.positive("focal_px")}
            if "focal_px" in fields
            else {
                axis: focal_from_fov(fields.angle("fov"), side)
                for axis, side in (("vertical", H), ("horizontal", W), ("diagonal", np.hypot(W, H)))
            }
        )
        for axis, focal in focals.items():
            yield (centres, axis), Pinhole(focal, focal, W / 2 + half, H / 2 + half, W, H)


def _poses(fields: Fields) -> Iterator[tuple[tuple[str, str], Pose]]:
    """Yield every reading of the pose: axes, direction."""
    matrix = fields.array("pose", (3, 4), (4, 4))
    if len(matrix) == 4 and np.any(matrix[3, :3]) and not np.any(matrix[:3, 3]):
        readings = {", row vectors": pose_from_matrix(matrix.T, fields, "pose")}
    else:  # R of row vectors beside a translation: [R | t] of PyTorch3D's R and T
        given = pose_from_matrix(matrix, fields, "pose")
        turned = rigid(given[:3, :3].T, given[:3, 3])
        readings = {"": given, ", rotation for row vectors": turned}
    for (words, transform), (axes, frame) in product(readings.items(), AXES.items()):
        yield (axes, "camera_from_world" + words), inverse(transform) @ frame
        yield (axes, "world_from_camera" + words), transform @ frame


def _verdict(scene: Scene, target: np.ndarray, hypotheses: list[Hypothesis]) -> Detection:
    best, others = hypotheses[0], hypotheses[1:]
    if best.iou < 0.5:
        words = f"No reading of the numbers explains the mask: the best, {best}, has IoU"
        return Detection((*hypotheses,), f"{words} {best.iou:.3f}.", False)
    covers = lambda hypothesis: np.asarray(silhouette(hypothesis.camera, scene)) > 0.5
    near, image, inside = RIVAL * best.iou, covers(best), target > 0.5
    rivals = [x for x in others if x.iou >= near and not _is_decided(image, covers(x), inside)]
    sentence = f"{best}: IoU {best.iou:.4f}."
    if rivals:
        unsure = [
            name.replace("_", " ")
            for name in LABELS
            if any(getattr(other, name) != getattr(best, name) for other in rivals)
        ]
        sentence += f" But the mask does not tell {' and '.join(unsure)}: {rivals[0]} has IoU"
        sentence += f" {rivals[0].iou:.4f}."
    elif others:
        sentence += f" Next: {others[0]}, IoU {others[0].iou:.4f}."
    return Detection((*hypotheses,), sentence, not rivals)


def _is_decided(image: np.ndarray, other: np.ndarray, target: np.ndarray) -> bool:
    """True if a target clearly prefers an image where it differs from another one."""
    disputed = image != other
    count, votes = int(disputed.sum()), int((disputed & (image == target)).sum())
    return votes > SHARE * count and 2 * votes - count > SIGMAS * count**0.5
