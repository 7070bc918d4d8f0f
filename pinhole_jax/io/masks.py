"""Masks from what users have: transparency, brightness, labels, a photo's background colour.

The meaning of a picture's values is not guessed where it matters. A picture that is no mask at
first sight is refused, with the ways to read it.
"""

import re
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .._files.paths import FilePath
from .._files.pictures import Picture, by_rows, from_picture, pixels, rows
from .._mask.target import MOST_BORDER, as_coverage as unclipped, border_of, check_image
from .._numerics.arrays import ArrayLike, Input
from .labels import labels_in, value_counts
from .tidy import SPECK, drop_specks
from .transparency import DARK, GREY, LIGHT, mask_with_colours, nearest, ring, shrunk

#: The ways to read a mask, as `mask_from` and the command's `--mask-from` name them.
WAYS = "alpha, luminance, label=N, background=COLOR (or COLOR,TOLERANCE)"
#: How a mask was read that is a picture's transparency, or that and its colours.
ALPHA = "mask: the transparency (alpha)"
BOTH = "mask: the colours where they are not transparent"
#: How a mask was read whose background is not black: by more than this (of 255).
HAZE, MOST_HAZE = "mask: its brightness", 16
#: How bright red, green and blue are (ITU-R BT.601, as Pillow has it).
BRIGHTNESS = (0.299, 0.587, 0.114)
#: What data sets write for pixels that nobody labelled.
VOID = (255, 65535)
#: Soft edges of a background mask reach this far (px) to both sides.
BAND_PX = 2
#: This many pixels are enough for a threshold.
SAMPLE = 1 << 20


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
    way = _way(mask_from)

    def read(image: Any) -> MaskReading:
        found = way(pixels(image))
        if invert:
            return MaskReading(255 - found.mask, f"{found.words or HAZE}, inverted")
        if mask_from is None:
            _check_border(found)
        return found

    mask, words = from_picture(path, "a mask", read)
    if say is not None and words:
        say(words)
    return np.ascontiguousarray(mask)


def as_coverage(mask: Input[ArrayLike, "H W"]) -> Float[np.ndarray, "H W"]:
    """Return a mask as fits read it: float64 in [0, 1], where 255 of uint8, and True, are 1.

    Raises ValueError unless it is (H, W), of bools, uint8 or floats, or of integers that are all 0
    or 1 (or 255, or 65535).

    ```python
    coverage = pj.io.as_coverage(np.uint8(255 * mask))  # the masks of `load_mask`, too
    ```
    """
    return unclipped(check_image("mask", mask)).clip(0, 1)


class MaskReading(NamedTuple):
    """A mask (H, W), 255 where the object is, and a text on how it was read, if not plainly."""

    mask: np.ndarray
    words: str


def _way(mask_from: str | None) -> Callable[[Picture], MaskReading]:
    """Return the reader of pictures that a user names; None is what is seen at first sight.

    Raises ValueError for any other text than `WAYS` has, and for colours of no known name.
    """
    if mask_from is None:
        return _at_first_sight
    if mask_from in ("alpha", "luminance"):
        return _opacity if mask_from == "alpha" else _luminance
    if found := re.fullmatch(r"label=(\d{1,9})", mask_from):
        return partial(_label, number=int(found[1]))
    if found := re.fullmatch(r"background=(.+?)(?:,(\d+(?:\.\d*)?))?", mask_from):
        limit = None if found[2] is None else float(found[2])
        return partial(_background, back=_colour(found[1]), name=found[1], tolerance=limit)
    raise ValueError(f"`mask_from`: expected one of {WAYS}, got {mask_from!r}")


def _check_border(read: MaskReading) -> None:
    """Raise ValueError for a mask that covers its border, and yet not all of the picture."""
    inside = read.mask > 127
    share = float(np.mean(border_of(inside)))
    if share <= MOST_BORDER or np.all(inside):
        return
    way = "alpha" if read.words.startswith(ALPHA) else "luminance"
    raise ValueError(
        f"a picture that covers {share:.0%} of its border, like a black object on white, or labels"
        " amid void; give `invert` (on the command line: --invert), or where it is right"
        f" `mask_from` {way} (--mask-from {way}) and a camera to start from"
    )


def _opacity(picture: Picture) -> MaskReading:
    if picture.opacity is None:
        raise ValueError("no transparency")
    return MaskReading(picture.opacity, ALPHA)


def _luminance(picture: Picture) -> MaskReading:
    colours = picture.colours
    grey = lambda part: np.round(colours[part] @ BRIGHTNESS)
    return MaskReading(by_rows(grey, colours.shape[:2]), HAZE)


def _at_first_sight(picture: Picture) -> MaskReading:
    if picture.opacity is not None and (read := _transparent(picture, picture.opacity)) is not None:
        return read
    colours, _, numbers, is_grey = picture
    has_bytes = getattr(numbers, "dtype", None) == np.uint8
    if has_bytes and numbers.max() == 1 and not np.any(colours[numbers == 0]):  # 0 is black
        return MaskReading(255 * numbers, "mask: its values 0 and 1")
    if not is_grey and _has_colour(colours):
        raise ValueError(f"a colour picture; say what is the object: {WAYS}")
    grey = colours[..., 0]
    labels = labels_in(numbers if is_grey else grey)
    if numbers is not None and not is_grey and len(labels):
        labels = np.unique(numbers[np.isin(grey, labels)])
    _check_labels(labels, "values", numbers is not None)
    values, counts = value_counts(grey)
    low, most = int(values[0]), int(values[-1])
    between = counts[(values >= DARK) & (values <= LIGHT)].sum()
    if between > counts[values > LIGHT].sum():
        raise ValueError(
            f"a grey picture in which {between / grey.size:.0%} of the pixels are neither black nor"
            f" white; say what is the object: {WAYS}"
        )
    if 0 < most < DARK:
        hint = f"`mask_from` label={most} (--mask-from label={most}) if its object is that"
        raise ValueError(f"a picture no lighter than {most} of 255; labels? Give {hint}")
    if low > 0 and len(values) == 2:
        return MaskReading(_stretched(grey, values), f"{HAZE}, {low} and {most}")
    hazy = f"{HAZE}, whose background is at least {low} of 255"
    return MaskReading(grey, hazy if low > MOST_HAZE else "")


def _has_colour(colours: np.ndarray) -> bool:
    """Whether a pixel's red, green and blue (H, W, 3) differ by more than a grey one's."""
    # (Over the three values of a pixel np.ptp takes twenty times as long as over planes.)
    parts = (np.moveaxis(colours[part], 2, 0).copy() for part in rows(*colours.shape[:2]))
    return any(np.max(np.ptp(planes, axis=0)) > GREY for planes in parts)


def _stretched(grey: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return a picture scaled so that its largest value is 255; its two values as 0 and 255."""
    ends = values[0] if len(values) == 2 else 0, values[-1]
    return np.round(np.interp(np.arange(256), ends, (0, 255))).astype(np.uint8)[grey]


def _transparent(picture: Picture, opaque: np.ndarray) -> MaskReading | None:
    """Return the mask of a picture whose transparency varies, None where it does not."""
    values, words, colours = value_counts(opaque)[0], ALPHA, picture.colours
    if len(values) == 1:
        if values[0] == 0 and np.any(colours != colours[0, 0]):
            words = "a picture that is transparent everywhere; say what is the object"
            raise ValueError(f"{words}: {WAYS}")
        return None if values[0] else MaskReading(opaque, ALPHA)
    _check_labels(labels_in(opaque), "transparency (alpha) of the values", False)
    is_colour = picture.numbers is None
    labels = labels_in(_packed(colours) if is_colour else picture.numbers, opaque > 0)
    _check_labels(labels, "colours" if is_colour else "values", not is_colour)
    if values[0] > 0 or values[-1] < 255:
        words = f"{ALPHA}, its values {values[0]} to {values[-1]}"
        if len(values) > 2 and values[-1] < DARK:
            raise ValueError(f"transparency (alpha) of at most {values[-1]} of 255; labels? {WAYS}")
        opaque = _stretched(opaque, values)
    mask = mask_with_colours(colours, opaque)
    return MaskReading(opaque, words) if mask is None else MaskReading(mask, BOTH)


def _packed(colours: np.ndarray) -> np.ndarray:
    """Return each pixel's colour as a number: 0xrrggbb behind its brightness."""
    places = np.array([1 << 16, 1 << 8, 1], np.uint32)
    number = lambda part: (
        colours[part].max(axis=-1).astype(np.uint32) << 24 | colours[part] @ places
    )
    return by_rows(number, colours.shape[:2], np.uint32)


def _check_labels(labels: np.ndarray, kind: str, is_pickable: bool) -> None:
    """Raise ValueError where there are labels; `is_pickable`: `label=N` reads one."""
    if not len(labels):
        return
    is_colour = labels.dtype == np.uint32
    listed = _listed([f"#{x & 0xFFFFFF:06x}" for x in labels] if is_colour else labels)
    hints = "save one of them as a mask; or"
    if is_colour:
        hints = "give `mask_from` alpha (--mask-from alpha) if all of them are the object; or"
    elif is_pickable:
        whole = [int(x) for x in labels if x > 0 and x == int(x)]
        hints = "".join(f"`mask_from` label={x} (--mask-from label={x}), or" for x in whole[:1])
    words = f"a label picture, it seems, with flat areas of the {kind} {listed}"
    raise ValueError(f"{words}; say which is the object: {hints} one of {WAYS}")


def _listed(values: Any) -> str:
    """Return the first of some values, between commas."""
    names = [x if isinstance(x, str) else f"{x:.9g}" for x in values[:12]]
    return ", ".join(names) + ", ..." * (len(values) > 12)


def _label(picture: Picture, number: int) -> MaskReading:
    numbers = picture.numbers
    if numbers is None:
        raise ValueError("a colour picture: labels are grey values or a palette's")
    values, counts = value_counts(numbers)
    if number not in values:
        raise ValueError(f"no pixel with the label {number}; there are {_listed(values)}")
    mask = np.where(numbers == number, np.uint8(255), np.uint8(0))
    share = counts[values == number][0] / numbers.size
    words = f"mask: label {number}, {share:.1%} of the picture, edges hard"
    void = [x for x in VOID if x in values and x != number and len(values) > 2]
    if void:
        words += f"; {void[0]}, often void, counts as background: give such pixels weight 0"
    return MaskReading(mask, words)


def _background(
    picture: Picture, back: np.ndarray, name: str, tolerance: float | None
) -> MaskReading:
    """Return a mask of pixels that differ from a colour by more than a tolerance (CIE Lab).

    Without one, Otsu's threshold parts near from far. Specks and pinholes are dropped, and the
    pixels beside an edge are taken for mixtures.
    """
    from skimage.color import rgb2lab
    from skimage.filters import threshold_otsu

    colours, centre = picture.colours, rgb2lab(back[None, None] / 255)
    off = lambda part: np.linalg.norm(rgb2lab(colours[part]) - centre, axis=-1)
    distance = by_rows(off, colours.shape[:2], np.float32)
    if np.ptp(distance) == 0:
        raise ValueError("a picture of one colour")
    step = int(np.ceil(np.sqrt(distance.size / SAMPLE)))
    limit = threshold_otsu(distance[::step, ::step]) if tolerance is None else tolerance
    inside = distance > limit
    del distance  # a large photo is as large as all else together
    drop_specks(inside, SPECK)
    share = np.count_nonzero(inside) / inside.size
    how = "Otsu's threshold" if tolerance is None else "as told"
    words = (
        f"mask: what differs from {name} by more than {limit:.1f} in CIE Lab ({how}),"
        f" {share:.1%} of the picture, soft edges from mixed colours"
    )
    return MaskReading(_with_soft_edges(inside, colours, back), words)


def _with_soft_edges(inside: np.ndarray, colours: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return a hard mask as uint8 with soft edges.

    A pixel beside the edge is a mixture of the background and the object's nearest colour. Its
    coverage is its place between both, in the values as stored.
    """
    deep, far = shrunk(inside, BAND_PX), shrunk(~inside, BAND_PX)
    places = np.argwhere(~(deep | far))
    near, _ = nearest(ring(deep, 0), places)
    mask = np.where(inside, np.uint8(255), np.uint8(0))
    if np.any(deep) and len(places):
        whole, mixed = (colours[tuple(x.T)] - back for x in (near, places))
        size = np.maximum(np.sum(whole**2, axis=-1), 1e-2)
        share = np.clip(np.sum(mixed * whole, axis=-1) / size, 0, 1)
        mask[tuple(places.T)] = np.round(255 * share)
    return mask


def _colour(name: str) -> np.ndarray:
    from PIL import ImageColor

    try:
        return np.array(ImageColor.getrgb(name)[:3])
    except ValueError:
        raise ValueError(
            f"`mask_from`: expected a colour such as white or #1e90ff, got {name!r}"
        ) from None
