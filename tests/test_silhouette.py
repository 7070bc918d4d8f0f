"""Coverage against the union of all projected triangles and of spheres' outlines: shapely."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from chosen import full, long
from numpy.testing import assert_allclose
from oracles import area_per_pixel, mesh_coverage, random_camera

import pinhole_jax as pj
from pinhole_jax import shapes

W, H = 40, 32


def bumpy(seed=0):
    # Gentle bumps: seen from anywhere no fold of the contour shares a pixel with the outline.
    mesh = shapes.bumpy(3, seed, bumps=0.006)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.parametrize(
    ("seed", "kind", "of_mesh", "lens"),
    [
        *((seed, "float64", "float64", None) for seed in range(5)),
        (5, "float64", "float64", pj.Lens([14.3, 20.1], 1.2)),
        long(0, "float32", "float64", None),
        full(0, "float64", "float32", None),
        full(0, "float32", "float32", None),
    ],
)
def test_closed_meshes_match_the_polygon_union(seed, kind, of_mesh, lens):
    """Types mix, and the camera's decides."""
    vertices, faces = bumpy(seed)
    camera = random_camera(np.random.default_rng(seed), W, H).replace(lens=lens)
    camera = jax.tree.map(lambda x: x.astype(kind), camera)
    image = pj.silhouette(camera, pj.Scene(mesh=pj.Mesh(vertices.astype(of_mesh), faces)))
    assert image.dtype == kind
    close = 1e-9 if kind == of_mesh == "float64" else 1e-4
    assert_allclose(image, mesh_coverage(camera, vertices, faces), atol=close)
    assert 0.05 < float(jnp.mean(image)) < 0.9


def quadrilaterals(w, h, number):
    """Yield corners (4, 2) of convex polygons in px, below a pixel and huge ones, thin ones, those
    on the grid; the last ones are three times the same."""
    random = np.random.default_rng(0)
    for k in range(number):
        size = [0.3, 2, 10, 1e6][k % 4]
        corners = random.uniform(0, [w, h]) + size * random.normal(size=(4, 2))
        corners = np.round(2 * corners) / 2 if k % 3 == 0 else corners
        if k % 10 == 9:
            corners[:, 1] = 2.5 + 1e-9 * corners[:, 1]
        hull = shapely.convex_hull(shapely.multipoints(corners))
        if hull.geom_type == "Polygon":
            around = np.array(hull.exterior.coords)[:-1]
            yield size, [*around, around[-1]][:4]


@pytest.mark.usefixtures("both_ways")
def test_polygons_have_their_exact_area_in_each_pixel():
    """Sheets in the plane in which a pixel is a unit wide."""
    w, h = 7, 5
    middle, phi = np.array([w / 2, h / 2, 0]), 2 * np.arctan(h / 8)
    camera = pj.Camera(middle + np.array([0, 0, 4]), middle, [0, 1, 0], phi, W=w, H=h)
    for size, corners in quadrilaterals(w, h, 60):
        mesh = pj.Mesh(np.pad(corners, ((0, 0), (0, 1))), [[0, 1, 2], [0, 2, 3]])
        expected = area_per_pixel(shapely.Polygon(corners), w, h)
        image = pj.silhouette(camera, pj.Scene(mesh=mesh))
        assert_allclose(image, expected, atol=1e-9 if size > 10 else 1e-13)


@pytest.mark.long
@pytest.mark.usefixtures("in_arrays")
def test_no_row_of_a_large_float32_image_is_covered_by_mistake():
    """Many curves pass within rounding of a pixel's corner there."""
    random = np.random.default_rng(0)
    vertices, faces = bumpy()
    scene = pj.Scene(mesh=pj.Mesh(vertices.astype(np.float32), faces))
    for _ in range(3):
        camera = jax.tree.map(lambda x: x.astype("float32"), random_camera(random, 1024, 1024))
        wide = jax.tree.map(lambda x: x.astype(float), camera)
        single, double = (np.asarray(pj.silhouette(c, scene)) for c in (camera, wide))
        assert np.max(np.abs(single - double)) < 2e-3


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
