"""Copies of faces and faces without area change nothing: neither the image, nor what a fit says."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from oracles import mesh_coverage, usual_camera

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._scene.scene import padded

CAMERA = usual_camera()
BODY = shapes.bumpy(2)
VERTICES, FACES = np.asarray(BODY.vertices), np.asarray(BODY.faces)


def two_sided():
    return np.concatenate([VERTICES, VERTICES]), np.concatenate(
        [FACES, FACES[:, ::-1] + len(VERTICES)]
    )


def shuffled_twice():
    order = np.random.default_rng(0).permutation(2 * len(FACES))
    both = np.concatenate([FACES, np.roll(FACES, 1, axis=1) + len(VERTICES)])
    return np.concatenate([VERTICES, VERTICES]), both[order]


def same_vertices():
    return VERTICES, np.concatenate([FACES, FACES[:, ::-1]])


def thrice():
    faces = [FACES, FACES + len(VERTICES), FACES[:, [0, 2, 1]] + 2 * len(VERTICES)]
    return np.concatenate([VERTICES] * 3), np.concatenate(faces)


def beside_another():
    more = trimesh.creation.icosphere(1, 0.3)
    points = np.asarray(more.vertices) + np.array([0, 1.7, 0])
    vertices, faces = two_sided()
    return np.concatenate([vertices, points]), np.concatenate(
        [faces, np.asarray(more.faces) + len(vertices)]
    )


@pytest.mark.parametrize(
    "copies", [two_sided, shuffled_twice, same_vertices, thrice, beside_another]
)
def test_faces_that_only_repeat_others_are_left_out(copies):
    vertices, faces = copies()
    mesh = pj.Mesh(vertices, faces)
    assert mesh.closed
    once = pj.Mesh(vertices, faces[np.ptp(np.asarray(mesh.faces), axis=1) > 0])
    assert mesh.edge_faces.shape == once.edge_faces.shape
    assert mesh.faces.shape == faces.shape
    lone = 0 if copies is not beside_another else 80
    assert once.faces.shape[0] == len(FACES) + lone


def test_walls_between_closed_bodies_stay():
    boxes = [trimesh.creation.box((1, 1, 1)) for _ in range(3)]
    for k, box in enumerate(boxes):
        box.apply_translation([k, 0, 0])
    parts = [np.asarray(b.vertices) for b in boxes], [np.asarray(b.faces) for b in boxes]
    faces = np.concatenate([f + 8 * k for k, f in enumerate(parts[1])])
    mesh = pj.Mesh(np.concatenate(parts[0]), faces)
    assert mesh.closed
    assert np.array_equal(mesh.faces, faces)


def test_inner_part_that_repeats_faces_stays_closed():
    sheet = np.concatenate([FACES, FACES[:5, ::-1]])
    mesh = pj.Mesh(VERTICES, sheet)
    assert np.array_equal(mesh.faces, sheet)


def with_slivers(number=12):
    """Cut faces open at the middles of some sides, and close the gaps with faces without area."""
    vertices, faces, random = list(VERTICES), FACES.tolist(), np.random.default_rng(1)
    for k in random.choice(len(FACES), number, replace=False):
        a, b, c = faces[k]
        # A middle that is exactly on the line: in numbers of few bits.
        vertices[a], vertices[b] = (np.round(vertices[i] * 64) / 64 for i in (a, b))
        m = len(vertices)
        vertices.append((vertices[a] + vertices[b]) / 2)
        faces[k] = [a, m, c]
        faces += [[m, b, c], [a, b, m]]
    return np.array(vertices), np.array(faces)


@pytest.mark.long
def test_faces_without_area_hand_their_edges_on():
    vertices, faces = with_slivers()
    area = trimesh.Trimesh(vertices, faces, process=False).area_faces
    assert np.sum(area == 0) == 12
    mesh = pj.Mesh(vertices, faces)
    assert mesh.closed
    assert np.all(area[np.asarray(mesh.edge_faces)] > 0)
    image = pj.silhouette(CAMERA, pj.Scene(mesh=mesh))
    assert_allclose(image, mesh_coverage(CAMERA, vertices, faces), atol=1e-12)


@pytest.mark.long
def test_faces_without_area_at_a_border_are_no_border():
    """A square whose four sides carry a row of them, some of two corners at one place."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    middles = (corners + np.roll(corners, -1, axis=0)) / 2
    quarters = (corners + middles) / 2
    vertices = np.concatenate([corners, middles, quarters, corners[:1]])
    faces = [[0, 1, 2], [0, 2, 3]]
    for k in range(4):
        faces += [[k, 4 + k, (k + 1) % 4], [k, 8 + k, 4 + k]]
    faces.append([0, 12, 8])
    mesh = pj.Mesh(vertices, np.array(faces))
    first, second = np.asarray(mesh.edge_faces).T
    assert np.all(first <= 1)  # a face with area
    sides = np.diff(vertices[np.asarray(mesh.edge_vertices)[second < 0]], axis=1)
    assert_allclose(np.sum(np.linalg.norm(sides, axis=-1)), 8)  # each border once
    # (Filled up, both share a program.)
    plain, scene = (padded(pj.Scene(mesh=m)) for m in (pj.Mesh(corners, faces[:2]), mesh))
    target = np.asarray(pj.silhouette(CAMERA, plain))
    assert_allclose(pj.silhouette(CAMERA, scene), target, atol=1e-13)


def test_long_row_of_faces_without_area_is_removed():
    """Each is beside the next: a strip along one line, between two faces."""
    n = 3000
    line = np.stack([np.arange(n + 1) / 1024, np.zeros(n + 1), np.zeros(n + 1)], axis=1)
    vertices = np.concatenate([line, [[1, 1, 0]]])
    k = np.arange(1, n)
    faces = np.concatenate([[[0, n, n + 1]], np.stack([0 * k, k, k + 1], axis=1)])
    mesh = pj.Mesh(vertices, faces)
    assert np.all(np.asarray(mesh.edge_faces)[:, 0] == 0)
