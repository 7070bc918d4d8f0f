"""Weights near an edge, pixels near it, and what a large photo takes: its outline."""

import tracemalloc

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from oracles import camera_ahead
from scipy.spatial.distance import cdist
from skimage.segmentation import find_boundaries

from pinhole_jax._mask.edges import edge_band
from pinhole_jax._mask.kinds import kind_of
from pinhole_jax._mask.mask import Mask
from pinhole_jax._mask.target import object_window


def disc(H, W):
    """Return a soft disc that fills half the height."""
    y, x = np.ogrid[:H, :W]
    far = np.hypot(y - 0.45 * H, x - 0.4 * W)
    return np.clip(H / 4 - far + 0.5, 0, 1).astype(np.float32)


@pytest.mark.parametrize("reach", [0.5, 2.0, 6.3, 14.0])
def test_pixels_near_an_edge_and_how_near(reach):
    inside = disc(70, 90) > 0.5
    inside[20:30, 30:] = False
    edge = np.argwhere(find_boundaries(inside))
    distance = cdist(np.argwhere(np.ones(inside.shape)), edge).min(axis=1)
    found = edge_band(inside, reach)
    assert_array_equal(found.place, np.flatnonzero(distance < 1 + reach))
    assert_allclose(found.value, distance[found.place], atol=1e-12)


@pytest.mark.parametrize("bits", [1, 8])
def test_large_photo_takes_no_image_of_floats(bits):
    """What a fit asks of its mask, in bytes that are held at once for each pixel: a pass over all
    of it in float64 takes eight."""
    soft = disc(1500, 2000)
    target = soft > 0.5 if bits == 1 else np.uint8(255 * soft)
    ones = np.broadcast_to(1.0, target.shape)
    mask = Mask(target, ones, camera_ahead(2000, 1500))
    steps = {
        "window": lambda: object_window(target),
        "kind": lambda: kind_of(target, ones, np.float32),
        "weights near the edge": lambda: mask.near_edge(2.0),
    }
    tracemalloc.start()
    for name, step in steps.items():
        tracemalloc.reset_peak()
        before, _ = tracemalloc.get_traced_memory()
        step()
        _, peak = tracemalloc.get_traced_memory()
        assert peak - before < 4 * target.size, name
    tracemalloc.stop()
