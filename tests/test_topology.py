"""Copies of faces and faces without area change nothing: neither the outline, nor the image."""

import numpy as np
import trimesh
from folders import in_trimesh
from numpy.random import default_rng
from numpy.testing import assert_allclose
from oracles import CORNERS, QUAD, filled, mesh_coverage, usual_camera
from refusals import pairs

import pinhole_jax as pj
from pinhole_jax import shapes

CAMERA = usual_camera()
BODY = shapes.bumpy(2)
VERTICES, FACES = np.asarray(BODY.vertices), np.asarray(BODY.faces)
BESIDE = trimesh.creation.icosphere(1, 0.3).apply_translation([0, 1.7, 0])
BOXES = [trimesh.creation.box((1, 1, 1)).apply_translation([k, 0, 0]) for k in range(3)]


def together(*parts):
    """Return vertices and faces of some parts, none of whose vertices are shared."""
    return trimesh.util.append_faces(*zip(*parts, strict=True))


def shuffled(vertices, faces):
    return vertices, default_rng(0).permutation(faces)


def with_slivers():
    """Cut faces open at the middles of some sides, and close the gaps with faces without area."""
    vertices, faces, random = list(VERTICES), FACES.tolist(), default_rng(1)
    for k in random.choice(len(FACES), 12, replace=False):
        a, b, c = faces[k]
        # A middle that is exactly on the line: in numbers of few bits.
        vertices[a], vertices[b] = (np.round(vertices[i] * 64) / 64 for i in (a, b))
        m = len(vertices)
        vertices.append((vertices[a] + vertices[b]) / 2)
        faces[k] = [a, m, c]
        faces += [[m, b, c], [a, b, m]]
    return np.array(vertices), np.array(faces)


def square_with_slivers():
    """A square whose four sides carry a row of them, some of two corners at one place."""
    middles = (CORNERS + np.roll(CORNERS, -1, axis=0)) / 2
    k = np.arange(4)
    halves, quarters = (k, 4 + k, (k + 1) % 4), (k, 8 + k, 4 + k)
    flat = [np.stack(halves, 1), np.stack(quarters, 1), [[0, 12, 8]]]
    vertices = np.concatenate([CORNERS, middles, (CORNERS + middles) / 2, CORNERS[:1]])
    return vertices, np.concatenate([QUAD, *flat])


def strip():
    """A long row of faces without area along one line, each beside the next, under one face."""
    k = np.arange(3001)
    vertices = np.append(k[:, None] / 1024 * [1, 0, 0], [[1, 1, 0]], axis=0)
    row = np.stack([0 * k, k, k + 1], axis=1)[1:-1]
    return vertices, np.append([[0, 3000, 3001]], row, axis=0)


TWO_SIDED = together((VERTICES, FACES), (VERTICES, FACES[:, ::-1]))
#: Vertices and faces; whether the mesh is closed, and how many edges its outline may have.
MESHES = {
    "two sides": (TWO_SIDED, True, 480),
    "twice, shuffled": (
        shuffled(*together((VERTICES, FACES), (VERTICES, np.roll(FACES, 1, axis=1)))), True, 480
    ),
    "of the same vertices": ((VERTICES, np.concatenate([FACES, FACES[:, ::-1]])), True, 480),
    "thrice": (together(*[(VERTICES, FACES)] * 2, (VERTICES, FACES[:, [0, 2, 1]])), True, 480),
    "beside another": (together(TWO_SIDED, (BESIDE.vertices, BESIDE.faces)), True, 600),
    "walls between bodies": (together(*((box.vertices, box.faces) for box in BOXES)), True, 54),
    "slivers": (with_slivers(), True, 480 + 2 * 12),
    "slivers at a border": (square_with_slivers(), False, 4 * 3 + 1),
    "slivers in a row": (strip(), False, 3002),
}  # fmt: skip


@pairs("name, body, closed, edges", MESHES)
def test_faces_that_repeat_or_have_no_area_are_no_outline(name, body, closed, edges):
    vertices, faces = body
    mesh = pj.Mesh(vertices, faces)
    assert mesh.closed == closed
    assert len(mesh.edge_vertices) == edges
    first, second = np.asarray(mesh.edge_faces).T
    area = in_trimesh(mesh).area_faces
    assert np.all(area[first] > 0)
    assert np.all(area[second[second >= 0]] > 0)
    image = pj.silhouette(CAMERA, pj.Scene(filled(vertices, faces, 4000)))
    assert_allclose(image, mesh_coverage(CAMERA, vertices, faces[area > 0]), atol=1e-12)
