"""Coverage against the union of all projected triangles and of spheres' outlines: shapely."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from chosen import first
from numpy.testing import assert_allclose, assert_array_equal
from oracles import area_per_pixel, mesh_coverage, random_camera

import pinhole_jax as pj
from pinhole_jax import shapes

W, H = 40, 32


def bumpy(seed=0):
    # Gentle bumps: seen from anywhere no fold of the contour shares a pixel with the outline.
    mesh = shapes.bumpy(3, seed, bumps=0.006)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


LENSES = [None, pj.Lens([14.3, 20.1], 1.2)]


@pytest.mark.parametrize(("seed", "lens"), [*((seed, None) for seed in range(5)), (5, LENSES[1])])
def test_closed_meshes_match_the_polygon_union(seed, lens):
    vertices, faces = bumpy(seed)
    camera = random_camera(np.random.default_rng(seed), W, H).replace(lens=lens)
    image = pj.silhouette(camera, pj.Scene(mesh=pj.Mesh(vertices, faces)))
    assert_allclose(image, mesh_coverage(camera, vertices, faces), atol=1e-9)
    assert 0.05 < float(jnp.mean(image)) < 0.9


#: Convex polygons, in px.
POLYGONS = {
    "within one pixel": [(2.2, 1.3), (2.8, 1.4), (2.5, 1.9)],
    "general": [(0.3, 0.2), (6.1, 1.7), (4.2, 4.9), (1.1, 3.3)],
    "on the grid": [(1, 1), (4, 1), (4, 3), (1, 3)],
    "diagonal through corners": [(1, 1), (4, 4), (1, 4)],
    "leaves left": [(-3.5, 1.2), (3.3, 0.4), (2.2, 4.4)],
    "leaves right": [(4.4, 1.2), (15.3, 2.4), (5.2, 4.4)],
    "leaves bottom": [(1.4, 2.2), (3.3, -7.4), (5.2, 3.4)],
    "leaves top": [(1.4, 2.2), (5.3, 2.4), (3.2, 13.4)],
    "holds the frame": [(-9, -9), (19, -8), (18, 21), (-7, 16)],
    "cuts the frame's corner": [(-4, 2), (2, -4), (-4, -4)],
    "left of the frame": [(-4, 1), (-1, 2), (-3, 4)],
    "right of the frame": [(8, 1), (9, 2), (8.5, 4)],
    "above the frame": [(1, 6), (3, 7), (2, 9)],
    "huge": [(-1e6, -3e5), (2e6, 1.1), (-1e6, 4e5)],
    "thin": [(0.5, 2.5), (6.5, 2.5 + 1e-9), (0.5, 2.5 + 2e-9)],
}


@pytest.mark.usefixtures("both_ways")
def test_polygons_have_their_exact_area_in_each_pixel():
    """Sheets in the plane in which a pixel is a unit wide."""
    w, h = 7, 5
    camera = pj.Camera(
        [w / 2, h / 2, 4], [w / 2, h / 2, 0], [0, 1, 0], 2 * np.arctan(h / 8), W=w, H=h
    )
    for name, points in POLYGONS.items():
        corners = np.pad([*points, points[-1]][:4], ((0, 0), (0, 1)))
        mesh = pj.Mesh(corners, [[0, 1, 2], [0, 2, 3]])
        expected = area_per_pixel(shapely.Polygon(points), w, h)
        image = pj.silhouette(camera, pj.Scene(mesh=mesh))
        tolerance = 1e-9 if name == "huge" else 1e-13
        assert_allclose(image, expected, atol=tolerance, err_msg=name)


@pytest.mark.long
@pytest.mark.usefixtures("in_arrays")
def test_no_row_of_a_large_float32_image_is_covered_by_mistake():
    """Many curves pass within rounding of a pixel's corner there."""
    random = np.random.default_rng(0)
    vertices, faces = bumpy()
    scene = pj.Scene(mesh=pj.Mesh(vertices.astype(np.float32), faces))
    for _ in range(10):
        camera = jax.tree.map(lambda x: x.astype("float32"), random_camera(random, 1024, 1024))
        exact, clamped = (np.asarray(pj.silhouette(camera, scene, o)) for o in (True, False))
        assert np.max(np.abs(exact - clamped)) < 2e-3


def test_objects_that_fill_or_miss_the_frame():
    vertices, faces = bumpy()
    scene = pj.Scene(mesh=pj.Mesh(vertices, faces))
    close = pj.Camera([0, 0, 2.5], [0, 0, 0], [0, 1, 0], 0.3, W=W, H=H)
    away = pj.Camera([0, 0, 5], [0, 0, 9], [0, 1, 0], 0.6, W=W, H=H)
    assert_allclose(pj.silhouette(close, scene), 1, atol=1e-12)
    assert_array_equal(pj.silhouette(away, scene), 0)


@pytest.mark.parametrize(
    ("camera_type", "scene_type"),
    first(0, [("float32", "float64"), ("float64", "float32"), ("float32", "float32")], of=3),
)
def test_float_types_mix_and_the_camera_decides(camera_type, scene_type):
    vertices, faces = bumpy()
    arrays = (np.array(x, camera_type) for x in ([0.3, 1, 5], [0.1, 0, 0], [0.1, 1, 0], 0.6))
    camera = pj.Camera(*arrays, 1.0, W, H)
    image = pj.silhouette(camera, pj.Scene(mesh=pj.Mesh(vertices.astype(scene_type), faces)))
    assert image.dtype == camera_type
    single = "float32" in (camera_type, scene_type)
    expected = mesh_coverage(camera, vertices, faces)
    assert_allclose(image, expected, atol=1e-4 if single else 1e-9)


@pytest.mark.long
def test_thousand_views_take_memory_for_their_masks_and_one():
    scene = pj.Scene(mesh=pj.Mesh(*bumpy()))
    camera = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.1, 1, 0], 0.6, W=W, H=H)
    at = lambda e: pj.silhouette(eqx.tree_at(lambda c: c.e, camera, e), scene)
    eyes = jnp.broadcast_to(camera.e, (1000, 3))
    used = [
        jax.jit(f).lower(x).compile().memory_analysis().temp_size_in_bytes
        for f, x in ((at, eyes[0]), (jax.vmap(at), eyes))
    ]
    masks = 8 * 1000 * W * H
    assert used[1] < 2 * used[0] + 2 * masks, (used, masks)
