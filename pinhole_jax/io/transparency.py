"""A picture's transparency and the colours that it shows: which of them is the mask, or both."""

from typing import Any

import numpy as np

from .._files.pictures import Image, bands, by_bands, eight_bits, rows

#: Values (of 255) between these are the in-between of an edge.
DARK, LIGHT = 26, 229
#: Channels or values that differ by less than this (of 255) are alike: JPEG leaves a few.
GREY = 8
#: Soft edges reach this far inwards (px).
EDGE_PX = 3
#: A share of the pixels that is noise.
FEW = 0.01
#: An outline that moves by less than this (px) is the same.
SAME_PX = 0.02


def opacity(image: Image) -> np.ndarray:
    """Return the opacity of each pixel (H, W), 255 where it hides all.

    Raises ValueError for a picture without transparency.
    """
    if not image.has_transparency_data:
        raise ValueError("no transparency")
    return by_bands(image, opaque_pixels)


def opaque_pixels(band: Image) -> np.ndarray:
    """Return `opacity` of some rows."""
    if band.mode.startswith("I"):  # Pillow compares 16 bits with it after it has made them 8
        return np.where(np.asarray(band) == band.info["transparency"], np.uint8(0), np.uint8(255))
    return np.asarray(band.convert("RGBA"))[..., 3]


def seen_through(image: Image, opaque: np.ndarray) -> np.ndarray | None:
    """Return the mask (H, W) that transparency and colours make together, None where the colours
    have no part in it: one colour, a premultiplied one, an object cut out of a photo.

    Where opacity is all or nothing and colours darken towards the edge, they hold the edge.

    Raises ValueError where each may be the mask.
    """
    from scipy.ndimage import binary_erosion

    shade = _shade(image, opaque)
    if shade is None or _is_same(opaque, shade):
        return None
    deep: Any = binary_erosion(opaque > LIGHT, np.ones((3, 3)), EDGE_PX, border_value=1)
    inner = shade[deep]
    mixed = _count_between(inner) > FEW * inner.size
    black = np.count_nonzero(inner < DARK) > FEW * inner.size
    mask = np.minimum(opaque, shade)  # one of them is all or nothing
    is_photo = _count_between(mask) > np.count_nonzero(mask > LIGHT)
    if mixed and is_photo:
        return None
    is_hard = _count_between(opaque) <= FEW * _count_between(mask)
    if is_hard and not mixed and not is_photo and (not black or _is_key(opaque, shade)):
        return mask
    raise ValueError(
        "transparency and colours that say different things; give `mask_from` alpha (--mask-from"
        " alpha) or `mask_from` luminance (--mask-from luminance), whichever is the object"
    )


def _shade(image: Image, opaque: np.ndarray) -> np.ndarray | None:
    """Return the lightness of each pixel (H, W), 255 for the lightest that is seen; None where the
    pixels that are seen have more than one hue."""
    if image.mode.startswith("I"):
        return eight_bits(image)
    lightest = np.zeros(3)
    for part, band in bands(image):
        colours = _colours(band)[opaque[part] > 0]
        if len(colours):
            lightest = max(lightest, colours[np.argmax(colours.sum(axis=1))], key=np.sum)
    if not np.any(lightest):
        return np.full_like(opaque, 255)
    shade, other = np.empty_like(opaque), 0
    for part, band in bands(image):
        colours = _colours(band)
        share = colours @ lightest / (lightest @ lightest)
        shade[part] = np.round(255 * np.clip(share, 0, 1))
        far = np.max(np.abs(colours - share[..., None] * lightest), axis=-1) > GREY
        other += np.count_nonzero(far & (opaque[part] > 0))
    return None if other > FEW * np.count_nonzero(opaque) else shade


def _colours(band: Image) -> np.ndarray:
    return np.asarray(band.convert("RGBA"))[..., :3].astype(np.float32)


def _is_same(opaque: np.ndarray, shade: np.ndarray) -> bool:
    """Return True where colours leave the outline of the opacity as it is."""
    soft = apart = lost = 0
    for part in rows(*opaque.shape):
        a, s = opaque[part].astype(np.int32), shade[part].astype(np.int32)
        seen = (a > 0) & ((a < 255 - GREY) | (s < 255 - GREY))
        soft += np.count_nonzero(seen)
        apart += np.count_nonzero(seen & (np.abs(a - s) > GREY))
        lost += np.sum(a * (255 - s)) / 255**2
    if apart <= FEW * soft:
        return True  # premultiplied, or the same picture twice
    body = opaque > 127
    edge = np.count_nonzero(body[1:] != body[:-1]) + np.count_nonzero(body[:, 1:] != body[:, :-1])
    return bool(lost <= SAME_PX * max(edge, 1))


def _is_key(opaque: np.ndarray, shade: np.ndarray) -> bool:
    """Return True where just what is black is transparent."""
    return bool(np.all((opaque > 0) == (shade > 0)))


def _count_between(values: np.ndarray) -> int:
    return int(np.count_nonzero((values >= DARK) & (values <= LIGHT)))
