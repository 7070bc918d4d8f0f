"""Pictures: read upright, written as 8 bits, and what their EXIF data say of the camera."""

from io import BytesIO

import numpy as np

from .._files.exif import FieldOfView, field_of_view
from .._files.paths import FilePath, as_path, refusal, replace_file
from .._files.pictures import from_picture, pixels

#: The most pixels of a picture (Pillow's limit, too: what is written can be read).
MOST_PIXELS = 178_956_970


def load_image(path: FilePath, *, rgb: bool = False) -> np.ndarray:
    """Return an image file as uint8: (H, W) if it is grey, else (H, W, 3) or (H, W, 4). With `rgb`
    it is always (H, W, 3): grey three times, and no transparency.

    A sideways photo (EXIF) is turned upright. Grey values of more than 8 bits are scaled so that
    the largest is 255; negative ones become 0.

    Raises FileNotFoundError, or ValueError where the file is no readable PNG, JPEG, TIFF, WebP, BMP
    or PNM. Also for values that are not finite, and for more than some 179 million pixels (Pillow's
    limit; half of it in WebP). It takes at most ten bytes a pixel as it works, WebP 17.

    ```python
    picture = pj.io.load_image("mask.png")
    ```
    """

    picture = from_picture(path, "a readable image", pixels)
    if picture.opacity is not None and not rgb:
        return np.dstack([picture.colours, picture.opacity])
    is_flat = picture.is_grey and not rgb
    return np.ascontiguousarray(picture.colours[..., 0] if is_flat else picture.colours)


def photo_fov(path: FilePath) -> FieldOfView | None:
    """Return the vertical field of view `phi` (rad) that a photo's EXIF data tell, and in `words`
    how; None where they do not. It is a first guess, as good as some per cent.

    Raises FileNotFoundError or ValueError like `load_image`.

    ```python
    pj.io.photo_fov("copy.png")  # None: it has no EXIF data
    ```
    """
    return from_picture(path, "a readable image", field_of_view)


def save_image(path: FilePath, image: np.ndarray) -> None:
    """Write a uint8 image, or bool or floats in [0, 1] as 8 bits, by the path's ending.

    The shape is (H, W), (H, W, 3), or (H, W, 4) with transparency. Floats beyond [0, 1] are
    clipped.

    Raises ValueError for other shapes and types, for values that are not finite, and for a path
    that cannot be written.

    ```python
    pj.io.save_image("copy.png", picture)
    ```
    """
    from PIL import Image

    array = np.asarray(image)
    if array.ndim < 2 or array.shape[2:] not in ((), (3,), (4,)) or not array.size:
        raise ValueError(f"`image`: expected shape (H, W), (H, W, 3 or 4), got {array.shape}")
    if array.dtype.kind in "bf":
        if not np.all(np.isfinite(array)):
            raise ValueError("`image`: expected finite values, got NaN or infinity")
        array = np.round(np.clip(array.astype(float), 0, 1) * 255).astype(np.uint8)
    elif array.dtype != np.uint8:
        raise ValueError(f"`image`: expected dtype bool, uint8 or float, got {array.dtype}")
    suffix, data = as_path(path).suffix or ".png", BytesIO()
    if (kind := Image.registered_extensions().get(suffix.lower())) is None:
        raise ValueError(f"`path`: expected the ending of an image format, got {suffix!r}")
    with refusal(path, "an image format that can hold it", KeyError):
        Image.fromarray(array).save(data, kind)
    replace_file(path, data.getvalue())
