"""Exact coverage of unions: overlaps, open meshes, soup, near plane, spheres among triangles.

Against the union of all projected triangles, and of spheres' outlines, by shapely. Meshes are
filled up to one size, so that they share a compiled program.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from chosen import first
from numpy.testing import assert_allclose, assert_array_equal
from oracles import filled, mesh_coverage, mesh_polygons, sphere_polygons, union_per_pixel
from slopes import both_ways

import pinhole_jax as pj

W, H = 64, 48
SHARED = ["bob.obj", "counter.stl", "cycloidal.ply", "spot.obj", "suzanne.ply", "teapot.obj"]


def noisy_sphere(subdivisions=2):
    sphere = trimesh.creation.icosphere(subdivisions)
    noise = np.random.default_rng(1).normal(size=(len(sphere.vertices), 1))
    return sphere.vertices * (1 + 0.08 * noise), sphere.faces


def bowl():
    sphere = trimesh.creation.icosphere(2)
    sphere.update_faces(sphere.triangles_center[:, 2] < 0.2)
    return sphere.vertices, sphere.faces


def crowd(number=200, subdivisions=1):
    random, ball = np.random.default_rng(2), trimesh.creation.icosphere(subdivisions)
    sizes, places = random.uniform(0.03, 0.15, number), random.uniform(-1, 1, (number, 3))
    vertices = [ball.vertices * r + c for r, c in zip(sizes, places, strict=True)]
    faces = [ball.faces + k * len(ball.vertices) for k in range(number)]
    return np.concatenate(vertices), np.concatenate(faces)


def soup(number=100):
    random = np.random.default_rng(3)
    corners = random.uniform(-1, 1, (number, 1, 3)) + 0.25 * random.normal(size=(number, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * number).reshape(-1, 3)


def room():
    """A box without a wall: rays along the axes meet corners' diagonals exactly."""
    box = trimesh.creation.box(extents=[2, 2, 2])
    return box.vertices, box.faces[box.face_normals[:, 2] < 0.5]


def turned_faces():
    vertices, faces = noisy_sphere()
    turn = np.random.default_rng(4).random(len(faces)) < 0.4
    return vertices, np.where(turn[:, None], faces[:, ::-1], faces)


MESHES = {
    "noisy sphere": noisy_sphere,
    "crowd of 200": crowd,
    "bowl": bowl,
    "soup": soup,
    "turned faces": turned_faces,
    "room": room,
    "rough sphere": lambda: rough(4, 0.12),  # tens of pieces in a pixel, nearly all of them hidden
    "rougher sphere": lambda: rough(4, 1.2),
}


def cameras(number, dtype=float, W=W, H=H):
    """Return cameras from within to far; some look past the object, some see a part."""
    random = np.random.default_rng(5)
    from_origin = ([0, 0, 0], [1, 0, 1], [0, 1, 0], 1.9, 1.0)
    yield pj.Camera(*(np.asarray(x, dtype) for x in from_origin), W, H)
    for k in range(number - 1):
        direction = random.normal(size=3)
        eye = direction / np.linalg.norm(direction) * [4, 1.3, 2, 0.4, 6][k % 5]
        aim = random.normal(size=3) * [0.3, 0.8, 0.6, 0.5, 0.1][k % 5]
        phi = [0.6, 1.2, 0.8, 1.6, 0.5][k % 5]
        arrays = (np.asarray(x, dtype) for x in (eye, aim, random.normal(size=3), phi, 1.0))
        yield pj.Camera(*arrays, W, H)


def in_scene(vertices, faces) -> pj.Scene:
    return pj.Scene(mesh=filled(vertices, faces, 20_000))


@pytest.mark.parametrize(
    ("name", "dtype"),
    first(1, [*((name, "float64") for name in MESHES), *((name, "float32") for name in MESHES)], 3),
)
def test_meshes_match_the_polygon_union(name, dtype, exhaustive):
    vertices, faces = MESHES[name]()
    vertices = vertices.astype(dtype)
    scene = in_scene(vertices, faces)
    for camera in cameras(20 if exhaustive else 5 if dtype == "float64" else 2, dtype):
        expected = mesh_coverage(camera, vertices, faces)
        tolerance = 1e-9 if dtype == "float64" else 1e-4
        assert_allclose(pj.silhouette(camera, scene), expected, atol=tolerance)


@pytest.mark.long
@pytest.mark.parametrize("name", SHARED)
def test_real_meshes_match_the_polygon_union(name, shared, exhaustive):
    mesh = pj.load_mesh(shared / "meshes" / name)
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = (vertices - (low + high) / 2) / np.max(high - low) * 2
    if len(faces) > 20_000 and not exhaustive:
        pytest.skip("large: only with --exhaustive")
    scene = pj.Scene(mesh=filled(vertices, faces, max(20_000, len(vertices), len(faces))))
    for camera in cameras(20 if exhaustive else 3):
        expected = mesh_coverage(camera, vertices, faces)
        assert_allclose(pj.silhouette(camera, scene), expected, atol=1e-9)


SPHERES = {
    "apart": ([[-0.9, 0.3, 0], [0.5, -0.7, 1], [0.6, 0.6, -1]], [0.4, 0.15, 0.35]),
    "overlap": ([[0, 0, 0], [0.9, 0.2, 0.3], [0.3, 0.8, -0.5]], [0.7, 0.5, 0.4]),
    "crosses the plane of the eye": ([[0.3, -1.2, 4.8], [-1.5, 0.2, 5.1]], [1.1, 1.4]),
    "touches the plane of the eye": ([[1.5, 0, 4.0]], [1.0]),
    "one within another, nearly touching": ([[0, 0, 0], [0.3, 0, 0], [0, 0, 0]], [1.0, 0.7, 1.0]),
    "below a pixel": ([[0.05, 0.03, 0], [0.051, 0.03, 0], [0.9, 0.1, 0]], [5e-4, 5e-4, 0.01]),
}


@pytest.mark.parametrize(
    ("name", "mixed"), first(1, [(name, mixed) for mixed in (False, True) for name in SPHERES], 2)
)
def test_spheres_match_their_outlines(name, mixed):
    centers, radii = (np.array(x, float) for x in SPHERES[name])
    vertices, faces = soup(20)
    camera = pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], 0.9, W=W, H=H)
    polygons = sphere_polygons(camera, centers, radii)
    polygons += mesh_polygons(camera, vertices, faces) if mixed else []
    out_of_sight = np.array([[9.0, k, 0] for k in range(3 - len(radii))]).reshape(-1, 3)
    spheres = pj.Spheres(
        np.concatenate([centers, out_of_sight]), np.append(radii, np.ones(len(out_of_sight)))
    )
    scene = pj.Scene(mesh=pj.Mesh(vertices, faces) if mixed else None, spheres=spheres)
    expected = union_per_pixel(polygons, W, H)
    assert_allclose(pj.silhouette(camera, scene), expected, atol=1e-6)


@pytest.mark.long
def test_eye_inside_a_closed_body_sees_nothing_else():
    camera = pj.Camera([0.1, 0, 0.2], [0, 1, 0], [0, 0, 1], 0.9, W=W, H=H)
    spheres = pj.Spheres([[0, 0, 0], [0, 3, 0], [1, 1, 0]], [0.5, 0.1, 0.2])
    for scene in (pj.Scene(spheres=spheres), in_scene(*noisy_sphere())):
        assert_array_equal(pj.silhouette(camera, scene), 1)


@pytest.mark.long
@pytest.mark.usefixtures("both_ways")
@pytest.mark.parametrize(
    ("size", "copies", "triangles"), [((2, 2), 1, 60), ((4, 3), 1, 60), ((W, H), 3000, 1)]
)
def test_pixel_that_holds_everything_is_resolved(size, copies, triangles):
    """Hundreds of pieces, which arrays cut until few are left; and more of them than arrays list at
    once, which are copies."""
    vertices, faces = soup(triangles)
    camera = pj.Camera([0, 0, 30], [0, 0, 0], [0, 1, 0], 0.3, 1.0, *size)
    every = np.tile(vertices, (copies, 1))
    mesh = pj.Mesh(every, np.arange(len(every)).reshape(-1, 3))
    expected = mesh_coverage(camera, vertices, faces)
    assert_allclose(pj.silhouette(camera, pj.Scene(mesh=mesh)), expected, atol=1e-9)


def leaves(moving):
    camera, scene = moving
    parts = scene.mesh.vertices, *jax.tree.leaves(scene.spheres)
    return camera.e, camera.p, camera.u, camera.phi, *parts


def rough(subdivisions, noise, seed=0):
    """A sphere whose vertices are off by this many edges, in all directions."""
    sphere = trimesh.creation.icosphere(subdivisions)
    edge = sphere.edges_unique_length.mean()
    off = np.random.default_rng(seed).normal(0, noise * edge, sphere.vertices.shape)
    return sphere.vertices + off, sphere.faces


@pytest.mark.long
def test_no_pixel_of_a_rough_mesh_is_wrong_in_float32():
    """Parts of pixels have corners that agree with their pieces, however these are rounded."""
    vertices, faces = rough(6, 0.25)
    single = pj.Scene(mesh=pj.Mesh(vertices.astype(np.float32), faces))
    double = pj.Scene(mesh=pj.Mesh(vertices.astype(np.float32).astype(float), faces))
    for camera in cameras(6, np.float32, 200, 150):
        wide = jax.tree.map(lambda x: x.astype(float), camera)
        expected = pj.silhouette(wide, double)
        assert_allclose(pj.silhouette(camera, single), expected, atol=5e-4)


@pytest.fixture(scope="module")
def mixed():
    camera = pj.Camera([0.3, 0.4, 4], [0, 0, 0], [0.1, 1, 0], 0.6, W=24, H=18)
    balls = pj.Spheres([[0.4, 0.3, 0.2], [-0.3, 0.1, 0.5]], [0.3, 0.35])
    return camera, pj.Scene(mesh=pj.Mesh(*soup(12)), spheres=balls)


@jax.jit
def pushed_and_pulled(mixed, directions, weight):
    """Return the image, its derivative along directions of all leaves, and those of its weighted
    sum by all leaves: one program for all."""
    image = lambda x: pj.silhouette(*eqx.tree_at(leaves, mixed, x))
    return both_ways(image, leaves(mixed), directions, weight)


@pytest.mark.long
def test_derivatives_of_a_union_equal_central_differences_of_the_oracle(mixed):
    random, start = np.random.default_rng(0), leaves(mixed)
    weight = random.normal(size=(mixed[0].H, mixed[0].W))

    def oracle(way, step):
        moved = tuple(x + step * d for x, d in zip(start, way, strict=True))
        camera, scene = eqx.tree_at(leaves, mixed, moved)
        polygons = mesh_polygons(camera, scene.mesh.vertices, scene.mesh.faces)
        polygons += sphere_polygons(camera, scene.spheres.centers, scene.spheres.radii, 100_000)
        return union_per_pixel(polygons, camera.W, camera.H)

    for k, direction in enumerate([random.normal(size=x.shape) for x in start]):
        way = tuple(direction if n == k else jnp.zeros_like(x) for n, x in enumerate(start))
        _, column, gradient = pushed_and_pulled(mixed, way, weight)
        slope = np.sum(gradient[k] * direction)
        assert_allclose(slope, np.sum(weight * column), rtol=1e-10, atol=1e-10)
        expected = (oracle(way, 1e-5) - oracle(way, -1e-5)) / 2e-5
        # Per pixel the oracle's polygons err by 1e-8 px^2, over the step 1e-3 at most; the loss
        # averages that out.
        assert_allclose(column, expected, atol=2e-5 * np.abs(expected).max())
        assert_allclose(slope, np.sum(weight * expected), rtol=1e-5)
