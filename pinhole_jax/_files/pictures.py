"""A picture's file, opened as nothing but a picture, and its pixels, some rows at a time.

Pillow's picture takes four bytes a pixel. What is made of it goes band by band, so that a large
photo never takes more than ten.
"""

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from .paths import open_file, reason

#: A PIL.Image.Image; Pillow is imported where a file is read.
Image = Any

#: What is opened; PPM stands for all of PNM. Other readers of Pillow's start programs
#: (Ghostscript), or are older than their users.
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM")
#: The most bytes of a picture's file, and the most pixels that are worked on at once.
MOST_BYTES = 1 << 30
BAND = 1 << 18
#: WebP's decoder takes twice as much a pixel: half of Pillow's limit.
MOST_WEBP = 89_478_485


def from_picture(path: Any, kind: str, read: Callable[[Image], Any]) -> Any:
    """Return `read` of an image file's picture, turned upright.

    Raises FileNotFoundError, or ValueError where the file is no such image, or `read` raises it.
    """
    from PIL import Image, ImageOps

    with open_file(path, "an image file", MOST_BYTES) as stream:
        try:
            # What Pillow warns of (sizes it would still read, odd metadata) is no harm here.
            with warnings.catch_warnings(action="ignore"):
                image = Image.open(stream, formats=FORMATS)
                if image.format == "WEBP" and image.width * image.height > MOST_WEBP:
                    raise ValueError(f"a WebP of more than {MOST_WEBP} pixels")
                bottoms = [box[3] for _, box, *_ in image.tile if box]
                if max(bottoms, default=image.height) < image.height:
                    raise ValueError("rows are missing")  # (a TIFF's count may be wrong)
                ImageOps.exif_transpose(image, in_place=True)  # upright
                image.load()
        except Exception as error:  # the readers raise whatever they meet
            words = f"a readable image ({', '.join(FORMATS)}), got {str(path)!r}"
            raise ValueError(f"`path`: expected {words}: {reason(error)}") from error
        try:
            return read(image)
        except ValueError as error:
            raise ValueError(f"`path`: expected {kind}, got {str(path)!r}: {error}") from error


def rows(H: int, W: int) -> Iterator[slice]:
    """Yield slices of rows, `BAND` pixels or one row each."""
    step = max(1, BAND // max(W, 1))
    return (slice(top, min(top + step, H)) for top in range(0, H, step))


def bands(image: Image) -> Iterator[tuple[slice, Image]]:
    """Yield a picture's rows, some at a time, as slices and pictures."""
    W, H = image.size
    return ((part, image.crop((0, part.start, W, part.stop))) for part in rows(H, W))


def by_bands(
    image: Image,
    values: Callable[[Image], np.ndarray],
    channels: tuple[int, ...] = (),
    dtype: type = np.uint8,
) -> np.ndarray:
    """Return a function's results for a picture's rows as one array (H, W, *channels)."""
    W, H = image.size
    result = np.empty((H, W, *channels), dtype)
    for part, band in bands(image):
        result[part] = values(band)
    return result


def eight_bits(image: Image) -> np.ndarray:
    """Return a picture's brightness as uint8; more than 8 bits are scaled so that 255 is the
    largest, and negative values become 0.

    Raises ValueError for values that are not finite.
    """
    if not image.mode.startswith(("I", "F")):
        return by_bands(image, lambda band: np.asarray(band.convert("L")))
    ends = np.array([[f(np.asarray(band)) for f in (np.min, np.max)] for _, band in bands(image)])
    if not np.all(np.isfinite(ends)):
        raise ValueError("NaN or infinity")
    unit = max(float(np.max(ends)), 1)
    grey = lambda band: np.round(255 * (np.maximum(np.asarray(band, float), 0) / unit))
    return by_bands(image, grey)


def three_channels(picture: np.ndarray) -> np.ndarray:
    """Return a picture (H, W) or (H, W, 3 or 4) as (H, W, 3)."""
    if picture.ndim == 2:
        return np.repeat(picture[..., None], 3, axis=2)
    return np.ascontiguousarray(picture[..., :3])
