"""Drawings of a camera for the page: numbers for its shader, the outline and its band, straight
lines as the lens bends them. Places are in px from the upper left corner, x right, y down.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import Camera, Fit, Lens, Scene, outline, project, rays_through
from ..plot import outline_sigma
from ..show.space import axes_of
from .hand import focal_px, principal_point

#: A grid of straight lines has this many of them along the shorter side of the picture.
GRID = 8
#: They reach this many times the film's size from the principal point: a barrel shows more.
REACH = 1.6
#: A bent line has this many points.
POINTS = 49
#: Lines farther from the picture than this many of its sides are not drawn.
FAR = 20

Line = tuple[tuple[float, float], tuple[float, float]]


def camera_numbers(camera: Camera) -> dict[str, Any]:
    """Return the camera's numbers for the page's shader and sliders."""
    distortion = camera.distortion
    return {
        "W": camera.W,
        "H": camera.H,
        "eye": np.asarray(camera.e, float).tolist(),
        "axes": axes_of(camera).tolist(),
        "focal": focal_px(camera).tolist(),
        "principal": principal_point(camera).tolist(),
        "phi_degrees": float(np.rad2deg(float(camera.phi))),
        "model": None if distortion is None else type(distortion).__name__,
        "distortion": {} if distortion is None else distortion.coefficients(),
    }


def outline_lines(camera: Camera, scene: Scene) -> list[list[float]]:
    """Return the outline as lines [x, y, x, y], to a hundredth of a px."""
    lines = _flip(outline(camera, scene), camera)
    near = np.all(np.abs(lines) < FAR * max(camera.W, camera.H), axis=(1, 2))
    return lines[near].round(2).reshape(-1, 4).tolist()


def band_of(fit: Fit, scene: Scene) -> dict[str, Any]:
    """Return the outline as lines, the half width (px) of a band about each, and their median.

    A half width is the motion of its line at one standard error.
    """
    lines = _flip(outline(fit.camera, scene), fit.camera)
    sigma = outline_sigma(fit, scene)
    shown = sigma[np.isfinite(sigma) & (sigma > 0)]
    return {
        "lines": lines.round(2).reshape(-1, 4).tolist(),
        "half_px": np.nan_to_num(sigma).clip(0, 1e4).round(3).tolist(),
        "median_px": float(np.median(shown)) if shown.size else 0.0,
    }


def grid_lines(camera: Camera) -> list[list[list[float]]]:
    """Return a grid of lines straight in space, as the lens shows them: rows of points."""
    size = np.array([camera.W, camera.H])
    spacing, reach = min(size) / GRID, REACH * size
    lines = []
    for axis in (0, 1):
        count = int(reach[axis] / spacing)
        steps = spacing * np.arange(-count, count + 1)[:, None]
        along = np.linspace(-1, 1, POINTS) * reach[1 - axis]
        pair = np.broadcast_arrays(steps, along)
        lines.append(np.stack(pair[:: 1 - 2 * axis], axis=-1))
    points = principal_point(camera) + np.concatenate(lines)
    bent = _reprojected(*_ideal_and_own(camera), points)
    near = np.all(np.abs(bent - size / 2) < 0.6 * size, axis=-1)
    shown = _flip(bent, camera).round(2).tolist()
    return [part for pair in zip(near.tolist(), shown, strict=True) for part in _near_parts(*pair)]


def _near_parts(near: list[bool], points: list[list[float]]) -> list[list[list[float]]]:
    """Return the parts of a line that are near the film."""
    runs = itertools.groupby(zip(near, points, strict=True), key=lambda pair: pair[0])
    return [[point for _, point in run] for is_near, run in runs if is_near]


def straight_lines(camera: Camera, lines: Sequence[Line]) -> list[list[list[float]]]:
    """Return lines straight in space, each from one place of the picture to another, as the lens
    shows them."""
    if not lines:
        return []
    ideal, own = _ideal_and_own(camera)
    ends = _reprojected(own, ideal, _flip(np.array(lines, float), camera))
    share = np.linspace(0, 1, POINTS)[:, None]
    rows = ends[:, None, 0] * (1 - share) + ends[:, None, 1] * share
    return _flip(_reprojected(ideal, own, rows), camera).round(2).tolist()


def _ideal_and_own(camera: Camera) -> tuple[Camera, Camera]:
    """Return the camera at the origin: without its distortion, and with it."""
    here = camera.with_pose([0, 0, 0], axes_of(camera))
    if camera.distortion is None:
        return here, here
    assert camera.lens is not None
    return here.replace(lens=Lens(camera.lens.principal_point, camera.lens.aspect)), here


def _reprojected(before: Camera, after: Camera, points: np.ndarray) -> np.ndarray:
    """Return film points of a camera as another camera of the same pose shows them."""
    rays = rays_through(before, points.astype(before.e.dtype))
    return np.asarray(project(after, rays.direction), float)


def _flip(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return film coordinates as places from the picture's upper left corner, or back."""
    return points * [1, -1] + [0, camera.H]
