"""The target averaged down to a pyramid of coarser images, as a compiled program reads them.

All levels lie one after the other in one raster, so one program reads any of them. Running sums in
raster order give the cost of any run of pixels that no contour touches in two look-ups, so a fit
never visits them.

The raster is kept by pages of some pixels. Nearly all pages of a mask are 0 or 1 throughout: these
are the same few, so what is worked out and kept grows like the outline, not like the pixels.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from .edges import SparseImage, Weights, alike, within
from .target import Window, as_coverage, extent_of

#: Cells of a page (two to this many); pages that are worked on at a time.
BITS, CACHED = 6, 1 << 12
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
BYTES = np.uint64(0x0101010101010101)


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

    @property
    def room(self) -> int:
        """How many cells there is room for."""
        return self.page.size * PAGE


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
        left, bottom = (int(x) for x in np.asarray(self.origin))
        return Window(left, bottom, int(self.W), int(self.H))


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
    level); None is all. There is room for `least` cells, or for the next of few sizes. Where
    `only_finest` is asked for, the last level stands alone, in the same room. Arrays of NumPy.
    """
    H, W = target.shape
    window = window or Window(0, 0, W, H)
    depth = max(int(np.floor(np.log2(extent_of(window.crop(target)) / coarsest_px))), 0)
    whole = 2**depth
    left, bottom = (x - x % whole for x in (window.left, window.bottom))
    right = min(-(-(window.left + window.W) // whole) * whole, W)
    top = min(-(-(window.bottom + window.H) // whole) * whole, H)
    window = Window(*(int(x) for x in (left, bottom, right - left, top - bottom)))
    shapes = [(-(-window.H // 2**k), -(-window.W // 2**k)) for k in range(depth + 1)]
    room = _room(sum(_cells(shape) for shape in shapes), least)

    images = _halvings(_Image.from_array(window.crop(target)), 0 if only_finest else depth)
    some = within(weight, window)
    weights = _weights_of_levels(some, len(images))
    most = (
        1.0 if isinstance(some, SparseImage) else float(some.flat[0] if alike(some) else some.max())
    )
    integer, real = (lambda x, t=t: np.asarray(x, t) for t in (np.int32, dtype))
    rasters, levels, start = [], [], 0
    for level in reversed(range(len(images))):
        h, w = shapes[level]
        # What reaches out of the window does not count.
        beyond = h * 2**level > window.H, w * 2**level > window.W
        rasters.append(_Raster.from_image(images[level], weights[level], most, beyond))
        origin, scale = real([left / 2**level, bottom / 2**level]), real(H / 2**level)
        place = integer(start), integer(w), integer(h)
        levels.append(Level(*place, origin, scale, real(np.inf)))
        start += _cells((h, w))
    return _written(rasters, most, room, min(least, LEAST_CELLS), dtype), levels


class _Image(NamedTuple):
    """An image whose largest value stands for 1: sums of integers stay integers."""

    values: np.ndarray
    one: float

    @classmethod
    def from_array(cls, image: np.ndarray) -> "_Image":
        """The image as bytes if it has bits or bytes, else as floats, and the value of 1 in it."""
        if image.dtype == bool:
            return cls(image.view(np.uint8), 1.0)
        if image.dtype == np.uint8:
            return cls(image, 255.0)
        return cls(as_coverage(image), 1.0)

    def halved(self) -> "_Image":
        """Return means over 2 x 2 blocks from the film's bottom left; 0 is what lies outside."""
        image, (H, W) = self.values, self.values.shape
        if H % 2 or W % 2:
            image = np.pad(image, ((H % 2, 0), (0, W % 2)))
        exact = image.dtype.kind == "u" and 4 * self.one < 2**32
        type_ = (np.uint16 if 4 * self.one < 2**16 else np.uint32) if exact else np.float64
        rows = np.add(image[0::2], image[1::2], dtype=type_)
        sums = rows[:, 0::2] + rows[:, 1::2]
        return _Image(sums, 4 * self.one) if exact else _Image(sums / (4 * self.one), 1.0)


def _halvings(image: _Image, times: int) -> list[_Image]:
    """Return an image, and it halved once, twice and so on."""
    images = [image]
    for _ in range(times):
        images.append(images[-1].halved())
    return images


def _weights_of_levels(weight: Weights, number: int) -> list[Weights]:
    """Return the weights of this many levels, each halved."""
    if alike(weight) or number == 1:
        return [weight] * number
    whole = weight.image() if isinstance(weight, SparseImage) else weight
    return [x.values for x in _halvings(_Image(as_coverage(whole), 1.0), number - 1)]


class _Raster(NamedTuple):
    """A level's pages: which of the first few each is, -1 for those of its own, and the target and
    weight (number, PAGE) of these."""

    page: np.ndarray
    target: np.ndarray
    weight: np.ndarray

    @classmethod
    def from_image(
        cls, image: _Image, weight: Weights, most: float, beyond: tuple[bool, bool]
    ) -> "_Raster":
        """The pages of an image; the top row or last column is perhaps `beyond` the window."""
        shown, one = _pages(image.values), 1.0
        zero, full = _throughout(shown, image.one)
        page = np.where(full, FULL, np.where(zero, EMPTY, -1))
        if isinstance(weight, SparseImage):
            (weights, none), full = _near_pages(weight), False
        elif alike(weight):
            weights = _pages(_without(np.ones(image.values.shape, np.uint8), beyond))
            none, full = _throughout(weights, 1.0)
            one = most
        else:
            weights = _pages(_without(weight, beyond))
            none, full = _throughout(weights, most)
        page = np.where(none, NOTHING, np.where(full, page, -1))
        own = np.flatnonzero(page == -1)
        return cls(page, shown[own] / image.one, weights[own] * one)


def _pages(image: np.ndarray) -> np.ndarray:
    """Return an image's raster (number, PAGE), from the bottom, a cell before and after a row."""
    H, W = image.shape
    flat = np.zeros(_cells((H, W)), image.dtype)
    flat[: H * (W + 2)].reshape(H, W + 2)[:, 1:-1] = image[::-1]
    return flat.reshape(-1, PAGE)


def _throughout(pages: np.ndarray, one: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which pages are 0, and which are `one`, in all their cells."""
    if pages.dtype == np.uint8:
        words = pages.view(np.uint64)
        whole = np.uint64(one) * BYTES
        low, high = np.bitwise_and.reduce(words, axis=1), np.bitwise_or.reduce(words, axis=1)
        return high == 0, (low == whole) & (high == whole)
    low, high = pages.min(axis=1), pages.max(axis=1)
    return (low == 0) & (high == 0), (low == one) & (high == one)


def _without(weight: np.ndarray, beyond: tuple[bool, bool]) -> np.ndarray:
    """Return weights without the top row or last column."""
    if any(beyond):
        weight = weight.copy()
        weight[: int(beyond[0])] = 0
        weight[:, weight.shape[1] - int(beyond[1]) :] = 0
    return weight


def _near_pages(weight: SparseImage) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights (number, PAGE), and which pages have none."""
    (H, W), (row, column) = weight.shape, weight.rows_columns
    cell = (H - 1 - row) * (W + 2) + column + 1
    flat = np.zeros(_cells(weight.shape))  # (what is not written to takes no time)
    flat[cell] = weight.value
    none = np.ones(len(flat) // PAGE, bool)
    none[cell // PAGE] = False
    return flat.reshape(-1, PAGE), none


def _written(rasters: list[_Raster], most: float, room: int, least: int, dtype: Any) -> Pyramid:
    """The pages of levels with their running sums, in memory that JAX takes without a copy.

    Pages that are all object or all background are shared. The others have room for `least` cells
    or more, in one of few sizes.
    """
    own = 3 + sum(len(raster.target) for raster in rasters)
    size = max(room // ONE_IN, least) + 4 * PAGE  # (the first few come on top)
    size = size if own * PAGE <= size else room + 4 * PAGE
    flat = _aligned_zeros((6, size), dtype)
    cells = flat.reshape(6, -1, PAGE)
    shared = np.zeros((3, PAGE)), np.full((3, PAGE), most)
    shared[0][FULL], shared[1][NOTHING] = 1, 0
    cells[:2, :3], inside = shared, _sums(*shared)
    cells[2:, :3, 1:] = inside[..., :-1]

    page = _aligned_zeros((room // PAGE,), np.int32)
    sums = _aligned_zeros((4, room // PAGE), dtype)
    begin, number = 0, 3
    for raster in rasters:
        ends, done = np.zeros((4, 1)), 0
        for first in range(0, len(raster.page), CACHED):
            which = raster.page[first : first + CACHED]
            mine = np.flatnonzero(which < 0)
            some = slice(done, done + len(mine))
            of_mine = _sums(raster.target[some], raster.weight[some])
            totals = inside[:, which, -1]
            totals[:, mine] = of_mine[..., -1]
            before = np.cumsum(np.concatenate([ends, totals], axis=1), axis=1)
            # Pages of their own hold what is summed up before each cell, rounded once: where
            # nothing comes to it, it stays the same number, and a difference is 0.
            at = slice(number, number + len(mine))
            cells[0, at], cells[1, at] = raster.target[some], raster.weight[some]
            base = before[:, mine, None]
            cells[2:, at, :1] = base
            cells[2:, at, 1:] = base + of_mine[..., :-1]
            before[:, mine] = 0
            stretch = slice(begin + first, begin + first + len(which))
            page[stretch], sums[:, stretch] = which, before[:, :-1]
            page[begin + first + mine] = number + np.arange(len(mine))
            ends, done, number = before[:, -1:], done + len(mine), number + len(mine)
        begin += len(raster.page)
    host: Any = page, sums, flat
    return Pyramid(*host)


def _sums(t: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Running sums over pages (n, PAGE), cell by cell: the squared residuals, the
    weights and the masses, (4, n, PAGE)."""
    return np.cumsum(np.stack([w * t**2, w * (1 - t) ** 2, w, w * t]), axis=2)


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
