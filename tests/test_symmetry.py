"""Turns that bring a mesh's faces to one another, against those of the bodies it was made of."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pinhole_jax._solver.symmetry import turns_of_a_mesh


def with_a_part(body, radius=0.15, at=(0.8, 0.1, 0.3)):
    part = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    part.apply_translation(at)
    return body + part


@pytest.mark.parametrize(
    ("mesh", "number"),
    [
        (trimesh.creation.icosphere(3), 59),
        (trimesh.creation.cylinder(0.8, 2, sections=24), 47),
        (with_a_part(trimesh.creation.cylinder(0.8, 2, sections=24)), 47),
        (trimesh.creation.box([1.0, 2.0, 3.0]), 3),
        (trimesh.creation.box([1.0, 1.3, 3.0]), 3),
        (trimesh.creation.torus(1, 0.3, major_sections=20, minor_sections=8), 39),
    ],
    ids=["ball", "can", "can with a bump", "brick", "another", "ring"],
)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_body_has_the_rotations_it_was_made_with(mesh, number, scale):
    turn = Rotation.from_rotvec([0.4, 1.1, -0.7]).as_matrix()
    vertices = scale * (np.asarray(mesh.vertices) @ turn.T + [3.0, -4.0, 5.0])
    found = turns_of_a_mesh(vertices.astype(np.float32), np.asarray(mesh.faces))
    assert len(found) == number
    for rotation, _ in found:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), int)),
        (np.zeros((3, 3)), [[0, 1, 2]] * 9),
        (np.eye(3), [[0, 1, 2]]),
        (np.arange(9.0).reshape(3, 3), [[0, 1, 2]] * 4),
    ],
    ids=["none", "a point", "one face", "a line"],
)
def test_mesh_without_area_has_no_rotations(vertices, faces):
    assert turns_of_a_mesh(vertices, np.asarray(faces)) == []


def test_noise_leaves_no_turn():
    ball = trimesh.creation.icosphere(3)
    noise = np.random.default_rng(0).normal(size=ball.vertices.shape)
    assert turns_of_a_mesh(np.asarray(ball.vertices) + 1e-3 * noise, np.asarray(ball.faces)) == []
