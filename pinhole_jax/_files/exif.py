"""What a photo's EXIF data say of the camera's field of view."""

import math
from typing import Any, NamedTuple

#: The diagonal of 35 mm film (36 x 24 mm): what "35 mm equivalent" refers to.
FILM_DIAGONAL_MM = math.hypot(36, 24)
#: EXIF's units of FocalPlaneResolutionUnit, in mm.
UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
#: Two shapes of a picture, or two focal lengths, are one up to this.
SAME_SHAPE, SAME_FOCAL = 0.01, 0.1


class FieldOfView(NamedTuple):
    """The vertical field of view `phi` (rad) of a photo held upright, and a text on where it is
    from."""

    phi: float
    words: str


def field_of_view(image: Any) -> FieldOfView | None:
    """Return an upright picture's, or None where its data do not tell it or it was cropped.

    FocalLengthIn35mmFilm, which compares diagonals, comes first; else FocalLength times
    FocalPlaneXResolution, the pixels a unit of the sensor, of a picture that may be smaller now.
    """
    from PIL import ExifTags

    tags = image.getexif().get_ifd(ExifTags.IFD.Exif)
    tag = lambda name: _positive(tags.get(ExifTags.Base[name]))
    (W, H), smaller = image.size, 1.0
    if all(full := (tag("ExifImageWidth"), tag("ExifImageHeight"))):
        smaller = max(W, H) / max(full)
        if abs(min(full) * smaller / min(W, H) - 1) > SAME_SHAPE:
            return None
    film, length = tag("FocalLengthIn35mmFilm"), tag("FocalLength")
    unit = UNIT_MM.get(tags.get(ExifTags.Base.FocalPlaneResolutionUnit, 2), math.inf)
    by_film = film * math.hypot(W, H) / FILM_DIAGONAL_MM
    by_sensor = length * tag("FocalPlaneXResolution") / unit * smaller
    words = f"FocalLength {length:g} mm and FocalPlaneXResolution"
    if by_film:
        against = f" (against {words}: {by_sensor / by_film:.2f} times as long)"
        is_other = by_sensor and abs(by_sensor / by_film - 1) > SAME_FOCAL
        words = f"FocalLengthIn35mmFilm {film:g} mm" + (against if is_other else "")
    focal = by_film or by_sensor
    return FieldOfView(2 * math.atan(H / (2 * focal)), words) if focal else None


def _positive(value: Any) -> float:
    """Return a tag's value, 0 where there is none or it makes no sense (0 stands for unknown)."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) and number > 0 else 0.0
