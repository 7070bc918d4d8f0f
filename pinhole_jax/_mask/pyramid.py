"""The target averaged down to a pyramid of coarser images, as a compiled program reads them.

All levels lie one after the other in one raster, so one program reads any of them. Running sums in
raster order give the cost of any run of pixels that no contour touches in two look-ups, so a fit
never visits them.

The raster is kept by pages of some pixels. Nearly all pages of a mask are 0 or 1 throughout: these
are the same few, so what is worked out and kept grows like the outline, not like the pixels.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from .edges import SparseImage, Weights, alike, within
from .target import Window, as_coverage, inside_of

#: Cells of a page (two to this many).
BITS = 6
PAGE = 1 << BITS
#: Cells of the smallest pyramid; the next sizes are 4 times as large, from `MANY_CELLS` on twice,
#: since what is empty takes memory as well: each is compiled for.
LEAST_CELLS, MANY_CELLS = 1 << 19, 1 << 23
#: There is room for pages of their own for one cell in this many, and for `LEAST_CELLS`; where
#: these are not enough, for all.
ONE_IN = 8
#: Where JAX takes an array of NumPy as it is, its address is a multiple of this.
ALIGNED = 64
#: The first pages: without weight, uncovered, and covered.
NOTHING, EMPTY, FULL = range(3)


class Pyramid(NamedTuple):
    """The levels' cells, a page at a time (see `cells_of`).

    `page` says which page each stretch of the raster is. `cells` are those of all pages: the
    target (only where there is a weight) and the weight, then what is summed up before the cell: of
    the squared residual if a pixel is uncovered or covered, of the weight, and of weight times
    target. `sums` is to be added to these four where stretches share a page.
    """

    page: Int[Array, "Q"]
    sums: Float[Array, "4 Q"]
    cells: Float[Array, "6 N"]


class Level(NamedTuple):
    """One level of a pyramid: where it begins, the size of its window and where on the film that
    begins (its pixels), and its pixels per film height.

    Rows from the window's bottom, each row with one cell before and after it. A residual above
    `explained` is more than the mask's kind leaves. Arrays of NumPy: numbers of shape (), `origin`
    (2,).
    """

    start: Any
    W: Any
    H: Any
    origin: Any
    scale: Any
    explained: Any

    def window(self) -> Window:
        """Return the window in the level's pixels."""
        return Window(*map(int, (*np.asarray(self.origin), self.W, self.H)))


def cells_of(pyramid: Pyramid, at: Int[Array, "*P"]) -> tuple[Float[Array, "*P"], ...]:
    """Target and weight at some cells of the raster."""
    here = (pyramid.page[at >> BITS] << BITS) + (at & (PAGE - 1))
    return pyramid.cells[0][here], pyramid.cells[1][here]


def pyramid(
    target: np.ndarray,
    weight: Weights,
    dtype: Any,
    coarsest_px: int = 16,
    window: Window | None = None,
    least: int = LEAST_CELLS,
    only_finest: bool = False,
) -> tuple[Pyramid, list[Level]]:
    """Return the levels from coarse to fine; on the coarsest the object is about `coarsest_px`.

    Only the window is looked at (and as much beside it as makes whole pixels of the coarsest
    level); None is all. Coarse pixels that reach out of the picture are left out. There is room for
    `least` cells, or for the next of few sizes. Where `only_finest` is asked for, the last level
    stands alone, in the same room. Arrays of NumPy.
    """
    H, W = target.shape
    window = window or Window(0, 0, W, H)
    extent = max(Window.about(inside_of(window.crop(target)), 0)[2:])
    depth = max(int(np.floor(np.log2(min(extent / coarsest_px, window.W, window.H)))), 0)
    whole = 2**depth
    low, size = np.array(window).reshape(2, 2)
    high = np.minimum(-(-(low + size) // whole) * whole, (W, H))
    low -= low % whole
    window = Window(*np.append(low, high - low).tolist())
    shapes = [(window.H >> k, window.W >> k) for k in range(depth + 1)]
    room = _room(sum(map(_cells, shapes)), least)

    number = 1 if only_finest else depth + 1
    images = _halvings(_Image.from_array(window.crop(target)), number)
    weights, most = _weights_of_levels(within(weight, window), number)
    integer, real = (lambda x, t=t: np.asarray(x, t) for t in (np.int32, dtype))
    rasters, levels, start = [], [], 0
    for k in reversed(range(number)):
        h, w = shapes[k]
        rasters.append(_Raster.from_image(images[k], weights[k]))
        place = integer(start), integer(w), integer(h)
        levels.append(Level(*place, real(low / 2**k), real(H / 2**k), real(np.inf)))
        start += _cells((h, w))
    joined = _Raster(*map(np.concatenate, zip(*rasters, strict=True)))
    return _written(joined, most, room, min(least, LEAST_CELLS), dtype), levels


class _Image(NamedTuple):
    """An image, and which of its values stands for 1: sums of integers stay integers."""

    values: np.ndarray
    one: float

    @classmethod
    def from_array(cls, image: np.ndarray) -> "_Image":
        """The image as bytes if it has bits or bytes, else as floats."""
        if image.dtype == bool:
            return cls(image.view(np.uint8), 1)
        return cls(image, 255) if image.dtype == np.uint8 else cls(as_coverage(image), 1)

    def halved(self) -> "_Image":
        """The sums of 2 x 2 blocks from the film's bottom left, as far as these are whole."""
        image, one = self.values, 4 * self.one
        H, W = (n - n % 2 for n in image.shape)
        image = image[len(image) - H :, :W]
        type_ = np.min_scalar_type(one) if image.dtype.kind == "u" else image.dtype
        rows = np.add(image[0::2], image[1::2], dtype=type_)
        return _Image(rows[:, 0::2] + rows[:, 1::2], one)


def _halvings(image: _Image, number: int) -> list[_Image]:
    """This many images: one, and it halved once, twice and so on."""
    images = [image]
    while len(images) < number:
        images.append(images[-1].halved())
    return images


def _weights_of_levels(
    weight: Weights, number: int
) -> tuple[Sequence[_Image | SparseImage], float]:
    """The weights of this many levels, as shares of the largest, and that."""
    if isinstance(weight, SparseImage):
        if number == 1:
            return [weight], 1.0
        weight = weight.image()
    if alike(weight):
        H, W = weight.shape
        ones = [_Image(np.ones((H >> k, W >> k), np.uint8), 1) for k in range(number)]
        return ones, float(weight.flat[0])
    most = float(weight.max())
    return _halvings(_Image(as_coverage(weight), most or 1.0), number), most


class _Raster(NamedTuple):
    """Levels' pages: which of the first few each is, -1 for those of its own, and the target and
    weight (number, PAGE) of these."""

    page: np.ndarray
    target: np.ndarray
    weight: np.ndarray

    @classmethod
    def from_image(cls, image: _Image, weight: _Image | SparseImage) -> "_Raster":
        """The pages of an image and its weights."""
        shown, empty, full = _pages(image)
        if isinstance(weight, SparseImage):
            (weights, none), whole, one = _near_pages(weight), False, 1.0
        else:
            (weights, none, whole), one = _pages(weight), weight.one
        page = np.where(full, FULL, np.where(empty, EMPTY, -1))
        page = np.where(none, NOTHING, np.where(whole, page, -1))
        own = page < 0
        return cls(page, shown[own] / image.one, weights[own] / one)


def _pages(image: _Image) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An image's raster (number, PAGE), from the bottom, a cell before and after a row; which pages
    are 0, and which 1, in all their cells."""
    values, (H, W) = image.values, image.values.shape
    flat = np.zeros(_cells((H, W)), values.dtype)
    flat[: H * (W + 2)].reshape(H, W + 2)[:, 1:-1] = values[::-1]
    pages = flat.reshape(-1, PAGE)
    first = pages[:, 0]
    even = np.all(pages == pages[:, :1], axis=1)
    return pages, even & (first == 0), even & (first == image.one)


def _near_pages(weight: SparseImage) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights (number, PAGE), and which pages have none."""
    (H, W), (row, column) = weight.shape, weight.rows_columns
    cell = (H - 1 - row) * (W + 2) + column + 1
    flat = np.zeros(_cells(weight.shape))  # (what is not written to takes no time)
    flat[cell] = weight.value
    none = np.ones(len(flat) // PAGE, bool)
    none[cell // PAGE] = False
    return flat.reshape(-1, PAGE), none


def _written(raster: _Raster, most: float, room: int, least: int, dtype: Any) -> Pyramid:
    """The pages of all levels with their running sums, in memory that JAX takes without a copy.

    Pages that are all object or all background are shared. The others have room for `least` cells
    or more, in one of few sizes.
    """
    own, used = np.flatnonzero(raster.page < 0), len(raster.page)
    number = 3 + len(own)
    size = max(room // ONE_IN, least) + 4 * PAGE  # (the first few come on top)
    size = size if number * PAGE <= size else room + 4 * PAGE
    flat, page = _aligned_zeros((6, size), dtype), _aligned_zeros((room // PAGE,), np.int32)
    sums = _aligned_zeros((4, len(page)), dtype)
    page[:used] = raster.page
    page[own] = 3 + np.arange(len(own))

    first = np.repeat([[0.0, 0, 1], [0, 1, 1]], PAGE, axis=1).reshape(2, 3, PAGE)
    target = np.concatenate([first[0], raster.target])
    weight = most * np.concatenate([first[1], raster.weight])
    cells = flat.reshape(6, -1, PAGE)[:, :number]
    cells[0], cells[1] = target, weight
    for k, summed in enumerate(_summed(target, weight)):
        inside = np.cumsum(np.pad(summed, ((0, 0), (1, 0))), axis=1)
        before = np.cumsum(np.append(0, inside[page[:used], -1]))[:-1]
        # Pages of their own hold what is summed up before each cell, rounded once: where nothing
        # comes to it, it stays the same number, and a difference is 0.
        inside[3:] += before[own, None]
        before[own] = 0
        cells[2 + k], sums[k, :used] = inside[:, :-1], before
    host: Any = page, sums, flat
    return Pyramid(*host)


def _summed(t: np.ndarray, w: np.ndarray) -> Iterator[np.ndarray]:
    """What is summed up of targets and weights: the squared residuals, the weights, the masses."""
    yield w * t**2
    yield w * (1 - t) ** 2
    yield w
    yield w * t


def _aligned_zeros(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Return zeros that JAX takes as they are on a CPU, without a copy: what is never written to
    then takes neither time nor memory. (100 MB of room cost 40 ms each time they were copied.)"""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    bytes_ = np.zeros(size + ALIGNED, np.uint8)
    first = -bytes_.ctypes.data % ALIGNED
    return bytes_[first : first + size].view(dtype).reshape(shape)


def _cells(shape: tuple[int, ...]) -> int:
    """The number of cells in the pages of a level of (H, W) pixels, the one past its end among
    them."""
    H, W = shape
    return -(-(H * (W + 2) + 1) // PAGE) * PAGE


def _room(cells: int, least: int) -> int:
    """Return the first of few sizes, from `least` on, that holds this many cells."""
    room = least
    while room < cells:
        room *= 4 if room < MANY_CELLS else 2
    return room
