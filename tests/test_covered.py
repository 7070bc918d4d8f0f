"""What is called surely covered is covered, by the union of polygons, on hostile scenes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from oracles import mesh_coverage, sphere_polygons, union_per_pixel

import pinhole_jax as pj
from pinhole_jax._camera.camera import film_map
from pinhole_jax._silhouette import silhouette as module
from pinhole_jax._silhouette.covered import faces_of, spheres_of, surely_covered

pytestmark = pytest.mark.altered

W, H, FACES = 40, 32, 4096
ALL = jnp.full(H * 2, 0xFFFFFFFF, jnp.uint32)


def loose(number, spread, size, seed=0):
    random = np.random.default_rng(seed)
    corners = random.normal(0, spread, (number, 1, 3)) + random.normal(0, size, (number, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * number).reshape(-1, 3)


def slivers():
    """Faces a hundred times as long as wide, which leave gaps between them."""
    vertices, faces = loose(FACES // 2, 0.7, 0.5)
    corners = vertices.reshape(-1, 3, 3)
    corners[:, 2] = corners[:, 1] + 0.01 * (corners[:, 2] - corners[:, 1])
    return corners.reshape(-1, 3), faces


def holes():
    """A plate of small squares, some of whose halves are left out: holes of less than a pixel."""
    x = np.linspace(-2, 2, 41)
    vertices = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((41, 41))], -1).reshape(-1, 3)
    k = np.arange(41 * 40).reshape(41, 40)[:-1] + np.arange(40)[:, None]
    k = k.ravel()
    faces = np.concatenate([np.stack([k, k + 41, k + 1], 1), np.stack([k + 41, k + 42, k + 1], 1)])
    keep = np.random.default_rng(1).random(len(faces)) > 0.1
    return vertices, faces[keep]


def pinholes():
    """A plate of two faces with a slit of a thousandth of a pixel between them."""
    y = 1e-4
    vertices = [[-3, -3, 0], [3, -3, 0], [3, -y, 0], [-3, -y, 0], [-3, 0, 0], [3, 0, 0], [0, 3, 0]]
    return np.array(vertices, float), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])


def bowl():
    """An open mesh that shows its back."""
    sphere = trimesh.creation.icosphere(3)
    sphere.update_faces(sphere.triangles_center[:, 2] < 0.2)
    return sphere.vertices, sphere.faces[:, ::-1]


def around_the_eye():
    """Faces before, behind and through the plane of the eye."""
    return loose(FACES // 4, 4.0, 2.0, 3)


MESHES = [slivers, holes, pinholes, bowl, around_the_eye]


def camera_of(dtype, seed=0, lens=None) -> pj.Camera:
    random = np.random.default_rng(seed)
    eye = np.array([0.3, 0.2, 4]) + 0.3 * random.normal(size=3)
    e, p, u, phi, d = (np.asarray(x, dtype) for x in (eye, [0.02, 0.01, 0], [0.1, 1, 0], 0.7, 1))
    return pj.Camera(e, p, u, phi, d, W, H, lens)


def wide(camera):
    return jax.tree.map(lambda x: jnp.asarray(x, float), camera)


def pixels(words):
    """Return bits (each row in whole words, from the bottom up) as an image."""
    bits = words.reshape(H, -1, 1) >> jnp.arange(32, dtype=jnp.uint32)[None, None] & 1
    return jnp.flip(bits.reshape(H, -1)[:, :W] > 0, axis=0)


@jax.jit
def covered_by_faces(camera, vertices, faces):
    film = film_map(camera)
    return pixels(surely_covered(film, [faces_of(film, vertices, faces)], jnp.array(True), ALL))


def filled(vertices, faces, dtype):
    """Return arrays of one size, so that one program serves all."""
    more = np.zeros((3 * FACES - len(vertices), 3))
    none = np.zeros((FACES - len(faces), 3), int)
    vertices = np.concatenate([vertices, more]).astype(dtype)
    return jnp.asarray(vertices), jnp.asarray(np.concatenate([faces, none]), jnp.int32)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("mesh", MESHES)
def test_no_pixel_is_called_covered_by_faces_that_is_not(mesh, dtype):
    own = mesh()
    vertices, faces = filled(own[0], own[1], dtype)
    known = np.any(np.asarray(faces) != 0, axis=1)
    for seed in range(3):
        camera = camera_of(dtype, seed)
        found = np.asarray(covered_by_faces(camera, vertices, faces))
        given = wide(camera), vertices.astype(float), np.asarray(faces)[known]
        area = mesh_coverage(*given, only=found)
        assert np.all(area[found] > 1 - 1e-9)


def test_covered_pixels_are_the_same_in_any_subset():
    """Few, some, most."""
    camera, (vertices, faces) = camera_of(float), filled(*loose(FACES, 0.5, 0.2), float)
    film = film_map(camera)
    things = [faces_of(film, vertices, faces)]
    found = jax.jit(lambda asked: surely_covered(film, things, jnp.array(True), asked))
    every = np.asarray(found(ALL))
    assert np.sum(pixels(jnp.asarray(every))) > 50
    random = np.random.default_rng(0)
    for few in (0.02, 0.3, 0.9):
        bits = random.random((2 * H, 32)) < few
        asked = np.packbits(bits, axis=1, bitorder="little").view(np.uint32)[:, 0]
        np.testing.assert_array_equal(found(jnp.asarray(asked)), every & asked)


def test_pixels_covered_by_adjacent_faces_are_found():
    corners = np.array(
        [[-1.5, -1.5, 0.1], [1.5, -1.5, 0.1], [0, 2, 0], [0.4, -2, 0.2], [3, 2, 0.2]]
    )
    camera, few = camera_of(float), np.array([[0, 1, 2], [3, 4, 2]])
    found = np.asarray(covered_by_faces(camera, *filled(corners, few, float)))
    each = [mesh_coverage(camera, corners, few[k : k + 1]) > 1 - 1e-9 for k in (0, 1)]
    assert np.sum(each[0]) > 100
    assert np.sum(each[1]) > 50
    # But for what lies within rounding of a row's line.
    assert np.mean(found[each[0] | each[1]]) > 0.98


@pytest.mark.long
def test_no_pixel_is_called_covered_by_spheres_that_is_not():
    """Small, large, through one another, about the eye, behind it and through its plane."""
    random = np.random.default_rng(0)
    centers = random.normal(0, 0.8, (300, 3))
    radii = random.uniform(0.01, 0.25, 300)
    centers[:4] = [[0.3, 0.2, 4.0], [0, 0, 6], [1.5, 0, 4.2], [-1.5, 0, 3.5]]
    radii[:4] = [0.05, 0.5, 0.9, 1.2]

    @jax.jit
    def covered(camera, spheres):
        film = film_map(camera)
        return pixels(surely_covered(film, [spheres_of(film, spheres)], jnp.array(True), ALL))

    # The same numbers in both types, as they are in the shorter one: the oracle takes long.
    camera = camera_of(np.float32, 4)
    centers, radii = centers.astype(np.float32), radii.astype(np.float32)
    apart = np.linalg.norm(centers - np.asarray(camera.e), axis=1) > radii
    polygons = sphere_polygons(wide(camera), centers[apart], radii[apart], 8000)
    area = union_per_pixel(polygons, W, H)
    for view in (camera, wide(camera)):
        balls = pj.Spheres(*(x.astype(view.e.dtype) for x in (centers, radii)))
        found = np.asarray(covered(view, balls))
        assert np.all(area[found] > 1 - 1e-5)  # of the oracle's polygons
        assert np.sum(found) > 0.6 * np.sum(area > 1 - 1e-5)


def test_distortion_switches_the_covered_test_off():
    vertices, faces = filled(*bowl(), float)
    lens = pj.Lens([W / 2, H / 2], distortion=pj.BrownConrady(k1=-0.2))

    @jax.jit
    def covered(camera, worth):
        film = film_map(camera)
        return surely_covered(film, [faces_of(film, vertices, faces)], worth, ALL)

    for camera, worth in ((camera_of(float, lens=lens), True), (camera_of(float), False)):
        assert not np.any(covered(camera, jnp.array(worth)))


@pytest.mark.long
@pytest.mark.usefixtures("in_arrays")
def test_masks_and_derivatives_are_the_same_whether_or_not_it_is_looked_for(monkeypatch):
    """A crowd of faces, of whose pixels most are passed over."""
    vertices, faces = loose(9000, 0.5, 0.2)
    scene = pj.Scene(mesh=pj.Mesh(vertices, faces))
    camera, weight = camera_of(float), np.random.default_rng(2).normal(size=(H, W))
    passed, wanted = [], [True]

    def looked(film, things, worth, asked):
        """Look for it, where that is wanted when the program runs: one program does both."""
        found = surely_covered(film, things, worth, asked)
        number = jnp.sum(jax.lax.population_count(found))
        jax.debug.callback(lambda n: passed.append(int(n)), number)
        flag = jax.pure_callback(lambda: np.bool_(wanted[0]), jax.ShapeDtypeStruct((), bool))
        return jnp.where(flag, found, 0)

    @jax.jit
    def both(camera):
        def loss(camera):
            image = pj.silhouette(camera, scene)
            return jnp.sum(weight * image), image

        slope, image = jax.grad(loss, has_aux=True, allow_int=True)(camera)
        return image, slope.e

    monkeypatch.setattr(module, "surely_covered", looked)
    image, slope = both(camera)
    jax.effects_barrier()
    assert max(passed) > 300
    np.testing.assert_allclose(image, mesh_coverage(camera, vertices, faces), atol=1e-9)
    wanted[0] = False
    plain, plain_slope = both(camera)
    np.testing.assert_allclose(image, plain, atol=1e-12)
    np.testing.assert_allclose(slope, plain_slope, rtol=1e-9, atol=1e-9)
