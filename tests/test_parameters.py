"""What may move: rows of the table, the moves' sizes, and what is reported of them."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax._camera.camera import camera_basis
from pinhole_jax._camera.distortion import COEFFICIENTS
from pinhole_jax._solver.moves import Move, displaced, moved, reported, rotation
from pinhole_jax._solver.parameters import NAMES, check_free, in_one, labels_of

CAMERA = pj.Camera([1.0, 2, 5], [0.1, 0, 0], [0.3, 1, 0.2], 0.7, 2.0, 30, 20)
PIVOT = jnp.array([0.2, -0.1, 0.3])


@pytest.mark.parametrize("size", [0, 1e-9, 1e-2, 0.0099, 3.0])
def test_rotation_is_that_of_scipy(size):
    vector = size * np.array([1.0, 2, 3])
    wanted = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation(jnp.asarray(vector)), wanted, atol=1e-14)


def test_focal_length_by_phi_and_by_d():
    # d means something only while the film's height h is held: phi = 2 atan(h / (2 d)).
    h = 2 * 2.0 * np.tan(0.35)
    by_d, by_phi = (
        moved(Move(CAMERA, PIVOT, jnp.ones(1)), jnp.log(jnp.array([1.5])), (name,))
        for name in ("d", "phi")
    )
    np.testing.assert_allclose([by_d.d, by_phi.d], [3.0, 2.0])
    np.testing.assert_allclose([by_d.phi, by_phi.phi], 2 * np.arctan(h / 6.0))


def test_position_keeps_the_orientation_and_orientation_the_eye():
    step = Move(CAMERA, PIVOT, jnp.ones(3)), jnp.array([0.1, 0.2, 0.3])
    there, turned = (moved(*step, (name,)) for name in ("position", "orientation"))
    np.testing.assert_allclose(camera_basis(there), camera_basis(CAMERA), atol=1e-14)
    np.testing.assert_allclose(turned.e, CAMERA.e, atol=1e-14)


@pytest.mark.parametrize(
    "free",
    [
        ("pose", "phi", "principal_point", "aspect", *COEFFICIENTS),
        ("position", "orientation", "d"),
    ],
)
def test_reported_steps_equal_the_displacement(free):
    """What a step of the reported parameters makes of a camera is what is reported of it."""
    lens = pj.Lens([14, 11], 1.1, pj.Rational(0.3, -0.1, 1e-3, -2e-3, 0.02, 0.6, 0.02, 0.05))
    camera = CAMERA.replace(phi=0.5, lens=lens)
    labels = labels_of(free)
    step = 1e-6 * np.random.default_rng(0).uniform(-1, 1, len(labels))
    before = np.asarray(reported(camera, camera, free))
    after = np.asarray(reported(camera, displaced(camera, labels, step), free))
    np.testing.assert_allclose(after - before, step, rtol=0, atol=1e-11)


def test_table_has_a_row_for_each_name():
    assert NAMES[-1] == "distortion"
    camera = CAMERA.replace(phi=0.5, lens=pj.Lens([14, 11], 1, pj.Rational()))
    everything = check_free(("pose", "phi", *NAMES[5:]), camera)
    assert {*everything} == {*NAMES} - {"position", "orientation", "d", "distortion"}


def test_names_may_be_in_any_order_and_position_with_orientation_is_the_pose():
    """A whole pose is searched and walked, under whatever names."""
    assert in_one(check_free(["phi", "orientation", "position"])) == ("pose", "phi")
    assert in_one(("position", "phi")) == ("position", "phi")


def test_camera_is_changed_by_its_arguments_and_its_pose():
    wide = CAMERA.replace(phi=1.0, W=60)
    assert (float(wide.phi), wide.W, wide.H, float(wide.d)) == (1.0, 60, 20, 2.0)
    axes = Rotation.random(random_state=0).as_matrix() * np.array([[1], [1], [-1]])  # b1, b2, v
    there = CAMERA.with_pose([3.0, 2.0, 1.0], axes)
    np.testing.assert_allclose(there.e, [3, 2, 1])
    np.testing.assert_allclose(np.stack(camera_basis(there)), axes, atol=1e-12)
    length = lambda c: np.linalg.norm(c.p - c.e)
    np.testing.assert_allclose(length(there), length(CAMERA))
