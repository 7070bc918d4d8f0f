"""Silhouettes under lens distortion against polygons of points that OpenCV projects densely."""

import jax
import numpy as np
import pytest
import shapely
from oracles import union_per_pixel
from test_distortion import by_opencv

import pinhole_jax as pj

W, H = 24, 18
BROWN = pj.BrownConrady(-0.2, 0.05, 4e-3, -3e-3, 0.004)
FISHEYE = pj.Fisheye(-0.02, 0.006, -0.002, 0.0003)
CUSHION = pj.BrownConrady(0.25, 0.1, -3e-3, 2e-3)


def camera(model, phi, distance=3.0):
    lens = pj.Lens([W * 0.53, H * 0.46], 1.04, model)
    return pj.Camera([0.4, 0.3, distance], [0.1, 0.05, 0], [0.1, 1, 0], phi, 1.0, W, H, lens)


def sheet(size=1.0):
    """Return two long triangles, whose edges bend, and one before them."""
    vertices = np.array(
        [[-2, -1, 0], [2.2, -1.1, 0.2], [2, 1.2, 0], [-2, 1, -0.3], [0, -3, 0.6], [0.5, 2.5, 1]],
        float,
    )
    return pj.Mesh(vertices * size, np.array([[0, 1, 2], [0, 2, 3], [4, 5, 0]]))


def dense(view, mesh, number=1000):
    """Return the union of the triangles, each side in many pieces, projected by OpenCV."""
    shapes = []
    share = np.linspace(0, 1, number, endpoint=False)[:, None]
    for face in np.asarray(mesh.faces):
        a, b, c = np.asarray(mesh.vertices, float)[face]
        side = [p + share * (q - p) for p, q in ((a, b), (b, c), (c, a))]
        shapes.append(shapely.Polygon(by_opencv(view, np.concatenate(side))))
    return union_per_pixel(shapes, W, H)


CASES = {
    "brown": (BROWN, 1.1),
    "cushion": (CUSHION, 0.9),
    "fisheye": (FISHEYE, 1.25),
    "strong": (pj.BrownConrady(-0.32), 0.95),
}
silhouette = jax.jit(pj.silhouette)


@pytest.mark.parametrize("case", CASES)
def test_coverage_is_that_of_the_bent_triangles(case):
    view, mesh = camera(*CASES[case]), sheet()
    image = silhouette(view, pj.Scene(mesh=mesh))
    expected = dense(view, mesh)
    assert np.sum((expected > 0) & (expected < 1)) > 20
    np.testing.assert_allclose(image, expected, atol=1.5e-3)
    assert np.sqrt(np.mean((image - expected) ** 2)) < 3e-4
