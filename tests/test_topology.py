"""Copies of faces and faces without area change nothing: neither the image, nor what a fit says."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose
from oracles import mesh_coverage, usual_camera

import pinhole_jax as pj
from pinhole_jax import shapes

CAMERA = usual_camera()
BODY = shapes.bumpy(2)
VERTICES, FACES = np.asarray(BODY.vertices), np.asarray(BODY.faces)


BESIDE = trimesh.creation.icosphere(1, 0.3).apply_translation([0, 1.7, 0])


def together(*parts):
    """Return vertices and faces of some parts, none of whose vertices are shared."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [np.asarray(faces) + k for (_, faces), k in zip(parts, first, strict=False)]
    return np.concatenate([np.asarray(vertices) for vertices, _ in parts]), np.concatenate(faces)


TWO_SIDED = together((VERTICES, FACES), (VERTICES, FACES[:, ::-1]))


ORDER = np.random.default_rng(0).permutation(2 * len(FACES))


TWICE = together((VERTICES, FACES), (VERTICES, np.roll(FACES, 1, axis=1)))


@pytest.mark.parametrize(
    ("vertices", "faces", "left"),
    [
        (*TWO_SIDED, 320),
        (TWICE[0], TWICE[1][ORDER], 320),
        (VERTICES, np.concatenate([FACES, FACES[:, ::-1]]), 320),
        (*together(*[(VERTICES, FACES)] * 2, (VERTICES, FACES[:, [0, 2, 1]])), 320),
        (*together(TWO_SIDED, (BESIDE.vertices, BESIDE.faces)), 400),
    ],
    ids=["two sides", "twice, shuffled", "of the same vertices", "thrice", "beside another"],
)
def test_faces_that_only_repeat_others_are_left_out(vertices, faces, left):
    mesh = pj.Mesh(vertices, faces)
    assert mesh.closed
    once = pj.Mesh(vertices, faces[np.ptp(np.asarray(mesh.faces), axis=1) > 0])
    assert mesh.edge_faces.shape == once.edge_faces.shape
    assert mesh.faces.shape == faces.shape
    assert len(once.faces) == left


def test_walls_between_closed_bodies_stay():
    boxes = [trimesh.creation.box((1, 1, 1)).apply_translation([k, 0, 0]) for k in range(3)]
    vertices, faces = together(*((box.vertices, box.faces) for box in boxes))
    mesh = pj.Mesh(vertices, faces)
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
    vertices = np.concatenate([corners, middles, (corners + middles) / 2, corners[:1]])
    k = np.arange(4)
    halves, quarters = (k, 4 + k, (k + 1) % 4), (k, 8 + k, 4 + k)
    flat = np.concatenate([np.stack(halves, 1), np.stack(quarters, 1), [[0, 12, 8]]])
    mesh = pj.Mesh(vertices, np.concatenate([[[0, 1, 2], [0, 2, 3]], flat]))
    first, second = np.asarray(mesh.edge_faces).T
    assert np.all(first <= 1)  # a face with area
    sides = np.diff(vertices[np.asarray(mesh.edge_vertices)[second < 0]], axis=1)
    assert_allclose(np.sum(np.linalg.norm(sides, axis=-1)), 8)  # each border once
    image = pj.silhouette(CAMERA, pj.Scene(mesh=mesh))
    assert_allclose(image, mesh_coverage(CAMERA, corners, [[0, 1, 2], [0, 2, 3]]), atol=1e-12)


def test_long_row_of_faces_without_area_is_removed():
    """Each is beside the next: a strip along one line, between two faces."""
    k = np.arange(3001)
    vertices = np.append(k[:, None] / 1024 * [1, 0, 0], [[1, 1, 0]], axis=0)
    strip = np.stack([0 * k, k, k + 1], axis=1)[1:-1]
    mesh = pj.Mesh(vertices, np.append([[0, 3000, 3001]], strip, axis=0))
    assert np.all(np.asarray(mesh.edge_faces)[:, 0] == 0)
