"""A scene's trees are made once, and never asked once the scene is another one."""

import gc
import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pinhole_jax as pj
from pinhole_jax import shapes
from pinhole_jax._trace import memo as keeper, trace as tracer


@pytest.fixture(scope="module")
def rays():
    random = np.random.default_rng(0)
    origin = random.normal(size=(60, 3))
    origin *= 3 / np.linalg.norm(origin, axis=1, keepdims=True)
    return pj.Rays(jnp.asarray(origin), jnp.asarray(0.6 * random.normal(size=(60, 3)) - origin))


@pytest.fixture
def made(monkeypatch):
    """The scenes whose trees are made from here on."""
    scenes = []
    function = tracer._trees_of
    monkeypatch.setattr(keeper, "_memo", {})
    monkeypatch.setattr(tracer, "_trees_of", lambda s, d: scenes.append(s) or function(s, d))
    return scenes


def new_scene():
    return pj.Scene(mesh=shapes.bumpy(1), spheres=pj.Spheres([[1.3, 0.9, 0]], [0.4]))


def same_as_built_within(scene, rays):
    arrays, rest = eqx.partition(scene, eqx.is_array)
    within = jax.jit(lambda a, r: pj.trace(eqx.combine(a, rest), r).primitive)
    ours = np.asarray(pj.trace(scene, rays).primitive)
    np.testing.assert_array_equal(ours, within(arrays, rays))
    return ours


@pytest.mark.long
def test_tree_is_built_once_for_each_scene(rays, made):
    scene = new_scene()
    first = np.asarray(pj.trace(scene, rays).primitive)
    pj.trace(scene, rays)
    pj.occluded(pj.Scene(mesh=scene.mesh, spheres=scene.spheres), rays)
    assert len(made) == 1

    moved = eqx.tree_at(lambda s: s.mesh.vertices, scene, 1.4 * scene.mesh.vertices)
    other = same_as_built_within(moved, rays)
    assert len(made) == 2
    assert np.any(other != first)
    turned = eqx.tree_at(lambda s: s.mesh.faces, scene, scene.mesh.faces[::-1])
    same_as_built_within(turned, rays)
    larger = eqx.tree_at(lambda s: s.spheres.radii, scene, 2 * scene.spheres.radii)
    assert np.any(same_as_built_within(larger, rays) != first)
    assert len(made) == 4

    copy = pickle.loads(pickle.dumps(scene))
    np.testing.assert_array_equal(pj.trace(copy, rays).primitive, first)


def test_postures_of_an_assembly_have_trees_of_their_own(rays, made):
    assembly = pj.Assembly([shapes.bumpy(1), shapes.bumpy(1)])
    for shift in (0.0, 1.5):
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[1, :3, 3] = shift
        same_as_built_within(assembly.at(poses), rays)
    assert len(made) == 2


def test_tree_is_freed_with_its_scene(rays, made):
    scene = new_scene()
    pj.trace(scene, rays)
    assert len(keeper._memo) == 1
    del scene
    made.clear()
    gc.collect()
    assert not keeper._memo


@pytest.mark.long
def test_programs_of_a_scene_that_is_there_share_its_tree(rays, made):
    """Batches of rays, derivatives in these, and what is compiled about the scene."""
    scene = new_scene()
    one_by_one = jax.vmap(lambda o, d: pj.trace(scene, pj.Rays(o, d)).primitive)
    first = pj.trace(scene, rays).primitive
    np.testing.assert_array_equal(one_by_one(*rays), first)
    np.testing.assert_array_equal(jax.jit(one_by_one)(*rays), first)
    assert len(made) == 1
    # An array of NumPy may be written to: no tree of it is kept.
    mutable = np.array(scene.mesh.vertices)
    loose = eqx.tree_at(lambda s: s.mesh.vertices, scene, mutable)
    np.testing.assert_array_equal(pj.trace(loose, rays).primitive, first)
    mutable *= 1.4
    moved = pj.trace(loose, rays).primitive
    assert np.any(np.asarray(moved) != np.asarray(first))
    assert len(made) == 1
