"""Every accelerated path gives what the plain one does, on random scenes of 0, 1, 2 and 2^k +- 1
faces: random triples of few vertices, so edges of one, two and many faces, of either winding."""

import itertools

import numpy as np
import pytest
from oracles import mesh_coverage

import pinhole_jax as pj
from pinhole_jax._scene.scene import padded

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
