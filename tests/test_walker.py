"""The library's walk: the hits of arrays and of brute force, hostile input, trees that are kept."""

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import first
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from oracles import CORNERS, QUAD, balls, body, lump, random_rays

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._native import library
from pinhole_jax._native.walker import walked
from pinhole_jax._trace import heap

pytestmark = pytest.mark.skipif(not library.is_available(), reason="the library was not built")
by_arrays = jax.jit(heap.first_met)
V, F, W, H = 60, 40, 22, 18
AWAY = np.array([148376.0, 1234.0, -223423.0])


def soup(random, kind):
    """Return vertices and faces that are unkind to who draws them."""
    vertices, faces = random.normal(size=(V, 3)), random.integers(0, V, (F, 3))
    match kind:
        case "scales":
            vertices *= 10.0 ** random.uniform(-3, 3, (V, 1))
        case "lattice":  # coplanar, edge-on, many vertices at one place
            vertices = np.round(2 * vertices) / 2
        case "plane":
            vertices = np.round(vertices) * [1, 0, 1]
        case "twice":
            faces[::2] = faces[1::2][:, [1, 2, 0]]
        case "slivers":
            vertices[:20] = vertices[20:40] + 1e-7 * random.normal(size=(20, 3))
            faces[:, 2] = (faces[:, 1] + 20) % V
        case "film-covering":
            vertices *= [1e3, 1e3, 1]
    return vertices, faces


def view(random, vertices, faces):
    """Return e, p, u, phi of a camera that may be in a face, on a lattice, or see next to all."""
    e = random.normal(size=3) * 10.0 ** random.uniform(-2, 1.5)
    p, u = random.normal(size=3) / 2, random.normal(size=3)
    if random.random() < 0.4:
        e, p, u = np.round(2 * e) / 2, np.round(p), np.array([0, 1.0, 0])
    if random.random() < 0.1:
        e = vertices[faces[0]].mean(axis=0)
    if np.all(p == e) or np.all(np.cross(p - e, u) == 0):
        p = p + np.array([0.3, 0.2, 1.1])
    return e, p, u, random.choice([0.6, 2.0, 3.1, 1e-3, 1e-6])


KINDS = ["scales", "lattice", "plane", "twice", "slivers", "film-covering"]


def differ(scene_of, vertices, origin, direction, ours):
    """Return the hits that arrays do not find: neither for these numbers nor, in 100 trials, for
    ones that differ by rounding of the numbers seen from the rays' origin."""
    random, eps = default_rng(0), 16 * np.finfo(vertices.dtype).eps
    wrong = np.asarray(by_arrays(scene_of(vertices), origin[None], direction)) != ours
    seen = (vertices.astype(np.longdouble) - origin).astype(vertices.dtype)
    for _ in range(100):
        if not wrong.any():
            break
        near = lambda x: np.asarray(x * (1 + eps * random.uniform(-1, 1, x.shape)), x.dtype)
        rays = jnp.zeros((1, 3), seen.dtype), jnp.asarray(near(direction))
        wrong &= np.asarray(by_arrays(scene_of(near(seen)), *rays)) != ours
    return wrong


@pytest.mark.parametrize("dtype", first(1, ["float32", "float64"]))
def test_hits_in_soups_are_those_by_arrays(dtype, exhaustive):
    """Rays of images, from before and within, whose neighbours walk together."""
    random = default_rng(0)
    base = pj.Mesh(*(x[:V] for x in soup(random, "scales")))
    met = 0
    for trial in range(2000 if exhaustive else 120):
        kind = KINDS[trial % len(KINDS)]
        vertices, faces = soup(random, kind)
        e, p, u, phi = view(random, vertices, faces)
        unit, away = random.choice([1, 1, 1, 1e-25, 1e25]), random.choice([0, 0, 0, 1])
        vertices, e, p = ((unit * (x + away * AWAY)).astype(dtype) for x in (vertices, e, p))
        if np.all(e == p):
            continue

        def scene_of(vertices, faces=faces):
            """One mesh's arrays are replaced: what is compiled serves all trials."""
            arrays = jnp.asarray(vertices), jnp.asarray(faces, "int32")
            return pj.Scene(eqx.tree_at(lambda m: (m.vertices, m.faces), base, arrays))

        camera = pj.Camera(e, p, u.astype(dtype), np.dtype(dtype).type(phi), 1.0, W, H)
        origin, direction = (np.asarray(x) for x in pj.camera_rays(camera))
        rays = jnp.asarray(origin[None]), jnp.asarray(direction.reshape(-1, 3))
        ours = np.asarray(walked(scene_of(vertices), *rays))
        assert_array_equal(walked(scene_of(vertices), *rays, any_hit=True) >= 0, ours >= 0)
        met += np.sum(ours >= 0)
        if kind != "plane":  # (there rounding decides)
            wrong = differ(scene_of, vertices, origin, np.asarray(rays[1]), ours)
            assert not wrong.any(), trial
    assert met > 5000


@pytest.mark.parametrize(
    "faces, dtype",
    first(1, [(65, "float32"), *((n, "float64") for n in (0, 1, 3, 4, 5, 1280))]),
)
def test_faces_and_spheres_are_hit_as_by_arrays(faces, dtype):
    random, whole = default_rng(1), shapes.bumpy(3)
    mesh = pj.Mesh(np.asarray(whole.vertices, dtype), np.asarray(whole.faces)[:faces])
    centers, radii = random.normal(size=(5, 3)), random.uniform(0.1, 0.3, 5)
    scene = balls(centers.astype(dtype), radii.astype(dtype), mesh)
    rays = random_rays(1001, dtype)
    ours = np.asarray(walked(scene, *rays))
    assert_array_equal(ours, by_arrays(scene, *rays))
    assert_array_equal(walked(scene, *rays, any_hit=True) >= 0, ours >= 0)
    assert np.any(ours >= faces)


def test_rays_on_many_threads_hit_the_same():
    scene, rays = lump(2), random_rays(100_003)
    whole, some = walked(scene, *rays), slice(70_001, 70_301)
    assert_array_equal(whole[some], walked(scene, *(x[some] for x in rays)))
    assert np.mean(np.asarray(whole) >= 0) > 0.3


def resized(mesh, size):
    return pj.Scene(eqx.tree_at(lambda m: m.vertices, mesh, size * mesh.vertices))


def test_batches_are_their_members():
    rays = tuple(x.reshape(3, 20, 3) for x in random_rays(60))
    one = lambda size, *rays: walked(resized(shapes.bumpy(1), size), *rays)
    whole = jax.jit(jax.vmap(jax.vmap(one, (None, 0, 0)), (0, None, None)))
    for size, together in zip((1.0, 0.7), whole(jnp.array([1.0, 0.7]), *rays), strict=True):
        for met, *own in zip(together, *rays, strict=True):
            assert_array_equal(met, one(size, *own))


def test_equally_near_faces_are_the_first():
    """A wall that is there many times, in another order each."""
    wall = pj.Mesh(CORNERS, QUAD * 40)
    random = default_rng(0)
    origin = jnp.asarray(random.uniform(-0.9, 0.9, (200, 3)) + np.array([0, 0, 3]))
    met = walked(pj.Scene(wall), origin, jnp.tile(jnp.array([0, 0, -1.0]), (200, 1)))
    assert {*np.asarray(met).tolist()} == {0, 1}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 1e-300, 5e-324, 0.0])
def test_hostile_numbers_end_in_answers(value):
    random = default_rng(0)
    scene = balls(random.normal(size=(40, 3)), np.full(40, 0.1), shapes.bumpy(2))
    for share in (0.02, 1.0):
        spoil = lambda x, share=share: jnp.where(random.random(x.shape) < share, value, x)
        parts = lambda s: (s.mesh.vertices, s.spheres.centers, s.spheres.radii)
        broken = eqx.tree_at(parts, scene, replace_fn=spoil)
        for rays in (random_rays(4096), map(spoil, random_rays(4096))):
            met = np.asarray(walked(broken, *rays))
            assert np.all((met >= -1) & (met < 320 + 40))


def test_vertex_gone_astray_hides_nothing():
    mesh, rays = shapes.bumpy(2), random_rays(500)
    astray = np.append(mesh.vertices, [[1e18, 0, 0]], axis=0)
    faces = np.append(mesh.faces, [[0, 1, len(mesh.vertices)]], axis=0)
    ours = np.asarray(walked(body(astray, faces), *rays))
    same = ours < len(mesh.faces)
    assert_array_equal(ours[same], np.asarray(walked(pj.Scene(mesh), *rays))[same])
    assert np.mean(same) > 0.9


@pytest.mark.parametrize("distance", [1e3, 1e9, 1e15, 1e25])
def test_rays_from_far_away_end_soon(distance):
    """Without digits for where they pass, but not by looking at everything."""
    mesh = shapes.bumpy(5)
    origin = distance * random_rays(20_000)[0]
    met = np.asarray(walked(pj.Scene(mesh), origin, -origin))
    assert np.all(met >= -1)
    assert distance > 1e9 or np.all(met >= 0)


def test_kept_trees_are_of_what_arrays_hold():
    """Six scenes in turn, four of them kept; and an array that is written to."""
    mesh, rays, sizes = shapes.bumpy(1), random_rays(300), np.linspace(0.5, 1.5, 6)
    first, again = ([np.asarray(walked(resized(mesh, s), *rays)) for s in sizes] for _ in range(2))
    assert all(np.any(a != b) for a, b in pairwise(first))
    assert_array_equal(first, again)
    loose = np.array(mesh.vertices)
    scene = pj.Scene(eqx.tree_at(lambda m: m.vertices, mesh, loose))
    for size in (0.5, 3.0):
        loose *= size  # a half, and then three halves
        assert_array_equal(pj.trace(scene, pj.Rays(*rays)).primitive, first[0 if size < 1 else -1])
