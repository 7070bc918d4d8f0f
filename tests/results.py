"""Fits as if they had been made: a camera, and how it errs."""

import numpy as np

import pinhole_jax as pj

#: What is free of a camera without a lens, in a fit's order.
NAMES = ("rotation_b1", "rotation_b2", "rotation_v", "e_x", "e_y", "e_z", "phi")


def fit_at(camera, covariance, names=NAMES, **more):
    """A fit that found this camera, with this covariance, or such standard errors, independent of
    each other; `more` are other fields."""
    if np.ndim(covariance) == 1:
        covariance = np.diag(np.square(covariance))
    return pj.Fit(camera, "converged", names, covariance, 0.01, 0.99, (3,))._replace(**more)


def degrees(fit, truth):
    """The angle between a fit's camera and the right one."""
    return float(np.rad2deg(pj.pose_error(fit.camera, truth)[0]))


def sigma(fit):
    """The standard error of a fit's rotation, in degrees."""
    return np.rad2deg(np.linalg.norm(fit.std[:3]))


def check_found(fit, truth, most):
    """Assert that a fit converged, and is off the right camera by fewer degrees than these."""
    assert fit.status == "converged"
    assert degrees(fit, truth) < most
