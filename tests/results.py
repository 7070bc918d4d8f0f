"""Fits as if they had been made: a camera, and how it errs."""

import numpy as np

import pinhole_jax as pj

#: What is free of a camera without a lens, in a fit's order.
NAMES = ("rotation_b1", "rotation_b2", "rotation_v", "e_x", "e_y", "e_z", "phi")


def fit_at(camera, covariance, names=NAMES, **more):
    """A fit that found this camera, with this covariance; `more` are other fields."""
    return pj.Fit(camera, "converged", names, covariance, 0.01, 0.99, (3,))._replace(**more)


def degrees(fit, truth):
    """The angle between a fit's camera and the right one."""
    return float(np.rad2deg(pj.pose_error(fit.camera, truth)[0]))
