"""The result of a joint fit, as a user reads it."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._camera.camera import Camera
from .._camera.poses import Pose
from .._fit.result import Fit, MaskError
from .._fit.words import UNIT, Estimate
from .._scene.scene import Scene


class ViewFit(NamedTuple):
    """One view of a joint fit.

    - `camera`: its camera in its scene's own frame: `silhouette(camera, scene)` is what it shows.
    - `iou`, `rms`: of its mask, as in `Fit`.
    - `off`: how far mask and outline go apart, beside the middle one of all views.
    - `weight`: how much it counts, at most 1: less where they go farther apart.
    - `astray`: which share of the outline is far (more than `outlier_px`) from the mask's edge.
    - `mask_error`: how the mask's outline errs; None where it is exact, and explained.
    - `scene`: what it shows, the zeros of joints where they were found.
    - `sigma`: how surely it disagrees with the other views, in standard errors.
    - `worth`: by how many times the standard errors of its camera's pose would grow without it, in
      the (geometric) mean; infinite where the other views do not determine that.
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


class JointZeros(NamedTuple):
    """What is to be added to joints' readings: of each of `names` its value and `unit` ("rad", of a
    joint that slides "world", of a body that grows "scale"), and their covariance (n, n)."""

    names: tuple[str, ...]
    values: Float[np.ndarray, "n"]
    units: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]

    @property
    def std(self) -> Float[np.ndarray, "n"]:
        """Standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def rows(self) -> list[Estimate]:
        """The zeros for people, angles in degrees."""
        rows = zip(self.names, self.values, self.std, self.units, strict=True)
        factors = {"rad": (180 / np.pi, "deg")}
        result = []
        for name, value, std, own in rows:
            times, unit = factors.get(own, (1.0, own))
            result.append(Estimate(name, times * value, times * std, unit, ""))
        return result

    def __str__(self) -> str:
        """The zeros as a table."""
        lines = ["joint         zero off   one sigma  unit"]
        for name, value, std, unit, _ in self.rows:
            lines.append(f"{name:<12}{value:>+10.3g}{std:>12.2g}  {unit}")
        return "\n".join(lines)


class ObjectFit(NamedTuple):
    """An object's `pose` in the world (4, 4); the `covariance` (6, 6) of a small rotation about the
    object's own axes x, y, z (rad) and of its place (world units)."""

    pose: Pose
    covariance: Float[np.ndarray, "6 6"]

    @property
    def std(self) -> Float[np.ndarray, "6"]:
        """Standard deviations."""
        return np.sqrt(np.diag(self.covariance))


class SceneScale(NamedTuple):
    """By how many times a scene is larger than it was given: the `value`, its standard deviation,
    and `across` (k,), its covariances with the pose of each unknown camera and object, by name, as
    these report it."""

    value: float
    std: float
    across: Mapping[str, Float[np.ndarray, "k"]]


class JointFit(NamedTuple):
    """The result of `fit_joint`.

    - `status`: as in `Fit`; trust the answer only where it is "converged".
    - `cameras`: for each camera's name a `Fit`: its camera's pose is on what carries it (in the
      world, if nothing does), its covariance is that of all views together.
    - `objects`: for each unknown object an `ObjectFit`.
    - `views`: what became of each mask, in their order.
    - `excess`: by how many times views differ more than their masks' errors say (1: no more): joint
      angles, meshes or lenses err. The covariances have grown by its square.
    - `weak`: sentences on what the masks determine badly, and which views disagree.
    - `modes`: other answers that explain the masks as well.
    - `steps`: on each level, coarse to fine.
    - `scales`: for each scale that views name a `SceneScale`.
    - `joint_zeros`: those of the joints whose zeros were sought, a `JointZeros`; None of none.

    ```python
    joint.status, joint.cameras
    ```
    """

    status: str
    cameras: Mapping[str, Fit]
    objects: Mapping[str, ObjectFit]
    views: tuple[ViewFit, ...]
    excess: float
    weak: tuple[str, ...]
    modes: tuple["JointFit", ...]
    steps: tuple[int, ...]
    scales: Mapping[str, SceneScale]
    joint_zeros: JointZeros | None = None

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
        lines += [f"  {words}" for words in self.weak]
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
