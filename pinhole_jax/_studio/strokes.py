"""A mask from strokes on a photo: some guide a guess of the object, some paint.

Places are in px from the picture's upper left corner, x right, y down.
"""

import base64
import itertools
import math
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np

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


class Stroke(NamedTuple):
    """A line through points, drawn with a round brush of a radius (px); `kind` is in `KINDS`."""

    kind: str
    radius: float
    points: tuple[tuple[float, float], ...]


class LoadedMask(NamedTuple):
    """A mask from a file (H, W), uint8, 255 on the object; it replaces all strokes before it."""

    mask: np.ndarray


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
        value, radius = values[stroke.kind], max(stroke.radius, 0.5)
        # Pillow's places are those of pixels' centres.
        points = [(x - 0.5, y - 0.5) for x, y in stroke.points]
        for before, after in itertools.pairwise(points):
            draw.line([before, after], value, max(round(2 * radius), 1))
        for x, y in points:
            draw.ellipse([x - radius, y - radius, x + radius, y + radius], value)
    return np.asarray(image)


def guides_of(work: Work) -> tuple[Stroke, ...]:
    """Return the guides since the last loaded mask."""
    guides: list[Stroke] = []
    for step in work:
        if isinstance(step, LoadedMask):
            guides.clear()
        elif step.kind in GUIDES:
            guides.append(step)
    return tuple(guides)


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

    `guess` is `guess_mask` of `guides_of(work)`.
    """
    mask = guess
    for step in work if guess is None else ():
        mask = step.mask if isinstance(step, LoadedMask) else mask
    painted = [step for step in work if isinstance(step, Stroke) and step.kind in PAINTS]
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
    none = np.zeros((H, W), np.uint8)
    seeds = draw_strokes(guides, {"object": 1, "background": 2}, none).copy()
    if not np.any(seeds == 1):
        return None
    if not np.any(seeds == 2):
        border = np.ones((H, W), bool)
        border[1:-1, 1:-1] = False
        seeds[border & (seeds == 0)] = 2
    if not np.any(seeds == 2):
        return np.full((H, W), 255, np.uint8)
    inside = None
    for level in _levels(W, H):
        inside = _refine(_resize(photo, level), _shrink_seeds(seeds, level), inside)
    assert inside is not None
    return np.uint8(255) * _resize(inside, (W, H))


def _levels(W: int, H: int) -> list[tuple[int, int]]:
    """Return sizes (W, H), each twice as large as the one before or less, up to the whole one or
    the finest."""
    halvings = max(math.ceil(math.log2(math.sqrt(W * H / COARSE_PX))), 0)
    sizes = [(max(W >> k, 1), max(H >> k, 1)) for k in range(halvings, -1, -1)]
    return [size for size in sizes if size[0] * size[1] <= FINEST_PX] or sizes[:1]


def _refine(photo: np.ndarray, seeds: np.ndarray, before: np.ndarray | None) -> np.ndarray:
    """Return the object's pixels of a picture, guessed anew near the edge of a coarser answer."""
    H, W = seeds.shape
    labels = seeds.astype(np.int32)
    if before is not None:
        coarse = _resize(before, (W, H))
        labels[(_depth(coarse) > EDGE_PX) & (labels == 0)] = 1
        labels[(_depth(~coarse) > EDGE_PX) & (labels == 0)] = 2
    if not (np.any(labels == 1) and np.any(labels == 2)):
        return labels == 1 if before is None else _resize(before, (W, H))
    if not np.any(labels == 0):
        return labels == 1
    return _random_walker(photo, labels) == 1


def _depth(part: np.ndarray) -> np.ndarray:
    """Return the distance (px) of each pixel of a part from the rest of the picture, 0 there."""
    from scipy import ndimage

    depth: Any = ndimage.distance_transform_edt(part)
    return depth


def _random_walker(photo: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Labels (H, W): each pixel that has none (0) gets that of the most similar stroke."""
    import warnings

    from skimage.color import rgb2lab
    from skimage.segmentation import random_walker

    with warnings.catch_warnings(action="ignore"):  # about pyamg and rounding
        return random_walker(
            rgb2lab(photo) / 100, labels, beta=CONTRAST, mode="cg_j", tol=1e-3, channel_axis=-1
        )


def _resize(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    from PIL import Image

    if (image.shape[1], image.shape[0]) == size:
        return image
    if image.dtype == bool:
        grey = Image.fromarray(np.uint8(255) * image)
        return np.asarray(grey.resize(size, Image.Resampling.BILINEAR)) > 127
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))


def _shrink_seeds(seeds: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return seeds on a smaller picture, thin strokes included."""
    if (seeds.shape[1], seeds.shape[0]) == size:
        return seeds
    object_, back = (_resize(np.uint8(255) * (seeds == label), size) for label in (1, 2))
    return np.where(object_ > back, 1, np.where(back > 0, 2, 0)).astype(np.uint8)


def png_of(mask: np.ndarray) -> str:
    """Return a mask as a PNG file in base64."""
    from PIL import Image

    data = BytesIO()
    Image.fromarray(mask).save(data, "PNG", compress_level=1)
    return base64.b64encode(data.getvalue()).decode()


def work_to_list(work: Work) -> list[dict[str, Any]]:
    """Return strokes and masks as JSON-ready values; masks are PNG files in base64."""
    return [
        {"mask": png_of(step.mask)}
        if isinstance(step, LoadedMask)
        else {"kind": step.kind, "radius_px": step.radius, "points": [[*p] for p in step.points]}
        for step in work
    ]


def work_from_list(data: Any, W: int, H: int) -> Work:
    """Return the work of `work_to_list` for a picture of this size, or raise ValueError."""
    if not isinstance(data, list) or len(data) > MOST_STROKES:
        raise ValueError("`strokes`: expected a list of strokes and masks")
    return tuple(_step(step, W, H) for step in data)


def _step(data: Any, W: int, H: int) -> Stroke | LoadedMask:
    if isinstance(data, dict) and "mask" in data:
        return LoadedMask(_mask_of_png(data["mask"], W, H))
    return stroke_of(data)


def stroke_of(data: Any) -> Stroke:
    """Return a stroke of `kind`, `radius_px` and `points`, or raise ValueError."""
    if not isinstance(data, dict) or data.get("kind") not in KINDS:
        kind = data.get("kind") if isinstance(data, dict) else data
        raise ValueError(f"`kind`: expected one of {', '.join(KINDS)}, got {kind!r}")
    try:
        radius = float(data["radius_px"])
        points = tuple((float(x), float(y)) for x, y in data["points"])
    except (KeyError, TypeError, ValueError):
        raise ValueError("`points`: expected a radius_px and points [x, y] (px)") from None
    if not (0 < len(points) <= MOST_POINTS and 0 < radius < 1e5):
        words = f"got {len(points)} points, a radius of {radius:g} px"
        raise ValueError(f"`points`: expected 1 to {MOST_POINTS}, and a positive radius, {words}")
    if not np.all(np.abs(points) < 1e6):
        raise ValueError("`points`: expected places on the picture (px), got some far away")
    return Stroke(data["kind"], radius, points)


def _mask_of_png(text: Any, W: int, H: int) -> np.ndarray:
    """The mask (H, W) in a PNG in base64, or a ValueError."""
    from PIL import Image

    try:
        mask = np.asarray(Image.open(BytesIO(base64.b64decode(text)), formats=("PNG",)))
    except Exception as error:  # the reader raises many kinds
        raise ValueError(f"`mask`: expected a PNG file in base64, got none: {error}") from None
    if mask.dtype != np.uint8 or mask.shape != (H, W):
        raise ValueError(f"`mask`: expected 8 bits, {W} x {H} px, got shape {mask.shape}")
    return mask
