"""Drawings of a camera for the page: numbers for its shader, the outline and its band, straight
lines as the lens bends them. Places are in px from the upper left corner, x right, y down.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import Camera, Fit, Lens, Scene, outline, project, rays_through
from ..plot import outline_sigma
from ..show.space import axes_of
from .hand import focal_px, principal_point

#: A grid of straight lines has this many of them along the shorter side of the picture.
GRID = 8
#: A bent line has this many points.
POINTS = 49
#: Lines farther from the picture than this many of its sides are not drawn.
FAR = 20

Line = tuple[tuple[float, float], tuple[float, float]]


def camera_numbers(camera: Camera) -> dict[str, Any]:
    """Return the camera's numbers for the page's shader and sliders."""
    lens = camera.lens
    distortion = None if lens is None or lens.distortion is None else lens.distortion
    return {
        "W": camera.W,
        "H": camera.H,
        "eye": np.asarray(camera.e, float).tolist(),
        "axes": axes_of(camera).tolist(),
        "focal": focal_px(camera).tolist(),
        "principal": principal_point(camera).tolist(),
        "phi_degrees": float(np.rad2deg(float(camera.phi))),
        "aspect": 1.0 if lens is None else float(lens.aspect),
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
    spacing = min(camera.W, camera.H) / GRID
    where = principal_point(camera)
    reach = 1.6  # a barrel shows more than the ideal film
    lines = []
    for axis, size in enumerate((camera.W, camera.H)):
        first = np.ceil((where[axis] - reach * size) / spacing)
        last = np.floor((where[axis] + reach * size) / spacing)
        other = (camera.W, camera.H)[1 - axis]
        along = np.linspace(-reach, reach, POINTS) * other + where[1 - axis]
        for k in np.arange(first, last + 1):
            line = np.empty((POINTS, 2))
            line[:, axis] = where[axis] + spacing * (k - np.round((first + last) / 2))
            line[:, 1 - axis] = along
            lines.append(line)
    return [
        part
        for line in _reproject(_ideal(camera), camera, np.array(lines))
        for part in _visible_parts(line, camera)
    ]


def straight_lines(camera: Camera, lines: Sequence[Line]) -> list[list[list[float]]]:
    """Return lines straight in space, each from one place of the picture to another, as the lens
    shows them."""
    if not lines:
        return []
    ends = np.array(lines, float) * [1, -1] + [0, camera.H]
    share = np.linspace(0, 1, POINTS)[:, None]
    ideal = _reproject(camera, _ideal(camera), ends)
    rows = ideal[:, None, 0] * (1 - share) + ideal[:, None, 1] * share
    return _flip(_reproject(_ideal(camera), camera, rows), camera).round(2).tolist()


def _ideal(camera: Camera) -> Camera:
    """Return the camera without its distortion."""
    aspect = 1.0 if camera.lens is None else camera.lens.aspect
    return camera.replace(lens=Lens(principal_point(camera), aspect))


def _reproject(before: Camera, after: Camera, points: np.ndarray) -> np.ndarray:
    """Return film points of a camera as another camera of the same pose shows them."""
    at_origin = lambda camera: camera.with_pose([0, 0, 0], axes_of(camera))
    rays = rays_through(at_origin(before), points.astype(before.e.dtype))
    return np.asarray(project(at_origin(after), rays.direction), float)


def _visible_parts(line: np.ndarray, camera: Camera) -> list[list[list[float]]]:
    """Return the parts of a line of points on the film or near it."""
    margin = np.array([camera.W, camera.H]) * 0.1
    on = np.all((line > -margin) & (line < np.array([camera.W, camera.H]) + margin), axis=1)
    cuts = np.flatnonzero(np.diff(on.astype(int))) + 1
    parts = np.split(_flip(line, camera).round(2), cuts)
    return [
        part.tolist()
        for part, is_on in zip(parts, np.split(on, cuts), strict=True)
        if is_on[0] and len(part) > 1
    ]


def _flip(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Return film coordinates as places from the picture's upper left corner."""
    return points * [1, -1] + [0, camera.H]
