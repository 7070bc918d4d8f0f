import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._camera.camera import film_map
from pinhole_jax._numerics.bitset import nth, rank_in, select
from pinhole_jax._scene.planes import CLUSTER, in_front, planes_and_clusters, undecided
from pinhole_jax._silhouette.clip import clipped
from pinhole_jax._silhouette.contour import contour_weights as _contour_weights
from pinhole_jax._silhouette.curves import ends, film_at
from pinhole_jax._silhouette.spheres import sphere_arcs

#: One program a mesh: step by step they are some fifty.
contour_weights = eqx.filter_jit(_contour_weights)


@jax.jit
def listed_by(mask):
    chosen = select(mask)
    return chosen.total, nth(chosen, jnp.arange(len(mask), dtype=jnp.int32))


@pytest.mark.parametrize("size", [1, 31, 32, 33, 500])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.6, 1.0])
def test_nth_lists_what_select_holds(size, share):
    mask = np.random.default_rng(size).random(size) < share
    total, listed = listed_by(mask)
    assert int(total) == mask.sum()
    np.testing.assert_array_equal(listed[: mask.sum()], np.flatnonzero(mask))


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


@pytest.mark.parametrize("bulge", [1e-2, 3e-3, 1e-3])
def test_edges_of_flat_parts_are_found_from_afar(bulge):
    """Of faces whose normals lie so close that the cosine of their angle is 1 in float32."""
    n, random = 40, np.random.default_rng(0)
    x, y = map(np.ravel, np.meshgrid(*2 * [np.linspace(-1, 1, n)]))
    vertices = np.stack([x, y, bulge * (1 - (x * x + y * y) / 2)], axis=1)
    first = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = [first[:, None] + np.array(of) for of in ([0, 1, n], [1, n + 1, n])]
    mesh = pj.Mesh(vertices.astype(np.float32), np.concatenate(faces))
    sides = jax.jit(lambda e: (in_front(mesh.planes, e), undecided(mesh.planes.clusters, e)))
    edges = np.asarray(mesh.edge_faces)
    inner = edges[:, 1] >= 0
    number = 0
    for _ in range(300):
        x, y, _ = vertices[random.integers(len(vertices))]
        way, far = random.uniform(0, 2 * np.pi), 10 ** random.uniform(2, 4)
        slope = -bulge * (x * np.cos(way) + y * np.sin(way))  # along the surface there
        front, asked = sides(np.float32(far * np.array([np.cos(way), np.sin(way), slope])))
        contour = inner & np.not_equal(*np.asarray(front)[edges.T])
        assert np.all(np.asarray(asked)[np.flatnonzero(contour) // CLUSTER])
        number += contour.sum()
    assert number > 3000


@pytest.mark.parametrize("draft", [2e-4, 5e-4])
def test_edges_of_walls_are_found_from_above(draft):
    """Walls all around that lean inwards by less than float32 tells of a cosine's complement."""
    n, random = 16, np.random.default_rng(0)  # (a cluster: as many diagonals as upright edges)
    turn = 2 * np.pi * np.arange(n) / n
    low = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    vertices = np.concatenate([low, low * (1 - draft) + [0, 0, 1]]).astype(np.float32)
    k, after = np.arange(n), (np.arange(n) + 1) % n
    faces = np.concatenate(
        [np.stack(of, 1) for of in ([k, after, n + k], [after, n + after, n + k])]
    )
    edges = np.asarray(pj.Mesh(vertices, faces).edge_faces)
    edges = edges[edges[:, 1] >= 0]
    planes = planes_and_clusters(vertices, faces, edges)
    assert planes.clusters.radius.shape == (1,)
    assert np.isfinite(planes.clusters.radius[0])
    sides = jax.jit(lambda e: (in_front(planes, e), undecided(planes.clusters, e)))
    seen = 0
    for _ in range(1000):
        way, far = random.uniform(0, 2 * np.pi), 10 ** random.uniform(3.5, 5)
        aside = random.uniform(0, 2) * draft
        e = far * np.array([aside * np.cos(way), aside * np.sin(way), 1])
        front, asked = map(np.asarray, sides(e.astype(np.float32)))
        if np.any(np.not_equal(*front[edges.T])):
            assert asked[0]
            seen += 1
    assert seen > 100


def test_rank_in_is_the_inverse_of_nth():
    mask = np.random.default_rng(0).random(100) < 0.3
    ranks = jax.jit(lambda mask: rank_in(select(mask), jnp.arange(100, dtype=jnp.int32)))(mask)
    np.testing.assert_array_equal(ranks, np.where(mask, np.cumsum(mask) - 1, -1))


@pytest.mark.long
def test_edges_are_cut_before_the_eye_and_left_of_the_film():
    film = film_map(pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], np.pi / 2, W=10, H=10))
    # In front; passes the eye on the right; behind; leaves the film on the left at height 5.
    edges = [[[1, 0, 0], [2, 1, 0]], [[1, 0, 0], [1, 0, 10]], [[1, 0, 10], [2, 0, 10]]]
    homogeneous = film(jnp.array([*edges, [[0, 0, 0], [-50, 0, 0]]], float))
    one = jnp.ones(4, jnp.int32)
    inside = clipped(homogeneous, one, one < 0, film.bounds)
    beside = clipped(homogeneous, one, one > 0, film.bounds)
    assert inside.weight.tolist() == [1, 1, 0, 1]
    assert beside.weight.tolist() == [0, 0, 0, 1]
    np.testing.assert_allclose(inside.a, [[6, 5], [6, 5], inside.a[2], [5, 5]])
    np.testing.assert_allclose(inside.b[jnp.array([0, 1, 3])], [[7, 6], [20, 5], [-10, 5]])
    np.testing.assert_allclose([beside.a[3], beside.b[3]], [[-10, 5], [-10, 5]])


def arcs_of(camera, spheres):
    ids = jnp.arange(6 * spheres.radii.shape[0], dtype=jnp.int32)
    return sphere_arcs(film_map(camera), spheres, ids)


@pytest.mark.long
def test_outline_of_a_sphere_on_the_axis_is_a_circle():
    # At distance 5, radius 3: the cone's half angle has sine 3/5, tangent 3/4.
    camera = pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], np.pi / 2, W=8, H=8)
    arcs = arcs_of(camera, pj.Spheres([[0.0, 0, 0]], [3.0]))
    shown = np.asarray(arcs.weight) > 0
    assert 4 <= shown.sum() <= 6
    for points in (*ends(arcs), film_at(arcs.frame, arcs.start)):
        np.testing.assert_allclose(np.linalg.norm(points[shown] - 4, axis=1), 3, rtol=1e-14)


@pytest.mark.long
def test_spheres_behind_the_eye_are_left_out():
    camera = pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, W=8, H=8)
    arcs = arcs_of(camera, pj.Spheres([[0.0, 0, 9], [0, 0, 0]], [1.0, 1.0]))
    assert np.all(arcs.weight[:6] == 0)
    assert np.sum(arcs.weight[6:]) >= 4


@pytest.mark.parametrize("shape", ["closed", "open"])
def test_clusters_pass_over_no_contour_edge(shape):
    ball = trimesh.creation.icosphere(4)
    vertices = ball.vertices * (1 + 0.1 * np.sin(5 * ball.vertices[:, :1]))
    mesh = pj.Mesh(vertices, ball.faces if shape == "closed" else ball.faces[:-7])
    assert mesh.planes.clusters is not None
    plain = eqx.tree_at(lambda m: m.planes.clusters, mesh, None)
    random = np.random.default_rng(0)
    passed = []
    for distance in np.repeat([0.0, 0.3, 0.9, 1.01, 1.5, 4, 1e3, 1e6], 5):
        direction = random.normal(size=3)
        e = jnp.asarray(distance * direction / np.linalg.norm(direction))
        np.testing.assert_array_equal(contour_weights(mesh, e), contour_weights(plain, e))
        passed.append(1 - np.mean(jax.jit(undecided)(mesh.planes.clusters, e)))
    assert np.mean(passed) > 0.5  # most need no look


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
