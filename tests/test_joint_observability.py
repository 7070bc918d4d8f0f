"""Observability of several views, before there is a mask."""

import numpy as np
from arm import RIG, START, TRUTH
from numpy.testing import assert_allclose
from oracles import body, central_difference, drawn
from refusals import refusal
from results import NAMES, fit_at

import pinhole_jax as pj
from pinhole_jax._camera.poses import at_pose, exponential, inverse, pose_of
from pinhole_jax._command.hand_eye import worths


def test_observability_of_a_rig_on_a_mount_equals_polygon_differences(scenes):
    """The right eye follows the left one, and both have one lens."""
    mount, placed = exponential(np.full(6, 0.1)), exponential(np.full(6, 0.2))
    left = fit_at(at_pose(TRUTH, inverse(mount) @ placed @ pose_of(TRUTH)), np.eye(7))
    place = {"mount": mount, "placed": placed}
    views = [pj.JointView(scenes[0], None, camera=name, **place) for name in RIG]
    cameras = {name: at_pose(left.camera, pose_of(left.camera) @ RIG[name]) for name in RIG}
    known = {"left": {"phi": (0.6, 0.01)}}
    told = pj.joint_observability(
        views, cameras, ("pose", "phi"), rig=RIG, shared="phi", prior=known, noise=0.1
    )

    def shown(x):
        moved = left.displaced(x)
        poses = (inverse(placed) @ mount @ pose_of(moved) @ RIG[name] for name in RIG)
        return np.stack([drawn(at_pose(moved, pose), scenes[0]) for pose in poses])

    J = central_difference(shown, np.zeros(7)).reshape(-1, 7)
    information = J.T @ J / 0.1**2
    information[6, 6] += 0.01**-2
    assert (told.names[:7], told.rank) == (tuple(f"left {name}" for name in NAMES), 7)
    expected = np.diag(np.linalg.inv(information))
    assert_allclose(told.std[:7] ** 2, expected, rtol=2e-4)


def test_observability_predicts_the_error_bars_of_a_fit(noisy):
    asked = START, ("pose", "phi")
    fit = pj.fit_joint(noisy[:1], *asked).cameras["camera"]
    told = pj.joint_observability(noisy[:1], fit.camera, ("pose", "phi"), noise=0.05)
    assert told.names == tuple(f"camera {name}" for name in fit.names)
    assert_allclose(told.std, np.sqrt(np.diag(fit.independent_covariance)), rtol=0.15)
    alone = pj.observability(fit.camera, noisy[0].scene, ("pose", "phi"), noise=0.05)
    assert_allclose(told.covariance, alone.covariance, rtol=1e-6)
    with refusal("`noise`: expected a positive standard deviation"):
        pj.joint_observability(noisy[:1], *asked, noise=0.0)


def test_proposed_mask_adds_its_information(scenes):
    """Of two masks that are alike a third one is worth its share; one that shows nothing, none."""
    seen = pj.JointView(scenes[0], None)
    mesh = scenes[0].mesh
    aside = seen._replace(scene=body(mesh.vertices + 90.0, mesh.faces))
    found = worths([seen, seen], TRUTH, "pose,phi", [seen, aside])
    assert_allclose(found, [1.5**0.5, 1], rtol=1e-6)
    assert worths([aside], TRUTH, "pose,phi", [seen, aside]) == [np.inf, 1]
