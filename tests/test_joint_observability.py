"""Observability of several views, before there is a mask."""

import numpy as np
import pytest
from arm import BOTH_EYES, RIG, START, TRUTH

import pinhole_jax as pj
from pinhole_jax._camera.poses import pose_of, skew
from pinhole_jax._command.proposals import worths


def by_the_left_eye():
    """The Jacobian of the right eye's reported numbers by the left eye's."""
    flip, step, turned = np.diag([1, -1, 1]), RIG["right"], pose_of(TRUTH)[:3, :3]
    follows = np.eye(6)
    follows[:3, :3] = flip @ step[:3, :3].T @ flip
    follows[3:, :3] = -skew(turned @ step[:3, 3]) @ turned @ flip
    return follows


def test_information_of_both_eyes_of_a_rig_adds_up(stereo):
    """What a rig's masks tell of its pose is what its left eye's and its right eye's do."""
    both = pj.joint_observability(stereo, BOTH_EYES, rig=RIG)
    left, right = (
        pj.joint_observability([v for v in stereo if v.camera == side], {side: camera})
        for side, camera in BOTH_EYES.items()
    )
    assert both.names[:6] == left.names
    assert both.of == 6
    follows = by_the_left_eye()
    information = np.linalg.inv(left.covariance)
    information = information + follows.T @ np.linalg.inv(right.covariance) @ follows
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    np.testing.assert_allclose(both.std[:6], expected, rtol=1e-6)


def test_observability_predicts_the_error_bars_of_a_fit(noisy):
    asked = START, ("pose", "phi")
    fit = pj.fit_joint(noisy[:1], *asked).cameras["camera"]
    told = pj.joint_observability(noisy[:1], fit.camera, ("pose", "phi"), noise=0.05)
    assert told.names == tuple(f"camera {name}" for name in fit.names)
    np.testing.assert_allclose(told.std, np.sqrt(np.diag(fit.independent_covariance)), rtol=0.15)
    alone = pj.observability(fit.camera, noisy[0].scene, ("pose", "phi"), noise=0.05)
    np.testing.assert_allclose(told.covariance, alone.covariance, rtol=1e-6)
    with pytest.raises(ValueError, match="`noise`: expected a positive standard deviation"):
        pj.joint_observability(noisy[:1], *asked, noise=0.0)


def test_proposed_mask_adds_its_information(scenes):
    """Of two masks that are alike a third one is worth its share; one that shows nothing, none."""
    seen = pj.JointView(scenes[0], None)
    mesh = scenes[0].mesh
    aside = seen._replace(scene=pj.Scene(mesh=pj.Mesh(mesh.vertices + 90.0, mesh.faces)))
    found = worths([seen, seen], TRUTH, "pose,phi", [seen, aside])
    np.testing.assert_allclose(found, [1.5**0.5, 1], rtol=1e-6)
    assert worths([aside], TRUTH, "pose,phi", [seen, aside]) == [np.inf, 1]
