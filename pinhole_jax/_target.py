"""The target image: checked at the door, and averaged down to a pyramid of coarser ones.

All levels lie in one flat array, so one compiled program reads any of them. Running sums in raster
order give the cost of any run of pixels that no contour touches in two look-ups, so a fit never
visits them.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

#: How far floats may reach out of [0, 1]: noise is kept as it is, since clipping would bias a fit.
NOISE = 1.0


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
    """One level of a pyramid: where it begins, its size, and its pixels per film height.

    `strict` says that pixels in which contours overlap are left out, not clamped.
    """

    start: Int[Array, ""]
    W: Int[Array, ""]
    H: Int[Array, ""]
    scale: Float[Array, ""]
    strict: Bool[Array, ""]


def check_image(name: str, image: Any, W: int, H: int) -> np.ndarray:
    """Return an image as float64 (H, W) in [0, 1], or raise ValueError in words."""
    array = np.asarray(image)
    expected = f"shape (H, W) = ({H}, {W})"
    if array.ndim != 2:
        hint = "; choose a channel or average them" if array.ndim == 3 else ""
        raise ValueError(f"`{name}`: expected {expected}, got shape {array.shape}{hint}")
    if array.shape != (H, W):
        raise ValueError(f"`{name}`: expected the camera's {expected}, got {array.shape}")
    if array.dtype == bool:
        return array.astype(np.float64)
    if array.dtype == np.uint8:
        return array / 255.0
    if not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"`{name}`: expected dtype bool, uint8 or float, got {array.dtype}")
    array = array.astype(np.float64)
    if not np.all(np.isfinite(array)):
        row, column = np.argwhere(~np.isfinite(array))[0]
        raise ValueError(
            f"`{name}`: expected finite values, got {array[row, column]} at [{row}, {column}]"
        )
    if array.min() < -NOISE or array.max() > 1 + NOISE:
        raise ValueError(
            f"`{name}`: expected floats in [0, 1], got {array.min():g} to {array.max():g}"
            " (masks of 0..255 are to be uint8)"
        )
    return array


def check_target(target: Any, weight: Any, W: int, H: int) -> tuple[np.ndarray, np.ndarray]:
    """Return target and weight as float64 (H, W), or raise ValueError: a mask must show an edge."""
    image = check_image("target", target, W, H)
    weights = check_weight(weight, W, H)
    counted = image[weights > 0]
    if counted.size == 0:
        raise ValueError("`weight`: expected some pixels to count, got 0 everywhere")
    if counted.max() < 0.5:
        raise ValueError(
            "`target`: expected a mask that covers something, got an empty one"
            f" (largest value {counted.max():g})"
        )
    if counted.min() > 0.5:
        raise ValueError(
            "`target`: expected a mask with some background, got one that covers every pixel"
            f" (least value {counted.min():g})"
        )
    return image, weights


def check_weight(weight: Any, W: int, H: int) -> np.ndarray:
    """Return weights as float64 (H, W), ones for None, or raise ValueError in words."""
    if weight is None:
        return np.ones((H, W))
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


def edge_distance(image: np.ndarray) -> np.ndarray:
    """Return (H, W): px from a pixel to the nearest one beside the mask's edge (at 0.5)."""
    from scipy.ndimage import distance_transform_edt

    inside = image > 0.5
    far = np.ones(inside.shape, bool)
    for axis in (0, 1):
        change = np.diff(inside, axis=axis)
        for side in ((0, 1), (1, 0)):
            widths = [(0, 0), (0, 0)]
            widths[axis] = side
            far &= ~np.pad(change, widths)
    distance: Any = distance_transform_edt(far)
    return distance


def near_an_edge(distance: np.ndarray, reach_px: float) -> np.ndarray:
    """Return Tukey's biweight of `edge_distance`: 1 at 0, and 0 farther than `reach_px` away."""
    return np.clip(1 - (distance / (1 + reach_px)) ** 2, 0, 1) ** 2


def pyramid(
    target: np.ndarray, weight: np.ndarray, dtype: Any, coarsest_px: int = 16
) -> tuple[Pyramid, list[Level]]:
    """Return the levels from coarse to fine; on the coarsest the object is about `coarsest_px`."""
    H, W = target.shape
    rows, columns = (np.flatnonzero(np.any(target > 0.5, axis=k)) for k in (1, 0))
    extent = max(np.ptp(rows), np.ptp(columns)) + 1 if rows.size and columns.size else max(W, H)
    depth = max(int(np.floor(np.log2(extent / coarsest_px))), 0)
    parts: list[np.ndarray] = []
    levels: list[Level] = []
    start = 0
    for level in range(depth, -1, -1):
        image, weights = _halved(target, weight, 2**level)
        part = _raster(image, weights)
        parts.append(part)
        h, w = image.shape
        scale = jnp.asarray(H / 2**level, dtype)
        levels.append(Level(jnp.int32(start), jnp.int32(w), jnp.int32(h), scale, jnp.bool_(False)))
        start += part.shape[1]
    # A few sizes for all images, so that they share compiled programs.
    room = 1 << (start - 1).bit_length()
    flat = np.concatenate([*parts, np.zeros((6, room - start))], axis=1)
    return Pyramid(*(jnp.asarray(x, dtype) for x in flat)), levels


def _halved(target: np.ndarray, weight: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return means over n x n blocks from the film's bottom left; those cut short weigh nothing."""
    H, W = target.shape
    pad = ((-H % n, 0), (0, -W % n))
    blocks = [
        np.pad(x, pad).reshape((H + pad[0][0]) // n, n, -1, n).mean(axis=(1, 3))
        for x in (target, weight, np.ones_like(target))
    ]
    image, weights, inside = blocks
    return image, np.where(inside > 1 - 1e-9, weights, 0)


def _raster(image: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the six flat arrays of one level."""
    sides = ((0, 0), (1, 1))
    target, weight = (np.pad(x[::-1], sides).ravel() for x in (image, weight))
    costs = [weight * target**2, weight * (1 - target) ** 2, weight, weight * target]
    sums = [np.concatenate([[0], np.cumsum(c)]) for c in costs]
    return np.stack([np.append(target, 0), np.append(weight, 0), *sums])


def level_slice(pyramid: Pyramid, level: Level, cell: Int[Array, "P"]) -> Pyramid:
    """Return the pyramid's entries at a level's cells."""
    return jax.tree.map(lambda x: x[level.start + cell], pyramid)
