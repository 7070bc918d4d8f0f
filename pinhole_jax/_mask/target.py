"""The target image: checked at the door, its levels, its window and how far its edge is."""

from os import PathLike
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .._numerics.arrays import array_of

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


class Window(NamedTuple):
    """A part of the film: its lower left corner and its size (px)."""

    left: int
    bottom: int
    W: int
    H: int

    @classmethod
    def about(cls, shown: np.ndarray, room: int, share: float = 0.0) -> "Window":
        """A window about what an image, of bools, shows, with this much room (px), or a share of
        its extent, on each side; all of the image where it shows nothing."""
        (H, W), spans = shown.shape, []
        for axis, size in enumerate((W, H)):
            there = np.flatnonzero(np.any(shown, axis=axis))
            low, high = (int(there[0]), int(there[-1]) + 1) if there.size else (0, size)
            more = max(int(share * (high - low)), room)
            spans.append((max(low - more, 0), min(high + more, size)))
        (left, right), (top, foot) = spans
        return cls(left, H - foot, right - left, foot - top)

    def crop(self, image: np.ndarray) -> np.ndarray:
        """The part (H, W) of an image."""
        top = image.shape[0] - self.bottom
        return image[top - self.H : top, self.left : self.left + self.W]

    def holds(self, points: Float[np.ndarray, "n 2"], W: int, H: int) -> bool:
        """True if all points (px) of a film of this size are inside, or off the film."""
        low, size = np.array(self).reshape(2, 2)
        high = low + size
        inside = ((low == 0) | (points > low)) & ((high == (W, H)) | (points < high))
        return bool(np.all(inside))


def as_coverage(image: np.ndarray) -> np.ndarray:
    """Return an image that passed `check_image` as float64, 255 of uint8 being 1."""
    return image / 255.0 if image.dtype == np.uint8 else np.asarray(image, np.float64)


def check_image(name: str, image: Any, *size: int) -> np.ndarray:
    """Return an image (H, W) of type bool, uint8 or float, of this `size` (W, H) if it is given; or
    raise ValueError."""
    return _with_range(name, image, *size)[0]


def as_image(name: str, image: Any, *size: int) -> Any:
    """Return an array (H, W), of this size (W, H) if it is given, or raise ValueError."""
    expected = f"the camera's shape (H, W) = {size[::-1]}" if size else "shape (H, W)"
    if isinstance(image, str | PathLike):
        expected += " (`pj.io.load_mask` reads files)"
    array = array_of(name, image, expected)
    if array.ndim != 2 or array.shape != (size[::-1] or array.shape):
        hint = "; choose a channel or average them" if array.ndim == 3 else ""
        raise ValueError(f"`{name}`: expected {expected}, got shape {array.shape}{hint}")
    return array


def _with_range(name: str, image: Any, *size: int) -> tuple[np.ndarray, tuple[Any, Any]]:
    """Return the checked image with its least and largest value, which callers need, too."""
    array = np.asarray(as_image(name, image, *size))
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
            " (convert masks of 0..255 to uint8)"
        )
    return array, (low, high)


def _two_values(name: str, array: np.ndarray, low: Any, high: Any) -> np.ndarray:
    """Return integers whose only values are 0 and 1 (or 255, or 65535) as bools, or raise."""
    if low >= 0 and high in (0, *FULL) and np.all((array == 0) | (array == high)):
        return array > 0
    raise ValueError(
        f"`{name}`: expected integers that are all 0 or 1 (or 255, or 65535), or uint8, got"
        f" {array.dtype} from {low} to {high}; give `mask > 0` if all but 0 is the object, or"
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
    low, high = as_coverage(np.array(ends))
    if high < 0.5:
        hint = "; give `target > 0` if all but 0 is the object" if high > 0 else ""
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


def inside_of(image: np.ndarray) -> np.ndarray:
    """Return which pixels of an image that passed `check_image` are more than half covered."""
    if image.dtype == bool:
        return image
    return image > (127 if image.dtype == np.uint8 else 0.5)


def border_of(image: np.ndarray) -> np.ndarray:
    """Return the pixels of a picture's border."""
    return np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])


def check_weight(weight: Any, W: int, H: int) -> np.ndarray:
    """Return weights as float64 (H, W), ones for None, or raise ValueError."""
    if weight is None:
        return np.broadcast_to(1.0, (H, W))
    array = np.asarray(as_image("weight", weight, W, H))
    if array.dtype.kind not in "bf":
        raise ValueError(f"`weight`: expected dtype bool or float, got {array.dtype}")
    array = array.astype(np.float64)
    if not (np.all(np.isfinite(array)) and array.min() >= 0):
        raise ValueError("`weight`: expected finite values of at least 0")
    return array


def levelled(image: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the mask with 0 and 1 for what is far from its edges, in the median: a JPEG's
    background is not quite black, nor is a network's."""
    if image.dtype == bool:
        return image
    step = max(int((image.size / SAMPLED) ** 0.5), 1)
    low, high = _levels(as_coverage(image[::step, ::step]), True)
    if max(low, 1 - high) <= LEVEL:
        return image
    values = as_coverage(image)
    far = edge_distance(values) >= 1 + LEVEL_PX
    low, high = _levels(values, far & (weights > 0))
    return (values - low) / (high - low) if max(low, 1 - high) > LEVEL else image


def _levels(image: np.ndarray, where: np.ndarray | bool) -> tuple[float, float]:
    """Return the medians of pixels that are less, and more, than half covered; 0 and 1 where there
    are none."""
    inside = image > 0.5
    less, more = image[where & ~inside], image[where & inside]
    return float(np.median(less)) if less.size else 0.0, float(
        np.median(more)
    ) if more.size else 1.0


def beside(inside: np.ndarray) -> np.ndarray:
    """Return the places in the flat image (H, W), of bools, of pixels that a neighbour differs
    from, ascending."""
    W = inside.shape[1]
    down = np.flatnonzero(inside[1:] != inside[:-1])
    row, column = np.divmod(np.flatnonzero(inside[:, 1:] != inside[:, :-1]), max(W - 1, 1))
    right = row * W + column
    return np.unique(np.concatenate([down, down + W, right, right + 1]))


def edge_distance(image: np.ndarray) -> np.ndarray:
    """Return (H, W): px from a pixel to the nearest one beside the mask's edge (at 0.5); infinite
    outside the object's window."""
    from scipy.ndimage import distance_transform_edt

    inside = inside_of(image)
    window = object_window(inside)
    inside = window.crop(inside)
    far = np.ones(inside.shape, bool)
    far.flat[beside(inside)] = False
    distance = np.full(image.shape, np.inf)
    window.crop(distance)[:] = distance_transform_edt(far)
    return distance


def object_window(target: np.ndarray) -> Window:
    """Return a window about all that is not 0, with half as much room again on each side."""
    return Window.about(target != 0, 16, 0.5)
