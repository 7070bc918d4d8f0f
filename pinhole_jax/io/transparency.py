"""A picture's transparency and the colours that it shows: which of them is the mask, or both."""

from typing import Any

import numpy as np

from .._files.pictures import by_rows

#: Values (of 255) between these are the in-between of an edge.
DARK, LIGHT = 26, 229
#: Channels or values that differ by less than this (of 255) are alike: JPEG leaves a few.
GREY = 8
#: Soft edges reach this far inwards (px).
EDGE_PX = 3
#: A share of the pixels that is noise.
FEW = 0.01
#: Pixels of a ring are looked for this far from an edge (px).
NEAR_PX = 8
#: This many pixels are a fair sample of an edge.
MOST_PLACES = 4096
#: An outline that moves by less than this (px) is the same.
SAME_PX = 0.02


def mask_with_colours(colours: np.ndarray, opaque: np.ndarray) -> np.ndarray | None:
    """Return the mask (H, W) that transparency and colours make together. None where transparency
    alone is the mask: one colour, premultiplied or not, or an object cut out of a photo.

    Where opacity is all or nothing and colours darken towards the edge, they hold the edge.

    Raises ValueError where each may be the mask.
    """
    shade = _shade(colours, opaque)
    if shade is not None:
        if _is_same(opaque, shade):
            return None
        inner = shade[shrunk(opaque > LIGHT, EDGE_PX, np.ones((3, 3)))]
        mask = np.minimum(opaque, shade)  # one of them is all or nothing
        is_photo = _between(mask) > np.count_nonzero(mask > LIGHT)
        is_mixed = _between(inner) > FEW * inner.size
        is_black = np.count_nonzero(inner < DARK) > FEW * inner.size
        is_hard = _between(opaque) <= FEW * _between(mask)
        if is_hard and not (is_mixed or is_photo or is_black):
            return mask
        if not (is_mixed and is_photo):
            raise ValueError(
                "transparency and colours that disagree; give `mask_from` alpha (--mask-from"
                " alpha) or `mask_from` luminance (--mask-from luminance), whichever is the object"
            )
    if _fades(colours, opaque):
        raise ValueError(
            "transparency that is all or nothing, and colours that hold a soft edge, too: the"
            " outline of the transparency is too far out; save the soft edge as transparency, or"
            " give `mask_from` alpha (--mask-from alpha) or `mask_from` luminance (--mask-from"
            " luminance), whichever is the object"
        )
    return None


def _fades(colours: np.ndarray, opaque: np.ndarray) -> bool:
    """Return True for an object of many colours that go over into the background's, of one colour,
    within the last pixels of a hard edge.

    The pixels along the edge lie between both colours, some near each. Shading that goes on farther
    in, as a ball's, does not count, nor does a dark rim.
    """
    seen = opaque > 0
    edge = np.argwhere(ring(seen, 0))
    if not len(edge) or _between(opaque) > FEW * len(edge):
        return False
    places = edge[:: max(1, len(edge) // MOST_PLACES)]
    rings = (ring(~seen, 1), ring(seen, 0), ring(seen, 4), ring(seen, 6))
    found = [nearest(pixels, places) for pixels in rings]
    known = np.all([distance < NEAR_PX for _, distance in found], axis=0)
    if np.count_nonzero(known) < max(16, len(places) // 2):
        return False
    seen_there = [colours[tuple(points[known].T)].astype(float) for points, _ in found]
    back = np.median(seen_there[0], axis=0)
    off, at_edge, near, deep = (np.linalg.norm(x - back, axis=1) for x in seen_there)
    if np.mean(off > GREY) > FEW or np.median(near) <= GREY or np.mean(near) < 0.9 * np.mean(deep):
        return False
    low, middle, high = np.quantile(at_edge / np.maximum(near, 1), (0.25, 0.5, 0.9))
    return bool(low < 0.4 and middle < 0.65 and high > 0.2)


def shrunk(inside: np.ndarray, by: int, neighbours: np.ndarray | None = None) -> np.ndarray:
    """Return the mask eroded by `by` px, in steps to these `neighbours` (None: four)."""
    from scipy.ndimage import binary_erosion

    deep: Any = binary_erosion(inside, neighbours, by, border_value=1) if by else inside
    return deep


def ring(inside: np.ndarray, depth: int) -> np.ndarray:
    """Return the pixels that are this far (px) inside."""
    deep = shrunk(inside, depth)
    return deep & ~shrunk(deep, 1)


def nearest(pixels: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel that is nearest to each place (n, 2), and its distance (px)."""
    from scipy.spatial import KDTree

    points = np.argwhere(pixels)
    if not len(points):
        return places, np.full(len(places), np.inf)
    distance, index = KDTree(points).query(places)
    return points[index], distance


def _shade(colours: np.ndarray, opaque: np.ndarray) -> np.ndarray | None:
    """Return the lightness of each pixel (H, W), 255 for the lightest that is seen; None where the
    pixels that are seen have more than one hue."""
    brightness = np.sum(colours, axis=-1, dtype=np.uint16) * (opaque > 0)
    lightest = colours[np.unravel_index(np.argmax(brightness), opaque.shape)].astype(np.float32)
    if not np.any(brightness):
        return np.full_like(opaque, 255)
    unit, off = lightest / (lightest @ lightest), np.zeros(opaque.shape, bool)

    def shade(part: slice) -> np.ndarray:
        share = colours[part] @ unit
        off[part] = np.max(np.abs(colours[part] - share[..., None] * lightest), axis=-1) > GREY
        return np.round(255 * np.clip(share, 0, 1))

    shades = by_rows(shade, opaque.shape)
    seen = opaque > 0
    return None if np.count_nonzero(off & seen) > FEW * np.count_nonzero(seen) else shades


def _is_same(opaque: np.ndarray, shade: np.ndarray) -> bool:
    """Return True where colours take hardly anything from the opacity: they are the same picture,
    premultiplied, or light."""
    lost = opaque - np.minimum(opaque, np.minimum(shade, 255 - GREY) + GREY)
    return bool(np.sum(lost) <= 255 * SAME_PX * np.count_nonzero(ring(opaque > 127, 0)))


def _between(values: np.ndarray) -> int:
    return int(np.count_nonzero((values >= DARK) & (values <= LIGHT)))
