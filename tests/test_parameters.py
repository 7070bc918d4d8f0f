import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pinhole_jax as pj
from pinhole_jax._camera.camera import camera_basis
from pinhole_jax._camera.distortion import COEFFICIENTS
from pinhole_jax._solver.moves import (
    Move,
    canonical,
    displaced,
    moved,
    on_film,
    reported,
    rotation,
    scales,
)
from pinhole_jax._solver.parameters import (
    NAMES,
    check_free,
    components,
    in_one,
    labels_of,
    with_lens,
)

CAMERA = pj.Camera([1.0, 2, 5], [0.1, 0, 0], [0.3, 1, 0.2], 0.7, 2.0, 30, 20)
PIVOT = jnp.array([0.2, -0.1, 0.3])


def move(y, *free):
    n = len(components(free))
    return moved(Move(CAMERA, PIVOT, jnp.ones(n)), jnp.asarray(y, float), free)


def test_rotation_is_rodrigues():
    np.testing.assert_allclose(
        rotation(jnp.array([0, 0, np.pi / 2])) @ jnp.array([1.0, 0, 0]), [0, 1, 0], atol=1e-15
    )
    np.testing.assert_array_equal(rotation(jnp.zeros(3)), np.eye(3))
    for size in (1e-9, 1e-2, 0.0099, 3.0):
        R = rotation(size * jnp.array([1.0, 2, 3]))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    slope = jax.jacfwd(rotation)(jnp.zeros(3))
    np.testing.assert_allclose(slope[..., 2], [[0, -1, 0], [1, 0, 0], [0, 0, 0]])


def test_zero_move_changes_nothing():
    for before, after in zip(
        jax.tree.leaves(CAMERA), jax.tree.leaves(move(np.zeros(7), "pose", "phi")), strict=True
    ):
        np.testing.assert_allclose(before, after, atol=1e-15)


def test_pose_moves_are_rigid_and_keep_the_gauge():
    after = move([0.3, -0.2, 0.5, 0.1, 0.2, 0.3], "pose")
    for camera in (CAMERA, after):
        view = np.asarray(camera.p - camera.e)
        np.testing.assert_allclose(np.linalg.norm(view), np.linalg.norm(CAMERA.p - CAMERA.e))
        np.testing.assert_allclose(np.linalg.norm(camera.u), np.linalg.norm(CAMERA.u))
        np.testing.assert_allclose(
            view @ np.asarray(camera.u), (CAMERA.p - CAMERA.e) @ CAMERA.u, rtol=1e-12
        )
    assert float(after.phi) == float(CAMERA.phi)


def test_turning_about_the_pivot_leaves_it_where_it_is_seen():
    after = move([0.3, -0.2, 0.5, 0, 0, 0], "pose")
    np.testing.assert_allclose(pj.project(after, PIVOT), pj.project(CAMERA, PIVOT), atol=1e-12)


def test_log_distance_scales_the_distance_to_the_pivot():
    after = move([0, 0, 0, 0, 0, np.log(2)], "pose")
    np.testing.assert_allclose(after.e - PIVOT, 2 * (CAMERA.e - PIVOT))


def test_position_keeps_the_orientation_and_orientation_the_eye():
    there = move([0.1, 0.2, 0.3], "position")
    np.testing.assert_allclose(camera_basis(there), camera_basis(CAMERA), atol=1e-14)
    turned = move([0.1, 0.2, 0.3], "orientation")
    np.testing.assert_allclose(turned.e, CAMERA.e, atol=1e-14)


def test_focal_length_by_phi_and_by_d():
    # d means something only while the film's height h is held: phi = 2 atan(h / (2 d)).
    h = 2 * 2.0 * np.tan(0.35)
    by_d = move([np.log(1.5)], "d")
    np.testing.assert_allclose(by_d.d, 3.0)
    np.testing.assert_allclose(by_d.phi, 2 * np.arctan(h / 6.0))
    by_phi = move([np.log(1.5)], "phi")
    assert float(by_phi.d) == 2.0
    np.testing.assert_allclose(by_phi.phi, by_d.phi)


def test_canonical_camera_sees_the_same_in_film_heights():
    unit = canonical(CAMERA)
    points = jnp.array([[0.3, 0.2, 0.1], [1, 1, 1]])
    np.testing.assert_allclose(20 * pj.project(unit, points), pj.project(CAMERA, points))
    back = on_film(unit, CAMERA)
    assert (back.W, back.H, back.lens) == (30, 20, None)
    back = on_film(unit, with_lens(CAMERA, ("principal_point",)))
    np.testing.assert_allclose(back.lens.principal_point, [15, 10])


@pytest.mark.long
def test_units_move_the_outline_by_about_a_pixel():
    free = ("pose", "phi", "principal_point", "aspect")
    unit = canonical(CAMERA)
    step = scales(unit, PIVOT, jnp.asarray(1.0), jnp.asarray(20.0), free)
    rim = PIVOT[None] + jnp.asarray(np.random.default_rng(0).normal(size=(50, 3)) / 2)

    def film(y):
        return 20 * pj.project(moved(Move(unit, PIVOT, step), y, free), rim)

    jacobian = np.asarray(jax.jacfwd(film)(jnp.zeros(10)))
    sizes = np.sqrt((jacobian**2).sum(axis=1).mean(axis=0))
    assert np.all((sizes > 0.2) & (sizes < 2))


def test_reported_steps_have_their_stated_units():
    free = ("pose", "phi", "principal_point", "aspect")
    unit = canonical(CAMERA)
    shift = jnp.array([0, 0, 0, 0, 0, 0, 0, 0.5, 0.25, 0.1])
    values = dict(
        zip(
            ["r1", "r2", "rv", "x", "y", "z", "phi", "px", "py", "aspect"],
            reported(unit, moved(Move(unit, PIVOT, jnp.ones(10)), shift, free), free).tolist(),
            strict=True,
        )
    )
    np.testing.assert_allclose([values[k] for k in "xyz"], CAMERA.e)
    np.testing.assert_allclose([values["px"], values["py"]], [0.75 + 0.5, 0.5 + 0.25])
    np.testing.assert_allclose(values["aspect"], np.exp(0.1))
    # A small turn of the camera about its own forward axis.
    roll = moved(Move(unit, unit.e, jnp.ones(3)), jnp.array([0, 0, 1e-6]), ("orientation",))
    np.testing.assert_allclose(reported(unit, roll, ("orientation",)), [0, 0, 1e-6], atol=1e-12)


@pytest.mark.parametrize(
    ("free", "message"),
    [
        (("pose", "zoom"), "`free`: expected names among pose, .*, got 'zoom'"),
        ((), "`free`: expected at least one"),
        (("phi", "d"), "`free`: expected phi or d"),
        (("pose", "position"), "`free`: expected pose, or position or orientation"),
    ],
)
def test_bad_names_are_refused(free, message):
    with pytest.raises(ValueError, match=message):
        check_free(free)


def test_position_and_orientation_are_the_pose_that_a_fit_guards():
    """A whole pose is searched and walked, under whatever names."""
    assert in_one(check_free(["phi", "orientation", "position"])) == ("pose", "phi")
    assert in_one(("position", "phi")) == ("position", "phi")


def test_names_may_be_one_word_or_in_any_order():
    assert check_free("phi") == ("phi",)
    assert check_free(["phi", "pose"]) == ("pose", "phi")


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


def test_camera_is_changed_by_its_arguments_and_its_pose():
    wide = CAMERA.replace(phi=1.0, W=60)
    assert (float(wide.phi), wide.W, wide.H, float(wide.d)) == (1.0, 60, 20, 2.0)
    with pytest.raises(ValueError, match="`phi`: expected an angle"):
        CAMERA.replace(phi=4.0)
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    axes[2] *= np.linalg.det(axes) * -1  # b1, b2, v: v = b2 x b1
    there = CAMERA.with_pose([3.0, 2.0, 1.0], axes)
    np.testing.assert_allclose(there.e, [3, 2, 1])
    np.testing.assert_allclose(np.stack(camera_basis(there)), axes, atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(there.p - there.e), np.linalg.norm(CAMERA.p - CAMERA.e)
    )
