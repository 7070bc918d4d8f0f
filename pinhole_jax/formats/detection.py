"""`detect`: which convention does a camera of unknown origin have? The one that explains a mask."""

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

import numpy as np

from .._camera.camera import Camera
from .._camera.lens import Lens
from .._camera.poses import inverse
from .._mask.target import check_image
from .._numerics.arrays import ArrayLike, Input
from .._scene.scene import Scene
from .._silhouette.silhouette import silhouette
from .fields import Fields
from .pinhole import (
    LEFT_UP_FORWARD,
    OPENCV,
    OPENGL,
    Pinhole,
    camera_of,
    focal_of_fov,
    rigid,
)
from .window import resized

#: Axes of the camera frame, and who has them.
AXES = {
    "x right, y down, z forward (OpenCV, COLMAP)": OPENCV,
    "x right, y up, z backward (OpenGL, Blender, NeRF, glTF)": OPENGL,
    "x left, y up, z forward (PyTorch3D, Mitsuba)": LEFT_UP_FORWARD,
    "x left, y down, z backward": np.diag([-1.0, 1.0, -1.0]),
}
LABELS = ("axes", "direction", "pixel_centres", "fov_axis")
#: First look: the longer side, px; not worth a program of its own up to the second number.
COARSE_PX, FULL_PX = 96, 320
#: How many poses get a second look.
KEPT = 6
#: Two hypotheses are told apart where, of the pixels in which their masks differ, the target takes
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
        """Return the reading as words."""
        fov = f", {self.fov_axis} field of view" if self.fov_axis else ""
        return f"{self.axes}; {self.direction}; pixel centres at {self.pixel_centres}{fov}"


class Detection(NamedTuple):
    """Hypotheses, best first; a sentence that says which one it is; whether the mask tells.

    ```python
    told.sentence, told.hypotheses[0].camera
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
    `pose` is (3, 4) or (4, 4), rotation and translation, world units: of either direction, columns
    or rows, and of any of the axes in `AXES`. The intrinsics are `K` (3, 3) in px, y down; or
    `focal_px`; or `fov`, rad, of the vertical, the horizontal or the diagonal. Without `K` the
    principal point is taken for (W/2, H/2).

    All readings are rendered small, the best in full, both with layers that overlap summed and
    clamped (`silhouette(..., overlaps=False)`): it compiles sooner. Scale,
    skew and distortion are not tried.

    Raises ValueError where the mask is empty or full, the pose no rigid transform, or the
    intrinsics are none or several.

    ```python
    K, R, t = pj.formats.to_opencv(camera, pixel_centres="half")
    pose = np.block([[R, t[:, None]], [np.zeros(3), 1]])
    told = pj.formats.detect(scene, pj.silhouette(camera, scene), pose, K=K)
    print(told)
    ```
    """
    if np.ndim(mask) != 2:
        raise ValueError(f"`mask`: expected shape (H, W), got {np.shape(mask)}")
    target = check_image("mask", mask, np.shape(mask)[1], np.shape(mask)[0])
    if not 0 < target.sum() < target.size:
        raise ValueError("`mask`: expected one that covers some pixels, got none or all")
    H, W = target.shape
    views = _intrinsics(W, H, K, focal_px, fov)
    promising = _promising(scene, target, list(_poses(pose)), views)
    scale = float(max(abs(np.asarray(pose, float)).max(), 1))
    merged = _merged([(view, one) for one in promising for view in views], scale)
    ranked = []
    for (view, (_, _, matrix)), words in merged:
        camera = _with_lens(_camera(view[2], matrix))
        image = np.asarray(silhouette(camera, scene, overlaps=False))
        agreement = _iou(_like(image, target), target)
        ranked.append((Hypothesis(iou=agreement, camera=camera, **words), image > 0.5))
    ranked.sort(key=lambda pair: -pair[0].iou)
    return _verdict(ranked, target > 0.5)


def _intrinsics(
    W: int, H: int, K: ArrayLike | None, focal_px: ArrayLike | None, fov: ArrayLike | None
) -> list[tuple[str, str, Pinhole]]:
    """Return (pixel_centres, fov_axis, intrinsics) of every reading."""
    given = {"K": K, "focal_px": focal_px, "fov": fov}
    data = {name: value for name, value in given.items() if value is not None}
    fields = Fields(data, "the arguments")
    if len(data) != 1:
        raise ValueError(f"expected one of `K`, `focal_px`, `fov`, got {', '.join(data) or 'none'}")
    cx, cy = W / 2, H / 2
    if "K" in data:
        matrix = fields.array("K", (3, 3))
        if np.any(matrix[2] != [0, 0, 1]) or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
            raise fields.wrong("K", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", matrix)
        focals = {"": (matrix[0, 0], matrix[1, 1])}
        cx, cy = matrix[0, 2], matrix[1, 2]
    elif "focal_px" in data:
        focal = fields.positive("focal_px")
        focals = {"": (focal, focal)}
    else:
        sides = {"vertical": H, "horizontal": W, "diagonal": float(np.hypot(W, H))}
        angle = fields.angle("fov")
        each = {axis: focal_of_fov(angle, side) for axis, side in sides.items()}
        focals = {axis: (focal, focal) for axis, focal in each.items()}
    return [
        (centres, axis, Pinhole(fx, fy, cx + shift, cy + shift, W, H))
        for axis, (fx, fy) in focals.items()
        for centres, shift in (("half", 0.0), ("integer", 0.5))
    ]


def _poses(pose: ArrayLike) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield (axes, direction, world_from_camera in OpenCV's axes) of every reading."""
    fields = Fields({"pose": pose}, "the arguments")
    matrix = fields.array("pose", (3, 4) if np.shape(pose) == (3, 4) else (4, 4))
    rows = len(matrix) == 4 and np.any(matrix[3, :3]) and not np.any(matrix[:3, 3])
    given = rigid(matrix.T if rows else matrix, fields, "pose")
    readings = [(", row vectors" if rows else "", given)]
    if not rows:  # R of row vectors beside a translation: [R | t] of PyTorch3D's R and T
        transposed = given.copy()
        transposed[:3, :3] = given[:3, :3].T
        readings.append((", rotation for row vectors", transposed))
    for (words, transform), (axes, columns) in product(readings, AXES.items()):
        frame = np.eye(4)
        frame[:3, :3] = columns.T
        yield axes, "camera_from_world" + words, inverse(transform) @ frame
        yield axes, "world_from_camera" + words, transform @ frame


def _camera(view: Pinhole, world_from_camera: np.ndarray) -> Camera:
    return camera_of(view, world_from_camera, OPENCV, Fields({}, "the arguments"))


def _with_lens(camera: Camera) -> Camera:
    """Return the camera with a lens, needed or not: then one compiled program serves all."""
    lens = camera.lens or Lens([camera.W / 2, camera.H / 2])
    return camera.replace(lens=lens)


def _promising(scene: Scene, target: np.ndarray, poses: list, views: list) -> list:
    """Return the poses that explain a small image of the target best, with any intrinsics."""
    from PIL import Image

    H, W = target.shape
    factor = 1.0 if max(W, H) <= FULL_PX else COARSE_PX / max(W, H)
    w, h = max(1, round(W * factor)), max(1, round(H * factor))
    picture = Image.fromarray(target.astype(np.float32))
    small = np.asarray(picture.resize((w, h), Image.Resampling.BOX), float)
    views = [view for view in views if view[0] == "half"]  # half a pixel is nothing here
    agreement = []
    for _, _, matrix in poses:
        best = 0.0
        for _, _, view in views:
            camera = _with_lens(resized(_camera(view, matrix), w, h))
            image = np.asarray(silhouette(camera, scene, overlaps=False), float)
            best = max(best, _iou(image, small))
        agreement.append(best)
    order = np.argsort(agreement)[::-1][:KEPT]
    return [poses[k] for k in order if agreement[k] >= 0.5 * agreement[order[0]]]


def _iou(image: np.ndarray, target: np.ndarray) -> float:
    return float(np.minimum(image, target).sum() / np.maximum(image, target).sum())


def _like(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return coverage as the target has it: cut at a half where the target is black and white."""
    hard = np.all((target == 0) | (target == 1))
    return (image > 0.5).astype(float) if hard else image.astype(float)


def _merged(readings: list, scale: float) -> list:
    """Return readings with their words; those of one and the same camera are joined."""
    groups: list[list] = []
    for view, pose in readings:
        for group in groups:
            (_, _, other_view), (_, _, other_pose) = group[0]
            same_view = np.allclose(view[2], other_view, rtol=0, atol=1e-6)
            if same_view and np.allclose(pose[2], other_pose, rtol=0, atol=1e-7 * scale):
                group.append((view, pose))
                break
        else:
            groups.append([(view, pose)])
    merged = []
    for group in groups:
        columns = zip(*((pose[0], pose[1], view[0], view[1]) for view, pose in group), strict=True)
        words = [" or ".join(dict.fromkeys(column)) for column in columns]
        merged.append((group[0], dict(zip(LABELS, words, strict=True))))
    return merged


def _verdict(ranked: list[tuple[Hypothesis, np.ndarray]], target: np.ndarray) -> Detection:
    hypotheses = tuple(hypothesis for hypothesis, _ in ranked)
    best, image = ranked[0]
    if best.iou < 0.5:
        words = "No reading of the numbers explains the mask"
        return Detection(hypotheses, f"{words}: the best, {best}, has IoU {best.iou:.3f}.", False)
    sentence = f"{best}: IoU {best.iou:.4f}."
    rivals = [other for other, mask in ranked[1:] if not _told_apart(image, mask, target)]
    if rivals:
        unsure = [
            name.replace("_", " ")
            for name in LABELS
            if any(getattr(other, name) != getattr(best, name) for other in rivals)
        ]
        sentence += f" But the mask does not tell {' and '.join(unsure)}: {rivals[0]} has IoU"
        sentence += f" {rivals[0].iou:.4f}."
    elif len(ranked) > 1:
        sentence += f" Next: {ranked[1][0]}, IoU {ranked[1][0].iou:.4f}."
    return Detection(hypotheses, sentence, not rivals)


def _told_apart(image: np.ndarray, other: np.ndarray, target: np.ndarray) -> bool:
    disputed = image != other
    count, votes = int(disputed.sum()), int((disputed & (image == target)).sum())
    return votes > SHARE * count and 2 * votes - count > SIGMAS * count**0.5
