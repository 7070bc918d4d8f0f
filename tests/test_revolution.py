"""Lines that a body is round about, against how the body was made."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pinhole_jax._solver.revolution import revolutions

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
    lines = found(vertices @ turn.T)
    assert len(lines) == 1
    assert abs(lines[0].axis @ turn @ [0, 0, 1]) > np.cos(np.deg2rad(0.2))
    assert lines[0].pitch == pytest.approx(2 * np.pi / sections)


def found(vertices):
    return revolutions(np.asarray(vertices))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize(
    "make", [mug, with_bump, lambda n: trimesh.creation.cylinder(0.5, 2, sections=n).vertices]
)
@pytest.mark.parametrize("sections", [20, 48, 64])
def test_axis_and_facets_are_recovered(make, sections, scale):
    (line,) = found(scale * (np.asarray(make(sections)) @ TURN.T + SHIFT))
    axis = TURN @ [0, 0, 1]
    assert abs(line.axis @ axis) > np.cos(np.deg2rad(0.2))
    off = line.centre - scale * SHIFT
    assert np.linalg.norm(off - (off @ axis) * axis) < 0.003 * scale
    assert line.pitch == pytest.approx(2 * np.pi / sections)


def test_smooth_body_has_no_facets():
    angle, height = np.random.default_rng(0).uniform([0, -1], [2 * np.pi, 1], (4000, 2)).T
    radius = 1 + 0.2 * height
    (line,) = found(np.stack([radius * np.cos(angle), radius * np.sin(angle), 2 * height], axis=-1))
    assert line.pitch is None


def test_million_vertices_on_a_circle_are_smooth():
    angle = np.linspace(0, 2 * np.pi, 500_000, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)], axis=-1)
    (line,) = found(np.concatenate([ring, -ring]))
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
    assert found(np.asarray(vertices, float)) == []


def test_ball_is_round_about_three_axes():
    assert len(found(trimesh.creation.icosphere(4).vertices)) == 3


def test_robots_and_animals_are_not_round(shared):
    for name in ("meshes/spot.obj", "robots/lbr_med7/mesh/link_2.stl", "knee/femur.stl"):
        assert found(np.asarray(trimesh.load(shared / name, force="mesh").vertices)) == []
