"""Masks from what users have: transparency, brightness, labels, a photo's background colour.

What a picture's values mean is not guessed where it matters: a picture that is no mask at first
sight is refused, with the ways to read it.
"""

import re
from typing import Any, NamedTuple

import numpy as np

#: A PIL.Image.Image; Pillow is imported where a file is read.
Image = Any

#: The ways to read a mask, as `mask_from` and the command's `--mask-from` name them.
WAYS = "alpha, luminance, label=N, background=COLOR (or COLOR,TOLERANCE)"
#: Grey values (of 255) between these are the in-between of an edge.
DARK, LIGHT = 26, 229
#: Channels that differ by less than this (of 255) are grey: JPEG leaves a few.
GREY = 8
#: Parts and holes smaller than this share of the largest part are noise.
SPECK = 5e-3
#: Soft edges of a background mask reach this far (px) to both sides.
BAND_PX = 2


class Way(NamedTuple):
    """A way to read a mask: its name, and the label, or the colour's name and the tolerance."""

    name: str
    value: str = ""
    tolerance: float | None = None


class Read(NamedTuple):
    """A mask (H, W), 255 where the object is, and in words how it was read, if not plainly."""

    mask: np.ndarray
    words: str


def way_of(mask_from: str | None) -> Way:
    """Return the way that a user names; None is what is seen at first sight.

    Raises ValueError for any other text than `WAYS` has, and for colours of no known name.
    """
    text = "first sight" if mask_from is None else mask_from
    if re.fullmatch(r"first sight|alpha|luminance", text):
        return Way(text)
    if found := re.fullmatch(r"label=(\d{1,9})", text):
        return Way("label", found[1])
    if found := re.fullmatch(r"background=(.+?)(?:,(\d+(?:\.\d*)?))?", text):
        try:
            _colour(found[1])
        except ValueError:
            raise ValueError(
                f"`mask_from`: expected a colour such as white or #1e90ff, got {found[1]!r}"
            ) from None
        return Way("background", found[1], float(found[2]) if found[2] else None)
    raise ValueError(f"`mask_from`: expected one of {WAYS}, got {text!r}")


def read_mask(image: Image, way: Way) -> Read:
    """Return the mask that a picture holds; at first sight its transparency if that varies, else
    its brightness if that is a mask's.

    Raises ValueError with what the picture holds instead.
    """
    if way.name == "alpha":
        return _alpha(image)
    if way.name == "luminance":
        return Read(eight_bits(image), "mask: its brightness")
    if way.name == "label":
        return _label(image, int(way.value))
    if way.name == "background":
        return _background(image, way.value, way.tolerance)
    return _at_first_sight(image)


def eight_bits(image: Image) -> np.ndarray:
    """Return a picture's brightness as uint8; more than 8 bits are scaled so that 255 is the
    largest, and negative values become 0.

    Raises ValueError for values that are not finite.
    """
    if not image.mode.startswith(("I", "F")):
        return np.array(image.convert("L"))
    values = np.asarray(image, float)
    if not np.all(np.isfinite(values)):
        raise ValueError("NaN or infinity")
    return np.round(255 * (np.maximum(values, 0) / max(float(values.max()), 1))).astype(np.uint8)


def _at_first_sight(image: Image) -> Read:
    if image.has_transparency_data:
        read = _alpha(image)
        if read.mask.min() < 255:
            return read
    if not image.mode.startswith(("1", "L", "I", "F")):
        colours = np.asarray(image.convert("RGB"), int)
        if np.max(np.ptp(colours, axis=2)) > GREY:
            raise ValueError(f"a colour picture; say what is the object: {WAYS}")
        image = image.convert("RGB").getchannel(0)
    grey = eight_bits(image)
    between = np.count_nonzero((grey >= DARK) & (grey <= LIGHT))
    if between > np.count_nonzero(grey > LIGHT):
        raise ValueError(
            f"a grey picture in which {between / grey.size:.0%} of the pixels are neither black nor"
            f" white; say what is the object: {WAYS}"
        )
    if 0 < grey.max() < DARK:
        raise ValueError(f"a picture no lighter than {grey.max()} of 255; labels? {WAYS}")
    return Read(grey, "")


def _alpha(image: Image) -> Read:
    if not image.has_transparency_data:
        raise ValueError("no transparency")
    return Read(np.array(image.convert("RGBA"))[..., 3], "mask: the transparency (alpha)")


def _label(image: Image, number: int) -> Read:
    if image.mode not in ("1", "L", "P") and not image.mode.startswith("I"):
        raise ValueError(f"a picture of mode {image.mode}: labels are grey values or a palette's")
    labels = np.asarray(image)
    inside = labels == number
    if not np.any(inside):
        there = np.unique(labels)
        some = ", ".join(str(int(x)) for x in there[:12]) + (", ..." if len(there) > 12 else "")
        raise ValueError(f"no pixel with the label {number}; there are {some}")
    words = f"mask: label {number}, {inside.mean():.1%} of the picture, edges hard"
    return Read(np.where(inside, 255, 0).astype(np.uint8), words)


def _background(image: Image, name: str, tolerance: float | None) -> Read:
    """Return what differs from a colour by more than a tolerance (distance in CIE Lab).

    Without one, Otsu's threshold parts near from far. Pixels beside the edge are mixtures: how much
    of the object is in them is read off between the background and the object's nearest colour, in
    the values as they are stored. Specks and pinholes are dropped.
    """
    from scipy import ndimage
    from skimage.color import rgb2lab
    from skimage.filters import threshold_otsu

    back = _colour(name)
    colours = np.asarray(image.convert("RGB")) / 255
    distance = np.linalg.norm(rgb2lab(colours) - rgb2lab(back[None, None]), axis=-1)
    if np.ptp(distance) == 0:
        raise ValueError("a picture of one colour")
    limit = float(threshold_otsu(distance)) if tolerance is None else tolerance
    inside = _without_specks(distance > limit)
    deep: Any = ndimage.binary_erosion(inside, iterations=BAND_PX, border_value=1)
    near: Any = ndimage.binary_dilation(inside, iterations=BAND_PX)
    coverage = inside.astype(float)
    if np.any(deep):
        band = near & ~deep
        place: Any = ndimage.distance_transform_edt(
            ~deep, return_distances=False, return_indices=True
        )
        object_colour = colours[tuple(place[:, band])] - back
        size = np.maximum(np.sum(object_colour**2, axis=-1), 1e-6)
        mixed = np.sum((colours[band] - back) * object_colour, axis=-1) / size
        coverage[band] = np.clip(mixed, 0, 1)
    how = "Otsu's threshold" if tolerance is None else "as told"
    words = (
        f"mask: what differs from {name} by more than {limit:.1f} in CIE Lab ({how}),"
        f" {inside.mean():.1%} of the picture, soft edges from mixed colours"
    )
    return Read(np.round(255 * coverage).astype(np.uint8), words)


def _colour(name: str) -> np.ndarray:
    from PIL import ImageColor

    return np.array(ImageColor.getrgb(name)[:3]) / 255


def _without_specks(inside: np.ndarray) -> np.ndarray:
    """Return the mask without parts, and then without holes, that are noise."""
    from scipy import ndimage

    for _ in range(2):
        parts: Any = ndimage.label(inside)
        labels, count = parts
        sizes = np.bincount(labels.ravel(), minlength=count + 1)
        sizes[0] = 0
        inside = inside & (sizes[labels] >= SPECK * max(sizes.max(), 1))
        inside = ~inside
    return inside
