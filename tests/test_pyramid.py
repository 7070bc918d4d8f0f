"""The pages of a pyramid against plain running sums, and what a large photo takes: its outline."""

import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import pinhole_jax as pj
from pinhole_jax._mask.edges import NearWeights, edge_band
from pinhole_jax._mask.kinds import kind_of
from pinhole_jax._mask.mask import Mask
from pinhole_jax._mask.pyramid import PAGE, cells_of, pyramid
from pinhole_jax._mask.target import Window, object_window


def disc(H: int, W: int) -> np.ndarray:
    """Return a soft disc that fills half the height."""
    y, x = np.ogrid[:H, :W]
    far = np.hypot(y - 0.45 * H, x - 0.4 * W)
    return np.clip(H / 4 - far + 0.5, 0, 1).astype(np.float32)


def told(data, level, cell) -> list[np.ndarray]:
    """What a level holds at some cells: target, weight, and what is summed up before them."""
    at = int(level.start) + cell
    here = data.page[at // PAGE] * PAGE + at % PAGE
    return [*data.cells[:2, here], *(data.sums[:, at // PAGE] + data.cells[2:, here])]


def plain_levels(target, weight, depth):
    """Return the levels' images and weights, coarse to fine: means over 2 x 2 from bottom left."""
    levels = [(target, weight)]
    for _ in range(depth):
        halves = []
        for image in levels[-1]:
            H, W = image.shape
            whole = np.pad(image, ((H % 2, 0), (0, W % 2)))
            halves.append(whole.reshape(-(-H // 2), 2, -(-W // 2), 2).mean(axis=(1, 3)))
        levels.append(tuple(halves))
    return levels[::-1]


WEIGHTS = {
    "none": lambda H, W: np.broadcast_to(1.0, (H, W)),
    "heavy": lambda H, W: np.broadcast_to(3.0, (H, W)),
    "half": lambda H, W: 1.0 * (np.arange(H)[:, None] < H // 2) * np.ones(W),
    "random": lambda H, W: np.random.default_rng(1).random((H, W)),
}
KINDS = {
    "one bit": lambda soft: soft > 0.5,
    "8 bits": lambda soft: np.round(255 * soft).astype(np.uint8),
    "float": lambda soft: soft,
    "noisy": lambda soft: soft + np.random.default_rng(0).normal(0, 0.1, soft.shape),
}


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("kind", KINDS)
def test_pages_equal_plain_running_sums(kind, weights):
    H, W = 96, 160  # (whole pixels on all three levels: nothing reaches out of the film)
    target, weight = KINDS[kind](disc(H, W)), WEIGHTS[weights](H, W)
    data, levels = pyramid(target, weight, np.float64, coarsest_px=12)
    alone, (finest,) = pyramid(target, weight, np.float64, only_finest=True)
    cell = np.arange(H * (W + 2) + 1)
    assert finest.window() == levels[-1].window()
    for a, b in zip(told(alone, finest, cell), told(data, levels[-1], cell), strict=True):
        assert_array_equal(a, b)
    image = target / 255 if target.dtype == np.uint8 else target.astype(float)
    plain = plain_levels(image, np.array(weight), len(levels) - 1)
    assert len(levels) == 3
    for level, (t, w) in zip(levels, plain, strict=True):
        t, w = (np.pad(x[::-1], ((0, 0), (1, 1))).ravel() for x in (t, w))
        cell = np.arange(t.size + 1)
        own, weighs, *rest = told(data, level, cell)
        assert_allclose(weighs[:-1], w, atol=1e-15)
        assert_allclose((weighs * own)[:-1], w * t, atol=1e-15)
        for a, b in zip(
            cells_of(*jax.tree.map(jnp.asarray, (data, level.start + cell.astype(np.int32)))),
            (own, weighs),
            strict=True,
        ):
            assert_array_equal(a, b)
        sums = w * t**2, w * (1 - t) ** 2, w, w * t
        for found, each in zip(rest, sums, strict=True):
            plain_sums = np.concatenate([[0], np.cumsum(each)])
            assert_allclose(found, plain_sums, rtol=1e-12, atol=1e-9)


def test_weights_near_an_edge_are_those_of_an_image():
    target = disc(90, 140) > 0.5
    place = np.sort(np.random.default_rng(0).permutation(target.size)[:500])
    weights = NearWeights(target.shape, place, np.linspace(0.1, 1, 500))
    window = Window(20, 30, 100, 50)
    found, (level,) = pyramid(target, weights, float, window=window, only_finest=True)
    plain, _ = pyramid(target, weights.image(), float, window=window, only_finest=True)
    cell = np.arange(int(level.H) * (int(level.W) + 2) + 1)
    for a, b in zip(told(found, level, cell)[1:], told(plain, level, cell)[1:], strict=True):
        assert_allclose(a, b, atol=1e-12)


def test_runs_in_which_nothing_is_added_are_nothing_in_float32():
    """What a covered or uncovered run costs is a difference of sums: not their rounding."""
    target = disc(300, 400)
    data, (*_, level) = pyramid(target, np.broadcast_to(1.0, target.shape), np.float32)
    t = np.pad(target[::-1], ((0, 0), (1, 1))).ravel()
    _, _, empty, full, *_ = told(data, level, np.arange(t.size + 1))
    beside = ~np.pad(np.ones(target.shape, bool), ((0, 0), (1, 1))).ravel()
    assert not np.any(np.diff(empty)[(t == 0) | beside])
    assert not np.any(np.diff(full)[(t == 1) | beside])
    assert np.any(t == 1)


@pytest.mark.parametrize("reach", [0.5, 2.0, 6.3, 14.0])
def test_pixels_near_an_edge_and_how_near(reach):
    from scipy.spatial import KDTree

    inside = disc(70, 90) > 0.5
    inside[20:30, 30:] = False
    edge = np.zeros(inside.shape, bool)
    for axis in (0, 1):
        change = np.diff(inside, axis=axis)
        for side in ((0, 1), (1, 0)):
            edge |= np.pad(change, [side if k == axis else (0, 0) for k in (0, 1)])
    pixels = np.indices(inside.shape).reshape(2, -1).T
    distance, _ = KDTree(np.argwhere(edge)).query(pixels)
    found = edge_band(inside, reach)
    assert_array_equal(found.place, np.flatnonzero(distance < 1 + reach))
    assert_allclose(found.distance, distance[found.place], atol=1e-12)


@pytest.mark.parametrize("kind", ["one bit", "8 bits"])
def test_large_photo_takes_no_image_of_floats(kind):
    """What a fit asks of its mask, in bytes that are held at once for each pixel: a pass over all
    of it in float64 takes eight."""
    target = KINDS[kind](disc(1500, 2000))
    ones = np.broadcast_to(1.0, target.shape)
    mask = Mask(
        target, ones, pj.Camera([0.0, 0, 4], [0.0, 0, 0], [0.0, 1, 0], 0.6, 1.0, 2000, 1500)
    )
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
