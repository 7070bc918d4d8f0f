import jax.numpy as jnp
import numpy as np
import pytest

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._contour import contour_weights, mesh_segments, nth, select, sphere_arcs


@pytest.mark.parametrize("size", [1, 31, 32, 33, 500])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.6, 1.0])
def test_nth_lists_what_select_holds(size, share):
    mask = np.random.default_rng(size).random(size) < share
    chosen = select(jnp.asarray(mask))
    assert int(chosen.total) == mask.sum()
    listed = nth(chosen, jnp.arange(mask.sum(), dtype=jnp.int32))
    np.testing.assert_array_equal(listed, np.flatnonzero(mask))


def test_the_contour_of_a_closed_mesh_closes():
    mesh = shapes.bumpy(2)
    weights = np.asarray(contour_weights(mesh, jnp.array([1.0, 2, 5])))
    ends = np.zeros(mesh.vertices.shape[0])
    np.add.at(ends, np.asarray(mesh.edge_vertices[:, 0]), weights)
    np.add.at(ends, np.asarray(mesh.edge_vertices[:, 1]), -weights)
    assert np.any(weights != 0)
    assert np.all(ends == 0)


def test_the_contour_of_an_open_mesh_counts_both_sides():
    mesh = pj.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]], [[0, 1, 2]])
    above = np.asarray(contour_weights(mesh, jnp.array([0.2, 0.2, 3.0])))
    below = np.asarray(contour_weights(mesh, jnp.array([0.2, 0.2, -3.0])))
    np.testing.assert_array_equal(above, [1, 1, 1])
    np.testing.assert_array_equal(below, -above)


def test_edges_are_cut_in_front_of_the_eye():
    camera = pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, W=10, H=10)
    vertices = jnp.array([[1.0, 0, 0], [1.0, 0, 10], [2.0, 0, 10]])
    segments = mesh_segments(camera, vertices, jnp.array([[0, 1], [1, 2]]), jnp.array([1, 1]))
    assert np.all(np.isfinite(segments.b))
    np.testing.assert_allclose(segments.a[0], pj.project(camera, vertices[0]))
    assert segments.weight.tolist() == [1, 0]  # the second is wholly behind


def test_the_outline_of_a_sphere_on_the_axis_is_a_circle():
    # At distance 5, radius 3: the cone's half angle has sine 3/5, tangent 3/4.
    camera = pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], np.pi / 2, W=8, H=8)
    arcs = sphere_arcs(camera, pj.Spheres([[0.0, 0, 0]], [3.0]))
    np.testing.assert_allclose(arcs.centre, np.full((4, 2), 4.0))
    np.testing.assert_allclose(arcs.shape, np.tile([3.0, 0, 3.0], (4, 1)), atol=1e-15)


def test_spheres_behind_the_eye_are_left_out():
    camera = pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, W=8, H=8)
    arcs = sphere_arcs(camera, pj.Spheres([[0.0, 0, 9], [0, 0, 0]], [1.0, 1.0]))
    assert arcs.weight.tolist() == [0, 1] * 4
    assert np.all(np.isfinite(arcs.shape))
