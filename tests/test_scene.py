import gc
import weakref

import jax
import numpy as np
import pytest
import trimesh
from folders import in_trimesh
from numpy.testing import assert_allclose, assert_array_equal
from oracles import body, lump
from refusals import refusal, refuses

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._scene.scene import bounding_box, padded

TETRAHEDRON = np.eye(4, 3, -1)  # the origin, and a corner on each axis
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])  # counter-clockwise from outside


def test_edge_shared_by_four_faces_has_two_records():
    # Two tetrahedra that share the edge 0-3 alone: each closed by itself, so the whole is closed.
    vertices = np.concatenate([TETRAHEDRON, [[-1, 0, 0], [0, -1, 0]]])
    mesh = pj.Mesh(vertices, np.concatenate([FACES, np.array([0, 4, 5, 3])[FACES]]))
    assert mesh.closed
    assert sum(sorted(ends) == [0, 3] for ends in mesh.edge_vertices.tolist()) == 2
    for faces in (FACES[:3], np.concatenate([FACES[:3], FACES[3:, ::-1]])):  # one turned over
        assert not pj.Mesh(TETRAHEDRON, faces).closed


@pytest.mark.parametrize("kind", [np.float64, np.float32, list])
def test_vertices_far_from_the_origin_are_warned_of_in_float32(kind):
    """A cube of 1 m at UTM coordinates: float32 has steps of 0.5 m there."""
    cube = trimesh.creation.box()
    far = np.add(cube.vertices, [500000.3, 5400000.7, 300.2])
    given = far.tolist() if kind is list else far.astype(kind)
    near = pj.Mesh(cube.vertices.astype(np.float32) + 100, cube.faces)  # steps of 8e-6
    assert near.vertices.dtype == np.float32
    if kind is np.float64:
        pj.Mesh(given, cube.faces)
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.warns(UserWarning, match=r"`vertices`: float32 .*steps of 0.5, 1/\d of the"):
            mesh = pj.Mesh(given, cube.faces)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert np.max(np.abs(np.asarray(mesh.vertices, float) - far)) > 0.1


def test_spheres_far_from_the_origin_are_warned_of_in_float32():
    far = np.array([[500000.3, 5400000.7, 300.2], [500001.3, 5400000.7, 300.2]], np.float32)
    pj.Spheres(far[:1], np.float32([4000]))  # steps of 0.5 are nothing to that
    for centers in (far, far[:1]):
        with pytest.warns(UserWarning, match=r"`centers`: float32 rounds .*steps of 0.5, 1/\d"):
            pj.Spheres(centers, np.full(len(centers), 0.5, np.float32))


def test_mesh_compiles_nothing(compiled):
    sizes = []
    for sections in (11, 11, 12, 17):
        ring = trimesh.creation.torus(1, 0.3, sections, 9)
        scene = body(ring)
        sizes.append(len(padded(scene).mesh.faces))
        assert_array_equal(
            bounding_box(scene), [ring.vertices.min(axis=0), ring.vertices.max(axis=0)]
        )
        if len(sizes) == 1:
            compiled.clear()  # (to hold an array takes a program of JAX's own, once)
    assert len({*sizes}) == 1
    assert not compiled


test_bad_meshes_are_refused = refuses(
    pj.Mesh,
    {"vertices": TETRAHEDRON, "faces": FACES},
    {
        r"`vertices`: expected .* \(N, 3\), got shape \(4, 2\)": {"vertices": np.zeros((4, 2))},
        "`vertices`: expected finite values, got nan at": {"vertices": TETRAHEDRON * np.nan},
        r"`faces`: expected shape \(F, 3\), got \(4, 2\)": {"faces": FACES[:, :2]},
        "`faces`: expected integers, got dtype float64": {"faces": FACES * 1.0},
        "`faces`: expected indices from 0 to 3, got 0": {"faces": [[0, 1, 2**63 - 1]]},
        "`faces`: expected indices from 0": {"faces": np.uint64([[0, 1, 2**63]])},
        "`faces`: expected indices from 0 to 3, got 1 to 4": {"faces": FACES + 1},
        "`faces`: expected indices from 0 to 3, got -1 to 2": {"faces": FACES - 1},
    },
)

test_bad_spheres_are_refused = refuses(
    pj.Spheres,
    {"centers": [[0, 0, 0]], "radii": [1.0]},
    {
        r"`centers`: expected .* got shape \(1, 2\)": {"centers": [[0, 0]]},
        r"`radii`: expected .* \(1,\), got shape \(2,\)": {"radii": [1.0, 2.0]},
        "`radii`: expected positive radii, got 0.0": {"radii": [0.0]},
        "`centers`: expected finite values, got inf": {"centers": [[0, np.inf, 0]]},
    },
)

test_parts_of_a_scene_that_are_none_are_refused = refuses(
    pj.Scene,
    {},
    {
        "`mesh`: expected a Mesh or None, got str": {"mesh": "bunny.obj"},
        "`mesh`: expected a Mesh .* got Trimesh; give `Mesh": {"mesh": trimesh.creation.box()},
        "`spheres`: expected Spheres or None, got list": {"spheres": [1, 2]},
    },
)


def test_traced_faces_are_refused():
    with refusal("`faces`: expected a concrete array"):
        jax.jit(lambda faces: pj.Mesh(TETRAHEDRON, faces).vertices)(FACES)


def test_trimesh_mesh_is_accepted():
    theirs = trimesh.creation.box()
    ours = pj.Mesh(theirs)
    assert_array_equal(ours.vertices, theirs.vertices)
    assert_array_equal(ours.faces, theirs.faces)
    with pytest.raises(TypeError, match="missing 1 required argument: 'faces'"):
        pj.Mesh(theirs.vertices)


def test_memory_of_a_fit_is_freed():
    """A loop over many masks holds no more at its end: 2 MB a fit stayed, as equinox keeps what is
    made of a module by `copy`."""
    gone = weakref.ref(padded(lump(1)).mesh)
    gc.collect()
    assert gone() is None


# --- example shapes -------------------------------------------------------------------------------


def test_bumpy_is_closed_wound_outwards_and_repeatable():
    mesh = shapes.bumpy(3, seed=2)
    assert mesh.closed
    assert mesh.faces.shape == (1280, 3)
    assert in_trimesh(mesh).volume > 0
    assert_array_equal(mesh.vertices, shapes.bumpy(3, seed=2).vertices)


PROFILE = np.array([(0, 0), (2, 0), (2, 3), (0, 3)])


def test_revolved_cylinder_has_its_volume():
    mesh = shapes.revolved(PROFILE, sections=400)
    assert mesh.closed
    volume = in_trimesh(mesh).volume
    assert_allclose(volume, np.pi * 4 * 3, rtol=1e-3)


def test_profile_off_the_axis_is_refused():
    with refusal("`profile`: expected radii 0"):
        shapes.revolved(PROFILE + 1)
