"""`detect`: the convention of a camera of unknown origin is the one that explains a mask."""

from collections.abc import Iterator
from itertools import product, starmap
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
from .window import resized

#: Axes of the camera frame, and who has them.
AXES: dict[str, np.ndarray] = {
    "x right, y down, z forward (OpenCV, COLMAP)": OPENCV,
    "x right, y up, z backward (OpenGL, Blender, NeRF, glTF)": OPENGL,
    "x left, y up, z forward (PyTorch3D, Mitsuba)": LEFT_UP_FORWARD,
    "x left, y down, z backward": np.diag([-1.0, 1.0, -1.0, 1.0]),
}
LABELS = ("axes", "direction", "pixel_centres", "fov_axis")
#: First look: the longer side, px; not worth a program of its own up to the second number.
COARSE_PX, FULL_PX = 96, 320
#: How many cameras get a second look.
KEPT = 24
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

    All readings are rendered small, the best in full. Scale, skew and distortion are not tried.

    Raises ValueError where the mask is empty or full, the pose no rigid transform, or the
    intrinsics are none or several.

    ```python
    K, R, t = pj.formats.to_opencv(camera, pixel_centres="half")
    pose = np.block([[R, t[:, None]], [np.zeros(3), 1]])
    detection = pj.formats.detect(scene, pj.silhouette(camera, scene), pose, K=K)
    print(detection)
    ```
    """
    if np.ndim(mask) != 2:
        raise ValueError(f"`mask`: expected shape (H, W), got {np.shape(mask)}")
    target = check_image("mask", mask, np.shape(mask)[1], np.shape(mask)[0])
    if not 0 < target.sum() < target.size:
        raise ValueError("`mask`: expected one that covers some pixels, got none or all")
    H, W = target.shape
    given = {"pose": pose, "K": K, "focal_px": focal_px, "fov": fov}
    fields = Fields({name: x for name, x in given.items() if x is not None}, "the arguments")
    readings: dict[tuple[float, ...], list[Reading]] = {}
    for reading in starmap(Reading, product(_poses(fields), _views(fields, W, H))):
        _, place = reading.pose
        numbers = np.r_[np.ravel(place / np.max(np.abs(place))), reading.view[1]]
        readings.setdefault(tuple(np.round(numbers, 6) + 0.0), []).append(reading)
    is_hard = bool(np.all((target == 0) | (target == 1)))
    ranked = []
    for group in _promising(scene, target, [*readings.values()]):
        camera = _camera(group[0])
        image = np.asarray(silhouette(camera, scene), float)
        columns = zip(*((*reading.pose[0], *reading.view[0]) for reading in group), strict=True)
        joined = (" or ".join(dict.fromkeys(column)) for column in columns)
        iou = _iou(image > 0.5 if is_hard else image, target)
        ranked.append((Hypothesis(iou, *joined, camera=camera), image > 0.5))
    ranked.sort(key=lambda pair: -pair[0].iou)
    return _verdict(ranked, target > 0.5)


class Reading(NamedTuple):
    """A reading of the numbers: axes and direction of the pose, which is world_from_camera in
    OpenCV's axes; pixel centres and axis of the field of view, and the intrinsics."""

    pose: tuple[tuple[str, str], Pose]
    view: tuple[tuple[str, str], Pinhole]


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
    shape = fields.shape("pose")
    matrix = fields.array("pose", shape if shape == (3, 4) else (4, 4))
    if len(matrix) == 4 and np.any(matrix[3, :3]) and not np.any(matrix[:3, 3]):
        readings = {", row vectors": pose_from_matrix(matrix.T, fields, "pose")}
    else:  # R of row vectors beside a translation: [R | t] of PyTorch3D's R and T
        given = pose_from_matrix(matrix, fields, "pose")
        turned = rigid(given[:3, :3].T, given[:3, 3])
        readings = {"": given, ", rotation for row vectors": turned}
    for (words, transform), (axes, frame) in product(readings.items(), AXES.items()):
        yield (axes, "camera_from_world" + words), inverse(transform) @ frame
        yield (axes, "world_from_camera" + words), transform @ frame


def _camera(reading: Reading) -> Camera:
    """Return the camera with a lens, needed or not: then one compiled program serves all."""
    (_, pose), (_, view) = reading
    camera = camera_from_pinhole(view, pose, OPENCV, Fields({}, "the arguments"))
    return camera.replace(lens=camera.lens or Lens([camera.W / 2, camera.H / 2]))


def _promising(
    scene: Scene, target: np.ndarray, groups: list[list[Reading]]
) -> Iterator[list[Reading]]:
    """Yield the readings whose cameras explain a small image of the target best."""
    from PIL import Image

    H, W = target.shape
    factor = 1.0 if max(W, H) <= FULL_PX else COARSE_PX / max(W, H)
    size = max(1, round(W * factor)), max(1, round(H * factor))
    picture = Image.fromarray(target.astype(np.float32))
    small = np.asarray(picture.resize(size, Image.Resampling.BOX), float)
    cameras = (resized(_camera(group[0]), *size) for group in groups)
    ious = [_iou(silhouette(camera, scene), small) for camera in cameras]
    order = np.argsort(ious)[::-1][:KEPT]
    return (groups[k] for k in order if ious[k] >= 0.5 * max(ious))


def _iou(image: ArrayLike, target: np.ndarray) -> float:
    return float(np.minimum(image, target).sum() / np.maximum(image, target).sum())


def _verdict(ranked: list[tuple[Hypothesis, np.ndarray]], target: np.ndarray) -> Detection:
    hypotheses = tuple(hypothesis for hypothesis, _ in ranked)
    best, image = ranked[0]
    if best.iou < 0.5:
        words = f"No reading of the numbers explains the mask: the best, {best}, has IoU"
        return Detection(hypotheses, f"{words} {best.iou:.3f}.", False)
    sentence = f"{best}: IoU {best.iou:.4f}."
    rivals = [other for other, mask in ranked[1:] if not _is_decided(image, mask, target)]
    if rivals:
        unsure = [
            name.replace("_", " ")
            for name in LABELS
            if any(getattr(other, name) != getattr(best, name) for other in rivals)
        ]
        sentence += f" But the mask does not tell {' and '.join(unsure)}: {rivals[0]} has IoU"
        sentence += f" {rivals[0].iou:.4f}."
    elif len(ranked) > 1:
        sentence += f" Next: {hypotheses[1]}, IoU {hypotheses[1].iou:.4f}."
    return Detection(hypotheses, sentence, not rivals)


def _is_decided(image: np.ndarray, other: np.ndarray, target: np.ndarray) -> bool:
    """True if a target clearly prefers an image where it differs from another one."""
    disputed = image != other
    count, votes = int(disputed.sum()), int((disputed & (image == target)).sum())
    return votes > SHARE * count and 2 * votes - count > SIGMAS * count**0.5
