"""A mask from strokes on a photo: some guide a guess of the object, some paint.

Places are in px from the picture's upper left corner, x right, y down.
"""

import base64
from collections.abc import Mapping, Sequence
from functools import lru_cache
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np

from .._files.fields import Fields

#: The kinds of strokes. Guides mark object and background, and the rest is guessed from the photo;
#: paint adds its pixels to the mask or takes them away.
GUIDES, PAINTS = ("object", "background"), ("add", "erase")
KINDS = (*GUIDES, *PAINTS)
#: A guess is made on a picture of about this many pixels, then along its edge on finer ones up to
#: this many, where a stroke takes some seconds.
COARSE_PX, FINEST_PX = 40_000, 800_000
#: The most that the edge may move (px) from one picture to the next.
EDGE_PX = 4
#: The random walker's aversion to steps between colours: scikit-image's beta.
CONTRAST = 2000.0
#: The distance of dots from a view's outline, as a share of the object's size in the picture.
KEEP_OFF = 0.12
#: The most points of a stroke and the most strokes: a hand draws no more.
MOST_POINTS, MOST_STROKES = 100_000, 10_000
#: The largest place and radius of a brush (px).
MOST_PX = 1e6


class Stroke(NamedTuple):
    """A line through points, drawn with a round brush; `kind` is in `KINDS`."""

    kind: str
    radius_px: float
    points: tuple[tuple[float, float], ...]


class LoadedMask(NamedTuple):
    """A mask from a file, a PNG in base64; it replaces all strokes before it."""

    mask: str


Work = tuple[Stroke | LoadedMask, ...]


def draw_strokes(
    strokes: Sequence[Stroke], values: Mapping[str, int], picture: np.ndarray
) -> np.ndarray:
    """Return a picture (H, W), uint8, with strokes drawn over it: each has its kind's value, on
    the pixels whose centres it covers."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    for stroke in strokes:
        value, radius = values[stroke.kind], max(stroke.radius_px, 0.5)
        # Pillow's places are those of pixels' centres.
        points = [(x - 0.5, y - 0.5) for x, y in stroke.points]
        draw.line(points, value, max(round(2 * radius), 1))
        for point in points:
            draw.circle(point, radius, value)
    return np.asarray(image)


def strokes_of(work: Work, kinds: Sequence[str]) -> tuple[Stroke, ...]:
    """Return the strokes of some kinds since the last loaded mask."""
    begin = max((k for k, step in enumerate(work) if isinstance(step, LoadedMask)), default=-1)
    return tuple(s for s in work[begin + 1 :] if isinstance(s, Stroke) and s.kind in kinds)


def guides_around(inside: np.ndarray) -> tuple[Stroke, ...]:
    """Return guides for a view's silhouette (H, W): dots well inside it and well outside."""
    H, W = inside.shape
    off = max(KEEP_OFF * float(np.sqrt(np.count_nonzero(inside))), 2.0)
    step = int(off)
    rows, columns = np.mgrid[step // 2 : H : step, step // 2 : W : step]
    dots = []
    for kind, part in zip(GUIDES, (inside, ~inside), strict=True):
        chosen = _depth(part)[rows, columns] > off
        points = zip(columns[chosen].tolist(), rows[chosen].tolist(), strict=True)
        dots += [Stroke(kind, off / 3, ((x + 0.5, y + 0.5),)) for x, y in points]
    return tuple(dots)


def mask_of(work: Work, guess: np.ndarray | None, W: int, H: int) -> np.ndarray | None:
    """Return the mask (H, W), 255 on the object; None without strokes or a mask.

    `guess` is `guess_mask` of the guides since the last loaded mask.
    """
    loaded = [step.mask for step in work if isinstance(step, LoadedMask)]
    mask = pixels_of(loaded[-1]) if loaded and guess is None else guess
    painted = strokes_of(work, PAINTS)
    if not painted:
        return mask
    ground = np.zeros((H, W), np.uint8) if mask is None else mask
    return draw_strokes(painted, {"add": 255, "erase": 0}, ground)


def guess_mask(photo: np.ndarray, guides: Sequence[Stroke]) -> np.ndarray | None:
    """Return a mask (H, W) guessed from strokes on object and background; None without an object.

    A random walker (Grady 2006, scikit-image's) gives each pixel to the stroke that it likely meets
    first, on a small picture in CIE Lab. The edge then follows the photo on finer ones.
    Without strokes on the background, the photo's border is it.
    """
    H, W = photo.shape[:2]
    seeds = draw_strokes(guides, {"object": 1, "background": 2}, np.zeros((H, W), np.uint8))
    if not np.any(seeds == 1):
        return None
    if not np.any(seeds == 2):
        border = np.pad(np.zeros((H - 2, W - 2), np.uint8), 1, constant_values=2)
        seeds = np.where(seeds == 1, 1, border)
    return np.uint8(255) * _object(photo, seeds)


def _object(photo: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Return the object's pixels (H, W): those of a picture half as large, guessed anew near their
    edge. Seeds are 1 on the object, 2 on the background."""
    import warnings

    from PIL import Image
    from skimage.color import rgb2lab
    from skimage.segmentation import random_walker

    H, W = seeds.shape
    labels = seeds.astype(np.int32)
    if H * W > COARSE_PX:
        halved = lambda image: np.asarray(Image.fromarray(image).reduce(2))
        marked = [halved(np.uint8(255) * (seeds == label)) for label in (1, 2)]  # thin ones, too
        small = np.select([marked[0] > marked[1], marked[1] > 0], [1, 2])
        guess = Image.fromarray(np.uint8(255) * _object(halved(photo), small))
        doubled = guess.resize((2 * guess.width, 2 * guess.height), Image.Resampling.BILINEAR)
        object_ = np.asarray(doubled)[:H, :W] > 127
        if H * W > FINEST_PX:
            return object_
        for label, part in ((1, object_), (2, ~object_)):
            labels[(_depth(part) > EDGE_PX) & (labels == 0)] = label
    if len(np.unique(labels)) < 3:  # nothing is left to guess, or to guess from
        return labels == 1
    lab = rgb2lab(photo) / 100
    with warnings.catch_warnings(action="ignore"):  # about pyamg and rounding
        found = random_walker(lab, labels, beta=CONTRAST, mode="cg_j", tol=1e-3, channel_axis=-1)
    return found == 1


def _depth(part: np.ndarray) -> np.ndarray:
    """Return the distance (px) of each pixel of a part from the rest of the picture, 0 there."""
    from scipy import ndimage

    depth: Any = ndimage.distance_transform_edt(part)
    return depth


@lru_cache(2)
def pixels_of(png: str) -> np.ndarray:
    """Return the mask (H, W) of a PNG file in base64."""
    from PIL import Image

    return np.asarray(Image.open(BytesIO(base64.b64decode(png)), formats=("PNG",)))


def step_of(data: Fields, W: int, H: int) -> Stroke | LoadedMask:
    """Return a stroke, or a mask for a picture of this size, of a session's file, or raise
    ValueError."""
    if "mask" not in data:
        return stroke_of(data)
    try:
        mask = pixels_of(data.text("mask"))
    except Exception as error:  # the reader raises many kinds
        raise data.wrong("mask", "a PNG file in base64", f"none: {error}") from None
    if mask.dtype != np.uint8 or mask.shape != (H, W):
        raise data.wrong("mask", f"8 bits, {W} x {H} px", f"shape {mask.shape}")
    return LoadedMask(data.text("mask"))


def stroke_of(data: Fields) -> Stroke:
    """Return a stroke of `kind`, `radius_px` and `points` [x, y], or raise ValueError."""
    kind, points = data.text("kind", KINDS), data.array("points", (-1, 2))
    if not 0 < len(points) <= MOST_POINTS or np.any(np.abs(points) > MOST_PX):
        raise data.wrong("points", f"1 to {MOST_POINTS} places on the picture (px)", points)
    radius = data.number("radius_px", None, "a radius above 0 px", 0, MOST_PX)
    return Stroke(kind, radius, tuple(map(tuple, points.tolist())))
