"""Masks from what users have: transparency, brightness, labels, a photo's background colour.

The meaning of a picture's values is not guessed where it matters. A picture that is no mask at
first sight is refused, with the ways to read it.
"""

import contextlib
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .._files.paths import FilePath
from .._files.pictures import BAND, Image, bands, by_bands, eight_bits, from_picture, rows
from .._mask.target import MOST_BORDER, covered_border
from .labels import FEW, labels_in
from .tidy import SPECK, parts
from .transparency import DARK, GREY, LIGHT, mask_with_colours, opacity, opaque_pixels

#: The ways to read a mask, as `mask_from` and the command's `--mask-from` name them.
WAYS = "alpha, luminance, label=N, background=COLOR (or COLOR,TOLERANCE)"
#: How a mask was read that is a picture's transparency, or that and its colours.
ALPHA = "mask: the transparency (alpha)"
BOTH = "mask: the colours where they are not transparent"
#: How a mask was read whose background is not black: by more than this (of 255).
HAZE, MOST_HAZE = "mask: its brightness", 16
#: This share of the pixels may have another colour where colours are labels.
FEW_OTHERS = 0.01
#: What data sets write for pixels that nobody labelled.
VOID = (255, 65535)
#: Soft edges of a background mask reach this far (px) to both sides.
BAND_PX = 2
#: The nearest colour of the object is looked for this many rows (px) around.
REACH_PX = 64
#: More parts than this are noise.
MOST_PARTS = 1 << 20


def load_mask(
    path: FilePath,
    mask_from: str | None = None,
    say: Callable[[str], object] | None = None,
    *,
    invert: bool = False,
) -> np.ndarray:
    """Return a mask file as uint8 (H, W), 255 where the object is; turned upright as `load_image`.

    `mask_from` is how to read it:

    - None: transparency if it varies, else a grey picture that is mostly black and white. Soft
      edges stay as they are, a JPEG's too: its ringing costs a fit less than a threshold would.
      Where transparency is all or nothing and the colours hold the soft edge, both count; many
      colours that do are refused. So are label pictures: more than two flat levels, or two colours
      on transparency. A mask that covers its border, as black on white does, needs `invert` or a
      way to read it. Two values, such as 25 and 255, become 0 and 255.
    - "alpha": the transparency. "luminance": the brightness, whatever it is.
    - "label=N": the pixels with this grey value or palette entry; edges are hard.
    - "background=COLOR": a photo before a background of one colour, by name or as #rrggbb. The
      object is farther from it in CIE Lab than Otsu's threshold, or than the tolerance of
      "background=COLOR,TOLERANCE" (2.3 is just noticeable). Edges are soft where colours mix.

    `invert`: the mask covers the background. `say` is called with a text on how the file was read,
    unless it is simply a grey mask.

    Raises FileNotFoundError or ValueError like `load_image`, and ValueError for a picture that does
    not hold what is asked for.

    ```python
    pj.io.save_image("mask.png", np.uint8(255 * pj.silhouette(camera, scene)))
    mask = pj.io.load_mask("mask.png")
    ```
    """
    way = parse_way(mask_from)
    read = from_picture(path, "a mask", lambda image: read_mask(image, way, invert))
    if say is not None and read.words:
        say(read.words)
    return read.mask


class Way(NamedTuple):
    """A way to read a mask: its name, and the label, or the colour's name and the tolerance."""

    name: str
    value: str = ""
    tolerance: float | None = None


class MaskReading(NamedTuple):
    """A mask (H, W), 255 where the object is, and a text on how it was read, if not plainly."""

    mask: np.ndarray
    words: str


def parse_way(mask_from: str | None) -> Way:
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


def read_mask(image: Image, way: Way, invert: bool = False) -> MaskReading:
    """Return the mask that a picture holds; at first sight its transparency if that varies, else
    its brightness if that is a mask's. `invert`: what is read is the background.

    Raises ValueError with what the picture holds instead.
    """
    read = _read(image, way)
    if invert:
        return MaskReading(255 - read.mask, f"{read.words or 'mask: its brightness'}, inverted")
    if way.name == "first sight":
        _check_border(read, image)
    return read


def _check_border(read: MaskReading, image: Image) -> None:
    """Raise ValueError for a mask that covers its border, and yet not all of the picture."""
    inside = read.mask > 127
    share = covered_border(inside)
    if share <= MOST_BORDER or np.all(inside):
        return
    if label := _label_amid_void(image):
        raise ValueError(
            f"a picture that covers {share:.0%} of its border with a value that is often void; give"
            f" `mask_from` label={label} (--mask-from label={label}) if its object is that"
        )
    inner = inside[1:-1, 1:-1]
    if inner.size and covered_border(inner) <= MOST_BORDER:
        raise ValueError("a picture with a frame of one pixel: crop it, or make it background")
    ways = {"": "luminance", HAZE: "luminance", BOTH: "luminance", ALPHA: "alpha"}
    way = ways.get(read.words.partition(",")[0], "label=1")
    raise ValueError(
        f"a picture that covers {share:.0%} of its border, like a black object on white; give"
        " `invert` (on the command line: --invert), or where it is right"
        f" `mask_from` {way} (--mask-from {way}) and a camera to start from"
    )


def _label_amid_void(image: Image) -> int:
    """Return the one label of a picture with void around it, or in a frame of one pixel; else 0."""
    if image.mode == "P" or not _has_numbers(image) or min(image.size) < 3:
        return 0
    values, (W, H) = _values(image), image.size
    labels = [int(x) for x in values if x > 0 and x not in VOID]
    amid_void = values[-1] in VOID and len(labels) == 1
    if amid_void and 0 in values:
        inner = _values(image.crop((1, 1, W - 1, H - 1)))
        amid_void = np.array_equal(inner, [0, *labels])
    return labels[0] if amid_void else 0


def _read(image: Image, way: Way) -> MaskReading:
    if way.name == "alpha":
        return MaskReading(opacity(image), ALPHA)
    if way.name == "luminance":
        return MaskReading(eight_bits(image), "mask: its brightness")
    if way.name == "label":
        return _label(image, int(way.value))
    if way.name == "background":
        return _background(image, way.value, way.tolerance)
    return _at_first_sight(image)


def _at_first_sight(image: Image) -> MaskReading:
    if image.has_transparency_data and (read := _transparent(image)) is not None:
        return read
    if _two_colours(image):
        return MaskReading(_label(image, 1).mask, "mask: its palette's entry 1")
    is_grey = image.mode != "P" and _has_numbers(image)
    grey = eight_bits(image) if is_grey else by_bands(image, _grey)
    labels = labels_in(image, np.asarray if is_grey else _grey)
    _check_labels(image, _entries(image, labels) if image.mode == "P" else labels)
    between = np.count_nonzero((grey >= DARK) & (grey <= LIGHT))
    if between > np.count_nonzero(grey > LIGHT):
        raise ValueError(
            f"a grey picture in which {between / grey.size:.0%} of the pixels are neither black nor"
            f" white; say what is the object: {_labels(image)}"
        )
    if grey.max() == 1 and image.mode in ("L", "P"):
        return MaskReading(255 * grey, "mask: its values 0 and 1")
    if 0 < grey.max() < DARK:
        raise ValueError(f"a picture no lighter than {grey.max()} of 255; {_labels(image)}")
    return _without_haze(grey)


def _without_haze(grey: np.ndarray) -> MaskReading:
    """Return a grey mask; 0 and 255 for its values if they are two and neither is 0."""
    low, high = int(grey.min()), int(grey.max())
    if low > 0 and (hard := _two_levels(grey)) is not None:
        return MaskReading(hard, f"{HAZE}, {low} and {high}")
    if low > MOST_HAZE:
        return MaskReading(grey, f"{HAZE}, whose background is at least {low} of 255")
    return MaskReading(grey, "")


def _two_levels(array: np.ndarray) -> np.ndarray | None:
    """Return an array of two values as 0 and 255; None if there are fewer or more."""
    low, high = array.min(), array.max()
    if low == high or not all(np.all((row == low) | (row == high)) for row in array):
        return None
    return np.where(array == high, np.uint8(255), np.uint8(0))


def _transparent(image: Image) -> MaskReading | None:
    """Return the mask of a picture whose transparency varies, None where it does not."""
    opaque = opacity(image)
    most = opaque.max()
    if opaque.min() == most:
        if most == 0 and _varies(image):
            words = "a picture that is transparent everywhere; say what is the object"
            raise ValueError(f"{words}: {WAYS}")
        return None if most else MaskReading(opaque, ALPHA)
    _check_opacity(image)
    _check_labels(image, _labels_that_show(image))
    words = ALPHA
    if most < 255 or opaque.min() > 0:
        words = f"{ALPHA}, its values {opaque.min()} to {most}"
        opaque = _stretched(opaque)
    mask = mask_with_colours(image, opaque)
    if mask is not None:
        return MaskReading(mask, BOTH)
    _check_colours(image)
    return MaskReading(opaque, words)


def _check_opacity(image: Image) -> None:
    """Raise ValueError where the transparency holds labels."""
    if len(labels := labels_in(image, opaque_pixels)):
        raise ValueError(
            "a label picture, it seems, with flat areas of the transparency (alpha) of the values"
            f" {_listed(labels)}; save it as grey to pick one, or give one of {WAYS}"
        )


def _stretched(opaque: np.ndarray) -> np.ndarray:
    """Return an opacity scaled so that its largest value is 255, its two values 0 and 255.

    Raises ValueError where it is hardly there.
    """
    if (hard := _two_levels(opaque)) is not None:
        return hard
    most = int(opaque.max())
    if most < DARK:
        raise ValueError(f"transparency (alpha) of at most {most} of 255; labels? {WAYS}")
    result = np.empty_like(opaque)
    for part in rows(*opaque.shape):
        result[part] = np.round(opaque[part] * (255 / most))
    return result


def _check_colours(image: Image) -> None:
    """Raise ValueError for a picture of two or more flat colours and no others: each may be an
    object."""
    if _has_numbers(image):
        return
    labels = labels_in(image, _numbered)
    labels = labels[labels >= 0]
    if len(labels) < 2:
        return
    seen = others = 0
    for _, band in bands(image):
        numbers = _numbered(band)
        numbers = numbers[numbers >= 0]
        seen += numbers.size
        others += np.count_nonzero(~np.isin(numbers, labels))
    if others <= FEW_OTHERS * seen:
        names = ", ".join(f"#{int(x):06x}" for x in labels[:12]) + ", ..." * (len(labels) > 12)
        raise ValueError(
            f"a label picture, it seems, with flat areas of the colours {names}; give `mask_from`"
            " alpha (--mask-from alpha) if all of them are the object, or save one as the mask"
        )


def _numbered(band: Image) -> np.ndarray:
    """Return a number for the colour of each pixel, -1 where it is transparent."""
    rgba = np.asarray(band.convert("RGBA")).astype(np.int32)
    red, green, blue, opaque = np.moveaxis(rgba, -1, 0)
    return np.where(opaque == 0, -1, (red << 16) + (green << 8) + blue)


def _varies(image: Image) -> bool:
    """Return True for a picture of more than one colour."""
    return any(low != high for low, high in image.convert("RGBA").getextrema()[:3])


def _labels_that_show(image: Image) -> np.ndarray:
    """Return the labels of a picture in which one value or colour is transparent."""
    none = np.zeros(0)
    if image.mode in ("LA", "PA", "RGBA") or (image.mode == "P" and not image.getcolors(FEW)):
        return none
    numbers = np.asarray if _has_numbers(image) else _grey
    hidden = lambda band: opaque_pixels(band) == 0
    with contextlib.suppress(ValueError):
        minus = np.int32(-1)
        labels = labels_in(image, lambda band: np.where(hidden(band), minus, numbers(band)))
        labels = labels[labels >= 0]
        return labels if len(labels) > 1 else none
    return none  # colours


def _has_numbers(image: Image) -> bool:
    """Return True where a pixel is one number."""
    return image.mode in ("1", "L", "P") or image.mode.startswith(("I", "F"))


def _check_labels(image: Image, labels: np.ndarray) -> None:
    """Raise ValueError where there are labels."""
    if not len(labels):
        return
    words = f"a label picture, it seems, with flat areas of the values {_listed(labels)}"
    if void := [x for x in labels if x in VOID]:
        words += f" ({void[0]:g} is often void: give such pixels weight 0)"
    if not _has_numbers(image):
        raise ValueError(f"{words}; save it as grey to pick one, or give one of {WAYS}")
    whole = [int(x) for x in labels if x > 0 and x == int(x)]
    hints = [f"`mask_from` label={x} (--mask-from label={x}), or " for x in whole[:1]]
    raise ValueError(f"{words}; say which is the object: {''.join(hints)}one of {WAYS}")


def _entries(image: Image, greys: np.ndarray) -> np.ndarray:
    """Return the entries of a grey palette that have these values."""
    palette = np.array(image.getpalette("RGB"))[::3]
    return np.array([k for k in _values(image) if palette[k] in greys])


def _listed(values: np.ndarray) -> str:
    """Return the first of some values, between commas."""
    return ", ".join(f"{x:.9g}" for x in values[:12]) + (", ..." if len(values) > 12 else "")


def _two_colours(image: Image) -> bool:
    """True if a picture uses two entries of its palette, 0 (black) and 1 (a colour): a label's."""
    if image.mode != "P" or max(image.getextrema()) != 1:
        return False
    colours = [*(image.getpalette() or ()), *6 * [0]][:6]
    return max(colours[:3]) < DARK < max(colours[3:]) and bool(np.ptp(colours[3:]) > GREY)


def _values(image: Image) -> np.ndarray:
    """Return the values that a picture of one channel has."""
    return np.unique(np.concatenate([np.unique(np.asarray(band)) for _, band in bands(image)]))


def _labels(image: Image) -> str:
    """Return the words that say how to read a picture of a few values."""
    values = _values(image)
    few = len(values) == 2 and values[0] == 0 and image.mode in ("L", "P")
    hint = f"`mask_from` label={values[1]} (--mask-from label={values[1]}) if its object is that;"
    return f"{hint} or one of {WAYS}" if few else f"labels? {WAYS}"


def _grey(band: Image) -> np.ndarray:
    """Return a channel of a picture whose channels are alike."""
    colours = np.asarray(band.convert("RGB"))
    if np.max(np.ptp(colours, axis=2)) > GREY:
        raise ValueError(f"a colour picture; say what is the object: {WAYS}")
    return colours[..., 0]


def _label(image: Image, number: int) -> MaskReading:
    if not _has_numbers(image):
        raise ValueError(f"a picture of mode {image.mode}: labels are grey values or a palette's")
    mask = by_bands(image, lambda band: np.where(np.asarray(band) == number, 255, 0))
    values = _values(image)
    if number not in values:
        raise ValueError(f"no pixel with the label {number}; there are {_listed(values)}")
    share = np.count_nonzero(mask) / mask.size
    words = f"mask: label {number}, {share:.1%} of the picture, edges hard"
    void = [x for x in VOID if x in values and x != number and len(values) > 2]
    if void:
        words += f"; {void[0]}, often void, counts as background: give such pixels weight 0"
    return MaskReading(mask, words)


def _background(image: Image, name: str, tolerance: float | None) -> MaskReading:
    """Return a mask of pixels that differ from a colour by more than a tolerance (CIE Lab).

    Without one, Otsu's threshold parts near from far. Specks and pinholes are dropped, and the
    pixels beside an edge are taken for mixtures.
    """
    from skimage.color import rgb2lab

    back = _colour(name)
    origin = rgb2lab(back[None, None])
    lab_distance = lambda band: np.linalg.norm(rgb2lab(_colours(band)) - origin, axis=-1)
    distance = by_bands(image, lab_distance, dtype=np.float32)
    if np.ptp(distance) == 0:
        raise ValueError("a picture of one colour")
    limit = _otsu(distance) if tolerance is None else tolerance
    inside = distance > limit
    del distance  # a large photo is as large as all else together
    _drop_specks(inside)
    share = np.count_nonzero(inside) / inside.size
    how = "Otsu's threshold" if tolerance is None else "as told"
    words = (
        f"mask: what differs from {name} by more than {limit:.1f} in CIE Lab ({how}),"
        f" {share:.1%} of the picture, soft edges from mixed colours"
    )
    return MaskReading(_with_soft_edges(inside, image, back), words)


def _otsu(values: np.ndarray) -> float:
    """Return Otsu's threshold of 256 equal steps, as scikit-image has it, without its copies."""
    from skimage.filters import threshold_otsu

    ends = float(np.min(values)), float(np.max(values))
    edges = np.histogram_bin_edges([], 256, ends)
    counts = sum(np.histogram(values[part], 256, ends)[0] for part in rows(*values.shape))
    return float(threshold_otsu(hist=(counts, (edges[1:] + edges[:-1]) / 2)))


def _with_soft_edges(inside: np.ndarray, image: Image, back: np.ndarray) -> np.ndarray:
    """Return a hard mask as uint8 with soft edges.

    A pixel beside the edge is a mixture of the background and the object's nearest colour, in at
    most `REACH_PX` rows above and below. Its coverage is its place between both, in the values as
    stored.
    """
    from scipy import ndimage

    H, W = inside.shape
    result = np.where(inside, np.uint8(255), np.uint8(0))
    step = max(REACH_PX, 8 * BAND // W)
    for top in range(0, H, step):
        first, last = max(0, top - REACH_PX), min(H, top + step + REACH_PX)
        around = inside[max(0, first - BAND_PX) : last + BAND_PX]
        cut = slice(min(first, BAND_PX), min(first, BAND_PX) + last - first)
        deep: Any = ndimage.binary_erosion(around, iterations=BAND_PX, border_value=1)[cut]
        near: Any = ndimage.binary_dilation(around, iterations=BAND_PX)[cut]
        edge = near & ~deep
        edge[: top - first] = edge[top + step - first :] = False
        if not (np.any(edge) and np.any(deep)):
            continue
        place: Any = ndimage.distance_transform_edt(
            ~deep, return_distances=False, return_indices=True
        )
        colours = np.asarray(image.crop((0, first, W, last)).convert("RGB"))
        object_colour = colours[tuple(place[:, edge])] / 255 - back
        size = np.maximum(np.sum(object_colour**2, axis=-1), 1e-6)
        mixed = np.sum((colours[edge] / 255 - back) * object_colour, axis=-1) / size
        result[first:last][edge] = np.round(255 * np.clip(mixed, 0, 1))
    return result


def _colour(name: str) -> np.ndarray:
    from PIL import ImageColor

    return np.array(ImageColor.getrgb(name)[:3]) / 255


def _colours(band: Image) -> np.ndarray:
    return np.asarray(band.convert("RGB")) / 255


def _drop_specks(inside: np.ndarray) -> None:
    """Drop parts, and then holes, that are noise, from a mask in place.

    Raises ValueError where there are more parts than a photo's specks are.
    """
    for _ in range(2):
        _drop_small_parts(inside)
        np.logical_not(inside, out=inside)


def _drop_small_parts(inside: np.ndarray) -> None:
    labels, sizes = parts(inside)
    if (count := len(sizes) - 1) > MOST_PARTS:
        raise ValueError(f"a picture of {count} parts: noise, not before one colour")
    keep = sizes >= SPECK * max(sizes.max(), 1)
    for part in rows(*inside.shape):
        inside[part] &= keep[labels[part]]
