"""The target image: checked at the door, and averaged down to a pyramid of coarser ones.

All levels lie in one flat array, so one compiled program reads any of them. Running sums in raster
order give the cost of any run of pixels that no contour touches in two look-ups, so a fit never
visits them.
"""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

#: How far floats may reach out of [0, 1]: noise is kept as it is, since clipping would bias a fit.
NOISE = 1.0
#: Levels that are off by more than this are taken for 0 and 1; so far (px) from a mask's edges; as
#: many pixels tell whether there are any.
LEVEL, LEVEL_PX, SAMPLED = 0.01, 3.0, 1 << 18
#: A mask that covers more than this share of its border is rather inverted. (An object that the
#: frame cuts off on all sides leaves more of it free.)
MOST_BORDER = 0.9
#: What integers of a mask of two values may be where they are not 0.
FULL = (1, 255, 65535)
#: Cells that are worked on at a time.
CACHED = 1 << 15
#: Cells of the smallest pyramid; the next sizes are 4 times as large, from `MANY_CELLS` on twice,
#: since what is empty takes memory as well: each is compiled for.
LEAST_CELLS, MANY_CELLS = 1 << 19, 1 << 23
#: Where JAX takes an array of NumPy as it is, its address is a multiple of this.
ALIGNED = 64


class Pyramid(NamedTuple):
    """The levels' pixels, rows from the film's bottom, each row with one cell before and after it.

    `empty` and `full` are running sums of the squared residual if a pixel is uncovered or covered,
    `weights` and `masses` of the weight and of weight times target.
    """

    target: Float[Array, "N"]
    weight: Float[Array, "N"]
    empty: Float[Array, "N"]
    full: Float[Array, "N"]
    weights: Float[Array, "N"]
    masses: Float[Array, "N"]


class Level(NamedTuple):
    """One level of a pyramid: where it begins, the size of its window and where on the film that
    begins (its pixels), and its pixels per film height.

    `resolved` says that pixels in which contours overlap show the union's coverage, not the clamped
    sum of the layers; a residual above `explained` is more than the mask's kind leaves. Arrays of
    NumPy: numbers of shape (), `origin` (2,).
    """

    start: Any
    W: Any
    H: Any
    origin: Any
    scale: Any
    resolved: Any
    explained: Any

    def window(self) -> "Window":
        """Return the window in the level's pixels."""
        left, bottom = (int(x) for x in self.origin)
        return Window(left, bottom, int(self.W), int(self.H))


class Window(NamedTuple):
    """A part of the film: its lower left corner and its size (px)."""

    left: int
    bottom: int
    W: int
    H: int

    def of(self, image: np.ndarray) -> np.ndarray:
        """Return the part (H, W) of an image."""
        top = image.shape[0] - self.bottom
        return image[top - self.H : top, self.left : self.left + self.W]

    def holds(self, points: Float[np.ndarray, "n 2"], W: int, H: int) -> bool:
        """Return whether all points (px) of a film of this size are inside, or beside the film."""
        x, y = points.T
        right, top = self.left + self.W, self.bottom + self.H
        return bool(
            (self.left == 0 or x.min() > self.left)
            and (self.bottom == 0 or y.min() > self.bottom)
            and (right == W or x.max() < right)
            and (top == H or y.max() < top)
        )


def shares(image: np.ndarray) -> np.ndarray:
    """Return an image that passed `check_image` as float64, 255 of uint8 being 1."""
    return image / 255.0 if image.dtype == np.uint8 else np.asarray(image, np.float64)


def check_image(name: str, image: Any, W: int, H: int) -> np.ndarray:
    """Return an image (H, W) of type bool, uint8 or float, or raise ValueError in words."""
    return _with_range(name, image, W, H)[0]


def _with_range(name: str, image: Any, W: int, H: int) -> tuple[np.ndarray, tuple[Any, Any]]:
    """Return the image, and its least and largest value: each pass over a large one counts."""
    array = np.asarray(image)
    expected = f"shape (H, W) = ({H}, {W})"
    if array.ndim != 2:
        hint = "; choose a channel or average them" if array.ndim == 3 else ""
        raise ValueError(f"`{name}`: expected {expected}, got shape {array.shape}{hint}")
    if array.shape != (H, W):
        raise ValueError(f"`{name}`: expected the camera's {expected}, got {array.shape}")
    if array.dtype.kind not in "biuf":
        raise ValueError(f"`{name}`: expected dtype bool, uint8 or float, got {array.dtype}")
    low, high = array.min(), array.max()
    if array.dtype.kind in "iu" and (array.dtype != np.uint8 or high == 1):
        array = _two_values(name, array, low, high)
        low, high = low > 0, high > 0
    if array.dtype in (bool, np.uint8):
        return array, (low, high)
    if not (np.isfinite(low) and np.isfinite(high)):
        row, column = np.argwhere(~np.isfinite(array))[0]
        raise ValueError(
            f"`{name}`: expected finite values, got {array[row, column]} at [{row}, {column}]"
        )
    if low < -NOISE or high > 1 + NOISE:
        raise ValueError(
            f"`{name}`: expected floats in [0, 1], got {low:g} to {high:g}"
            " (masks of 0..255 are to be uint8)"
        )
    return array, (low, high)


def _two_values(name: str, array: np.ndarray, low: Any, high: Any) -> np.ndarray:
    """Return integers whose only values are 0 and 1 (or 255, or 65535) as bools, or raise."""
    if low >= 0 and high in (0, *FULL) and np.all((array == 0) | (array == high)):
        return array > 0
    raise ValueError(
        f"`{name}`: expected integers that are all 0 or 1 (or 255, or 65535), or uint8, got"
        f" {array.dtype} from {low} to {high}; give `mask > 0` if what is not 0 is the object, or"
        " floats in [0, 1]"
    )


def check_target(target: Any, weight: Any, W: int, H: int) -> tuple[np.ndarray, np.ndarray]:
    """Return target (see `check_image`) and weight, float64, or raise ValueError: a mask must show
    an edge."""
    image, ends = _with_range("target", target, W, H)
    weights = check_weight(weight, W, H)
    if weight is not None:
        counted = image[weights > 0]
        if counted.size == 0:
            raise ValueError("`weight`: expected some pixels to count, got 0 everywhere")
        ends = counted.min(), counted.max()
    low, high = shares(np.array(ends))
    if high < 0.5:
        hint = "; give `target > 0` if what is not 0 is the object" if high > 0 else ""
        raise ValueError(
            "`target`: expected a mask that covers something, got an empty one"
            f" (largest value {high:.2g}){hint}"
        )
    if low > 0.5:
        raise ValueError(
            "`target`: expected a mask with some background, got one that covers every pixel"
            f" (least value {low:g})"
        )
    return image, weights


def covered_border(mask: np.ndarray) -> float:
    """Return which share of a picture's border a mask (H, W), of bools, covers."""
    border = np.concatenate([mask[0], mask[-1], mask[1:-1, 0], mask[1:-1, -1]])
    return np.count_nonzero(border) / border.size


def check_weight(weight: Any, W: int, H: int) -> np.ndarray:
    """Return weights as float64 (H, W), ones for None, or raise ValueError in words."""
    if weight is None:
        return np.broadcast_to(1.0, (H, W))
    array = np.asarray(weight)
    if array.shape != (H, W):
        raise ValueError(f"`weight`: expected shape (H, W) = ({H}, {W}), got {array.shape}")
    if array.dtype == bool or np.issubdtype(array.dtype, np.floating):
        array = array.astype(np.float64)
    else:
        raise ValueError(f"`weight`: expected dtype bool or float, got {array.dtype}")
    if not (np.all(np.isfinite(array)) and array.min() >= 0):
        raise ValueError("`weight`: expected finite values of at least 0")
    return array


def levelled(image: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the mask with 0 and 1 for what is far from its edges, in the median: a JPEG's
    background is not quite black, nor is a network's."""
    if image.dtype == bool:
        return image
    step = max(int((image.size / SAMPLED) ** 0.5), 1)
    some = shares(image[::step, ::step])
    inside = some > 0.5
    low, high = _median(some, ~inside, 0.0), _median(some, inside, 1.0)
    if max(low, 1 - high) <= LEVEL:
        return image
    values = shares(image)
    inside = values > 0.5
    far = (near_an_edge(edge_distance(values), LEVEL_PX) == 0) & (weights > 0)
    low, high = _median(values, far & ~inside, 0.0), _median(values, far & inside, 1.0)
    return (values - low) / (high - low) if max(low, 1 - high) > LEVEL else image


def _median(image: np.ndarray, where: np.ndarray, default: float) -> float:
    return float(np.median(image[where])) if np.any(where) else default


def edge_distance(image: np.ndarray) -> np.ndarray:
    """Return (H, W): px from a pixel to the nearest one beside the mask's edge (at 0.5); infinite
    outside the object's window."""
    from scipy.ndimage import distance_transform_edt

    inside = image > 0.5
    window = object_window(inside)
    inside = window.of(inside)
    far = np.ones(inside.shape, bool)
    for axis in (0, 1):
        change = np.diff(inside, axis=axis)
        for side in ((0, 1), (1, 0)):
            widths = [(0, 0), (0, 0)]
            widths[axis] = side
            far &= ~np.pad(change, widths)
    distance = np.full(image.shape, np.inf)
    window.of(distance)[:] = distance_transform_edt(far)
    return distance


def near_an_edge(distance: np.ndarray, reach_px: float) -> np.ndarray:
    """Return Tukey's biweight of `edge_distance`: 1 at 0, and 0 farther than `reach_px` away."""
    return np.clip(1 - (distance / (1 + reach_px)) ** 2, 0, 1) ** 2


def object_window(target: np.ndarray) -> Window:
    """Return a window about all that is not 0, with half as much room again on each side."""
    H, W = target.shape
    shown, spans = target != 0, []
    for axis, size in ((0, W), (1, H)):
        there = np.flatnonzero(np.any(shown, axis=axis))
        low, high = (there[0], there[-1] + 1) if there.size else (0, size)
        room = max(int(high - low) // 2, 16)
        spans.append((max(int(low) - room, 0), min(int(high) + room, size)))
    (left, right), (top, foot) = spans
    return Window(left, H - foot, right - left, foot - top)


def pyramid(
    target: np.ndarray,
    weight: np.ndarray,
    dtype: Any,
    coarsest_px: int = 16,
    window: Window | None = None,
    least: int = LEAST_CELLS,
    only_finest: bool = False,
) -> tuple[Pyramid, list[Level]]:
    """Return the levels from coarse to fine; on the coarsest the object is about `coarsest_px`.

    Only the window is looked at (and as much beside it as makes whole pixels of the coarsest
    level); None is all. There is room for `least` cells, or for the next of few sizes. Where
    `only_finest` is asked for, the last level stands alone, in the same room.
    """
    flat, levels = pyramid_of(target, weight, dtype, coarsest_px, window, least, only_finest)
    return Pyramid(*jax.device_put([*flat])), levels


def pyramid_of(
    target: np.ndarray,
    weight: np.ndarray,
    dtype: Any,
    coarsest_px: int = 16,
    window: Window | None = None,
    least: int = LEAST_CELLS,
    only_finest: bool = False,
) -> tuple[Pyramid, list[Level]]:
    """Return `pyramid`'s on the host: arrays of NumPy."""
    H, W = target.shape
    window = window or Window(0, 0, W, H)
    rows, columns = (np.flatnonzero(np.any(window.of(target) > 0.5, axis=k)) for k in (1, 0))
    extent = max(np.ptp(rows), np.ptp(columns)) + 1 if rows.size and columns.size else max(W, H)
    depth = max(int(np.floor(np.log2(extent / coarsest_px))), 0)
    whole = 2**depth
    left, bottom = (x - x % whole for x in (window.left, window.bottom))
    right = min(-(-(window.left + window.W) // whole) * whole, W)
    top = min(-(-(window.bottom + window.H) // whole) * whole, H)
    window = Window(*(int(x) for x in (left, bottom, right - left, top - bottom)))
    images, weights = [shares(window.of(target))], [shares(window.of(weight))]
    alike = weight.strides == (0, 0)
    shapes = [(-(-window.H // 2**k), -(-window.W // 2**k)) for k in range(depth + 1)]
    room = _room(sum(_cells(shape) for shape in shapes), least)
    for _ in range(0 if only_finest else depth):
        images.append(_halved(images[-1]))
        same = np.broadcast_to(weights[0][0, 0], images[-1].shape)
        weights.append(same.copy() if alike else _halved(weights[-1]))
    integer, real = (lambda x, t=t: np.asarray(x, t) for t in (np.int32, dtype))
    flat = _aligned_zeros((6, room), dtype)
    levels: list[Level] = []
    start = 0
    for level in reversed(range(len(images))):
        h, w = images[level].shape
        size = _cells((h, w))
        if h * 2**level > window.H:  # what reaches out of the window does not count
            weights[level][0] = 0
        if w * 2**level > window.W:
            weights[level][:, -1] = 0
        _raster(images[level], weights[level], flat[:, start : start + size])
        origin, scale = real([left / 2**level, bottom / 2**level]), real(H / 2**level)
        rest = np.array(level == 0), real(np.inf)
        levels.append(Level(integer(start), integer(w), integer(h), origin, scale, *rest))
        start += size
    return Pyramid(*flat), levels


def _aligned_zeros(shape: tuple[int, int], dtype: Any) -> np.ndarray:
    """Return zeros that JAX takes as they are on a CPU, without a copy: what is never written to
    then takes neither time nor memory. (100 MB of room cost 40 ms each time they were copied.)"""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    bytes_ = np.zeros(size + ALIGNED, np.uint8)
    first = -bytes_.ctypes.data % ALIGNED
    return bytes_[first : first + size].view(dtype).reshape(shape)


def _cells(shape: tuple[int, int]) -> int:
    """Return how many cells a level of (H, W) pixels takes."""
    H, W = shape
    return H * (W + 2) + 1


def _room(cells: int, least: int) -> int:
    """Return the first of few sizes, from `least` on, that holds so many cells."""
    room = least
    while room < cells:
        room *= 4 if room < MANY_CELLS else 2
    return room


def _halved(image: np.ndarray) -> np.ndarray:
    """Return means over 2 x 2 blocks from the film's bottom left; 0 is what lies outside."""
    H, W = image.shape
    if H % 2 or W % 2:
        image = np.pad(image, ((H % 2, 0), (0, W % 2)))
    rows = image[0::2] + image[1::2]
    result = rows[:, 0::2] + rows[:, 1::2]
    result /= 4
    return result


def _raster(image: np.ndarray, weight: np.ndarray, out: np.ndarray) -> None:
    """Write the six flat arrays of one level, some rows at a time: what fits into a cache."""
    H, W = image.shape
    width, sides = W + 2, ((0, 0), (1, 1))
    step = max(CACHED // width, 1)
    ends = np.zeros(4)
    for first in range(0, H, step):
        rows = slice(H - min(first + step, H), H - first)
        t, w = (np.pad(x[rows][::-1], sides).ravel() for x in (image, weight))
        begin, end = first * width, first * width + t.size
        out[0, begin:end], out[1, begin:end] = t, w
        for k, sums in enumerate(_running_sums(t, w)):
            out[2 + k, begin + 1 : end + 1] = sums + ends[k]
            ends[k] += sums[-1]


def _running_sums(t: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the running sums of w t^2, w (1 - t)^2, w and w t: most pixels of a mask are 0 or 1,
    most that are far from its edge do not count."""
    if not np.any(w):
        return w, w, w, w
    weights = np.cumsum(w)
    if not np.any(t):
        return t, weights, weights, t
    masses = np.cumsum(w * t)
    if np.all((t == 0) | (t == 1)):
        return masses, weights - masses, weights, masses
    return np.cumsum(w * t**2), np.cumsum(w * (1 - t) ** 2), weights, masses


def level_slice(pyramid: Pyramid, level: Level, cell: Int[Array, "*P"]) -> Pyramid:
    """Return the pyramid's entries at a level's cells."""
    return jax.tree.map(lambda x: x[level.start + cell], pyramid)
