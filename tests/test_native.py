"""The compiled library: the numbers of the array form, batches, hostile input, life without it."""

import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fuzz_native import compare
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from oracles import lump
from processes import printed
from slopes import both_ways

import pinhole_jax as pj
from pinhole_jax._camera.camera import film_map
from pinhole_jax._files.native_library import SWITCH
from pinhole_jax._native import library, rasteriser as native

pytestmark = pytest.mark.skipif(not library.is_available(), reason="the library was not built")
EYE = jnp.array([0.3, 0.8, 4.0])


def camera(e, lens=None):
    return pj.Camera(e, jnp.zeros(3), jnp.array([0.0, 1, 0]), 0.8, W=24, H=18, lens=lens)


RANDOM = default_rng(3)
SOUP = pj.Mesh(RANDOM.normal(size=(36, 3)), np.arange(36).reshape(-1, 3))
BALLS = pj.Spheres(RANDOM.normal(size=(5, 3)), RANDOM.uniform(0.1, 0.6, 5))
SCENES = {"closed": lump(1), "both": pj.Scene(SOUP, BALLS)}


def drawn(e, scene):
    return native.coverage(film_map(camera(e)), scene)


@pytest.mark.long
@pytest.mark.parametrize("bends", [False, True])
@pytest.mark.parametrize("kind", ["closed", "both"])
def test_coverage_and_derivatives_are_those_by_arrays(kind, bends):
    """Forward and back, by the eye and by the scene."""
    lens = pj.Lens([12.5, 8.5], distortion=pj.BrownConrady(k1=-0.2, p1=0.01)) if bends else None
    compare(camera(EYE, lens=lens), SCENES[kind], default_rng(4), 5e-14)


def test_batches_are_their_members():
    """Of images and gradients, a batch of batches: all that the library takes moves by the eye."""
    eyes = jnp.asarray(RANDOM.normal(EYE, 0.1, (2, 2, 3)))
    weights = jnp.asarray(RANDOM.normal(size=(18, 24)))
    parts = lambda s: (s.mesh.vertices, s.spheres.centers, s.spheres.radii)

    def seen(e):
        scene = lambda e: eqx.tree_at(parts, SCENES["both"], replace_fn=lambda x: x * e[2] / 4)
        return both_ways(lambda e: drawn(e, scene(e)), e, jnp.ones(3), weights)

    together, one = jax.jit(jax.vmap(jax.vmap(seen)))(eyes), jax.jit(seen)
    for at in np.ndindex(2, 2):
        for whole, own in zip(together, one(eyes[at]), strict=True):
            assert_allclose(whole[at], own, rtol=1e-12, atol=1e-12)


def test_second_derivative_is_refused():
    loss = lambda e: jnp.sum(drawn(e, SCENES["closed"]) ** 2)
    with pytest.raises(NotImplementedError, match="differentiated once"):
        jax.jit(jax.hessian(loss))(EYE)


def test_indices_out_of_range_are_left_out():
    mesh = pj.shapes.bumpy(1)
    for name in ("faces", "edge_vertices", "edge_faces"):
        broken = jax.tree.map(lambda x: x, mesh)
        object.__setattr__(broken, name, getattr(mesh, name) + (1 << 28))
        image = drawn(EYE, pj.Scene(broken))
        assert jnp.all((image >= 0) & (image <= 1))


@pytest.mark.long
def test_switch_chooses_arrays(tmp_path):
    """For masks and for hits, in a process of its own."""
    code = """
import sys, numpy as np, pinhole_jax as pj
from pinhole_jax._native.library import is_available
spheres = pj.Spheres(np.array([[1.1, 0.9, 0.2]]), np.array([0.4]))
scene = pj.Scene(pj.shapes.bumpy(1), spheres=spheres)
camera = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 22, 18)
seen = pj.silhouette(camera, scene), pj.trace(scene, camera).primitive
np.savez(sys.argv[1], available=is_available(), mask=seen[0], hits=seen[1])
"""
    found = []
    for switch in ("0", "1"):
        path, environment = tmp_path / f"{switch}.npz", {**os.environ, SWITCH: switch}
        printed("-W", "error", "-c", code, path, env=environment)
        found.append(np.load(path))
    arrays, compiled = found
    assert (bool(arrays["available"]), bool(compiled["available"])) == (False, True)
    assert_allclose(arrays["mask"], compiled["mask"], atol=1e-5)
    assert_array_equal(arrays["hits"], compiled["hits"])
    assert compiled["hits"].max() == 80


def test_missing_library_is_a_warning(monkeypatch):
    monkeypatch.setattr(library, "library_path", lambda: None)
    library.is_available.cache_clear()
    try:
        with pytest.warns(RuntimeWarning, match="without its compiled library"):
            assert not library.is_available()
    finally:
        library.is_available.cache_clear()
