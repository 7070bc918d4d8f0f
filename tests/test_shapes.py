import numpy as np
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusal

from pinhole_jax import shapes


def test_bumpy_is_closed_wound_outwards_and_repeatable():
    mesh = shapes.bumpy(3, seed=2)
    assert mesh.closed
    assert mesh.faces.shape == (1280, 3)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume > 0
    assert_array_equal(mesh.vertices, shapes.bumpy(3, seed=2).vertices)


def test_revolved_cylinder_has_its_volume():
    mesh = shapes.revolved(np.array([(0, 0), (2, 0), (2, 3), (0, 3)]), sections=400)
    assert mesh.closed
    volume = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume
    assert_allclose(volume, np.pi * 4 * 3, rtol=1e-3)


def test_profile_off_the_axis_is_refused():
    with refusal("`profile`: expected radii 0"):
        shapes.revolved(np.array([(1, 0), (2, 0), (2, 3), (0, 3)]))
