"""How far a camera has moved: which way, and how surely."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import usual_camera
from results import NAMES, fit_at
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import pinhole_jax as pj
from pinhole_jax._camera.poses import at_pose, exponential, pose_of
from pinhole_jax._fit.drift import other_places
from pinhole_jax._solver.moves import displaced

CAMERA = usual_camera()
#: Turns and shifts that go together, as those of a small object far away do.
MIX = np.random.default_rng(0).normal(size=(7, 7)) @ np.diag([1, 1, 1, 1, 0.1, 0.01, 0.01])
COVARIANCE = 1e-6 * MIX @ MIX.T


def fit_of(camera, covariance=COVARIANCE, names=NAMES):
    n = len(names)
    return fit_at(camera, covariance[:n, :n], names)


def moved(turn=(0, 0, 0), shift=(0, 0, 0)):
    """CAMERA turned about, and shifted along, its axes right, up, forward (OpenCV's frame)."""
    down = np.array([1, -1, 1])
    twist = 1.0 * np.concatenate([down * turn, down * shift])
    return at_pose(CAMERA, pose_of(CAMERA) @ exponential(twist))


def test_drift_has_the_right_direction():
    """Up is pitch, left is yaw: what was in the middle is then seen lower, or farther right."""
    middle = np.asarray(CAMERA.p)
    x, y = np.asarray(pj.project(CAMERA, middle))
    for axis, change in enumerate(([0, -1], [1, 0])):
        turn = np.zeros(3)
        turn[axis] = 0.01
        camera = moved(turn=turn)
        there = np.asarray(pj.project(camera, middle)) - [x, y]
        assert np.argmax(np.abs(there)) == np.argmax(np.abs(change))
        assert np.sum(there * change) > 0
        found = pj.drift(fit_of(camera), CAMERA)
        assert_allclose(found.turn, turn, atol=1e-9)
        assert found.angle == pytest.approx(0.01, rel=1e-6)
    # The right side down: what is at the right is seen higher.
    right = middle + 0.5 * np.asarray(pj.camera_basis(CAMERA).b1)
    camera = moved(turn=(0, 0, 0.01))
    assert pj.project(camera, right)[1] > pj.project(CAMERA, right)[1] + 0.01
    assert_allclose(pj.drift(fit_of(camera), CAMERA).turn, [0, 0, 0.01], atol=1e-9)
    found = pj.drift(fit_of(moved(shift=(0.1, -0.2, 0.3))), CAMERA)
    assert_allclose(found.shift, [0.1, -0.2, 0.3], atol=1e-9)
    assert "right +0.1, up -0.2, forward +0.3" in str(found)


@pytest.mark.parametrize("both", [False, True])
def test_drift_of_a_still_camera_is_as_rare_as_chance(both):
    random = np.random.default_rng(1)
    root = np.linalg.cholesky(COVARIANCE + 1e-14 * np.eye(7))
    around = lambda: displaced(CAMERA, NAMES, root @ random.normal(size=7))
    reference = lambda: fit_of(around()) if both else CAMERA
    sigmas = [pj.drift(fit_of(around()), reference()).sigma for _ in range(200)]
    # |x| of a normal number x.
    assert kstest(sigmas, "halfnorm").pvalue > 1e-3
    assert np.mean(np.array(sigmas) > 2) < 0.1


def test_errors_that_go_together_count_once():
    """A move along the widest direction is likely, one across is not, though it is no longer."""
    values, vectors = np.linalg.eigh(COVARIANCE[:6, :6])
    along, across = (
        pj.drift(fit_of(displaced(CAMERA, NAMES[:6], 2e-3 * vectors[:, k])), CAMERA) for k in (5, 0)
    )
    assert not along.moved
    assert across.moved
    assert str(along).startswith("not moved: ")
    assert values[5] > 100 * values[0]


def test_parameters_held_in_both_fits_add_no_error():
    """A calibration with phi free, checked with phi held: its error is in both, and a move that is
    large beside the rest is seen."""
    whole = np.diag([1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2, 1e-2]) ** 2
    along = np.array([0, 0, 0, 0, 0, 5.0, 0.5])  # phi against the distance
    whole = whole + np.outer(along, along)
    rest = np.linalg.inv(np.linalg.inv(whole)[:6, :6])
    names = NAMES[:6]
    step = np.array([0, 0, 0, 0, 0, 3.0])
    moved_on = fit_of(displaced(CAMERA, names, step), rest, names)
    assert pj.drift(moved_on, fit_of(CAMERA, whole)).sigma > 5
    # With phi free in both, it might be phi.
    assert not pj.drift(fit_of(moved_on.camera, whole), fit_of(CAMERA, whole)).moved


def test_directions_that_masks_do_not_show_do_not_count():
    free = COVARIANCE.copy()
    free[2, :] = free[:, 2] = np.nan
    free[2, 2] = np.inf
    camera = moved(turn=(0, 0, 0.5))
    found = pj.drift(fit_of(camera, free), CAMERA)
    assert found.sigma < 1
    assert found.by[2] == 0
    assert pj.drift(fit_of(camera), CAMERA).moved
    blind = np.full((7, 7), np.nan)
    np.fill_diagonal(blind, np.inf)
    assert pj.drift(fit_of(camera, blind), CAMERA).sigma == 0


def test_drift_of_a_partly_fitted_pose():
    found = pj.drift(fit_of(moved(turn=(0.01, 0, 0)), names=NAMES[:3]), CAMERA)
    assert found.moved
    assert np.all(np.isnan(found.by[3:]))


def test_drift_of_a_certain_move_is_finite():
    found = pj.drift(fit_of(moved(shift=(5, 0, 0))), CAMERA)
    assert np.isfinite(found.sigma)
    assert found.sigma > 100


def test_fit_without_pose_is_refused():
    with pytest.raises(ValueError, match="`fit`: expected one whose pose was free, got phi"):
        pj.drift(fit_of(CAMERA, np.eye(1), ("phi",)), CAMERA)


def test_modes_that_the_noise_does_not_tell_apart_are_one():
    """One standard error away is the same place, ten are another one; told twice, it is one."""
    covariance = np.diag(np.full(7, 0.02) ** 2)
    fit = fit_of(CAMERA, covariance)
    near, far, beside = (moved(turn=(0.02 * x, 0, 0)) for x in (1, 10, 10.5))
    modes = [fit_of(camera, covariance) for camera in (near, far, beside)]
    assert [m.camera for m in other_places(fit, modes)] == [far]
    # What is as near is another place where the noise is less, or does not say.
    sharp, blind = 1e-4 * covariance, covariance.copy()
    blind[0, 0] = np.inf
    for told in (sharp, blind):
        found = other_places(fit_of(CAMERA, told), modes)
        assert [m.camera for m in found] == [near, far, beside]
    assert other_places(fit, []) == []
    # One that is left keeps the status, the farthest of those that are the fit's place.
    assert [m.camera for m in other_places(fit, [fit_of(CAMERA, covariance), modes[0]])] == [near]
    # However wide the error bars are, a large move is reported.
    wide = fit_of(CAMERA, 1e4 * covariance)
    assert [m.camera for m in other_places(wide, modes)] == [far]


def test_modes_but_for_a_free_turn_are_one():
    """A can is seen upright from one side, or upside down from any."""
    about = lambda axis, angle: Rotation.from_rotvec(angle * np.array(axis)).as_matrix()

    def seen(turn):
        e, p, u = (turn @ x for x in np.eye(3)[[2, 0, 1]])
        return fit_of(pj.Camera(5 * e, p, u, 0.6, 1.0, 96, 80), np.full((7, 7), np.inf))

    over = about([1.0, 0, 0], np.pi)
    fit, beside = seen(np.eye(3)), seen(about([0, 1.0, 0], 2.0))
    below, beside_below = seen(over), seen(about([0, 1.0, 0], 1.0) @ over)
    modes = [beside, below, beside_below]
    assert other_places(fit, modes) == modes
    assert other_places(fit, modes, [np.array([0, 1.0, 0])]) == [below]
