"""Scenes on the pixel grid, where edges coincide with one another, with pixels' sides and corners.

Each kind of scene has one number of edges, so that all of a kind share a compiled program.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from numpy.random import default_rng
from numpy.testing import assert_allclose
from oracles import body, cast, mesh_coverage

import pinhole_jax as pj
from pinhole_jax._scene.scene import padded

W, H = 40, 32
UP = np.array([[0, 1, 0], [1, 0, 0], [0, -1, 0], [-1, 0, 0]])
SOME, MANY = 24, 400


def camera(turn, dtype=float):
    """Return a camera that sees 16 pixels to a unit of z = 0, turned by this many right angles."""
    ahead = pj.Camera([0, 0, 4], [0, 0, 0], UP[turn], 2 * np.arctan(0.25), 1.0, W, H)
    return cast(ahead, dtype)


def interval(random, low, high, step):
    return np.sort(random.choice(np.arange(low, high + 1), 2, replace=False)) * step


def sheet(random, low_high):
    """Return a rectangle in z = 0, wound and halved one way or the other."""
    (x0, x1), (y0, y1) = low_high
    vertices = [[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]]
    faces = np.array([[[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]]][random.integers(2)])
    return np.array(vertices, float), faces[:, :: random.choice([1, -1])]


#: How far apart sheets' corners are: 4 pixels, one, a half.
STEPS = 1 / 4, 1 / 16, 1 / 32


def sheets(random, step):
    """Return eight rectangles, the last two of them copies."""
    spans = [[interval(random, -5, 5, step) for _ in range(2)] for _ in range(6)]
    parts = [sheet(random, x) for x in (*spans, *spans[:2])]
    return trimesh.util.append_faces(*zip(*parts, strict=True))


def scene_of(vertices, faces, dtype=float):
    return padded(body(vertices.astype(dtype), faces))


@eqx.filter_jit
def with_change(camera, scene, direction):
    """Return the image and its derivative where all vertices move alike."""
    mesh = scene.mesh
    moved = lambda v: eqx.tree_at(lambda s: s.mesh.vertices, scene, v)
    velocity = jnp.broadcast_to(direction, mesh.vertices.shape)
    return jax.jvp(lambda v: pj.silhouette(camera, moved(v)), (mesh.vertices,), (velocity,))


@pytest.mark.long
@pytest.mark.parametrize("step", STEPS)
def test_sheets_on_the_grid_and_their_derivative_are_exact(step, exhaustive):
    """On a pixel's side an edge counts for the pixel that it moves into."""
    for seed in range(MANY if exhaustive else SOME):
        random, turn = default_rng(seed), seed % 4
        vertices, faces = sheets(random, step)
        across, up = random.uniform(0.1, 1, 2)
        way = (across * np.cross([0, 0, -1], UP[turn]) + up * UP[turn]) / 16
        image, change = with_change(camera(turn), scene_of(vertices, faces), jnp.array(way))
        covered, after = (mesh_coverage(camera(turn), vertices + k * way, faces) for k in (0, 1e-6))
        assert_allclose(image, covered, atol=5e-14)
        assert_allclose(change, (after - covered) / 1e-6, atol=1e-5)
        single = scene_of(vertices, faces, np.float32)
        assert_allclose(pj.silhouette(camera(turn, np.float32), single), covered, atol=3e-5)


def on_one_line(random):
    """Return five triangles with corners on pixels' corners, a side of each on the same line."""
    steps = np.array([[12, 7], [5, 13], [7, 11], [13, 12], [3, 13]])
    step = random.choice([-1, 1], 2) * steps[random.integers(5)]
    corners = np.zeros((5, 3, 3))
    starts = np.array([random.choice(19, 2, replace=False) - 9 for _ in range(5)])
    corners[:, :2, :2] = random.integers(-6, 7, 2) + starts[..., None] * step
    corners[:, 2, :2] = random.integers(-16, 17, (5, 2))
    return corners.reshape(-1, 3) / 16, np.arange(15).reshape(-1, 3)


@pytest.mark.usefixtures("both_ways")
def test_edges_that_coincide_match_the_polygon_union(exhaustive):
    """Rounding lets one edge on a line, and not another, come into a pixel beside its corner."""
    for seed in range(10 * MANY if exhaustive else 2 * SOME):
        vertices, faces = on_one_line(default_rng(seed))
        view = camera(seed % 4)
        expected = mesh_coverage(view, vertices, faces)
        image = pj.silhouette(view, scene_of(vertices, faces))
        assert_allclose(image, expected, atol=1e-13)
