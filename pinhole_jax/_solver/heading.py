"""Where a camera looks, as pitch, yaw and roll, and covariances carried to other parameters.

A fit's covariance is of small turns about the camera's own axes: they have no value. Pitch, yaw and
roll do, about the world axis that the camera's up is nearest to. They are never more than 55
degrees from it, so no two of the three axes ever come together (no gimbal lock).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .._camera.axes import axes_of
from .._camera.camera import Camera

#: What depends on an unknown parameter by less than this share of its derivative does not.
NOTHING = 1e-6


class Heading(NamedTuple):
    """Where a camera looks.

    - `angles` (3,): pitch, up from level; yaw, anticlockwise about `up` from `ahead`; roll, the
      right side down (rad).
    - `derivative` (3, 3): of the angles by small turns about the camera's axes b1, b2, v.
    - `up`, `ahead`: the world axes, such as "+y" and "+z".
    """

    angles: Float[np.ndarray, "3"]
    derivative: Float[np.ndarray, "3 3"]
    up: str
    ahead: str


def heading(camera: Camera) -> Heading:
    """The direction that a camera looks in.

    A turn of the camera is w = pitch' level + yaw' up + roll' v: `level` is its right without roll,
    v forward, and dots are derivatives. Solved for these, it is the derivative.
    """
    b1, b2, v = axes = axes_of(camera)
    which = int(np.argmax(np.abs(b2)))
    sign = float(np.sign(b2[which]))
    up, ahead = sign * np.eye(3)[which], np.eye(3)[(which + 1) % 3]
    level = np.cross(v, up)
    level /= np.linalg.norm(level)

    pitch = np.arcsin(np.clip(v @ up, -1, 1))
    yaw = np.arctan2(v @ np.cross(up, ahead), v @ ahead)
    roll = np.arctan2(-b1 @ np.cross(level, v), b1 @ level)
    turns = np.stack([level, up, v], axis=1)
    derivative = np.linalg.solve(turns, axes.T)
    names = "xyz"[which], "xyz"[(which + 1) % 3]
    return Heading(
        np.array([pitch, yaw, roll]),
        derivative,
        f"{'+' if sign > 0 else '-'}{names[0]}",
        f"+{names[1]}",
    )


def carried(
    covariance: Float[np.ndarray, "n n"], derivative: Float[np.ndarray, "m n"]
) -> Float[np.ndarray, "m m"]:
    """Return the covariance of parameters with this derivative by those of a covariance.

    What depends on a parameter that is not determined (of infinite variance) is not either: it has
    infinite variance, and no covariance (NaN).
    """
    known = np.isfinite(np.diag(covariance))
    part = derivative[:, known]
    result = part @ covariance[np.ix_(known, known)] @ part.T
    size = np.max(np.abs(derivative), axis=1, initial=0.0, keepdims=True)
    lost = np.any(np.abs(derivative[:, ~known]) > NOTHING * size, axis=1)
    result[lost] = np.nan
    result[:, lost] = np.nan
    infinite = np.nan if np.any(np.isnan(np.diag(covariance))) else np.inf
    result[lost, lost] = infinite
    return result
