import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import turned

import pinhole_jax as pj

CAMERA = pj.Camera([1.0, 2, 5], [0.1, 0, 0], [0.3, 1, 0.2], 0.7, 2.0, 3, 2)


@pytest.mark.parametrize("degrees", [1e-9, 0.3, 90.0, 180.0])
def test_pose_error_is_the_angle_turned_and_the_way_moved(degrees):
    angle, shift = pj.pose_error(CAMERA, turned(CAMERA, [1, 2, 3], degrees))
    assert_allclose(np.rad2deg(angle), degrees, rtol=1e-5)
    expected = np.linalg.norm(np.asarray(turned(CAMERA, [1, 2, 3], degrees).e - CAMERA.e))
    assert_allclose(shift, expected)


def test_pose_error_is_free_of_the_gauge():
    other = pj.Camera(CAMERA.e, CAMERA.e + 3 * (CAMERA.p - CAMERA.e), 2 * CAMERA.u, 0.3, 5.0, 8, 8)
    angle, shift = pj.pose_error(CAMERA, other)
    assert_allclose([angle, shift], 0, atol=1e-15)


def test_pose_error_has_a_finite_derivative_at_zero():
    slope = jax.jit(jax.grad(lambda c: pj.pose_error(c, CAMERA)[0]))(CAMERA)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slope))


def test_iou_by_hand():
    a, b = jnp.array([[1.0, 0.5, 0]]), jnp.array([[0.5, 0.5, 0.5]])
    assert_allclose(pj.iou(a, b), 1.0 / 2.0)
    assert float(pj.iou(0 * a, 0 * a)) == 1
