"""Coverage against the union of all projected triangles and of spheres' outlines: shapely.

Closed and open meshes, soup, the plane of the eye, spheres among triangles. Meshes are filled up to
one size, so that they share a compiled program.
"""

import equinox as eqx
import jax
import numpy as np
import pytest
import shapely
import trimesh
from chosen import first, full, long
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from oracles import (
    QUAD,
    balls,
    body,
    camera_ahead,
    cast,
    coverage,
    filled,
    mesh_coverage,
    normal,
    random_camera,
    single,
    union_per_pixel,
    usual_camera,
)
from slopes import both_ways

import pinhole_jax as pj
from pinhole_jax import shapes

W, H = 64, 48
SHARED = "bob.obj counter.stl cycloidal.ply spot.obj suzanne.ply teapot.obj"


def gentle(seed=0):
    """Gentle bumps: seen from anywhere no fold of the contour shares a pixel with the outline."""
    mesh = shapes.bumpy(3, seed, bumps=0.006)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def noisy_sphere():
    sphere = trimesh.creation.icosphere(2)
    noise = normal((len(sphere.vertices), 1), 1)
    return sphere.vertices * (1 + 0.08 * noise), sphere.faces


def bowl():
    sphere = trimesh.creation.icosphere(2)
    sphere.update_faces(sphere.triangles_center[:, 2] < 0.2)
    return sphere.vertices, sphere.faces


def crowd(number=200):
    random, ball = default_rng(2), trimesh.creation.icosphere(1)
    sizes, places = random.uniform(0.03, 0.15, number), random.uniform(-1, 1, (number, 3))
    vertices = [size * ball.vertices + place for size, place in zip(sizes, places, strict=True)]
    return trimesh.util.append_faces(vertices, number * [ball.faces])


def soup(number=100):
    random = default_rng(3)
    corners = random.uniform(-1, 1, (number, 1, 3)) + 0.25 * random.normal(size=(number, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * number).reshape(-1, 3)


def room():
    """A box without a wall: rays along the axes meet corners' diagonals exactly."""
    box = trimesh.creation.box(extents=[2, 2, 2])
    return box.vertices, box.faces[box.face_normals[:, 2] < 0.5]


def turned_faces():
    vertices, faces = noisy_sphere()
    turn = default_rng(4).random(len(faces)) < 0.4
    return vertices, np.where(turn[:, None], faces[:, ::-1], faces)


def rough(subdivisions, noise):
    """A sphere whose vertices are off by this many edges, in all directions."""
    sphere = trimesh.creation.icosphere(subdivisions)
    edge = sphere.edges_unique_length.mean()
    off = default_rng(0).normal(0, noise * edge, sphere.vertices.shape)
    return sphere.vertices + off, sphere.faces


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
    random = default_rng(5)
    yield cast(pj.Camera([0, 0, 0], [1, 0, 1], [0, 1, 0], 1.9, 1.0, W, H), dtype)
    for k in range(number - 1):
        direction = random.normal(size=3)
        eye = direction / np.linalg.norm(direction) * [4, 1.3, 2, 0.4, 6][k % 5]
        aim = random.normal(size=3) * [0.3, 0.8, 0.6, 0.5, 0.1][k % 5]
        phi = [0.6, 1.2, 0.8, 1.6, 0.5][k % 5]
        yield cast(pj.Camera(eye, aim, random.normal(size=3), phi, 1.0, W, H), dtype)


def in_scene(vertices, faces):
    return pj.Scene(filled(vertices, faces, max(20_000, len(vertices), len(faces))))


def check(camera, scene, tolerance):
    """Assert that a silhouette is the union of all that is projected, and return it."""
    image = pj.silhouette(camera, scene)
    assert_allclose(image, coverage(camera, scene), atol=tolerance)
    return image


@pytest.mark.parametrize(
    "seed, kind, of_mesh, lens",
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
    vertices, faces = gentle(seed)
    camera = random_camera(default_rng(seed), 40, 32).replace(lens=lens)
    camera = cast(camera, kind)
    close = 1e-9 if kind == of_mesh == "float64" else 1e-4
    image = check(camera, body(vertices.astype(of_mesh), faces), close)
    assert image.dtype == kind
    assert 0.05 < np.mean(image) < 0.9


@pytest.mark.parametrize(
    "name, dtype", first(1, [(name, f"float{n}") for n in (64, 32) for name in MESHES], 3)
)
def test_open_and_overlapping_meshes_match_the_polygon_union(name, dtype, exhaustive):
    vertices, faces = MESHES[name]()
    scene = in_scene(vertices.astype(dtype), faces)
    for camera in cameras(20 if exhaustive else 5 if dtype == "float64" else 2, dtype):
        check(camera, scene, 1e-9 if dtype == "float64" else 1e-4)


@pytest.mark.long
@pytest.mark.parametrize("name", SHARED.split())
def test_real_meshes_match_the_polygon_union(name, shared, exhaustive):
    mesh = pj.load_mesh(shared / "meshes" / name)
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if len(faces) > 20_000 and not exhaustive:
        pytest.skip("large: only with --exhaustive")
    scene = in_scene((vertices - (low + high) / 2) / np.max(high - low) * 2, faces)
    for camera in cameras(20 if exhaustive else 3):
        check(camera, scene, 1e-9)


#: Centres and radii of three spheres each. (Where fewer are meant, others are out of sight.)
SPHERES = {
    "apart": "-0.9 0.3 0 0.4    0.5 -0.7 1 0.15    0.6 0.6 -1 0.35",
    "overlap": "0 0 0 0.7    0.9 0.2 0.3 0.5    0.3 0.8 -0.5 0.4",
    "crosses the plane of the eye": "0.3 -1.2 4.8 1.1    -1.5 0.2 5.1 1.4    9 0 0 1",
    "touches the plane of the eye": "1.5 0 4 1    9 0 0 1    9 1 0 1",
    "one within another, nearly touching": "0 0 0 1    0.3 0 0 0.7    0 0 0 1",
    "below a pixel": "0.05 0.03 0 5e-4    0.051 0.03 0 5e-4    0.9 0.1 0 0.01",
}


@pytest.mark.parametrize(
    "name, mixed", first(1, [(name, mixed) for mixed in (False, True) for name in SPHERES], 2)
)
def test_spheres_match_their_outlines(name, mixed):
    *centers, radii = np.array(SPHERES[name].split(), float).reshape(3, 4).T
    camera = camera_ahead(W, H).replace(phi=0.9)
    mesh = pj.Mesh(*soup(20)) if mixed else None
    check(camera, balls(np.transpose(centers), radii, mesh), 1e-6)


@pytest.mark.long
def test_eye_inside_a_closed_body_sees_nothing_else():
    camera = pj.Camera([0.1, 0, 0.2], [0, 1, 0], [0, 0, 1], 0.9, W=W, H=H)
    spheres = balls([[0, 0, 0], [0, 3, 0], [1, 1, 0]], [0.5, 0.1, 0.2])
    for scene in (spheres, in_scene(*noisy_sphere())):
        assert_array_equal(pj.silhouette(camera, scene), 1)


@pytest.mark.long
@pytest.mark.usefixtures("both_ways")
@pytest.mark.parametrize(
    "size, copies, triangles",
    [((2, 2), 1, 60), ((4, 3), 1, 60), ((3, 2), 1, 200), ((W, H), 3000, 1)],
)
def test_pixel_that_holds_everything_is_resolved(size, copies, triangles):
    """Hundreds of pieces, which arrays cut until few are left; and more of them than arrays list at
    once, which are copies."""
    vertices, faces = soup(triangles)
    camera = camera_ahead(*size).replace(e=[0, 0, 30], phi=0.3)
    every = np.tile(vertices, (copies, 1))
    scene = body(every, np.arange(len(every)).reshape(-1, 3))
    expected = mesh_coverage(camera, vertices, faces)
    assert_allclose(pj.silhouette(camera, scene), expected, atol=1e-9)


def quadrilaterals(w, h, number):
    """Yield corners (4, 2) of convex polygons in px, below a pixel and huge ones, thin ones, those
    on the grid; the last ones are three times the same."""
    random = default_rng(0)
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
        expected = union_per_pixel([shapely.Polygon(corners)], w, h)
        image = pj.silhouette(camera, body(np.pad(corners, ((0, 0), (0, 1))), QUAD))
        assert_allclose(image, expected, atol=1e-9 if size > 10 else 1e-13)


def check_float32(cameras, scene, tolerance):
    """Assert that masks in float32 are about those of the same numbers in float64."""
    for camera in cameras:
        expected = pj.silhouette(*cast((camera, scene), float))
        assert_allclose(pj.silhouette(camera, scene), expected, atol=tolerance)


@pytest.mark.long
@pytest.mark.usefixtures("in_arrays")
def test_no_row_of_a_large_float32_image_is_covered_by_mistake():
    """Many curves pass within rounding of a pixel's corner there."""
    random = default_rng(0)
    views = [single(random_camera(random, 1024, 1024)) for _ in range(3)]
    check_float32(views, single(body(*gentle())), 2e-3)


@pytest.mark.long
def test_no_pixel_of_a_rough_mesh_is_wrong_in_float32():
    """Parts of pixels have corners that agree with their pieces, however these are rounded."""
    scene = single(body(*rough(6, 0.25)))
    check_float32(cameras(6, np.float32, 200, 150), scene, 5e-4)


@pytest.mark.long
def test_thousand_views_take_memory_for_their_masks_and_one():
    scene = body(*gentle())
    camera = usual_camera(W, H)
    at = lambda e: pj.silhouette(eqx.tree_at(lambda c: c.e, camera, e), scene)
    eyes = np.broadcast_to(camera.e, (1000, 3))
    used = [
        jax.jit(f).lower(x).compile().memory_analysis().temp_size_in_bytes
        for f, x in ((at, eyes[0]), (jax.vmap(at), eyes))
    ]
    masks = 8 * 1000 * W * H
    assert used[1] < 2 * used[0] + 2 * masks, (used, masks)


def moving(view):
    camera, scene = view
    parts = scene.mesh.vertices, *jax.tree.leaves(scene.spheres)
    return camera.e, camera.p, camera.u, camera.phi, *parts


@pytest.fixture(scope="module")
def mixed():
    camera = pj.Camera([0.3, 0.4, 4], [0, 0, 0], [0.1, 1, 0], 0.6, W=24, H=18)
    return camera, balls([[0.4, 0.3, 0.2], [-0.3, 0.1, 0.5]], [0.3, 0.35], pj.Mesh(*soup(12)))


@jax.jit
def pushed_and_pulled(mixed, directions, weight):
    """Return the image, its derivative along directions of all leaves, and those of its weighted
    sum by all leaves: one program for all."""
    image = lambda x: pj.silhouette(*eqx.tree_at(moving, mixed, x))
    return both_ways(image, moving(mixed), directions, weight)


@pytest.mark.long
def test_derivatives_of_a_union_equal_central_differences_of_the_oracle(mixed):
    random, start = default_rng(0), moving(mixed)
    weight = random.normal(size=(mixed[0].H, mixed[0].W))

    def oracle(way, step):
        moved = tuple(x + step * d for x, d in zip(start, way, strict=True))
        return coverage(*eqx.tree_at(moving, mixed, moved))

    for k, direction in enumerate([random.normal(size=x.shape) for x in start]):
        way = tuple(direction if n == k else np.zeros_like(x) for n, x in enumerate(start))
        _, column, gradient = pushed_and_pulled(mixed, way, weight)
        slope = np.sum(gradient[k] * direction)
        assert_allclose(slope, np.sum(weight * column), rtol=1e-10, atol=1e-10)
        expected = (oracle(way, 1e-5) - oracle(way, -1e-5)) / 2e-5
        # Per pixel the oracle's polygons err by 1e-8 px^2, over the step 1e-3 at most; the loss
        # averages that out.
        assert_allclose(column, expected, atol=2e-5 * np.abs(expected).max())
        assert_allclose(slope, np.sum(weight * expected), rtol=1e-5)
