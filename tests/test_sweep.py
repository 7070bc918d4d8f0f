"""A line that stops at equal distances, against the union of polygons and against every halt."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from test_hidden import pieces

from pinhole_jax._silhouette.sweep import Cells, Visible, sweep

ROOM, CELLS, TRIANGLES = 16, 200, 4


@pytest.fixture(scope="module")
def cells():
    """Return cells with triangles whose corners lie where lines stop, and their unions' areas."""
    random = np.random.default_rng(0)
    piece, area = np.zeros((CELLS, ROOM, 6)), np.zeros(CELLS)
    for k in range(CELLS):
        corners = random.integers(1, 16, (TRIANGLES, 3, 2)) / 16
        turned = [shapely.Polygon(c).exterior.is_ccw for c in corners]
        corners = [c if ccw else c[::-1] for c, ccw in zip(corners, turned, strict=True)]
        sides = np.concatenate([pieces(c) for c in corners])
        piece[k, : len(sides)] = sides
        area[k] = shapely.unary_union([shapely.Polygon(c) for c in corners]).area
    owner = np.stack(np.broadcast_arrays(0, np.arange(ROOM)), axis=-1)
    owner = np.broadcast_to(owner, (CELLS, ROOM, 2)).astype(np.int32)
    return Cells(jnp.asarray(piece), jnp.asarray(owner)), area


@partial(jax.jit, static_argnums=2)
def swept(cells, stops, flux=False) -> tuple[jax.Array, list[Visible]]:
    at = jnp.ones(()), jnp.zeros((CELLS, 2))
    return sweep(cells, jnp.zeros(CELLS), [None], *at, flux, stops)


def reach(cells):
    """Return how far the pieces of a cell reach across the way of the line, all together."""
    start, end = np.asarray(cells.piece)[..., :2], np.asarray(cells.piece)[..., 2:4]
    return np.sum(np.abs(end - start), axis=1).min(axis=1)


@pytest.mark.parametrize("stops", [1, 3, 8, 50])
def test_area_errs_by_half_a_stop_for_each_unit_across(cells, stops):
    some, expected = cells
    error = np.abs(swept(some, jnp.int32(stops))[0] - expected)
    assert np.all(error <= reach(some) / (2 * stops) + 1e-12)
    assert np.max(error) <= 1 / stops  # what is seen of them reaches less far
    assert np.max(error) > 0.02 / stops


def test_visible_length_errs_by_one_stop_for_each_stretch(cells):
    some, _ = cells
    (_, [exact]), (_, [told]) = swept(some, None, True), swept(some, jnp.int32(20), True)
    error = np.abs(np.asarray(told.part - exact.part)[..., 5])
    assert np.max(error) <= TRIANGLES / 20  # each other one cuts a side once
    assert np.mean(error[error > 0]) < 0.5 / 20
    assert np.max(error) > 0.02 / 20
    np.testing.assert_array_equal(told.curve, exact.curve)
