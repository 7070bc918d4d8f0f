"""Drawings of a camera for the page: numbers for its shader, the outline and its band, straight
lines as the lens bends them. Places are in px from the upper left corner, x right, y down.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import Camera, Fit, Scene, outline
from ..plot import outline_sigma
from ..show.space import axes_of, from_top, places_of, points_at
from .hand import focal_px, principal_point

#: A grid of straight lines has this many of them along the shorter side of the picture.
GRID = 8
#: They reach this many times the film's size from the principal point: a barrel shows more.
REACH = 1.6
#: A bent line has this many points.
POINTS = 49


def camera_numbers(camera: Camera) -> dict[str, Any]:
    """Return the camera's numbers for the page's shader and sliders."""
    distortion = camera.distortion
    return {
        "W": camera.W,
        "H": camera.H,
        "eye": np.asarray(camera.e, float),
        "axes": axes_of(camera),
        "focal": focal_px(camera),
        "principal": principal_point(camera),
        "phi_degrees": float(np.rad2deg(float(camera.phi))),
        "model": None if distortion is None else type(distortion).__name__,
        "distortion": {} if distortion is None else distortion.coefficients(),
    }


def outline_lines(camera: Camera, scene: Scene) -> np.ndarray:
    """Return the outline as lines (n, 4), x, y, x, y to a hundredth of a px."""
    return from_top(camera, outline(camera, scene)).round(2).reshape(-1, 4)


def band_of(fit: Fit, scene: Scene) -> dict[str, Any]:
    """Return the outline as lines, the half width (px) of a band about each, and their median.

    A half width is the motion of its line at one standard error.
    """
    sigma = outline_sigma(fit, scene)
    shown = sigma[sigma > 0]
    return {
        "lines": outline_lines(fit.camera, scene),
        "half_px": sigma.clip(0, 1e4).round(3),
        "median_px": float(np.median(shown)) if shown.size else 0.0,
    }


def grid_lines(camera: Camera) -> list[np.ndarray]:
    """Return a grid of lines straight in space, as the lens shows them: rows of points."""
    size = np.array([camera.W, camera.H])
    x, y = REACH * size
    spacing = min(size) / GRID
    steps = lambda reach: spacing * np.arange(-(reach // spacing), reach // spacing + 1)
    lines = [((a, -y), (a, y)) for a in steps(x)] + [((-x, b), (x, b)) for b in steps(y)]
    right_up, ahead = np.split(axes_of(camera), [2])
    slopes = np.array(lines) / focal_px(camera)
    bent = _bent(camera, np.asarray(camera.e, float) + slopes @ right_up + ahead)
    near = np.all(np.abs(bent - size / 2) < 0.6 * size, axis=-1)
    parts = []
    for line, inside in zip(bent, near, strict=True):
        runs = np.split(line, np.flatnonzero(np.diff(inside)) + 1)
        parts += runs[int(not inside[0]) :: 2]
    return parts


def straight_lines(camera: Camera, lines: Sequence[Any]) -> np.ndarray:
    """Return lines straight in space, each from one place of the picture to another, as the lens
    shows them: rows of points."""
    ends = points_at(camera, from_top(camera, np.reshape(lines, (-1, 2))), 1.0)
    return _bent(camera, ends.reshape(-1, 2, 3))


def _bent(camera: Camera, ends: np.ndarray) -> np.ndarray:
    """Return the places (n, `POINTS`, 2) of lines straight in space, by their ends (n, 2, 3)."""
    return places_of(camera, np.linspace(ends[:, 0], ends[:, 1], POINTS, axis=1)).round(2)
