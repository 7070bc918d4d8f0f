"""What a fit minimises, for losses of one's own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import drawn, lump, usual_camera
from refusals import refusal

import pinhole_jax as pj

CAMERA = usual_camera(48, 40)
SCENE = lump(2)
EXACT = drawn(CAMERA, SCENE)
START = CAMERA.replace(e=[0.35, 1.03, 5.1])


@pytest.mark.parametrize("mask", [EXACT, EXACT > 0.5, np.uint8(255 * EXACT)])
def test_residuals_are_those_of_a_fit(mask):
    weight = np.ones(mask.shape)
    weight[:, :20] = 0.25
    fit = pj.fit_camera(SCENE, mask, START, weight=weight)
    squares = float(np.sum(np.asarray(pj.residuals(fit.camera, SCENE, mask, weight)) ** 2))
    assert_allclose(fit.rms, np.sqrt(squares / weight.sum()), rtol=1e-6, atol=1e-9)


def test_residuals_are_least_where_a_fit_ends():
    """A fit to a hard mask counts pixels near its edge alone; no shift leads further down."""
    mask = EXACT > 0.5
    fit = pj.fit_camera(SCENE, mask, CAMERA, free="position")
    at = lambda shift: fit.camera.replace(e=fit.camera.e + shift, p=fit.camera.p + shift)
    loss = lambda shift: jnp.sum(pj.residuals(at(shift), SCENE, mask, outlier_px=2.0) ** 2)
    slope = jax.jit(jax.grad(loss))
    for axis in np.eye(3):
        here, beside = (float(slope(x * axis) @ axis) for x in (0.0, 0.02))
        assert abs(here) < 0.02 * abs(beside)


def test_residuals_have_the_slope_of_differences():
    seen = lambda e: pj.residuals(CAMERA.replace(e=e), SCENE, EXACT > 0.5)
    loss = jax.jit(lambda e: jnp.sum(seen(e) ** 2))
    step = 1e-6 * np.array([0.3, -0.5, 0.8])
    central = (loss(START.e + step) - loss(START.e - step)) / 2
    assert_allclose(jax.jit(jax.grad(loss))(START.e) @ step, central, rtol=1e-5)


def test_residuals_of_traced_masks_are_refused():
    with refusal("`target`, `weight`: expected numbers, got traced"):
        jax.grad(lambda mask: pj.residuals(CAMERA, SCENE, mask).sum())(jnp.asarray(EXACT))
