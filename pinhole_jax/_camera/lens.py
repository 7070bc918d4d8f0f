"""What lies between the ideal pinhole and the pixels: principal point, pixel aspect, distortion.

The first two are affine on the film, so a straight edge stays straight. A camera without a lens
pays nothing, and one without distortion nothing for that.
"""

import equinox as eqx
from jaxtyping import Array, Float

from .._numerics.arrays import ArrayLike, Input, check_above_zero, float_array, float_dtype
from .distortion import MODELS, Distortion


class Lens(eqx.Module):
    """Principal point, pixel aspect and distortion of a camera.

    - `principal_point`: where the view axis meets the film, in film coordinates (px, origin at the
      film's bottom-left corner, y up). A centred camera has (W/2, H/2).
    - `aspect`: focal length in pixels along x over focal length in pixels along y (`fx / fy`).
    - `distortion`: a `BrownConrady`, a `Rational`, a `Fisheye`, or None. `phi` then sets the focal
      length `H / (2 tan(phi/2))` px that the coefficients go with; the field of view itself is
      another.

    Raises ValueError for wrong shapes, non-finite values and an aspect that is not positive.

    ```python
    lens = pj.Lens([47.5, 41.0], aspect=1.0, distortion=pj.BrownConrady(k1=-0.1))
    distorted = camera.replace(lens=lens)
    ```
    """

    principal_point: Float[Array, "2"]
    aspect: Float[Array, ""]
    distortion: Distortion | None

    def __init__(
        self,
        principal_point: Input[ArrayLike, "2"],
        aspect: Input[ArrayLike, ""] = 1.0,
        distortion: Input[Distortion | None, "model"] = None,
    ):
        dtype = float_dtype(principal_point, aspect)
        self.principal_point = float_array("principal_point", principal_point, (2,), dtype)
        self.aspect = float_array("aspect", aspect, (), dtype)
        check_above_zero("aspect", self.aspect, "a positive ratio")
        if not (distortion is None or isinstance(distortion, Distortion)):
            raise ValueError(
                f"`distortion`: expected a {', a '.join(MODELS)} or None, got {distortion!r}"
            )
        self.distortion = distortion


def check_lens(lens: object) -> None:
    """Raise ValueError unless this is a lens or None."""
    if not (lens is None or isinstance(lens, Lens)):
        raise ValueError(f"`lens`: expected a Lens or None, got {type(lens).__name__}")
