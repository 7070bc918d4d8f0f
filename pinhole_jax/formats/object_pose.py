"""The object's pose in the camera's frame, with its covariance, as a robot's arm needs it."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .._camera.axes import skew
from .._camera.distortion import Distortion
from .._camera.matrices import Centres
from .._camera.poses import Pose, inverse, rigid
from .._fit.result import Fit, check_fit
from .._fit.words import in_digits
from .._numerics.arrays import Input
from .._solver.heading import carried
from .pinhole import to_opencv

#: A fit's parameters that the pose depends on, in the order of `_derivative`'s columns.
POSE = ("rotation_b1", "rotation_b2", "rotation_v", "e_x", "e_y", "e_z")


class ObjectPose(NamedTuple):
    """Where the camera sees the object: OpenCV's axes, x right, y down, z forward.

    - `K` (3, 3): intrinsics, px. `pixel_centres`: where they count from, "integer" or "half".
    - `R` (3, 3), `t` (3,): X_camera = R X_object + t. The object's frame is the mesh's, which is
      the fit's world.
    - `covariance` (6, 6), `std` (6,): of the object's turns (rad) about the camera's x, y and z
      axes, around its own origin; then of t (world units). Infinite, with NaN beside it, where the
      mask does not determine one; 0 for frozen parameters.
    - `distortion`: the lens's, beside K; None if it has none.

    ```python
    pose.camera_from_world, pose.covariance
    ```
    """

    K: Float[np.ndarray, "3 3"]
    pixel_centres: str
    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "6 6"]
    std: Float[np.ndarray, "6"]
    distortion: Distortion | None = None

    @property
    def camera_from_world(self) -> Pose:
        """Return the object's pose in the camera's frame."""
        return rigid(self.R, self.t)

    @property
    def world_from_camera(self) -> Pose:
        """Return the camera's pose in the object's frame."""
        return inverse(self.camera_from_world)

    def __str__(self) -> str:
        """Return it as the command prints it."""
        from scipy.spatial.transform import Rotation

        turns, shifts = np.rad2deg(self.std[:3]), self.std[3:]
        quaternion = Rotation.from_matrix(self.R).as_quat(canonical=True)
        t = "".join(f"{in_digits(*x):>15}" for x in zip(self.t.tolist(), shifts, strict=True))
        digits = lambda numbers: "".join(f"{x:>15.2g}" for x in numbers)
        first = 0 if self.pixel_centres == "integer" else 0.5
        return "\n".join(
            [
                "object in the camera's frame, OpenCV's (x right, y down, z forward):"
                " X_camera = R X_object + t",
                *_lines("R", self.R),
                f"  t        {t}   world",
                f"  one sigma{digits(shifts)}   world",
                f"  turned by{digits(turns)}   deg, one sigma about x, y, z",
                *_lines("x y z w", [quaternion]),
                "camera in the object's frame: world_from_camera",
                *_lines("", self.world_from_camera[:3]),
                f"intrinsics, px; the first pixel's centre is {first}",
                *_lines("K", self.K),
                *_distorted(self.distortion),
            ]
        )


def object_pose(fit: Fit, *, pixel_centres: Input[Centres, "of K"]) -> ObjectPose:
    """Return the object's pose in the camera's frame with its covariance, K beside it (OpenCV).

    `pixel_centres` ("integer", "half") says where the reader of K puts them, as in `to_opencv`.

    `Fit.covariance` is that of the camera: of small turns about its own axes and of the eye in the
    world. This one is that of the inverse pose, exact to first order.

    ```python
    fit = pj.fit_camera(scene, pj.silhouette(camera, scene), camera.replace(e=[0.5, 1.2, 5]))
    pose = pj.formats.object_pose(fit, pixel_centres="integer")
    print(pose)
    ```
    """
    check_fit(fit)
    K, R, t = to_opencv(fit.camera, pixel_centres=pixel_centres)
    own = [k for k, name in enumerate(fit.names) if name in POSE]
    columns = [POSE.index(fit.names[k]) for k in own]
    covariance = carried(fit.covariance[np.ix_(own, own)], _derivative(R, t)[:, columns])
    std, lens = np.sqrt(np.diag(covariance)), fit.camera.lens
    return ObjectPose(K, pixel_centres, R, t, covariance, std, lens and lens.distortion)


def _derivative(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the derivative (6, 6) of the object's pose by the camera's.

    Let a camera turn by the small vector w, in its own axes, and its eye move by de in the world.
    With a^ the matrix of the cross product with a, the new transform is

        R' = (1 - w^) R,    t' = -R' (e + de) = t - w x t - R de.

    So the object turns by -w about the camera's axes, and t moves by t^ w - R de. This is the
    adjoint of camera_from_world in these coordinates. A fit counts its turns about b1, b2 and v,
    which are x, -y and z here.
    """
    turns = np.diag([1.0, -1.0, 1.0])
    return np.block([[-turns, np.zeros((3, 3))], [skew(t) @ turns, -R]])


def _distorted(distortion: Distortion | None) -> list[str]:
    """Return a lens's distortion as a line, nothing if it has none."""
    if distortion is None:
        return []
    numbers = (f"{name} {value:.8g}" for name, value in distortion.coefficients().items())
    return [f"  distortion, {type(distortion).__name__}: {', '.join(numbers)}"]


def _lines(name: str, matrix: Any) -> list[str]:
    """Return a matrix's rows, the name before the first."""
    heads = [name] + [""] * (len(matrix) - 1)
    rows = ["".join(f"{x:>15.8g}" for x in np.round(row, 8) + 0.0) for row in matrix]
    return [f"  {head:<9}{row}".rstrip() for head, row in zip(heads, rows, strict=True)]
