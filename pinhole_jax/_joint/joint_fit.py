"""The result of a joint fit, as a user reads it."""

from collections.abc import Mapping
from dataclasses import KW_ONLY
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from .._camera.camera import Camera
from .._camera.poses import Pose
from .._fit.result import Fit, MaskError, Measurement, Record, Result
from .._fit.words import UNIT, Estimate
from .._scene.scene import Scene


class ViewFit(NamedTuple):
    """One view of a joint fit.

    - `camera`: its camera in its scene's frame: `silhouette(camera, scene)` draws the view.
    - `iou`, `rms`: of its mask, as in `Fit`.
    - `off`: the root mean square difference of mask and outline, relative to the median view's.
    - `weight`: the weight of the view, at most 1: views with a large `off` count less.
    - `astray`: the share of the outline that is more than `outlier_px` from the mask's edge.
    - `mask_error`: the error of the mask's outline; None where the mask is exact and matches.
    - `scene`: the scene that it shows, with joints' zeros as found.
    - `sigma`: its disagreement with the other views, in standard errors.
    - `worth`: the factor by which the standard errors of its camera's pose would grow without it
      (geometric mean). Infinite where the other views do not determine that pose.
    """

    camera: Camera
    iou: float
    rms: float
    off: float
    weight: float
    astray: float
    mask_error: MaskError | None
    scene: Scene
    sigma: float
    worth: float


class JointZeros(Measurement):
    """Corrections to add to joints' readings, by `names`, and their covariance (n, n).

    `units` are "rad" for a joint that turns, "world" for one that slides, "scale" for a body that
    grows.
    """

    names: tuple[str, ...]
    values: Float[np.ndarray, "n"]
    units: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]

    @property
    def rows(self) -> list[Estimate]:
        """The zeros for people, angles in degrees."""
        units = {"rad": (180 / np.pi, "deg")}
        each = zip(self.names, self.values, self.std, self.units, strict=True)
        return [
            Estimate(name, times * value, times * std, unit, "")
            for name, value, std, known in each
            for times, unit in [units.get(known, (1.0, known))]
        ]

    def __str__(self) -> str:
        """The zeros as a table."""
        lines = ["joint         zero off   one sigma  unit"]
        for name, value, std, unit, _ in self.rows:
            lines.append(f"{name:<12}{value:>+10.3g}{std:>12.2g}  {unit}")
        return "\n".join(lines)


class ObjectFit(Measurement):
    """An object's `pose` in the world (4, 4), and its `covariance` (6, 6).

    The covariance is of a small rotation about the object's own axes x, y, z (rad), then of its
    position (world units).
    """

    pose: Pose
    covariance: Float[np.ndarray, "6 6"]


class SceneScale(Record):
    """The factor by which a scene is larger than its mesh: `value`, standard deviation `std`.

    `across` has its covariances (k,) with the pose of each unknown camera and object, by name.
    """

    value: float
    std: float
    across: Mapping[str, Float[np.ndarray, "k"]]


class JointFit(Result):
    """The result of `fit_joint`.

    - `status`: as in `Fit`; trust the answer only where it is "converged".
    - `cameras`: a `Fit` for each camera, by name. The pose is relative to the camera's carrier (to
      the world, if it has none), the covariance is that of all views together.
    - `objects`: an `ObjectFit` for each unknown object.
    - `views`: a `ViewFit` for each mask, in their order.
    - `excess`: the differences of views, relative to what their masks' errors explain (1: no more).
      Above 1, joint angles, meshes or lenses err, and covariances have grown by its square.
    - `weak`: sentences on what the masks determine badly, and on views that disagree.
    - `modes`: other answers that match the masks as well.
    - `steps`: the number of steps on each level, coarse to fine.
    - `scales`: a `SceneScale` for each scale that views name.
    - `joint_zeros`: the corrections of joints' zeros; None where none were sought.

    ```python
    joint.status, joint.cameras
    ```
    """

    status: str
    cameras: Mapping[str, Fit]
    objects: Mapping[str, ObjectFit]
    views: tuple[ViewFit, ...]
    excess: float
    steps: tuple[int, ...]
    scales: Mapping[str, SceneScale]
    joint_zeros: JointZeros | None = None
    _: KW_ONLY
    modes: tuple["JointFit", ...] = ()

    data: ClassVar[str] = "the masks"

    @property
    def camera(self) -> Camera:
        """The camera, where there is one."""
        if len(self.cameras) != 1:
            known = ", ".join(self.cameras)
            raise ValueError(f"`camera`: expected one camera, got {known}: see `cameras`")
        return next(iter(self.cameras.values())).camera

    def __str__(self) -> str:
        """The fit as tables."""
        lines = [f"{self.status}: {len(self.views)} views"]
        lines += [f"  {words}" for words in self.notes]
        for name, fit in self.cameras.items():
            lines += [f"{name}:", str(fit)]
        for name, found in self.objects.items():
            place = ", ".join(f"{x:.6g}" for x in found.pose[:3, 3])
            sigma = ", ".join(f"{x:.2g}" for x in found.std[3:])
            lines.append(f"{name}: at ({place}), one sigma ({sigma}) {UNIT}")
        for name, scale in self.scales.items():
            lines.append(f"{name}: {scale.value:.6g} times as large, one sigma {scale.std:.2g}")
        if self.joint_zeros is not None:
            lines.append(str(self.joint_zeros))
        lines.append("view   IoU     rms     off (sigma)  weight")
        for k, v in enumerate(self.views):
            lines.append(f"{k:4d}  {v.iou:.4f}  {v.rms:.4f}  {v.sigma:11.1f}  {v.weight:.2f}")
        return "\n".join(lines)
