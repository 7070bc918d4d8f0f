"""How areas grow as curves move: one by one as of vectors, straight pieces as by their points."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import first, on_cpu

import pinhole_jax as pj
from pinhole_jax._camera.camera import film_map
from pinhole_jax._silhouette import boundary
from pinhole_jax._silhouette.boundary import Seen, Some
from pinhole_jax._silhouette.coverage import end_flux, shares
from pinhole_jax._silhouette.curves import Segments, piece_flux
from pinhole_jax._silhouette.parts import Ordered
from pinhole_jax._silhouette.spheres import sphere_arcs

pytestmark = pytest.mark.altered

W, H, WAYS = 12, 9, 3
CAMERA = pj.Camera([0.3, 0.2, 4.0], [0.0, 0, 0], [0.0, 1, 0], 0.5, 1.0, W, H)


@pytest.fixture
def random():
    return np.random.default_rng(5)


def segments(random):
    ends = random.uniform(-2, 14, (2, 20, 2))
    return Segments(jnp.asarray(ends[0]), jnp.asarray(ends[1]), jnp.asarray([1.0, -2.0] * 10))


def arcs(random):
    del random
    spheres = pj.Spheres(jnp.array([[0.1, 0, 0], [0.5, 0.3, 0]]), jnp.array([0.6, 0.4]))
    ids = jnp.arange(12, dtype=jnp.int32)
    return jax.jit(lambda camera: sphere_arcs(film_map(camera), spheres, ids))(CAMERA)


@pytest.mark.parametrize("kind", first(1, [segments, arcs]))
def test_piecewise_areas_equal_vectorised_ones(kind, random, monkeypatch):
    curves = jax.jit(Ordered.of)(kind(random))
    number, ends = len(curves.rising), 2 if kind is segments else 3
    some = Some(curves, jnp.int32(0), jnp.int32(number))
    seen = Seen(W, H, jnp.asarray(random.random(W * H) < 0.7), lambda add, start, lists: start)
    points = jnp.asarray(random.uniform(0.5, 2, (number, ends, 3)))
    rate = jnp.asarray(random.normal(size=(number, ends, 3, WAYS)))
    flux = boundary._flux(curves.monotone, points, rate)
    weights = jnp.asarray(random.normal(size=(W * H, WAYS)))
    before = jnp.asarray(random.normal(size=rate.shape))

    def both():
        @eqx.filter_jit  # anew for each way
        def images(seen, some, points, flux, weights, before):
            image = boundary._ordinary_pushed(seen, some, flux, jnp.zeros((W * H, WAYS)))
            return image, boundary._ordinary_pulled(seen, some, points, weights, before) - before

        return jax.tree.map(np.asarray, images(seen, some, points, flux, weights, before))

    image, back = both()
    monkeypatch.setattr(boundary, "on_cpu", lambda one, *rest, elsewhere: elsewhere(*rest))
    for found, expected in zip((image, back), both(), strict=True):
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11)
    assert not image[~np.asarray(seen.alone)].any()
    # Each is the other's transpose, way by way.
    there, here = (weights * image).sum(axis=0), (np.asarray(rate) * back).sum(axis=(0, 1, 2))
    np.testing.assert_allclose(there, here, rtol=1e-9)


@on_cpu
def test_curves_cut_from_a_list_equal_themselves_alone(random):
    ends = jnp.asarray(random.uniform(1, 8, (2, 20, 2)))
    curves = Ordered.of(Segments(ends[0], ends[1], jnp.ones(20)))
    seen = Seen(W, H, jnp.ones(W * H, bool), lambda add, start, lists: start)
    weights = jnp.asarray(random.normal(size=(W * H, WAYS)))
    points, none = jnp.asarray(random.uniform(0.5, 2, (6, 2, 3))), jnp.zeros((6, 2, 3, WAYS))

    def back(some):
        return np.asarray(boundary._ordinary_pulled(seen, some, points, weights, none))

    alone = Some(curves, jnp.int32(7), jnp.int32(6)).cut(6)
    expected = back(Some(alone, jnp.int32(0), jnp.int32(6)))
    assert np.abs(expected[5]).max() > 1e-3
    np.testing.assert_array_equal(back(Some(curves, jnp.int32(7), jnp.int32(6))), expected)
    fewer = back(Some(curves, jnp.int32(7), jnp.int32(5)))
    np.testing.assert_array_equal(fewer[:5], expected[:5])
    assert not fewer[5].any()


def test_shares_of_a_straight_piece_are_its_flux(random):
    points = random.uniform(0.5, 2, (20, 2, 3))
    a, b = (points[:, k, :2] / points[:, k, 2:] for k in (0, 1))
    m = jax.jit(Ordered.of)(Segments(jnp.asarray(a), jnp.asarray(b), jnp.ones(20))).monotone
    low, high = np.asarray(m.low), np.asarray(m.high)
    start, end = (jnp.asarray(low + t * (high - low)) for t in (0.2, 0.7))
    points = jnp.asarray(points)

    @jax.jit
    def both(m, points, start, end):
        of_ends = shares(m, start, end)[..., None, None] * end_flux(m, points)
        return jnp.sum(of_ends, axis=1), piece_flux(points, m.curves, start, end)

    found, expected = both(m, points, start, end)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
