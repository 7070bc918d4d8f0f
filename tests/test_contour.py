import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._camera.camera import film_map
from pinhole_jax._native.rasteriser import sphere_frames
from pinhole_jax._silhouette.clip import Homogeneous, cut_off
from pinhole_jax._silhouette.conics import arc_end, film_at, frame_of
from pinhole_jax._silhouette.contour import contour_weights as _contour_weights
from pinhole_jax._silhouette.spheres import shown_arcs

#: One program a mesh: step by step they are some fifty.
contour_weights = eqx.filter_jit(_contour_weights)


def test_contour_of_a_closed_mesh_is_closed():
    mesh = shapes.bumpy(2)
    weights = np.asarray(contour_weights(mesh, jnp.array([1.0, 2, 5])))
    ends = np.zeros(mesh.vertices.shape[0])
    np.add.at(ends, np.asarray(mesh.edge_vertices[:, 0]), weights)
    np.add.at(ends, np.asarray(mesh.edge_vertices[:, 1]), -weights)
    assert np.any(weights != 0)
    assert np.all(ends == 0)


def test_contour_of_an_open_mesh_counts_both_sides():
    mesh = pj.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]], [[0, 1, 2]])
    above = np.asarray(contour_weights(mesh, jnp.array([0.2, 0.2, 3.0])))
    below = np.asarray(contour_weights(mesh, jnp.array([0.2, 0.2, -3.0])))
    np.testing.assert_array_equal(above, [1, 1, 1])
    np.testing.assert_array_equal(below, -above)


@pytest.mark.long
def test_edges_are_cut_before_the_eye_and_left_of_the_film():
    film = film_map(pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], np.pi / 2, W=10, H=10))
    # In front; passes the eye on the right; behind; leaves the film on the left at height 5.
    edges = [[[1, 0, 0], [2, 1, 0]], [[1, 0, 0], [1, 0, 10]], [[1, 0, 10], [2, 0, 10]]]
    homogeneous = film(jnp.array([*edges, [[0, 0, 0], [-50, 0, 0]]], float))
    ends = [Homogeneous(*homogeneous[:, k].T) for k in (0, 1)]
    cut = lambda beside: cut_off(*ends, jnp.ones(4, jnp.int32), jnp.array(beside), film.bounds)
    (a, b), weight = cut(False)
    (c, d), left = cut(True)
    assert weight.tolist() == [1, 1, 0, 1]
    assert left.tolist() == [0, 0, 0, 1]
    seen = np.array([0, 1, 3])
    np.testing.assert_allclose(np.stack(a, 1)[seen], [[6, 5], [6, 5], [5, 5]])
    np.testing.assert_allclose(np.stack(b, 1)[seen], [[7, 6], [20, 5], [-10, 5]])
    np.testing.assert_allclose([np.stack(end, 1)[3] for end in (c, d)], [[-10, 5], [-10, 5]])


@jax.jit
def arcs_of(camera, spheres):
    """Ends of the arcs on the film, the points that they begin with, and weights."""
    film = film_map(camera)
    frames = sphere_frames(film, spheres).reshape(-1, 3, 3)
    every = jnp.repeat(frames, 6, axis=0)
    start, end, weight = shown_arcs(frames, jnp.ones(len(frames), bool))
    ends = (arc_end(frame_of(every), *x) for x in ((start, 1), (end, -1)))
    on = film_at(every, jnp.stack(start, axis=-1))
    return [*(jnp.stack(x, axis=-1) for x in ends), on], weight


@pytest.mark.long
def test_outline_of_a_sphere_on_the_axis_is_a_circle():
    # At distance 5, radius 3: the cone's half angle has sine 3/5, tangent 3/4.
    camera = pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], np.pi / 2, W=8, H=8)
    several, weight = arcs_of(camera, pj.Spheres([[0.0, 0, 0]], [3.0]))
    shown = np.asarray(weight) > 0
    assert 4 <= shown.sum() <= 6
    for points in several:
        np.testing.assert_allclose(np.linalg.norm(points[shown] - 4, axis=1), 3, rtol=1e-14)


@pytest.mark.long
def test_spheres_behind_the_eye_are_left_out():
    camera = pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, W=8, H=8)
    _, weight = arcs_of(camera, pj.Spheres([[0.0, 0, 9], [0, 0, 0]], [1.0, 1.0]))
    assert np.all(weight[:6] == 0)
    assert np.sum(weight[6:]) >= 4


def test_moved_vertices_are_looked_at_anew():
    ball = trimesh.creation.icosphere(2)
    mesh = pj.Mesh(ball.vertices, ball.faces)
    moved = eqx.tree_at(lambda m: m.vertices, mesh, mesh.vertices * jnp.array([[1.0, 2, 0.5]]))
    anew = pj.Mesh(moved.vertices, ball.faces)  # its edges come in another order
    e = jnp.array([1.0, 2, 5])

    def by_edge(mesh):
        edges = np.asarray(mesh.edge_vertices).tolist()
        return sorted(zip(edges, np.asarray(contour_weights(mesh, e)).tolist(), strict=True))

    assert by_edge(moved) == by_edge(anew)
    assert by_edge(moved) != by_edge(mesh)
