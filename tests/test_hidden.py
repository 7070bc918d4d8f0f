"""Cells whose pieces are all hidden, against winding numbers at many points of them."""

import jax
import jax.numpy as jnp
import numpy as np

from pinhole_jax._silhouette import hidden as module
from pinhole_jax._silhouette.sweep import Cells

all_hidden = jax.jit(module.all_hidden)
ROOM = 16
GRID = (np.stack(np.meshgrid(*2 * [np.arange(200)]), axis=-1).reshape(-1, 2) + 0.5) / 200


def pieces(polygon):
    """Return a polygon's sides (n, 6) in a cell; it has a layer more on its sides' left."""
    ends = np.stack([polygon, np.roll(polygon, -1, axis=0)], axis=1)
    rises = ends[:, 1, 1] >= ends[:, 0, 1]
    ends = np.where(rises[:, None, None], ends, ends[:, ::-1])
    return np.column_stack([ends.reshape(-1, 4), np.full(len(ends), 2), np.where(rises, -1, 1)])


def windings(polygon, points):
    """Return how often a polygon winds about points: sides met on the way to the right."""
    (x, y), total = points.T, 0
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        meets = ((y0 <= y) != (y1 <= y)) & (
            x < x0 + (y - y0) * (x1 - x0) / (y1 - y0 if y1 != y0 else 1)
        )
        total = total + np.where(meets, np.sign(y1 - y0), 0)
    return total


def hidden(cells, corners):
    """Return which cells, lists of polygons, are hidden."""
    piece = np.zeros((len(cells), ROOM, 6))
    for row, polygons in zip(piece, cells, strict=True):
        sides = np.concatenate([pieces(p) for p in polygons])
        row[: len(sides)] = sides
    owner = jnp.zeros((len(cells), ROOM, 2), jnp.int32)
    return np.asarray(all_hidden(Cells(jnp.asarray(piece), owner), jnp.asarray(corners, float)))


def test_folds_are_hidden_and_holes_are_not():
    fold = np.array([[0.2, 0.3], [0.7, 0.4], [0.4, 0.9]])
    hole, within, beside = fold[::-1], 0.2 * fold + 0.3, 0.2 * fold
    upright = np.array([[0.2, 0.2], [0.6, 0.2], [0.6, 0.8], [0.2, 0.8]])
    cases = [
        ([fold], 1, True),
        ([fold], 0, False),
        ([hole], 1, False),
        ([hole], 2, True),
        ([fold, within[::-1]], 1, True),
        ([fold, beside[::-1]], 1, False),
        ([upright], 1, False),  # not told: a sweep does
    ]
    cells, corners, expected = zip(*cases, strict=True)
    np.testing.assert_array_equal(hidden(cells, corners), expected)


def test_layers_that_end_where_nothing_is_looked_at():
    """... in a point at the corner; and beside a piece that begins below another one's middle."""
    piece = np.zeros((3, ROOM, 6))
    piece[:2, 0] = [0, 0, 0, 0, 1, 1], [0, 0, 0, 0, 1, -1]
    piece[2, :2] = [0, 0.6, 1, 0.8, 1, 4], [0.5, 0, 1, 0.1, 2, -1]
    owner = jnp.zeros((3, ROOM, 2), jnp.int32)
    assert not np.any(all_hidden(Cells(jnp.asarray(piece), owner), jnp.array([1.0, 1.0, 4.0])))


def test_no_cell_is_hidden_that_has_a_part_uncovered():
    random = np.random.default_rng(0)
    cells, corners, least = [], [], []
    for _ in range(400):
        # Corners of one lie on sides of another now and then.
        polygons = [np.round(random.uniform(0.05, 0.95, (n, 2)), 2) for n in (3, 4)]
        polygons[1][0] = polygons[0][:2].mean(axis=0)
        corner = random.integers(1, 5)
        cells.append(polygons)
        corners.append(corner)
        least.append(np.min(corner + sum(windings(p, GRID) for p in polygons)))
    told, covered = hidden(cells, corners), np.array(least) > 0
    assert not np.any(told & ~covered)
    assert np.sum(told) > 40
