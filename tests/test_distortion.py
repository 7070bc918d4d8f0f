"""Lens distortion against OpenCV: `projectPoints`, `fisheye.projectPoints`."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import first
from jax.flatten_util import ravel_pytree
from oracles import central_difference

import pinhole_jax as pj

W, H = 64, 48
BROWN = pj.BrownConrady(-0.28, 0.07, 1.2e-3, -2.2e-4, 0.01)
FISHEYE = pj.Fisheye(-0.02, 0.011, -0.004, 0.0006)
RATIONAL = pj.Rational(0.6, 0.02, 1.2e-3, -2.2e-4, 0.05, 0.31, -0.12, 0.02)


def camera(distortion, phi=1.0, W=W, H=H):
    lens = pj.Lens([W * 0.53, H * 0.48], 1.02, distortion)
    return pj.Camera([0.3, -0.2, 4], [0, 0.1, 0], [0.1, 1, 0.05], phi, 1.0, W, H, lens)


def by_opencv(camera, points):
    """Return film coordinates by OpenCV: y down, pixel centres at integers there."""
    K, R, t = pj.formats.to_opencv(camera.lens and _ideal(camera), pixel_centres="integer")
    model = camera.lens.distortion
    k = np.array([*model.coefficients().values()])
    rotation = cv2.Rodrigues(R)[0]
    points = np.asarray(points, float).reshape(-1, 1, 3)
    if isinstance(model, pj.Fisheye):
        found = cv2.fisheye.projectPoints(points, rotation, t.reshape(3, 1), K, k)[0]
    else:
        found = cv2.projectPoints(points, rotation, t.reshape(3, 1), K, k)[0]
    u, v = found[:, 0].T
    return np.stack([u + 0.5, camera.H - (v + 0.5)], axis=-1)


def _ideal(camera):
    return eqx.tree_at(lambda c: c.lens.distortion, camera, None, is_leaf=lambda x: x is None)


@pytest.mark.parametrize("model", [BROWN, FISHEYE, RATIONAL], ids=["brown", "fisheye", "rational"])
def test_points_project_as_opencv_projects_them(model):
    view = camera(model)
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    np.testing.assert_allclose(
        pj.project(view, jnp.asarray(points)), by_opencv(view, points), rtol=0, atol=1e-10
    )


@pytest.mark.parametrize(
    ("model", "phi"),
    [
        (BROWN, 1.0),
        (RATIONAL, 1.0),
        (FISHEYE, 1.3),
        (pj.BrownConrady(0.3, p2=0.01), 1.3),
        (pj.BrownConrady(-0.15), 0.9),
        (pj.Fisheye(), 1.3),
    ],
)
def test_rays_and_projection_undo_each_other(model, phi):
    view = camera(model, phi)
    rays = pj.camera_rays(view)
    np.testing.assert_allclose(np.linalg.norm(rays.direction, axis=-1), 1, rtol=1e-14)
    film = pj.project(view, view.e[None, None] + 3.0 * rays.direction)
    column, row = np.arange(W) + 0.5, np.arange(H)[::-1] + 0.5
    np.testing.assert_allclose(film[..., 0], np.tile(column, (H, 1)), atol=1e-9)
    np.testing.assert_allclose(film[..., 1], np.tile(row[:, None], (1, W)), atol=1e-9)


@pytest.mark.parametrize("model", first(1, [BROWN, FISHEYE]), ids=["brown", "fisheye"])
def test_derivatives_of_rays_and_projection_are_differences(model):
    view = camera(model, 1.2, 4, 3)
    points = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (5, 3)))
    flat, unravel = ravel_pytree(eqx.filter(view, eqx.is_inexact_array))
    rebuild = lambda x: eqx.combine(unravel(x), view)
    both = lambda x: (pj.camera_rays(rebuild(x)).direction, pj.project(rebuild(x), points))
    image = jax.jit(lambda x: jnp.concatenate([z.reshape(-1) for z in both(x)]))
    forward = jax.jit(jax.jacfwd(image))(flat)
    up = np.random.default_rng(2).normal(size=len(forward))
    reverse = jax.jit(jax.grad(lambda x: jnp.sum(up * image(x))))(flat)
    assert np.all(np.isfinite(forward))
    np.testing.assert_allclose(up @ forward, reverse, atol=1e-9)
    np.testing.assert_allclose(forward, central_difference(image, flat), rtol=1e-5, atol=1e-7)


def test_a_camera_may_be_made_while_tracing():
    made = jax.jit(lambda x: pj.project(camera(BROWN), x))(jnp.ones((1, 3)))
    np.testing.assert_allclose(made, pj.project(camera(BROWN), jnp.ones((1, 3))), atol=1e-12)


def test_no_distortion_is_the_ideal_camera_in_the_program_too():
    view = camera(None)
    plain = pj.Camera(view.e, view.p, view.u, view.phi, view.d, W, H, pj.Lens([34.0, 23.0], 1.02))
    text = [str(jax.make_jaxpr(lambda c: pj.camera_rays(c).direction)(c)) for c in (view, plain)]
    assert text[0] == text[1]
    zero = camera(pj.BrownConrady())
    points = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (20, 3)))
    np.testing.assert_allclose(pj.project(zero, points), pj.project(view, points), atol=1e-12)


@pytest.mark.parametrize(
    "model", [pj.BrownConrady(-0.4), pj.Fisheye(-0.2), BROWN, pj.Fisheye(), RATIONAL]
)
def test_the_continuation_is_smooth_and_grows(model):
    """Beyond the fold, the image goes on: as a function of the radius it is C1 and increasing."""
    radius = np.concatenate([[0.0], np.geomspace(1e-2, 1e3, 20001)])
    x, rise = jax.jit(
        lambda r: jax.jvp(lambda r: model(0.6 * r, 0.8 * r), (r,), (jnp.ones_like(r),))
    )(jnp.asarray(radius))
    length = np.hypot(*x)
    assert np.all(np.diff(length) > 0)
    assert np.all(np.abs(np.diff(np.hypot(*rise))) < 0.05 * (1 + np.hypot(*rise)[1:]))


@pytest.mark.parametrize(
    ("model", "phi"), [(pj.BrownConrady(-0.4), 1.6), (pj.Fisheye(), 2.8), (pj.Fisheye(-0.3), 2.0)]
)
def test_lenses_that_fold_within_the_film_are_refused(model, phi):
    with pytest.raises(ValueError, match=r"`lens`: expected a distortion that holds up to the"):
        camera(model, phi)


def test_a_distortion_of_another_kind_is_refused():
    with pytest.raises(
        ValueError, match=r"`distortion`: expected a BrownConrady, a Rational, a Fisheye or No"
    ):
        pj.Lens([1, 1], 1.0, [0.1, 0.2])
    with pytest.raises(ValueError, match=r"`k2`: expected finite values, got nan"):
        pj.BrownConrady(0.1, np.nan)
