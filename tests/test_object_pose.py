"""The object's pose in the camera's frame, against OpenCV's, differences and random draws."""

import cv2
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from oracles import camera_ahead, central_difference, normal, random_camera, usual_camera
from results import fit_at

import pinhole_jax as pj
from pinhole_jax import formats, io


def fit_of(camera, seed=0):
    root = 1e-4 * normal((7, 7), seed)
    return fit_at(camera, root @ root.T)


def pose_of(fit):
    return formats.object_pose(fit, pixel_centres="half")


def change(pose, other):
    """Return the turn (rad) about the camera's axes and the shift from one pose to another."""
    return np.append(cv2.Rodrigues(other.R @ pose.R.T)[0][:, 0], other.t - pose.t)


@pytest.mark.parametrize("seed", range(4))
def test_covariance_equals_that_of_differences(seed):
    camera = random_camera(default_rng(seed), 64, 48)
    fit = fit_of(camera, seed=seed)
    pose = pose_of(fit)
    at = lambda step: pose_of(fit._replace(camera=fit.displaced(step)))
    # (OpenCV takes turns below 1e-5 for none.)
    J = central_difference(lambda step: change(pose, at(step)), np.zeros(7), 1e-3)
    assert_allclose(pose.covariance, J @ fit.covariance @ J.T, rtol=1e-5, atol=1e-15)
    assert_allclose(pose.std**2, np.diag(pose.covariance))


def test_pose_projects_as_the_camera_does():
    camera = random_camera(default_rng(3), 64, 48)
    pose = pose_of(fit_of(camera))
    middle = 3 * np.asarray(camera.p) - 2 * np.asarray(camera.e)
    points = middle + normal((5, 3), 4) / 4
    seen = cv2.projectPoints(points, cv2.Rodrigues(pose.R)[0], pose.t, pose.K, None)[0][:, 0]
    seen[:, 1] = camera.H - seen[:, 1]
    assert_allclose(seen, pj.project(camera, points), rtol=1e-9)
    assert_allclose(pose.camera_from_world @ pose.world_from_camera, np.eye(4), atol=1e-12)
    assert_allclose(pose.world_from_camera[:3, 3], camera.e)


def test_frozen_parameters_have_no_error_and_hidden_ones_infinite():
    camera = camera_ahead(64, 48)
    covariance = np.array([[np.inf, np.nan], [np.nan, 1e-8]])
    lost = fit_at(camera, covariance, ("rotation_v", "e_x"))
    pose = pose_of(lost)
    assert np.isinf(pose.std[2])
    assert_allclose(pose.std[[0, 1, 3, 4, 5]], [0, 0, 1e-4, 0, 0], atol=1e-12)
    assert np.isnan(pose.covariance[2, 3])


@pytest.mark.parametrize("centres", ["integer", "half"])
def test_pose_is_printed_and_saved_with_the_fit(centres):
    lens = pj.Lens([32, 24], 1.0, pj.BrownConrady(-0.1))
    fit = fit_of(usual_camera(64, 48).replace(lens=lens))
    pose = formats.object_pose(fit, pixel_centres=centres)
    for words in (
        "X_camera = R X_object + t",
        "one sigma",
        "x y z w",
        "BrownConrady: k1 -0.1, k2 0",
    ):
        assert words in str(pose)
    written = io.fit_to_dict(fit, pixel_centres=centres)["fit"]["object_in_camera"]
    assert written["pixel_centres"] == centres
    for name in ("K", "R", "t", "camera_from_world", "world_from_camera"):
        assert_array_equal(written[name], getattr(pose, name))
    assert_array_equal(written["object_covariance"], pose.covariance)
    assert "covariance" not in written  # that of the fit alone has this name
    assert written["distortion"] == {"model": "BrownConrady", **lens.distortion.coefficients()}
