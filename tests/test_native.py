"""The compiled library: the numbers of the array form, batches, hostile input, life without it."""

import os
import subprocess
import sys
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import long

import pinhole_jax as pj
from pinhole_jax._camera.camera import film_map
from pinhole_jax._files.native_library import SWITCH
from pinhole_jax._native import library, rasteriser as native
from pinhole_jax._silhouette.silhouette import in_arrays

pytestmark = pytest.mark.skipif(not library.is_available(), reason="the library was not built")
EYE = jnp.array([0.3, 0.8, 4.0])


def camera(e=EYE, W=24, H=18, lens=None):
    return pj.Camera(e, jnp.zeros(3), jnp.array([0.0, 1, 0]), 0.8, W=W, H=H, lens=lens)


def soup(rng, number=12):
    corners = rng.normal(size=(3 * number, 3))
    return pj.Mesh(corners, np.arange(3 * number).reshape(-1, 3))


def balls(rng, number=5):
    return pj.Spheres(rng.normal(size=(number, 3)), rng.uniform(0.1, 0.6, number))


SCENES = {
    "closed": lambda rng: pj.Scene(mesh=pj.shapes.bumpy(1)),
    "soup": lambda rng: pj.Scene(mesh=soup(rng)),
    "spheres": lambda rng: pj.Scene(spheres=balls(rng)),
    "both": lambda rng: pj.Scene(mesh=soup(rng), spheres=balls(rng)),
}


def drawn(e, scene):
    return native.coverage(film_map(camera(e)), scene)


@pytest.mark.parametrize("bends", [False, long(True)])
@pytest.mark.parametrize("kind", ["closed", long("soup"), long("spheres"), long("both")])
def test_coverage_and_derivatives_are_those_by_arrays(kind, bends):
    """Forward and back, by the eye and by the scene."""
    scene, random = SCENES[kind](np.random.default_rng(3)), np.random.default_rng(4)
    lens = pj.Lens([12.5, 8.5], distortion=pj.BrownConrady(k1=-0.2, p1=0.01)) if bends else None
    moving, held = eqx.partition((EYE, scene), eqx.is_inexact_array)
    weights = jnp.asarray(random.normal(size=(18, 24)))
    ways = jax.tree.map(lambda x: jnp.asarray(random.normal(size=x.shape)), moving)

    def both_ways(draw):
        def image(moving):
            e, scene = eqx.combine(moving, held)
            return draw(film_map(camera(e, lens=lens)), scene)

        def at_once(moving):
            pushed = jax.jvp(image, (moving,), (ways,))
            return *pushed, jax.grad(lambda x: jnp.sum(weights * image(x)))(moving)

        return jax.jit(at_once)(moving)

    pairs = zip(*(jax.tree.leaves(both_ways(f)) for f in (native.coverage, in_arrays)), strict=True)
    for number, (a, b) in enumerate(pairs):
        tolerance = 5e-14 if number == 0 else 1e-10 * max(1, np.abs(b).max())
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance)


@pytest.mark.parametrize("kind", SCENES)
def test_derivative_is_the_central_difference(kind):
    scene = SCENES[kind](np.random.default_rng(4))
    slopes, step = jax.jit(jax.jacfwd(drawn))(EYE, scene), 1e-6
    for k in range(3):
        there, back = (drawn(EYE.at[k].add(s), scene) for s in (step, -step))
        central = (there - back) / (2 * step)
        assert jnp.max(jnp.abs(slopes[..., k] - central)) < 1e-6 * jnp.max(jnp.abs(slopes))


@pytest.mark.parametrize("kind", SCENES)
def test_pull_is_the_transpose_of_push(kind):
    scene = SCENES[kind](np.random.default_rng(5))
    moved = lambda e, scale: drawn(e, jax.tree.map(lambda x: _scaled(x, scale), scene))
    weights = jnp.asarray(np.random.default_rng(6).normal(size=(18, 24)))
    forward = jax.jacfwd(moved, argnums=(0, 1))(EYE, 1.0)
    back = jax.grad(lambda *x: jnp.sum(weights * moved(*x)), argnums=(0, 1))(EYE, 1.0)
    for push, pull in zip(forward, back, strict=True):
        total = jnp.tensordot(weights, push, axes=2)
        np.testing.assert_allclose(pull, total, rtol=1e-10, atol=1e-10)


def _scaled(x, scale):
    return x * scale if jnp.issubdtype(x.dtype, jnp.floating) else x


def test_batches_are_their_members():
    scene, rng = SCENES["both"](np.random.default_rng(7)), np.random.default_rng(8)
    eyes = EYE[None] + jnp.asarray(rng.normal(size=(3, 3))) * 0.1
    loss = lambda e: jnp.sum(drawn(e, scene) ** 2)
    for one in (partial(drawn, scene=scene), jax.grad(loss), jax.jacfwd(loss)):
        together = jax.jit(jax.vmap(one))(eyes)
        np.testing.assert_allclose(together, jnp.stack([one(e) for e in eyes]), rtol=0, atol=1e-12)


def test_nested_batches_are_their_members():
    scene = SCENES["closed"](None)
    eyes = EYE[None, None] + jnp.arange(12.0).reshape(2, 2, 3) * 0.01
    together = jax.vmap(jax.vmap(partial(drawn, scene=scene)))(eyes)
    each = [[drawn(e, scene) for e in row] for row in eyes]
    np.testing.assert_array_equal(together, jnp.array(each))


def test_nan_of_a_member_leaves_the_others():
    scene = SCENES["closed"](None)
    eyes = jnp.stack([EYE, EYE * jnp.nan, EYE])
    images = jax.vmap(partial(drawn, scene=scene))(eyes)
    assert not jnp.any(images[1])
    np.testing.assert_array_equal(images[0], images[2])


def test_second_derivative_is_refused():
    loss = lambda e: jnp.sum(drawn(e, SCENES["closed"](None)) ** 2)
    with pytest.raises(NotImplementedError, match="differentiated once"):
        jax.hessian(loss)(EYE)


def test_indices_out_of_range_are_left_out():
    mesh = pj.shapes.bumpy(1)
    for name in ("faces", "edge_vertices", "edge_faces"):
        broken = jax.tree.map(lambda x: x, mesh)
        object.__setattr__(broken, name, getattr(mesh, name) + (1 << 28))
        image = drawn(EYE, pj.Scene(mesh=broken))
        assert jnp.all((image >= 0) & (image <= 1))


def test_switch_chooses_arrays():
    code = (
        "import pinhole_jax as pj, numpy as np\n"
        "from pinhole_jax._native.library import is_available\n"
        "camera = pj.Camera([0., 1, 5], [0., 0, 0], [0., 1, 0], 0.6, W=16, H=16)\n"
        "mask = pj.silhouette(camera, pj.Scene(mesh=pj.shapes.bumpy(0)))\n"
        "print(is_available(), float(mask.sum()))"
    )
    said = {}
    for switch in ("0", "1"):
        environment = {**os.environ, SWITCH: switch}
        run = [sys.executable, "-W", "error", "-c", code]
        done = subprocess.run(run, capture_output=True, text=True, env=environment, check=True)
        said[switch] = done.stdout.split()
    assert (said["0"][0], said["1"][0]) == ("False", "True")
    assert float(said["0"][1]) == pytest.approx(float(said["1"][1]), rel=1e-5)


def test_missing_library_is_a_warning(monkeypatch):
    monkeypatch.setattr(library, "library_path", lambda: None)
    library.is_available.cache_clear()
    try:
        with pytest.warns(RuntimeWarning, match="without its compiled library"):
            assert not library.is_available()
    finally:
        library.is_available.cache_clear()
