"""Descriptions of a fit for the page, as text and numbers that JSON holds."""

from typing import Any

import numpy as np

from .. import Fit, Scene
from ..formats import object_pose
from ..names import STATUSES
from ..plot import disagreement
from .drawing import band_of


def with_assumed_phi(fit: Fit, phi_from: str) -> Fit:
    """Return a fit that names the guess of the field of view that it held fixed.

    The camera is only as right as that guess, so it has not `converged`. `phi_from` is the guess's
    origin, "" if somebody gave it.
    """
    if not phi_from:
        return fit
    words = f"field of view {phi_from}: {np.rad2deg(float(fit.camera.phi)):.1f} degrees"
    words += "; the sigmas ignore its error: let the fit change it, or give --fov"
    status = "uncertain" if fit.status == "converged" else fit.status
    return fit._replace(status=status, weak=(words, *fit.weak))


def fit_description(
    fit: Fit, scene: Scene, mask: np.ndarray | None, phi_from: str = ""
) -> dict[str, Any]:
    """Return a fit's status, table, notes, outline with its band, K, R and t. (`phi_from`: see
    `with_assumed_phi`.)"""
    status = {"status": fit.status, "meaning": STATUSES[fit.status]}
    if phi_from and fit.status == "uncertain":
        status["meaning"] = f"use it as a start only: {fit.weak[0].partition(';')[0]}"
    if fit.status == "non_finite":
        none: dict[str, Any] = {"iou": None, "rows": [], "notes": [], "band": None, "pose": ""}
        return {**status, **none}
    notes = () if mask is None else disagreement(fit.camera, scene, mask)
    return {
        **status,
        "iou": fit.iou,
        "rows": [row.cells() for row in fit.parameters.rows],
        "notes": [*fit.weak, *notes],
        "band": band_of(fit, scene),
        "pose": str(object_pose(fit, pixel_centres="integer")),
    }
