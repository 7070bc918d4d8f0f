"""Coverage against the union of all projected triangles and of spheres' outlines: shapely."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from chosen import first
from oracles import area_per_pixel, mesh_coverage, random_camera, sphere_union

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._scene.scene import padded

W, H = 40, 32


def box(low, high):
    mesh = trimesh.creation.box(bounds=[low, high])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def filled(vertices, faces):
    """Return the scene with its arrays filled up, so that small meshes share a program."""
    return padded(pj.Scene(mesh=pj.Mesh(vertices, faces)))


def bumpy(seed=0):
    # Gentle bumps: seen from anywhere no fold of the contour shares a pixel with the outline.
    mesh = shapes.bumpy(3, seed, bumps=0.006)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.parametrize("seed", range(6))
def test_closed_meshes_match_the_polygon_union(seed):
    vertices, faces = bumpy(seed)
    camera = random_camera(np.random.default_rng(seed), W, H)
    image = pj.silhouette(camera, pj.Scene(mesh=pj.Mesh(vertices, faces)))
    np.testing.assert_allclose(image, mesh_coverage(camera, vertices, faces), atol=1e-9)
    assert 0.05 < float(jnp.mean(image)) < 0.9


@pytest.mark.parametrize(
    "look_at", [(2.2, 0, 0), (-2.2, 0, 0), (0, 2.2, 0), (0, -2.2, 0), (1.9, 1.6, 0), (9, 9, 0)]
)
def test_contours_may_leave_the_frame_on_any_side(look_at):
    vertices, faces = bumpy()
    camera = pj.Camera(np.add([0, 0, 5], look_at), look_at, [0, 1, 0], 0.6, W=W, H=H)
    image = pj.silhouette(camera, pj.Scene(mesh=pj.Mesh(vertices, faces)))
    np.testing.assert_allclose(image, mesh_coverage(camera, vertices, faces), atol=1e-9)


@pytest.mark.long
def test_no_row_of_a_large_float32_image_is_covered_by_mistake():
    """Many curves pass within rounding of a pixel's corner there."""
    random = np.random.default_rng(0)
    vertices, faces = (np.asarray(x) for x in bumpy())
    scene = pj.Scene(mesh=pj.Mesh(vertices.astype(np.float32), faces))
    for _ in range(30):
        camera = random_camera(random, 1024, 1024)
        camera = jax.tree.map(lambda x: x.astype(jnp.float32), camera)
        told, plain = (np.asarray(pj.silhouette(camera, scene, o)) for o in (True, False))
        assert np.max(np.abs(told - plain)) < 2e-3


def test_objects_that_fill_or_miss_the_frame():
    vertices, faces = bumpy()
    scene = pj.Scene(mesh=pj.Mesh(vertices, faces))
    close = pj.Camera([0, 0, 2.5], [0, 0, 0], [0, 1, 0], 0.3, W=W, H=H)
    away = pj.Camera([0, 0, 5], [0, 0, 9], [0, 1, 0], 0.6, W=W, H=H)
    np.testing.assert_allclose(pj.silhouette(close, scene), 1, atol=1e-12)
    np.testing.assert_array_equal(pj.silhouette(away, scene), 0)


@pytest.mark.long
def test_edges_along_pixel_rows_and_corners():
    # 90 degrees at distance 5 from the front face: one unit is 16/5 px; the face's corners fall on
    # (20 +- 8, 16 +- 8) px exactly.
    vertices, faces = box([-2.5, -2.5, -4], [2.5, 2.5, 0])
    camera = pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], np.pi / 2, W=W, H=H)
    image = np.asarray(pj.silhouette(camera, filled(vertices, faces)))
    expected = np.zeros((H, W))
    expected[8:24, 12:28] = 1
    np.testing.assert_allclose(image, expected, atol=1e-12)


@pytest.mark.long
def test_hole_is_not_covered():
    torus = trimesh.creation.torus(1.0, 0.3, 32, 12)
    camera = pj.Camera([0, 0.5, 5], [0, 0, 0], [0, 1, 0], 0.6, W=W, H=H)
    expected = mesh_coverage(camera, torus.vertices, torus.faces)
    assert expected[H // 2, W // 2] == 0
    scene = filled(torus.vertices, torus.faces)
    np.testing.assert_allclose(pj.silhouette(camera, scene), expected, atol=1e-9)


SPHERES = {
    "one": ([[0.0, 0, 0]], [0.8]),
    "beside the axis": ([[1.0, 0.4, -2]], [0.6]),
    "apart": ([[-0.9, 0.3, 0], [0.5, -0.7, 1], [0.6, 0.6, -1]], [0.4, 0.15, 0.35]),
    "leaves the frame": ([[1.6, 0.9, 0]], [0.7]),
    "close": ([[0.1, 0.1, 3.9]], [0.5]),
    "below a pixel": ([[0.05, 0.03, 0]], [0.01]),
}


@pytest.mark.parametrize("name", first(1, SPHERES))
def test_spheres_match_their_outlines(name):
    centers, radii = np.array(SPHERES[name][0]), np.array(SPHERES[name][1])
    camera = pj.Camera([0, 0, 5], [0.1, 0, 0], [0.1, 1, 0], 0.6, W=W, H=H)
    image = pj.silhouette(camera, pj.Scene(spheres=pj.Spheres(centers, radii)))
    expected = area_per_pixel(sphere_union(camera, centers, radii), W, H)
    np.testing.assert_allclose(image, expected, atol=2e-6)


@pytest.mark.long
def test_mesh_and_spheres_apart_add_up():
    vertices, faces = bumpy()
    camera = pj.Camera([0, 0, 8], [0, 0, 0], [0, 1, 0], 0.6, W=W, H=H)
    mesh, spheres = pj.Mesh(vertices, faces), pj.Spheres([[2.0, 1.5, 0]], [0.4])
    both = pj.silhouette(camera, pj.Scene(mesh=mesh, spheres=spheres))
    one, other = (
        pj.silhouette(camera, pj.Scene(mesh=m, spheres=s))
        for m, s in ((mesh, None), (None, spheres))
    )
    np.testing.assert_allclose(both, one + other, atol=1e-14)


def test_empty_scene_covers_nothing():
    camera = pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, W=3, H=2)
    none = pj.Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    for scene in (
        pj.Scene(),
        pj.Scene(mesh=none),
        pj.Scene(spheres=pj.Spheres(np.zeros((0, 3)), [])),
    ):
        np.testing.assert_array_equal(pj.silhouette(camera, scene), np.zeros((2, 3)))


@pytest.mark.long
def test_lens_moves_and_stretches_the_image():
    vertices, faces = bumpy()
    lens = pj.Lens([14.3, 20.1], 1.2)
    camera = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.1, 1, 0], 0.6, 1.0, W, H, lens)
    image = pj.silhouette(camera, pj.Scene(mesh=pj.Mesh(vertices, faces)))
    np.testing.assert_allclose(image, mesh_coverage(camera, vertices, faces), atol=1e-9)


@pytest.mark.long
@pytest.mark.usefixtures("in_arrays")
def test_no_number_of_contour_edges_or_pieces_is_too_many(monkeypatch):
    mesh = shapes.bumpy(3, bumps=0.05)
    scene = pj.Scene(mesh=pj.Mesh(mesh.vertices, mesh.faces))
    camera = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.1, 1, 0], 0.6, W=W, H=H + 1)
    simple = pj.silhouette(camera, scene, overlaps=False)
    weight = jnp.asarray(np.random.default_rng(0).normal(size=simple.shape))

    @partial(eqx.filter_value_and_grad, has_aux=True)
    def loss(camera):
        image = pj.silhouette(camera, scene)
        return jnp.sum(weight * image), image

    (_, image), gradient = loss(camera)
    assert np.sum(np.abs(image - simple) > 1e-6) > 4
    monkeypatch.setattr("pinhole_jax._silhouette.pixels.AT_A_TIME", 16)
    monkeypatch.setattr("pinhole_jax._silhouette.pieces.AT_A_TIME", 8)
    monkeypatch.setattr("pinhole_jax._silhouette.crowds.SWEPT", 2)
    jax.clear_caches()
    (_, image_again), again = loss(camera)
    np.testing.assert_allclose(image_again, image, atol=1e-13)
    for one, other in zip(jax.tree.leaves(gradient), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-11)
    jax.clear_caches()


@pytest.mark.long
def test_scene_behind_the_eye_has_finite_derivatives():
    vertices, faces = box([-1, -1, -1], [1, 1, 9])
    scene = pj.Scene(mesh=pj.Mesh(vertices, faces), spheres=pj.Spheres([[0.5, 0, 6.1]], [0.9]))
    camera = pj.Camera([0.2, 1.3, 6], [0, 0, 0], [0, 1, 0], 0.6, W=W, H=H)
    value, slope = eqx.filter_value_and_grad(lambda c: jnp.sum(pj.silhouette(c, scene)))(camera)
    assert np.isfinite(value)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slope))


@pytest.mark.full
def test_supersampled_hard_masks_converge_to_it():
    vertices, faces = bumpy()
    scene = pj.Scene(mesh=pj.Mesh(vertices, faces), spheres=pj.Spheres([[1.1, 0.9, 0]], [0.3]))
    camera = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.1, 1, 0], 0.6, W=12, H=10)
    image = pj.silhouette(camera, scene)
    errors = []
    for samples in (4, 16):
        hard = jnp.mean(pj.occluded(scene, pj.camera_rays(camera, samples)), axis=-1, dtype=float)
        errors.append(float(jnp.sqrt(jnp.mean((hard - image) ** 2))))
    assert errors[0] < 0.02
    assert errors[1] < errors[0] / 4  # a regular grid: error about samples^-3/2


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
    exact = pj.Camera(
        *(np.asarray(x, float) for x in (camera.e, camera.p, camera.u, camera.phi)), 1.0, W, H
    )
    single = "float32" in (camera_type, scene_type)
    expected = mesh_coverage(exact, vertices, faces)
    np.testing.assert_allclose(image, expected, atol=1e-4 if single else 1e-9)


@pytest.mark.long
def test_vmap_over_cameras_is_the_same_as_one_by_one():
    vertices, faces = bumpy()
    scene = pj.Scene(mesh=pj.Mesh(vertices, faces))
    camera = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.1, 1, 0], 0.6, W=W, H=H)
    eyes = camera.e[None] + jnp.array([[0, 0, 0], [0.5, 0, 0], [0, -1, 2.0]])
    at = lambda e: pj.silhouette(eqx.tree_at(lambda c: c.e, camera, e), scene)
    np.testing.assert_allclose(jax.vmap(at)(eyes), jnp.stack([at(e) for e in eyes]), atol=1e-14)


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
