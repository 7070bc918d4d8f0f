"""How far a camera has moved: which way, and how surely."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import normal, usual_camera
from refusals import refusal
from results import NAMES, fit_at
from scipy.stats import kstest

import pinhole_jax as pj

CAMERA = usual_camera()
#: Turns and shifts that go together, as those of a small object far away do.
MIX = normal((7, 7)) @ np.diag([1, 1, 1, 1, 0.1, 0.01, 0.01])
COVARIANCE = 1e-6 * MIX @ MIX.T


def fit_of(camera, covariance=COVARIANCE, names=NAMES):
    n = len(names)
    return fit_at(camera, covariance[:n, :n], names)


def moved(turn=(0, 0, 0), shift=(0, 0, 0)):
    """CAMERA turned about, and shifted along, its axes right, up, forward."""
    return fit_of(CAMERA).displaced([*turn, *(shift @ np.stack(pj.camera_basis(CAMERA))), 0])


def drift_to(camera, *given):
    """The drift from CAMERA to a fit that found a camera."""
    return pj.drift(fit_of(camera, *given), CAMERA)


@pytest.mark.parametrize("axis", range(3))
def test_drift_has_the_right_direction(axis):
    """Up is pitch, left is yaw, the right side down is roll: what was in the middle is then seen
    lower, or farther right, and what is at the right higher."""
    turn = 0.01 * np.eye(3)[axis]
    camera = moved(turn=turn)
    right = np.asarray(pj.camera_basis(CAMERA).b1)
    place = np.asarray(CAMERA.p) + (0.5 * right if axis == 2 else 0)
    change = np.asarray(pj.project(camera, place)) - np.asarray(pj.project(CAMERA, place))
    assert np.argmax(np.abs(change)) == [1, 0, 1][axis]
    assert change @ [[0, -1], [1, 0], [0, 1]][axis] > 0.01
    found = drift_to(camera)
    assert_allclose(found.turn, turn, atol=1e-9)
    assert found.angle == pytest.approx(0.01, rel=1e-6)


def test_drift_along_the_axes_is_said_with_their_names():
    found = drift_to(moved(shift=(0.1, -0.2, 0.3)))
    assert_allclose(found.shift, [0.1, -0.2, 0.3], atol=1e-9)
    assert "right +0.1, up -0.2, forward +0.3" in str(found)


@pytest.mark.parametrize("both", [False, True])
def test_drift_of_a_still_camera_is_as_rare_as_chance(both):
    random = np.random.default_rng(1)
    root = np.linalg.cholesky(COVARIANCE + 1e-14 * np.eye(7))
    around = lambda: fit_of(CAMERA).displaced(root @ random.normal(size=7))
    reference = lambda: fit_of(around()) if both else CAMERA
    sigmas = [pj.drift(fit_of(around()), reference()).sigma for _ in range(200)]
    # |x| of a normal number x.
    assert kstest(sigmas, "halfnorm").pvalue > 1e-3
    assert np.mean(np.array(sigmas) > 2) < 0.1


def test_errors_that_go_together_count_once():
    """A move along the widest direction is likely, one across is not, though it is no longer."""
    values, vectors = np.linalg.eigh(COVARIANCE[:6, :6])
    pose = fit_of(CAMERA, COVARIANCE, NAMES[:6]).displaced
    along, across = (drift_to(pose(2e-3 * vectors[:, k])) for k in (5, 0))
    assert not along.moved
    assert across.moved
    assert str(along).startswith("not moved: ")
    assert values[5] > 100 * values[0]


def test_parameters_held_in_both_fits_add_no_error():
    """A calibration with phi free, checked with phi held: its error is in both, and a move that is
    large beside the rest is seen."""
    along = np.array([0, 0, 0, 0, 0, 5.0, 0.5])  # phi against the distance
    whole = np.diag([1e-6] * 3 + [1e-4] * 4) + np.outer(along, along)
    rest = np.linalg.inv(np.linalg.inv(whole)[:6, :6])
    there = fit_of(CAMERA).displaced([0, 0, 0, 0, 0, 3.0, 0])
    before = fit_of(CAMERA, whole)
    assert pj.drift(fit_of(there, rest, NAMES[:6]), before).sigma > 5
    # With phi free in both, it might be phi.
    assert not pj.drift(fit_of(there, whole), before).moved


def test_directions_that_masks_do_not_show_do_not_count():
    camera = moved(turn=(0, 0, 0.5))
    assert drift_to(camera).moved
    for hidden in ([2], range(7)):
        free = COVARIANCE.copy()
        free[hidden, :] = free[:, hidden] = np.nan
        free[hidden, hidden] = np.inf
        found = drift_to(camera, free)
        assert found.sigma < 1
        assert found.by[2] == 0
        assert ("cannot tell" in str(found)) == (len(hidden) == 7)


def test_drift_of_a_partly_fitted_pose():
    found = drift_to(moved(turn=(0.01, 0, 0)), COVARIANCE, NAMES[:3])
    assert found.moved
    assert np.all(np.isnan(found.by[3:]))


def test_drift_of_a_certain_move_is_finite():
    assert 100 < drift_to(moved(shift=(5, 0, 0))).sigma < np.inf


def test_fit_without_pose_is_refused():
    with refusal("`fit`: expected one whose pose was free, got phi"):
        drift_to(CAMERA, np.eye(1), ("phi",))
