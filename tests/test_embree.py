"""`search="embree"`: the tree's hits, ties and all; the tree is held to Embree in `test_trace`."""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import first

import pinhole_jax as pj
from pinhole_jax import shapes

pytest.importorskip("embreex")

N = 1800


def unkind_rays(mesh, random):
    """Return rays from anywhere, at vertices and edges, from the surface, far away, and no rays."""
    vertices, edges = np.asarray(mesh.vertices), np.asarray(mesh.edge_vertices)
    origin = random.normal(size=(N, 3))
    origin *= 3 / np.linalg.norm(origin, axis=1, keepdims=True)
    aim = 0.7 * random.normal(size=(N, 3))
    aim[:300] = vertices[random.integers(0, len(vertices), 300)]
    a, b = vertices[edges[random.integers(0, len(edges), 500)]].transpose(1, 0, 2)
    aim[300:800] = a + random.integers(0, 5, (500, 1)) / 4 * (b - a)
    aim[700:800] += 1e-7 * random.normal(size=(100, 3))
    origin[800:900] = vertices[np.asarray(mesh.faces)[:100]].mean(axis=1)
    origin[900:1000] *= 1000
    direction = aim - origin
    direction[1000:1002] = [[0, 0, 0], [np.nan, 0, 1]]
    return origin, direction


def both(scene, rays):
    return (np.asarray(pj.trace(scene, rays, search=s).primitive) for s in ("embree", "tree"))


@pytest.mark.parametrize("dtype", first(0, ["float32", "float64"], of=2))
@pytest.mark.usefixtures("optimised")
def test_hits_equal_those_of_the_tree(dtype):
    """Also with a sphere among the faces, and where half of the faces are there twice.

    (Of faces that are equally deep both take the first where the compiler contracts the same
    products in both programs: as users have it, it does.)
    """
    random = np.random.default_rng(0)
    whole = shapes.bumpy(2)
    vertices, faces = np.asarray(whole.vertices), np.asarray(whole.faces)
    # Another body whose corners are at the same places: a wall that two bodies share, all over.
    vertices = np.concatenate([vertices, vertices])
    faces = np.concatenate([faces, faces[::-2][:, [1, 2, 0]] + len(whole.vertices)])
    mesh = pj.Mesh(vertices.astype(dtype), faces)
    spheres = pj.Spheres(np.array([[1.0, 0.3, 0.2]], dtype), np.array([0.4], dtype))
    scene = pj.Scene(mesh=mesh, spheres=spheres)
    origin, direction = unkind_rays(whole, random)
    rays = pj.Rays(jnp.asarray(origin, dtype), jnp.asarray(direction, dtype))
    theirs, ours = both(scene, rays)
    np.testing.assert_array_equal(theirs, ours)
    assert np.mean(ours >= 0) > 0.5
    assert np.any(ours == len(mesh.faces))
    np.testing.assert_array_equal(
        pj.occluded(scene, rays, search="embree"), pj.occluded(scene, rays)
    )


@pytest.mark.long
def test_few_rays_are_in_doubt(monkeypatch):
    """Of rays from anywhere one in a hundred or so is searched for twice."""
    from pinhole_jax._trace import embree

    random = np.random.default_rng(1)
    mesh = shapes.bumpy(2)
    scene = pj.Scene(mesh=mesh)
    origin, direction = (x[1002:] for x in unkind_rays(mesh, random))
    doubts = []
    search = embree._searched_again

    def counted(*arguments):
        jax.debug.callback(lambda doubt: doubts.append(np.mean(doubt)), arguments[-1])
        return search(*arguments)

    monkeypatch.setattr(embree, "_searched_again", counted)
    pj.trace(scene, pj.Rays(jnp.asarray(origin), jnp.asarray(direction)), search="embree")
    jax.effects_barrier()
    assert len(doubts) == 1
    assert doubts[0] < 0.02


@pytest.mark.long
def test_traced_scenes_batches_and_derivatives():
    mesh = shapes.bumpy(2)
    random = np.random.default_rng(2)
    origin, direction = (jnp.asarray(x[1100:1140]) for x in unkind_rays(mesh, random))

    def total(size, origin, direction, search):
        moved = eqx.tree_at(lambda m: m.vertices, mesh, size * mesh.vertices)
        t = pj.trace(pj.Scene(mesh=moved), pj.Rays(origin, direction), search=search).t
        return jnp.sum(jnp.where(jnp.isfinite(t), t, 0))

    sizes, spread = jnp.array([1.0, 1.3]), (0, None, None, None)
    gradients = jax.jit(jax.vmap(jax.value_and_grad(total, (0, 1)), spread), static_argnums=3)
    theirs, ours = (gradients(sizes, origin, direction, s) for s in ("embree", "tree"))
    for a, b in zip(jax.tree.leaves(theirs), jax.tree.leaves(ours), strict=True):
        assert np.all(np.isfinite(a))
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)

    one = lambda o, d: pj.trace(pj.Scene(mesh=mesh), pj.Rays(o, d), search="embree").primitive
    theirs, ours = both(pj.Scene(mesh=mesh), pj.Rays(origin, direction))
    np.testing.assert_array_equal(jax.vmap(one)(origin, direction), theirs)
    np.testing.assert_array_equal(theirs, ours)


def test_unknown_search_is_refused(monkeypatch):
    scene, rays = pj.Scene(mesh=shapes.bumpy(1)), pj.Rays(jnp.zeros(3), jnp.ones(3))
    with pytest.raises(ValueError, match="`search`: expected 'tree' or 'embree', got 'bvh'"):
        pj.trace(scene, rays, search="bvh")
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(
        ImportError, match=r"`search`: expected 'tree', as embreex is not installed"
    ):
        pj.trace(scene, rays, search="embree")
