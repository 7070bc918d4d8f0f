"""Lines that a body is round about and turns that bring its faces to one another, against how the
body was made."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pinhole_jax._scene.alike import Alike

TURN, SHIFT = Rotation.from_rotvec([0.4, 1.1, -0.7]).as_matrix(), np.array([3.0, -4.0, 5.0])


def handle(at, major=24, minor=12):
    ring = trimesh.creation.torus(0.35, 0.08, major_sections=major, minor_sections=minor)
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    ring.apply_translation([at, 0, 0])
    return ring


def mug(sections, height=2.0, **dense):
    body = trimesh.creation.cylinder(radius=0.8, height=height, sections=sections)
    return np.asarray((body + handle(0.85, **dense)).vertices)


def with_bump(sections):
    body = trimesh.creation.cylinder(radius=0.8, height=2, sections=sections)
    bump = trimesh.creation.icosphere(subdivisions=2, radius=0.15)
    bump.apply_translation([0.8, 0, 0.3])
    return np.asarray((body + bump).vertices)


def pot(cut):
    """A ball cut off, with a handle."""
    height = np.linspace(cut, 1, 24)
    profile = np.stack([np.sqrt(np.maximum(1 - height**2, 0)), height], axis=-1)
    body = trimesh.creation.revolve(np.concatenate([[[0, cut]], profile]), sections=48)
    return np.asarray((body + handle(1.0)).vertices)


def rings(sections, number):
    """A can whose vertices are in the order of its rings."""
    angle = 2 * np.pi * np.arange(sections) / sections
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return np.concatenate([ring + np.array([0, 0, z]) for z in np.linspace(-1, 1, number)])


@pytest.mark.parametrize("turn", [np.eye(3), TURN])
@pytest.mark.parametrize(
    ("vertices", "sections"),
    [
        *((mug(64, h), 64) for h in (0.96, 1.2, 1.36, 1.6, 2.08)),
        (pot(-0.5), 48),
        (rings(64, 150), 64),
        (rings(32, 600), 32),
        (mug(64, major=200, minor=100), 64),
    ],
)
def test_bodies_as_people_model_them(vertices, sections, turn):
    lines = lines_of(vertices @ turn.T)
    assert len(lines) == 1
    assert abs(lines[0].axis @ turn @ [0, 0, 1]) > np.cos(np.deg2rad(0.2))
    assert lines[0].pitch == pytest.approx(2 * np.pi / sections)


def lines_of(vertices):
    return Alike(np.asarray(vertices), np.zeros((0, 3), int), np.zeros(3)).lines


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize(
    "make", [mug, with_bump, lambda n: trimesh.creation.cylinder(0.5, 2, sections=n).vertices]
)
@pytest.mark.parametrize("sections", [20, 48, 64])
def test_axis_and_facets_are_recovered(make, sections, scale):
    (line,) = lines_of(scale * (np.asarray(make(sections)) @ TURN.T + SHIFT))
    axis = TURN @ [0, 0, 1]
    assert abs(line.axis @ axis) > np.cos(np.deg2rad(0.2))
    off = line.centre - scale * SHIFT
    assert np.linalg.norm(off - (off @ axis) * axis) < 0.003 * scale
    assert line.pitch == pytest.approx(2 * np.pi / sections)


def test_smooth_body_has_no_facets():
    angle, height = np.random.default_rng(0).uniform([0, -1], [2 * np.pi, 1], (4000, 2)).T
    radius = 1 + 0.2 * height
    around = radius * np.cos(angle), radius * np.sin(angle)
    (line,) = lines_of(np.stack([*around, 2 * height], axis=-1))
    assert line.pitch is None


def test_million_vertices_on_a_circle_are_smooth():
    angle = np.linspace(0, 2 * np.pi, 500_000, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)], axis=-1)
    (line,) = lines_of(np.concatenate([ring, -ring]))
    assert line.pitch is None


@pytest.mark.parametrize(
    "vertices",
    [
        np.zeros((0, 3)),
        np.ones((1, 3)),
        np.ones((9, 3)),
        np.eye(3)[:2],
        1e308 * np.eye(9, 3),
        1.7e308 * np.random.default_rng(1).uniform(-1, 1, (2000, 3)),
        trimesh.creation.box([1.2, 1.32, 1.05]).vertices,
        trimesh.creation.box([1.7, 1.2, 0.08]).vertices,
        trimesh.creation.icosphere(3).vertices * [1.1, 0.8, 0.95],
        np.random.default_rng(1).normal(size=(500, 3)) * [1, 1, 0],
        np.random.default_rng(1).normal(size=(500, 3)) * [1, 0, 0],
    ],
    ids=[
        "none",
        "a point",
        "nine",
        "two",
        "huge",
        "many",
        "box",
        "plate",
        "ellipsoid",
        "flat",
        "a segment",
    ],
)
def test_angular_body_has_no_axis(vertices):
    assert lines_of(np.asarray(vertices, float)) == []


def test_ball_is_round_about_three_axes():
    assert len(lines_of(trimesh.creation.icosphere(4).vertices)) == 3


def test_robots_and_animals_are_not_round(shared):
    for name in ("meshes/spot.obj", "robots/lbr_med7/mesh/link_2.stl", "knee/femur.stl"):
        assert lines_of(np.asarray(trimesh.load(shared / name, force="mesh").vertices)) == []


def turns_of(vertices, faces):
    return Alike(vertices, faces, np.zeros(3)).turns


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
    found = turns_of(vertices.astype(np.float32), np.asarray(mesh.faces))
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
    assert turns_of(vertices, np.asarray(faces)) == []


def test_noise_leaves_no_turn():
    ball = trimesh.creation.icosphere(3)
    noise = np.random.default_rng(0).normal(size=ball.vertices.shape)
    assert turns_of(np.asarray(ball.vertices) + 1e-3 * noise, np.asarray(ball.faces)) == []
