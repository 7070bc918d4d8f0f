"""The library's walk: the hits of arrays and of brute force, hostile input, trees that are kept."""

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import first
from numpy.testing import assert_array_equal

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


def differ(mesh, rays, ours, theirs):
    """Return which rays' faces differ by more than rounding may let them.

    It may where the ray meets both, give or take their corners' rounding, and as deep or where it
    starts in one of them; where one meets nothing, where the ray meets the other's face at its
    edge. In long numbers.
    """
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    eps = 16 * np.finfo(corners.dtype).eps
    at = np.asarray(ours != theirs)
    shape = rays.direction.shape
    origin, direction = (np.broadcast_to(x, shape)[at].astype(np.longdouble) for x in rays)
    least, most, aside = [], [], []
    for face in (ours[at], theirs[at]):
        seen = corners[face].astype(np.longdouble) - origin[:, None]
        size = np.abs(seen).max(axis=(1, 2))
        low, high, beyond = met_within(seen, direction, eps * size)
        none = face < 0
        least.append(np.where(none, -np.inf, low))
        most.append(np.where(none, np.inf, high))
        aside.append(np.where(none, False, beyond))
    wrong = np.zeros(at.shape, bool)
    apart = (np.maximum(*least) > np.minimum(*most)) & (least[0] > 0) & (least[1] > 0)
    wrong[at] = apart | aside[0] | aside[1]
    return wrong


def met_within(seen, direction, rounding):
    """Return between which depths rays meet triangles, whose corners (n, 3, 3) are seen from the
    rays' origins and moved by as much as rounding moves them, and which rays meet none of these."""
    ends = np.roll(seen, -1, axis=1)
    normal = np.cross(seen, ends)
    edge = np.einsum("nki,ni->nk", np.roll(normal, -1, axis=1), direction)
    slack = rounding[:, None] * 2 * np.abs(seen).max(axis=(1, 2))[:, None]
    aside = (edge < -slack).any(axis=1) & (edge > slack).any(axis=1)
    along = np.einsum("nki,ni->nk", seen, direction)
    total, error = np.abs(edge.sum(axis=1)), 3 * slack[:, 0]
    depth = np.einsum("nk,nk->n", edge, along) / np.where(total > 0, edge.sum(axis=1), 1)
    spread = np.where(total > 2 * error, error / np.maximum(total - error, 1e-300), 1)
    spread = 4 * spread * np.abs(seen).max(axis=(1, 2)) + rounding
    flat = spread > np.ptp(along, axis=1)
    low = np.where(flat, along.min(axis=1) - rounding, depth - spread)
    return low, np.where(flat, along.max(axis=1) + rounding, depth + spread), aside


KINDS = ["scales", "lattice", "plane", "twice", "slivers", "film-covering"]


@pytest.mark.parametrize("dtype", first(1, ["float32", "float64"]))
def test_hits_in_soups_are_those_by_arrays(dtype, exhaustive):
    """Rays of images, from before and within, whose neighbours walk together."""
    random = np.random.default_rng(0)
    base = pj.Mesh(*(x[:V] for x in soup(random, "scales")))
    met = 0
    for trial in range(2000 if exhaustive else 120):
        vertices, faces = soup(random, KINDS[trial % len(KINDS)])
        e, p, u, phi = view(random, vertices, faces)
        unit, away = random.choice([1, 1, 1, 1e-25, 1e25]), random.choice([0, 0, 0, 1])
        vertices, e, p = ((unit * (x + away * AWAY)).astype(dtype) for x in (vertices, e, p))
        if np.all(e == p):
            continue
        # One mesh's arrays are replaced: what is compiled serves all trials.
        arrays = jnp.asarray(vertices), jnp.asarray(faces, "int32")
        mesh = eqx.tree_at(lambda m: (m.vertices, m.faces), base, arrays)
        camera = pj.Camera(e, p, u.astype(dtype), np.dtype(dtype).type(phi), 1.0, W, H)
        origin, direction = pj.camera_rays(camera)
        rays = pj.Rays(origin[None], direction.reshape(-1, 3))
        scene = pj.Scene(mesh=mesh)
        ours, theirs = (np.asarray(f(scene, *rays)) for f in (walked, by_arrays))
        wrong = differ(mesh, rays, ours, theirs)
        assert_array_equal(ours[wrong], theirs[wrong], err_msg=f"trial {trial}")
        assert_array_equal(walked(scene, *rays, any_hit=True) >= 0, ours >= 0)
        met += np.sum(ours >= 0)
    assert met > 5000


def random_rays(number, dtype="float64"):
    random = np.random.default_rng(0)
    origin = random.normal(size=(number, 3))
    origin *= 3 / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = 0.6 * random.normal(size=(number, 3)) - origin
    return jnp.asarray(origin, dtype), jnp.asarray(direction, dtype)


@pytest.mark.parametrize(
    ("faces", "dtype"),
    first(1, [(65, "float32"), *((n, "float64") for n in (0, 1, 3, 4, 5, 1280))]),
)
def test_faces_and_spheres_are_hit_as_by_arrays(faces, dtype):
    random, whole = np.random.default_rng(1), shapes.bumpy(3)
    mesh = pj.Mesh(np.asarray(whole.vertices, dtype), np.asarray(whole.faces)[:faces])
    centers, radii = random.normal(size=(5, 3)), random.uniform(0.1, 0.3, 5)
    scene = pj.Scene(mesh=mesh, spheres=pj.Spheres(centers.astype(dtype), radii.astype(dtype)))
    rays = random_rays(1001, dtype)
    ours = np.asarray(walked(scene, *rays))
    assert_array_equal(ours, by_arrays(scene, *rays))
    assert_array_equal(walked(scene, *rays, any_hit=True) >= 0, ours >= 0)
    assert np.any(ours >= faces)


def test_rays_on_many_threads_hit_the_same():
    scene, rays = pj.Scene(mesh=shapes.bumpy(2)), random_rays(100_003)
    whole, some = walked(scene, *rays), slice(70_001, 70_301)
    assert_array_equal(whole[some], walked(scene, *(x[some] for x in rays)))
    assert np.mean(np.asarray(whole) >= 0) > 0.3


def test_batches_are_their_members():
    mesh, rays = shapes.bumpy(1), random_rays(60)
    moved = lambda size: eqx.tree_at(lambda m: m.vertices, mesh, size * mesh.vertices)
    one = lambda size, *rays: walked(pj.Scene(mesh=moved(size)), *rays)
    sizes, fans = jnp.array([1.0, 0.7]), tuple(x.reshape(3, 20, 3) for x in rays)
    together = jax.jit(jax.vmap(jax.vmap(one, (None, 0, 0)), (0, None, None)))(sizes, *fans)
    each = [[one(s, *(x[k] for x in fans)) for k in range(3)] for s in sizes]
    assert_array_equal(together, jnp.array(each))


def test_equally_near_faces_are_the_first():
    """A wall that is there many times, in another order each."""
    mesh = pj.Mesh(
        np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]),
        np.array([[0, 1, 2], [0, 2, 3]] * 40),
    )
    across = np.random.default_rng(0).uniform(-0.9, 0.9, (200, 2))
    origin = jnp.asarray(np.pad(across, ((0, 0), (0, 1)), constant_values=3.0))
    met = walked(pj.Scene(mesh=mesh), origin, jnp.array([[0.0, 0, -1]]) * jnp.ones((200, 1)))
    assert set(np.asarray(met)) == {0, 1}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 1e-300, 5e-324, 0.0])
def test_hostile_numbers_end_in_answers(value):
    random, mesh = np.random.default_rng(0), shapes.bumpy(2)
    spheres = pj.Spheres(random.normal(size=(40, 3)), np.full(40, 0.1))
    scene, rays = pj.Scene(mesh=mesh, spheres=spheres), random_rays(4096)
    where = lambda s: (s.mesh.vertices, s.spheres.centers, s.spheres.radii)
    for share in (0.02, 1.0):
        spoiled = lambda x, share=share: jnp.where(random.random(x.shape) < share, value, x)
        broken = eqx.tree_at(where, scene, [spoiled(x) for x in where(scene)])
        for given in (rays, [spoiled(x) for x in rays]):
            met = np.asarray(walked(broken, *given))
            assert met.min() >= -1
            assert met.max() < len(mesh.faces) + 40


def test_vertex_gone_astray_hides_nothing():
    mesh, rays = shapes.bumpy(2), random_rays(500)
    astray = jnp.concatenate([mesh.vertices, jnp.array([[1e18, 0, 0]])])
    faces = np.concatenate([mesh.faces, [[0, 1, len(mesh.vertices)]]])
    ours = np.asarray(walked(pj.Scene(mesh=pj.Mesh(astray, faces)), *rays))
    theirs = np.asarray(walked(pj.Scene(mesh=mesh), *rays))
    same = ours < len(mesh.faces)
    assert_array_equal(ours[same], theirs[same])
    assert np.mean(same) > 0.9


def test_indices_out_of_range_are_left_out():
    mesh, rays = shapes.bumpy(1), random_rays(200)
    for shift in (1 << 28, -(1 << 28)):
        faces = mesh.faces.at[::2].add(shift)
        broken = pj.Scene(mesh=eqx.tree_at(lambda m: m.faces, mesh, faces))
        met = np.asarray(walked(broken, *rays))
        assert np.all((met == -1) | (met % 2 == 1))
        assert np.any(met >= 0)


@pytest.mark.parametrize("distance", [1e3, 1e9, 1e15, 1e25])
def test_rays_from_far_away_end_soon(distance):
    """Without digits for where they pass, but not by looking at everything."""
    mesh = shapes.bumpy(5)
    origin = distance * random_rays(20_000)[0]
    met = np.asarray(walked(pj.Scene(mesh=mesh), origin, -origin))
    assert np.all(met >= -1)
    assert distance > 1e9 or np.all(met >= 0)


def test_kept_trees_are_of_what_arrays_hold():
    """Six scenes in turn, four of them kept; and an array that is written to."""
    mesh, rays = shapes.bumpy(1), random_rays(300)
    moved = lambda size: pj.Scene(
        mesh=eqx.tree_at(lambda m: m.vertices, mesh, size * mesh.vertices)
    )
    first = [np.asarray(walked(moved(s), *rays)) for s in np.linspace(0.5, 1.5, 6)]
    assert all(np.any(a != b) for a, b in pairwise(first))
    for size, met in zip(np.linspace(0.5, 1.5, 6), first, strict=True):
        assert_array_equal(walked(moved(size), *rays), met)
    loose = np.array(mesh.vertices)
    scene = pj.Scene(mesh=eqx.tree_at(lambda m: m.vertices, mesh, loose))
    assert_array_equal(pj.trace(scene, pj.Rays(*rays)).primitive, walked(moved(1), *rays))
    loose *= 1.5
    assert_array_equal(pj.trace(scene, pj.Rays(*rays)).primitive, first[-1])
