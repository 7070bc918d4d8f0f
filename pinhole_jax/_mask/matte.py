"""What share of each pixel is the object's, by the colours on the two sides of its outline.

Region-based trackers (RBOT, SRT3D) learn colours beside the outline, here and there along it, and
ask of each pixel near it which side it belongs to. Here colours are light that mixes: a pixel
that the object covers by the share c shows c F + (1 - c) B, if F and B are the colours beside it.
With normal noise the share that a colour tells is then linear in it, and its variance is one over
the squared contrast of F and B in standard deviations: just what a least-squares fit of the exact
coverage asks for, a target and a weight.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

#: Statistics are local: of tiles of this many px, blurred by this many tiles.
#: (Synthetic photos of experiments/real.py: tiles of 12 and 18 px err 1.2 and 1.4 times as much.)
TILE_PX, BLURRED = 8, 0.7
#: What is seen all along the outline counts as much as this many pixels of a tile.
PIXELS_OF_ALL = 3.0
#: Light is uncertain by this much, of 1, however even a colour is: noise, JPEG, shading.
#: (0.012 to 0.03 were equally good.)
LEAST_SPREAD = 0.02
#: Blur spreads an edge over some px: differences of a share from a half count this much more. That
#: moves no edge, and Gauss-Newton steps are no longer three times too short.
SHARPER = 2.0
#: A share errs by this much, however clear the colours are. (0.05 to 0.3 were equally good.)
LEAST_ERROR = 0.15


class Band(NamedTuple):
    """How far from the outline, in px, colours are learned (from `gap` to `depth`) and asked for
    (up to `reach`)."""

    gap: float
    depth: float
    reach: float


class Matte(NamedTuple):
    """The share of each pixel (h, w) that is the object's, from 0 to 1, and the weights of these:
    in [0, 1], 0 where nothing was asked or colours do not tell."""

    share: Float[np.ndarray, "h w"]
    weight: Float[np.ndarray, "h w"]


def light(photo: Shaped[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Return the light of a photo's sRGB colours (uint8, or floats in [0, 1]): in [0, 1], float32.

    The inverse of sRGB's transfer function (IEC 61966-2-1). Colours mix as light does: in sRGB's
    own values edges err by 0.1 to 0.3 px, to the dark side.
    """
    value = np.arange(256) / 255 if photo.dtype == np.uint8 else np.clip(photo, 0, 1)
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    linear = linear.astype(np.float32)
    return linear[photo] if photo.dtype == np.uint8 else linear


def matte(
    colours: Float[np.ndarray, "h w 3"],
    distance: Float[np.ndarray, "h w"],
    band: Band,
    counts: Bool[np.ndarray, "h w"],
) -> Matte:
    """Return the matte near an outline, from `distance`s (px) to it, positive inside.

    Colours are learned where a pixel `counts`.
    """
    front = counts & (distance > band.gap) & (distance < band.depth)
    back = counts & (distance < -band.gap) & (distance > -band.depth)
    axis, start, contrast = _discriminant(colours, front, back)
    rows, columns = np.nonzero(np.abs(distance) < band.reach)
    here = lambda x: _at_pixels(x, rows, columns)
    squared = np.maximum(here(contrast), 1e-6)
    along = np.sum(colours[rows, columns] * np.stack([*map(here, axis)], -1), axis=-1)
    along_axis = (along - here(start)) / squared
    share = (distance > 0) + np.zeros(distance.shape)
    share[rows, columns] = np.clip(0.5 + SHARPER * (along_axis - 0.5), 0, 1)
    weight = np.zeros(distance.shape)
    nearness = 1 - (distance[rows, columns] / (band.reach + 1)) ** 2
    weight[rows, columns] = nearness / (1 + 1 / (LEAST_ERROR**2 * squared))
    return Matte(share, weight)


def _discriminant(
    colours: np.ndarray, front: np.ndarray, back: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Fisher's linear discriminant of two regions' colours, tile by tile: the axis
    (3, h, w), where on it the back's mean lies, and how far from there the front's (h, w)."""
    (f, f_spread), (b, b_spread) = (_moments(colours, region) for region in (front, back))
    spread = (f_spread + b_spread) / 2 + LEAST_SPREAD**2 * np.eye(3)
    axis = np.linalg.solve(spread, (f - b)[..., None])[..., 0]
    seen = front.any() and back.any()
    contrast = np.sum((f - b) * axis, axis=-1) * seen
    return np.moveaxis(axis, -1, 0), np.sum(b * axis, axis=-1), contrast


def _moments(colours: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (h, w, 3) and covariance (h, w, 3, 3) of a region's colours about each tile."""
    from scipy.ndimage import gaussian_filter

    tile, shape = tiles(region.shape)
    x, of = colours[region], tile[region]
    one, two = np.triu_indices(3)
    channels = [np.ones(len(x)), *x.T, *(x[:, one] * x[:, two]).T]
    sums = [np.bincount(of, c, minlength=shape[0] * shape[1]).reshape(shape) for c in channels]
    total = np.stack(sums, axis=-1)
    everywhere = np.sum(total, axis=(0, 1))
    everywhere /= max(everywhere[0], 1.0)
    about = 2 * np.pi * BLURRED**2 * gaussian_filter(total, (BLURRED, BLURRED, 0), mode="constant")
    about += PIXELS_OF_ALL * everywhere
    about /= np.maximum(about[..., :1], 1e-9)
    mean, products = about[..., 1:4], np.empty((*shape, 3, 3))
    products[..., one, two] = products[..., two, one] = about[..., 4:]
    return mean, products - mean[..., :, None] * mean[..., None, :]


def tiles(shape: tuple[int, ...]) -> tuple[np.ndarray, tuple[int, int]]:
    """Return the number of each pixel's tile (h, w), and how many rows and columns of them are."""
    rows, columns = (-(-n // TILE_PX) for n in shape)
    row, column = (np.arange(n) // TILE_PX for n in shape)
    return row[:, None] * columns + column, (rows, columns)


def _at_pixels(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return values of tiles at pixels, bilinearly between the tiles' middles."""
    from scipy.ndimage import map_coordinates

    middles = [(x + 0.5) / TILE_PX - 0.5 for x in (rows, columns)]
    return map_coordinates(values, middles, order=1, mode="nearest")
