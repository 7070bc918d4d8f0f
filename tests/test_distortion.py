"""Lens distortion against OpenCV: `projectPoints`, `fisheye.projectPoints`."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chosen import first
from jax.flatten_util import ravel_pytree
from numpy.random import default_rng
from numpy.testing import assert_allclose
from oracles import cast, central_difference, normal
from refusals import refusal
from slopes import both_ways

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
    program = cv2.fisheye if isinstance(model, pj.Fisheye) else cv2
    points = np.asarray(points, float).reshape(-1, 1, 3)
    k = np.array([*model.coefficients().values()])
    found, _ = program.projectPoints(points, cv2.Rodrigues(R)[0], t.reshape(3, 1), K, k)
    u, v = found[:, 0].T
    return np.stack([u + 0.5, camera.H - (v + 0.5)], axis=-1)


@pytest.mark.parametrize("model", [BROWN, FISHEYE, RATIONAL], ids=["brown", "fisheye", "rational"])
def test_points_project_as_opencv_projects_them(model):
    view = camera(model)
    points = default_rng(0).uniform(-1, 1, (200, 3))
    wanted = by_opencv(view, points)
    assert_allclose(pj.project(view, points), wanted, rtol=0, atol=1e-10)


@pytest.mark.parametrize("model", first(1, [None, BROWN, FISHEYE]))
def test_derivatives_of_rays_and_projection_are_differences(model):
    view = camera(model, 1.2, 4, 3)
    points = jnp.asarray(default_rng(1).uniform(-1, 1, (5, 3)))
    flat, unravel = ravel_pytree((view, points))

    @jax.jit
    def image(x):
        moved, points = unravel(x)
        directions = pj.camera_rays(moved).direction
        return jnp.concatenate([z.ravel() for z in (directions, pj.project(moved, points))])

    up = normal(len(image(flat)), 2)
    slopes = lambda way: both_ways(image, flat, way, up)[1:]
    slopes = jax.jit(jax.vmap(slopes, out_axes=(1, None)))
    forward, reverse = slopes(jnp.eye(len(flat)))
    assert np.all(np.isfinite(forward))
    assert_allclose(up @ forward, reverse, atol=1e-9)
    assert_allclose(forward, central_difference(image, flat), rtol=1e-5, atol=1e-7)


trusted = jax.jit(lambda model: model.trusted_radius())


@jax.jit
def round_trip(model, x, y):
    """Points that are distorted, and undistorted."""
    return jnp.stack(model.undistorted(*model(x, y)))


@jax.jit
def along_a_line(model, radius):
    """Places in the image at radii of a direction, and how they move with these."""
    return jax.jvp(lambda r: model(0.6 * r, 0.8 * r), (radius,), (jnp.ones_like(radius),))


def wide(seed):
    """Two lenses at random."""
    k = normal(5, seed) * [0.2, 0.1, 0.003, 0.003, 0.02]
    return pj.BrownConrady(*k), pj.Rational(0.3 + k[0], 0.02, 1e-3, -2e-4, 0.05, k[1], -0.1, 0.02)


#: Polynomials that grow to the plane of the eye, and some that fold before it.
ANGLES = np.loadtxt(
    """
     0.03126  0.005177  0.000664  0.0001007
    -0.1      0         0         0
    -0.25     0.1       0         0
     1        1         1         1
     0.36330 -0.00498   0.00433  -0.01487
    -0.4      0         0         0
    10       -3         0         0
    """.splitlines()
)
TRUSTED = [*(pj.Fisheye(*k) for k in ANGLES), *(lens for seed in range(4) for lens in wide(seed))]


@pytest.mark.parametrize(
    "model", [pj.BrownConrady(-0.4), pj.Fisheye(-0.2), BROWN, pj.Fisheye(), RATIONAL]
)
def test_continuation_beyond_the_fold_is_smooth_and_increasing(model):
    """Beyond the fold, the image goes on: as a function of the radius it is C1 and increasing."""
    radius = np.concatenate([[0.0], np.geomspace(1e-2, 1e3, 20001)])
    x, rise = along_a_line(model, jnp.asarray(radius))
    length = np.hypot(*x)
    assert np.all(np.diff(length) > 0)
    assert np.all(np.abs(np.diff(np.hypot(*rise))) < 0.05 * (1 + np.hypot(*rise)[1:]))


@pytest.mark.parametrize(
    "model, phi", [(pj.BrownConrady(-0.4), 1.6), (pj.Fisheye(), 2.8), (pj.Fisheye(-0.3), 2.0)]
)
def test_lens_that_folds_within_the_film_is_refused(model, phi):
    with refusal("`lens`: expected a distortion that"):
        camera(model, phi)


def test_distortion_that_is_none_is_refused():
    with refusal("`distortion`: expected a BrownConrady, a Rational"):
        pj.Lens([1, 1], 1.0, [0.1])
    with refusal("`k2`: expected finite values, got nan"):
        pj.BrownConrady(0.1, np.nan)


def test_derivatives_of_fisheye_rays_hold_to_89_degrees():
    """There and back changes nothing, whatever the radius and the lens."""
    radius = np.tan(np.radians([1e-6, 30, 60, 80, 88, 89]))

    def there_and_back(radius, k):
        x, y = round_trip(pj.Fisheye(*k), 0.6 * radius, 0.8 * radius)
        return jnp.arctan(0.6 * x + 0.8 * y) - jnp.arctan(radius)

    def with_slope(radius, k):
        return jnp.stack(jax.value_and_grad(there_and_back)(radius, k))

    for jacobian in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(jax.vmap(jacobian(with_slope, (0, 1)), (0, None)))
        for slope in slopes(radius, jnp.asarray(ANGLES[0])):
            assert_allclose(slope[:, 0], 0, atol=1e-8)
            assert_allclose(slope[1:, 1], 0, atol=1e-8)


@pytest.mark.parametrize("dtype", first(1, ["float64", "float32"]))
def test_wide_lenses_are_inverted_wherever_they_are_trusted(dtype):
    """Up to where the image grows by a hundred times, or by a twentieth, of its growth inside."""
    for model in TRUSTED:
        edge = 0.999 * np.arctan(float(trusted(model)))
        radius = np.tan(np.linspace(0, min(edge, 1.52), 500))
        ideal = (radius * np.stack([np.cos(9 * radius), np.sin(9 * radius)])).astype(dtype)
        off = np.asarray(round_trip(cast(model, dtype), *ideal), float) - ideal
        assert np.all(np.hypot(*off) < 5000 * np.finfo(dtype).eps * (1 + radius**2))


def test_points_beyond_a_lens_go_on_straight():
    model = pj.Fisheye(*ANGLES[5])  # folds at 51 degrees
    ideal = np.linspace(0.9, 30.0, 500) * float(trusted(model))
    ideal = np.stack([0.6 * ideal, 0.8 * ideal])
    assert_allclose(round_trip(model, *ideal), ideal, rtol=1e-12)
