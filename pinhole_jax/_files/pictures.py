"""A picture's file, opened as nothing but a picture, and its pixels as arrays.

Pillow's picture takes four bytes a pixel, and is closed when its pixels are taken. What is made of
them goes some rows at a time, so that a large photo never takes more than ten.
"""

import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from .paths import open_file, refusal

#: What is opened; PPM stands for all of PNM. Other readers of Pillow's start programs
#: (Ghostscript), or are older than their users.
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM")
#: The most bytes of a picture's file, and the most pixels that are worked on at once.
MOST_BYTES = 1 << 30
BAND = 1 << 18
#: WebP's decoder takes twice as much a pixel: half of Pillow's limit.
MOST_WEBP = 89_478_485


class Picture(NamedTuple):
    """The pixels of a picture.

    - `colours` (H, W, 3), uint8: red, green, blue; of a grey picture its brightness, three times.
    - `opacity` (H, W), uint8: 255 where it hides all; None without transparency.
    - `numbers` (H, W): grey values of any depth, or the entries of a palette; None where pixels are
      colours. `is_grey`: they are grey values.
    """

    colours: np.ndarray
    opacity: np.ndarray | None
    numbers: Any
    is_grey: bool


def pixels(image: Any) -> Picture:
    """Return the pixels of Pillow's picture, and close it.

    Raises ValueError for values that are not finite.
    """
    W, H = image.size
    is_deep, through = image.mode.startswith(("I", "F")), image.has_transparency_data
    is_grey = is_deep or image.mode in ("1", "L")
    numbers: Any = np.array(image) if is_grey or image.mode == "P" else None
    opacity = None
    if is_deep and through:  # Pillow compares 16 bits with it after it has made them 8
        opacity = np.where(numbers == image.info["transparency"], np.uint8(0), np.uint8(255))
    if is_grey and (is_deep or not through):
        colours = np.broadcast_to(eight_bits(numbers)[..., None], (H, W, 3))
    else:
        mode = "RGBA" if through else "RGB"
        band = lambda part: image.crop((0, part.start, W, part.stop)).convert(mode)
        both = by_rows(lambda part: np.asarray(band(part)), (H, W, len(mode)))
        colours, opacity = both[..., :3], both[..., -1] if through else None
    image.close()
    return Picture(colours, opacity, numbers, is_grey)


def from_picture(path: Any, kind: str, read: Callable[[Any], Any]) -> Any:
    """Return `read` of an image file's picture (Pillow's), turned upright.

    Raises FileNotFoundError, or ValueError where the file is no such image, or `read` raises it.
    """
    from PIL import Image, ImageOps

    with open_file(path, "an image file", MOST_BYTES) as stream:
        # The readers raise whatever they meet. What Pillow warns of (sizes it would still read, odd
        # metadata) is no harm here.
        readable = refusal(path, f"a readable image ({', '.join(FORMATS)})", Exception)
        with readable, warnings.catch_warnings(action="ignore"):
            image = Image.open(stream, formats=FORMATS)
            if image.format == "WEBP" and image.width * image.height > MOST_WEBP:
                raise ValueError(f"a WebP of more than {MOST_WEBP} pixels")
            bottoms = [box[3] for _, box, *_ in image.tile if box]
            if max(bottoms, default=image.height) < image.height:
                raise ValueError("rows are missing")  # (a TIFF's count may be wrong)
            ImageOps.exif_transpose(image, in_place=True)  # upright
            image.load()
        with refusal(path, kind):
            return read(image)


def rows(H: int, W: int) -> Iterator[slice]:
    """Yield slices of rows, `BAND` pixels or one row each."""
    step = max(1, BAND // max(W, 1))
    return (slice(top, min(top + step, H)) for top in range(0, H, step))


def by_rows(
    values: Callable[[slice], np.ndarray], shape: tuple[int, ...], dtype: type = np.uint8
) -> np.ndarray:
    """Return an array (H, W, ...) whose rows a function makes, some at a time."""
    result = np.empty(shape, dtype)
    for part in rows(*shape[:2]):
        result[part] = values(part)
    return result


def eight_bits(numbers: np.ndarray) -> np.ndarray:
    """Return grey values as uint8; more than 8 bits are scaled so that 255 is the largest, and
    negative values become 0.

    Raises ValueError for values that are not finite.
    """
    if numbers.dtype == np.uint8:
        return numbers
    most = float(np.max(numbers))
    if not np.isfinite([most, np.min(numbers)]).all():
        raise ValueError("NaN or infinity")
    share = lambda part: np.maximum(numbers[part].astype(float), 0) / max(most, 1)
    return by_rows(lambda part: np.round(255 * share(part)), numbers.shape)
