"""Every accelerated path gives what the plain one does, on random scenes of 0, 1, 2 and 2^k +- 1
faces: random triples of few vertices, so edges of one, two and many faces, of either winding."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import mesh_coverage
from views import taken

import pinhole_jax as pj
from pinhole_jax._mask.pyramid import pyramid
from pinhole_jax._mask.target import object_window
from pinhole_jax._scene.scene import padded
from pinhole_jax._solver.moves import canonical

SIZES = sorted({0, 1, 2} | {2**k + d for k in range(1, 8) for d in (-1, 1)})
FEW = [0, 1, 2, 33]
CAMERA = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 12, 10)


@pytest.fixture
def sizes(exhaustive) -> list[int]:
    """Each size compiles programs of its own: the default run tries few."""
    return SIZES if exhaustive else FEW


def soup(faces: int, extent: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and different triples of them, in any turn."""
    random = np.random.default_rng(faces)
    vertices = extent * random.uniform(-1, 1, (faces // 2 + 4, 3))
    triples = np.array([*itertools.combinations(range(len(vertices)), 3)])
    chosen = random.permutation(len(triples))[:faces]
    return vertices, random.permuted(triples[chosen], axis=1)


@pytest.mark.long
def test_image_is_the_union_of_all_faces(sizes):
    for faces in sizes:
        vertices, triangles = soup(faces)
        image = pj.silhouette(CAMERA, padded(pj.Scene(mesh=pj.Mesh(vertices, triangles))))
        np.testing.assert_allclose(image, mesh_coverage(CAMERA, vertices, triangles), atol=1e-11)


@pytest.mark.long
@pytest.mark.parametrize("faces", [0, 2])
def test_padding_changes_no_bit(faces):
    scene = pj.Scene(mesh=pj.Mesh(*soup(faces)))
    np.testing.assert_array_equal(
        pj.silhouette(CAMERA, scene), pj.silhouette(CAMERA, padded(scene))
    )


def plain_hits(vertices, faces, origin, direction) -> tuple[np.ndarray, np.ndarray]:
    """Return distance and face of the nearest hit of each ray, by volumes of tetrahedra."""
    best, which = np.full(len(direction), np.inf), np.full(len(direction), -1)
    for number, face in enumerate(faces):
        a, b, c = (np.broadcast_to(v, direction.shape) for v in vertices[face] - origin)
        u, v, w = (np.sum(direction * np.cross(x, y), axis=1) for x, y in ((b, c), (c, a), (a, b)))
        inside = ((u >= 0) & (v >= 0) & (w >= 0)) | ((u <= 0) & (v <= 0) & (w <= 0))
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.sum(a * np.cross(b, c), axis=1) / (u + v + w)
        nearer = inside & (t > 0) & (t < best)
        best[nearer], which[nearer] = t[nearer], number
    return best, which


@pytest.mark.long
def test_tree_and_packets_match_brute_force(sizes):
    for faces in sizes:
        vertices, triangles = soup(faces)
        scene = pj.Scene(mesh=pj.Mesh(vertices, triangles))
        rays = pj.camera_rays(pj.Camera(CAMERA.e, CAMERA.p, CAMERA.u, 0.6, 1.0, 37, 29))
        flat = np.asarray(rays.direction).reshape(-1, 3)
        t, face = plain_hits(vertices, triangles, np.asarray(rays.origin), flat)
        one_by_one = pj.Rays(rays.origin, jnp.asarray(flat))
        for hit in (pj.trace(scene, rays), pj.trace(scene, one_by_one)):
            np.testing.assert_array_equal(np.ravel(hit.primitive), face)
            np.testing.assert_allclose(np.ravel(hit.t), t, rtol=1e-10)


@pytest.mark.long
def test_window_of_the_film_matches_the_whole_film(sizes):
    for faces in sizes[1:]:  # there is no fit to an empty scene
        vertices, triangles = soup(faces, 0.3)
        camera = pj.Camera(CAMERA.e, CAMERA.p, CAMERA.u, 0.6, 1.0, 96, 80)
        scene = padded(pj.Scene(mesh=pj.Mesh(vertices, triangles)))
        random = np.random.default_rng(0)
        target = np.zeros((80, 96))
        target[30:50, 35:60] = random.random((20, 25))
        window = object_window(target)
        assert (window.W, window.H) != (96, 80)
        values = []
        for part in (window, None):
            data, levels = pyramid(target, np.ones_like(target), float, window=part)
            sums = taken(canonical(camera), scene, data, levels[-1]).sums
            values.append([sums.squares, sums.overlap, sums.union])
        np.testing.assert_allclose(*values, rtol=1e-12, atol=1e-12)
