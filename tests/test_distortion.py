"""Lens distortion against OpenCV: `projectPoints`, `fisheye.projectPoints`."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import first
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose
from oracles import central_difference

import pinhole_jax as pj

W, H = 16, 12
BROWN = pj.BrownConrady(-0.28, 0.07, 1.2e-3, -2.2e-4, 0.01)
FISHEYE = pj.Fisheye(-0.02, 0.011, -0.004, 0.0006)
RATIONAL = pj.Rational(0.6, 0.02, 1.2e-3, -2.2e-4, 0.05, 0.31, -0.12, 0.02)


def camera(distortion, phi=1.0, W=W, H=H):
    lens = pj.Lens([W * 0.53, H * 0.48], 1.02, distortion)
    return pj.Camera([0.3, -0.2, 4], [0, 0.1, 0], [0.1, 1, 0.05], phi, 1.0, W, H, lens)


def by_opencv(camera, points):
    """Return film coordinates by OpenCV: y down, pixel centres at integers there."""
    K, R, t = pj.formats.to_opencv(camera, pixel_centres="integer")
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


@pytest.mark.parametrize("model", [BROWN, FISHEYE, RATIONAL], ids=["brown", "fisheye", "rational"])
def test_points_project_as_opencv_projects_them(model):
    view = camera(model)
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    wanted = by_opencv(view, points)
    assert_allclose(pj.project(view, points), wanted, rtol=0, atol=1e-10)


@pytest.mark.parametrize("model", first(1, [None, BROWN, FISHEYE]))
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
    assert_allclose(up @ forward, reverse, atol=1e-9)
    assert_allclose(forward, central_difference(image, flat), rtol=1e-5, atol=1e-7)


def test_no_distortion_costs_nothing_and_coefficients_of_0_change_nothing():
    view, zero = camera(None), camera(pj.BrownConrady())
    assert "while" not in str(jax.make_jaxpr(pj.camera_rays)(view))
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    assert_allclose(pj.project(zero, points), pj.project(view, points), atol=1e-12)


@pytest.mark.parametrize(
    "model", [pj.BrownConrady(-0.4), pj.Fisheye(-0.2), BROWN, pj.Fisheye(), RATIONAL]
)
def test_continuation_beyond_the_fold_is_smooth_and_increasing(model):
    """Beyond the fold, the image goes on: as a function of the radius it is C1 and increasing."""
    radius = np.concatenate([[0.0], np.geomspace(1e-2, 1e3, 20001)])
    x, rise = jax.jit(
        lambda r: jax.jvp(lambda r: model(0.6 * r, 0.8 * r), (r,), (jnp.ones_like(r),))
    )(jnp.asarray(radius))
    length = np.hypot(*x)
    assert np.all(np.diff(length) > 0)
    assert np.all(np.abs(np.diff(np.hypot(*rise))) < 0.05 * (1 + np.hypot(*rise)[1:]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        *(
            (lambda model=model, phi=phi: camera(model, phi), "`lens`: expected a distortion that")
            for model, phi in (
                (pj.BrownConrady(-0.4), 1.6),
                (pj.Fisheye(), 2.8),
                (pj.Fisheye(-0.3), 2.0),
            )
        ),
        (lambda: pj.Lens([1, 1], 1.0, [0.1]), "`distortion`: expected a BrownConrady, a Rational"),
        (lambda: pj.BrownConrady(0.1, np.nan), "`k2`: expected finite values, got nan"),
    ],
)
def test_lens_that_folds_within_the_film_or_is_none_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


#: Polynomials that grow to the plane of the eye, and some that fold before it.
ANGLES = [
    (0.03126, 0.005177, 0.000664, 0.0001007),
    (-0.1, 0.0, 0.0, 0.0),
    (-0.25, 0.1, 0.0, 0.0),
    (1.0, 1.0, 1.0, 1.0),
    (0.36330, -0.00498, 0.00433, -0.01487),
    (-0.4, 0.0, 0.0, 0.0),
    (10.0, -3.0, 0.0, 0.0),
]


undistorted = jax.jit(lambda model, x, y: model.undistorted(x, y))


def by_halves(function, most, value):
    """Return the places of values of a growing function, by halving (NumPy alone)."""
    low, high = np.zeros_like(value), np.full_like(value, most)
    for _ in range(60):
        middle = (low + high) / 2
        less = function(middle) < value
        low, high = np.where(less, middle, low), np.where(less, high, middle)
    return (low + high) / 2


def fisheye_polynomial(k):
    return lambda angle: angle * (1 + sum(c * angle ** (2 * n + 2) for n, c in enumerate(k)))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("k", ANGLES)
def test_fisheye_angles_are_those_of_bisection(k, dtype):
    model = pj.Fisheye(*np.asarray(k, dtype))
    k = np.array([*model.coefficients().values()])
    bent, edge = fisheye_polynomial(k), float(np.arctan(np.float64(model.trusted_radius())))
    around = np.random.default_rng(0).uniform(0, 2 * np.pi, 2001)
    radius = bent(np.linspace(0, edge * (1 - 1e-6), 2001))
    x, y = (radius * f(around) for f in (np.cos, np.sin))
    x, y = np.asarray(x, dtype), np.asarray(y, dtype)
    ideal = np.hypot(*np.asarray(undistorted(model, x, y), float))
    wanted = by_halves(bent, edge, np.hypot(x.astype(float), y))
    # Rounding of the radius, where the image grows by a twentieth only.
    allowed = 60 * np.finfo(dtype).eps if dtype == "float32" else 1e-12
    assert_allclose(np.arctan(ideal), wanted, rtol=0, atol=allowed * max(1, *radius))


def test_derivatives_of_fisheye_rays_hold_to_89_degrees():
    """Against what the polynomial's own derivatives say of its inverse."""
    k, angle = np.array(ANGLES[0]), np.radians([0.0, 1e-6, 30, 60, 80, 88, 89])
    powers = np.stack([angle ** (2 * n + 3) for n in range(4)])
    radius = angle + k @ powers
    growth = 1 + (k * np.arange(3, 10, 2)) @ np.stack([angle ** (2 * n + 2) for n in range(4)])

    def angles(radius, k):
        x, y = pj.Fisheye(*k).undistorted(0.6 * radius, 0.8 * radius)
        return jnp.arctan(0.6 * x + 0.8 * y)

    by_radius = np.diag(1 / growth)
    for jacobian in (jax.jacfwd, jax.jacrev):
        found = jax.jit(jacobian(angles, (0, 1)))(jnp.asarray(radius), jnp.asarray(k))
        assert_allclose(found[0], by_radius, atol=1e-11)
        assert_allclose(found[1], -(powers / growth).T, atol=1e-11)
    second = jax.jit(jax.vmap(jax.grad(jax.grad(angles)), (0, None)))
    bend = (k * [6, 20, 42, 72]) @ np.stack([angle ** (2 * n + 1) for n in range(4)])
    found = second(jnp.asarray(radius)[2:], jnp.asarray(k))
    assert_allclose(found, (-bend / growth**3)[2:], atol=1e-9)


def test_points_beyond_a_lens_go_on_straight():
    model = pj.Fisheye(*ANGLES[5])  # folds at 51 degrees
    ideal = np.linspace(0.9, 30.0, 200) * float(model.trusted_radius())
    ideal = np.stack([0.6 * ideal, 0.8 * ideal])
    assert_allclose(inverted(model, ideal), ideal, rtol=1e-12)


def inverted(model, ideal):
    """Points that are distorted, and undistorted."""
    return np.asarray(undistorted(model, *model(*jnp.asarray(ideal))))


def test_wide_lenses_are_inverted_wherever_they_are_trusted():
    """Up to where the image grows by a hundred times, or by a twentieth, of its growth inside."""
    for seed in range(4):
        k = np.random.default_rng(seed).normal(size=5) * [0.2, 0.1, 0.003, 0.003, 0.02]
        wide = pj.Rational(0.3 + k[0], 0.02, 1e-3, -2e-4, 0.05, k[1], -0.1, 0.02)
        for model in (pj.BrownConrady(*k), wide):
            radius = np.linspace(0, min(0.98 * float(model.trusted_radius()), 20.0), 500)
            ideal = radius * np.stack([np.cos(9 * radius), np.sin(9 * radius)])
            off = np.hypot(*inverted(model, ideal) - ideal)
            assert np.all(off < 1e-12 * (1 + radius))
