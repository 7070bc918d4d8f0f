"""Signatures of masks, and how far two of them are apart.

A signature is a mask in polar coordinates about its own centroid, on a film turned to face it and
scaled to its own size: what is left of a mask when shift, distance and (up to a rotation of the
columns) roll are taken away.
"""

from typing import NamedTuple

import numpy as np

#: A signature's rings, out to `REACH` radii of the disc of the mask's own area, and angles.
RINGS, ANGLES, REACH = 16, 72, 2.4
#: Where a part is hidden, the middle is this many radii farther there, the object this many times
#: as large, and unknown what lies this many radii beyond the middle.
MIDDLE, LARGER, BEHIND = 0.2, 1.3, 0.3


class Signature(NamedTuple):
    """Masks about their own centroids: samples (N, RINGS, ANGLES), whether each was in the picture,
    solid angles (N,) and axes (N, 3, 3): rows x, y and the centroid's direction, in camera axes.
    """

    samples: np.ndarray
    valid: np.ndarray
    solid_angle: np.ndarray
    axes: np.ndarray


def signatures(
    images: np.ndarray,
    weight: np.ndarray,
    focal: np.ndarray,
    centre: np.ndarray,
    hidden: float | None = None,
) -> Signature:
    """Return the signatures of images (N, H, W); focal lengths and principal point in px.

    Where `weight` (H, W) is 0 nothing is known of the image. Where a part is `hidden`, in a
    direction (rad, from the film's right to its top), nothing is known: the middle lies farther
    there, and the object is larger.
    """
    from scipy.ndimage import map_coordinates

    images, weight = images[:, ::-1], weight[::-1]  # rows from the film's bottom
    N, H, W = images.shape
    x, y = ((np.arange(n) + 0.5 - centre[k]) / focal[k] for k, n in enumerate((W, H)))
    cosine = (1 + x**2 + y[:, None] ** 2) ** -0.5
    share = images * (weight > 0) * cosine**3 / (focal[0] * focal[1])
    total = np.maximum(share.sum(axis=(1, 2)), 1e-12)
    middle = np.stack(
        [(share.sum(axis=1) @ x) / total, (share.sum(axis=2) @ y) / total, np.ones(N)], axis=-1
    )
    if hidden is not None:
        toward = np.array([np.cos(hidden), np.sin(hidden)])
        size = np.sqrt(total / np.pi)
        middle[:, :2] += MIDDLE * size[:, None] * toward
        total = total * LARGER
        far = toward[0] * (x - middle[0, 0]) + toward[1] * (y - middle[0, 1])[:, None]
        weight = weight * (far < BEHIND * size[0])
    axes = facing(middle)
    radius = np.tan(np.minimum(np.sqrt(total / np.pi), 1.2))
    ring = (np.arange(RINGS) + 0.5) / RINGS * REACH
    angle = 2 * np.pi * np.arange(ANGLES) / ANGLES
    r = (radius[:, None] * ring)[:, :, None]
    flat = np.stack([r * np.cos(angle), r * np.sin(angle), np.ones((N, RINGS, ANGLES))], axis=-1)
    ray = (flat.reshape(N, -1, 3) @ axes).reshape(flat.shape)
    ahead = ray[..., 2] > 1e-3
    depth = np.where(ahead, ray[..., 2], 1)
    column, row = (ray[..., k] / depth * focal[k] + centre[k] - 0.5 for k in (0, 1))
    places = np.broadcast_arrays(np.arange(N)[:, None, None], row, column)
    samples = map_coordinates(images, places, order=1, mode="nearest")
    known = map_coordinates(weight, places[1:], order=1, mode="grid-constant")  # 0 beside it
    return Signature(samples, ahead & (known > 0.5), total, axes)


def facing(direction: np.ndarray) -> np.ndarray:
    """Return axes (N, 3, 3) whose third row is along a direction, turned there the shortest way."""
    d = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    x, y, z = d.T
    k = 1 / (1 + np.maximum(z, -1 + 1e-9))
    rows = [[1 - k * x * x, -k * x * y, -x], [-k * x * y, 1 - k * y * y, -y], [x, y, z]]
    return np.moveaxis(np.array(rows), -1, 0)


def distances(mask: Signature, views: Signature) -> np.ndarray:
    """Return (N, ANGLES): mean squared difference of one mask and N views turned by each angle."""
    area = np.arange(RINGS)[:, None] + 0.5
    known, seen = (s.valid * 1.0 for s in (mask, views))
    target, samples = mask.samples * known, views.samples * seen

    def correlate(a, b):
        spectrum = np.fft.rfft(a * area, axis=-1) * np.conj(np.fft.rfft(b, axis=-1))
        return np.fft.irfft(spectrum, n=ANGLES, axis=-1).sum(axis=1)

    both = np.maximum(correlate(known, seen), 1)
    total = correlate(target**2, seen) + correlate(known, samples**2)
    return (total - 2 * correlate(target, samples)) / both
