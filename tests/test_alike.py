"""Lines that a body is round about and turns that bring its faces to one another, against how the
body was made."""

import numpy as np
import pytest
import trimesh
from chosen import first
from numpy.random import default_rng
from oracles import normal
from refusals import pairs
from scipy.spatial.transform import Rotation

from pinhole_jax._scene.alike import Alike

TURN, SHIFT = Rotation.from_rotvec([0.4, 1.1, -0.7]).as_matrix(), np.array([3.0, -4.0, 5.0])


def handle(at, radius=0.35, **dense):
    sections = {"major_sections": 24, "minor_sections": 12, **dense}
    ring = trimesh.creation.torus(radius, 0.08, **sections)
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    return ring.apply_translation([at, 0, 0])


def can(sections, height=2.0):
    return trimesh.creation.cylinder(0.8, height, sections)


def bump(at=(0.8, 0, 0.3), subdivisions=2):
    return trimesh.creation.icosphere(subdivisions, 0.15).apply_translation(at)


def revolved(height, radius, sections=48):
    profile = np.stack([radius, height], axis=-1)
    return trimesh.creation.revolve(profile, sections=sections)


CUT = np.linspace(-0.5, 1, 24)
POT = revolved(np.append(-0.5, CUT), np.append(0, np.sqrt(np.maximum(1 - CUT**2, 0)))) + handle(1.0)
#: Bodies about the z axis, and how many facets they have.
ROUND = [
    *((can(64, h) + handle(0.85), 64) for h in (0.96, 1.2, 1.36, 1.6, 2.08)),
    (can(64) + handle(0.85, major_sections=200, minor_sections=100), 64),
    *((part, n) for n in (20, 48, 64) for part in (can(n) + handle(0.85), can(n) + bump(), can(n))),
    (POT, 48),
    (revolved(np.linspace(-1, 1, 150), np.ones(150), 64), 64),
    (revolved(np.linspace(-1, 1, 600), np.ones(600), 32), 32),
]


def alike(vertices, faces=()):
    faces = np.asarray(faces, int).reshape(-1, 3)
    return Alike(np.asarray(vertices), faces, np.zeros(3))


@pytest.mark.parametrize("turn, scale", first(1, [(TURN, 1e-3), (TURN, 1e4), (np.eye(3), 1.0)]))
def test_axis_and_facets_are_recovered(turn, scale):
    for body, sections in ROUND:
        (line,) = alike(scale * (np.asarray(body.vertices) @ turn.T + SHIFT)).lines
        axis = turn @ [0, 0, 1]
        assert abs(line.axis @ axis) > np.cos(np.deg2rad(0.2))
        off = line.centre - scale * SHIFT
        assert np.linalg.norm(off - (off @ axis) * axis) < 0.003 * scale
        assert line.pitch == pytest.approx(2 * np.pi / sections)


def test_smooth_body_has_no_facets():
    """Of places at random, or of a million on two circles."""
    around = lambda angle, height: np.stack(
        [(1 + 0.2 * height) * np.cos(angle), (1 + 0.2 * height) * np.sin(angle), 2 * height], -1
    )
    random = default_rng(0).uniform([0, -1], [2 * np.pi, 1], (4000, 2))
    circle = around(np.linspace(0, 2 * np.pi, 500_000, endpoint=False), np.ones(500_000))
    for vertices in (around(*random.T), np.concatenate([circle, -circle])):
        (line,) = alike(vertices).lines
        assert line.pitch is None


@pytest.mark.parametrize(
    "vertices",
    [
        *(np.zeros((0, 3)), np.ones((1, 3)), np.ones((9, 3)), np.eye(3)[:2]),
        *(1e308 * np.eye(9, 3), 1.7e308 * default_rng(1).uniform(-1, 1, (2000, 3))),
        *(trimesh.creation.box(size).vertices for size in ([1.2, 1.32, 1.05], [1.7, 1.2, 0.08])),
        trimesh.creation.icosphere(3).vertices * [1.1, 0.8, 0.95],
        *(normal((500, 3), 1) * x for x in ([1, 1, 0], [1, 0, 0])),
    ],
)
def test_angular_body_has_no_axis(vertices):
    assert alike(vertices).lines == []


def test_robots_and_animals_are_not_round_and_a_ball_is_about_three_axes(shared):
    assert len(alike(trimesh.creation.icosphere(4).vertices).lines) == 3
    for name in ("meshes/spot.obj", "robots/lbr_med7/mesh/link_2.stl", "knee/femur.stl"):
        assert alike(trimesh.load(shared / name, force="mesh").vertices).lines == []


TURNED = {
    "ball": (trimesh.creation.icosphere(3), 59),
    "can": (can(24), 47),
    "can with a bump": (can(24) + bump(at=(0.8, 0.1, 0.3), subdivisions=1), 47),
    "brick": (trimesh.creation.box([1.0, 2.0, 3.0]), 3),
    "ring": (trimesh.creation.torus(1, 0.3, major_sections=20, minor_sections=8), 39),
}


@pairs("name, mesh, number", TURNED)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_body_has_the_rotations_it_was_made_with(name, mesh, number, scale):
    vertices = scale * (np.asarray(mesh.vertices) @ TURN.T + SHIFT)
    found = alike(vertices.astype(np.float32), mesh.faces).turns
    assert len(found) == number
    for rotation, _ in found:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-6)


def test_mesh_of_no_area_or_with_noise_has_no_rotations():
    ball = trimesh.creation.icosphere(3)
    noise = normal(ball.vertices.shape)
    for vertices, faces in (
        (np.zeros((0, 3)), []),
        (np.zeros((3, 3)), [[0, 1, 2]] * 9),
        (np.eye(3), [[0, 1, 2]]),
        (np.arange(9.0).reshape(3, 3), [[0, 1, 2]] * 4),
        (ball.vertices + 1e-3 * noise, ball.faces),
    ):
        assert alike(vertices, faces).turns == []
