"""Hits against Embree (an independent tracer, in float32) and by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import full
from folders import in_trimesh
from numpy.testing import assert_allclose, assert_array_equal
from oracles import balls, body, lump, random_rays, single, usual_camera
from refusals import refusal

import pinhole_jax as pj
from pinhole_jax import shapes

CAMERA = usual_camera(24, 20)


@pytest.mark.parametrize("name", ["spot.obj", full("bob.obj"), "bumpy"])
def test_same_hits_as_embree(name, request):
    pytest.importorskip("embreex")
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    if name == "bumpy":
        mesh = shapes.bumpy(4)
    else:
        mesh = pj.load_mesh(request.getfixturevalue("shared") / "meshes" / name)
    rays = pj.Rays(*random_rays(1500))
    hit = pj.trace(pj.Scene(mesh), rays)
    origin, direction = (np.asarray(x) for x in rays)
    peer = RayMeshIntersector(in_trimesh(mesh))
    places, which, faces = peer.intersects_location(origin, direction, multiple_hits=False)
    assert len(which) > 0.2 * len(origin)
    assert_array_equal(np.flatnonzero(hit.primitive >= 0), np.sort(which))
    assert_array_equal(hit.primitive[which], faces)
    assert_allclose(hit.t[which], np.linalg.norm(places - origin[which], axis=1), rtol=1e-6)


@pytest.mark.parametrize("dtype, offset", [("float32", 0.0), ("float32", 1.0), ("float64", 1.0)])
def test_no_ray_leaks_through_edges_or_vertices(dtype, offset):
    """Rays from within a closed mesh, aimed at vertices and points of edges; also far away."""
    mesh = shapes.bumpy(2)
    random = np.random.default_rng(0)
    away = offset * np.array([148376.0, 1234.0, -223423.0])
    vertices = (np.asarray(mesh.vertices) + away).astype(dtype)
    a, b = vertices[np.asarray(mesh.edge_vertices)].transpose(1, 0, 2)
    along = random.random((4, len(a), 1)).astype(dtype)
    aims = np.concatenate([vertices, (a + along * (b - a)).reshape(-1, 3)])
    origin = np.broadcast_to(away.astype(dtype), aims.shape)
    direction = aims - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    scene = body(vertices, np.asarray(mesh.faces))
    blocked = pj.occluded(scene, pj.Rays(jnp.asarray(origin), jnp.asarray(direction)))
    assert int(jnp.sum(~blocked)) == 0


TRIANGLE = pj.Mesh([[0, 0, 0], [2, 0, 0], [0, 2, 0.0]], [[0, 1, 2]])
#: Rays and their hits: origin, direction, t, primitive, normal.
BY_HAND = np.loadtxt(
    """
    0.5 0.25  3   0 0 -1      3   0   0 0 1      # a triangle
    0.5 0.25  3   0 0 -2    1.5   0   0 0 1      # by a longer direction
    0.5 0.25 -3   0 0 1       3   0   0 0 1      # from below
    0.5 0.25  3   0 0 1     inf  -1   0 0 0      # behind
    0.5 0.25  3   0.6 0.8 0 inf  -1   0 0 0      # edge-on
     -5 0     4   0 0 -1      3   1   0 0 1      # a sphere
     -5 0     4   0 0 -2    1.5   1   0 0 1      # by a longer direction
     -5 0     0   0 0 -1      1   1   0 0 -1     # its far wall
     -5 0.6   4   0 0 -1    3.2   1   0 0.6 0.8  # off its centre
     -5 1     4   0 0 -1      4   1   0 1 0      # touched
     -5 1.1   4   0 0 -1    inf  -1   0 0 0      # missed
     -5 0    -2   0 0 -1      2   2   0 0 1      # from between two spheres
    0.3 1     4   0 0 -1    3.5   3   0 0 1      # a sphere before the triangle
    """.splitlines()
)


def test_hits_are_those_worked_out_by_hand():
    scene = balls([[-5.0, 0, 0], [-5, 0, -5], [0.3, 1.0, 0]], [1.0, 1.0, 0.5], TRIANGLE)
    origin, direction, t, primitive, normal = np.split(BY_HAND, [3, 6, 7, 8], axis=1)
    rays = pj.Rays(jnp.array(origin), jnp.array(direction))
    hit = pj.trace(scene, rays)
    assert_allclose(hit.t, t[:, 0], rtol=1e-12)
    assert_array_equal(hit.primitive, primitive[:, 0])
    assert_allclose(hit.normal, normal, atol=1e-12)
    # (0.5, 0.25) = 0.625 a + 0.25 b + 0.125 c
    assert_allclose(hit.barycentric[:2], [[0.625, 0.25, 0.125]] * 2, atol=1e-15)
    assert_allclose(hit.barycentric[3:], 0, atol=1e-15)


@pytest.mark.long
@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6])
def test_small_spheres_far_away_keep_their_digits_in_float32(distance):
    # The textbook discriminant b^2 - 4ac loses them all from a distance of some 1e3 radii.
    origin = jnp.array([0.3, 0.4, distance], jnp.float32)
    rays = pj.Rays(origin, jnp.array([0, 0, -1], jnp.float32))
    scene = single(balls([[0.0, 0, 0]], [1.0]))
    exact = distance - np.sqrt(0.75)
    assert_allclose(pj.trace(scene, rays).t, exact, rtol=2e-7)


@pytest.mark.long
def test_shapes_follow_the_rays_and_no_rays_give_no_hits():
    scene, down = pj.Scene(TRIANGLE), jnp.array([0.0, 0, -1])
    t = lambda origin: pj.trace(scene, pj.Rays(origin, down)).t
    assert_allclose(jax.vmap(t)(jnp.array([[0.5, 0.25, 4], [0.1, 0.1, 5]])), [4, 5])
    assert pj.trace(scene, pj.Rays(jnp.zeros(3), jnp.zeros((2, 0, 3)))).t.shape == (2, 0)
    rays = pj.Rays(jnp.zeros(3), jnp.ones((4, 3)))
    assert pj.trace(pj.Scene(), rays).primitive.tolist() == [-1] * 4


@pytest.mark.long
def test_camera_stands_for_its_rays():
    scene = balls([[1.1, 0.9, 0.2]], [0.4], shapes.bumpy(1))
    for lens in (None, pj.Lens([11.0, 7.0], 1.1, pj.BrownConrady(k1=-0.1))):
        view = CAMERA.replace(lens=lens)
        seen, traced = pj.trace(scene, view), pj.trace(scene, pj.camera_rays(view))
        assert {int(k) for k in np.unique(seen.primitive)} > {-1, 80}
        assert_array_equal(seen.primitive, traced.primitive)
        assert_allclose(seen.t, traced.t, rtol=1e-13)
        assert_array_equal(pj.occluded(scene, view), np.isfinite(seen.t))


def test_unknown_search_is_refused():
    scene, rays = lump(1), pj.Rays(jnp.zeros(3), jnp.ones(3))
    for function in (pj.trace, pj.occluded):
        with refusal(r"`search`: expected 'tree', got 'embree'; .*removed"):
            function(scene, rays, search="embree")
