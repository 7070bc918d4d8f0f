"""Pictures of a fit, as arrays (uint8 RGB) and SVG text: the outline with its uncertainty over the
photo, where mask and camera differ, how the fit came there, the object and the camera in space.
"""

from itertools import groupby
from typing import Any

import numpy as np
from jaxtyping import Float

from ._camera.camera import Camera
from ._camera.rays import project
from ._fit.result import Fit, Progress, check_fit
from ._mask.target import as_coverage, check_image
from ._scene.scene import Scene, check_view
from ._show.disagreement import disagreement as disagreement
from ._show.outline import contour_points, outline as outline
from ._show.space import scene_view as scene_view
from ._silhouette.silhouette import silhouette
from ._solver.moves import displaced

CYAN = (0, 240, 255)
RED = (235, 40, 60)
DARK = (0, 30, 60)
YELLOW = (255, 220, 0)
#: How much of 255 a band covers of the picture.
TINT = 50
MORE, LESS = (230, 90, 20), (30, 110, 210)
#: Pictures are enlarged to about this many pixels.
SHOWN_PX = 800


Window = tuple[int, int, int, int]


def outline_sigma(fit: Fit, scene: Scene) -> Float[np.ndarray, "n"]:
    """Return how far (px) each segment of `outline(fit.camera, scene)` moves across itself at one
    standard error of the camera.

    To first order: points of the contour stay on the object while the camera moves by each
    principal axis of its covariance. Parameters that the mask does not determine are left out.

    ```python
    sigma = pj.plot.outline_sigma(fit, scene)  # px, for each segment
    ```
    """
    from scipy.spatial import KDTree

    check_fit(fit)
    check_view(fit.camera, scene)
    known = np.flatnonzero(np.isfinite(fit.std))
    segments = outline(fit.camera, scene)
    if not known.size or not len(segments):
        return np.zeros(len(segments))
    variance, axes = np.linalg.eigh(fit.covariance[np.ix_(known, known)])
    place = lambda camera: np.asarray(project(camera, points), float)
    moved = lambda step: displaced(fit.camera, fit.names, step)
    points = np.asarray(contour_points(fit.camera, scene), fit.camera.e.dtype)
    points = points[KDTree(place(fit.camera)).query(segments.mean(axis=1))[1]]
    far = float(np.linalg.norm(np.mean(points - np.asarray(fit.camera.e), axis=0)))
    large = {"e": far, "d": float(fit.camera.d), "principal": fit.camera.H}
    small = 1e-3 * np.array([large.get(name.split("_")[0], 1.0) for name in fit.names])
    along = segments[:, 1] - segments[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)
    total = np.zeros(len(segments))
    for size, axis in zip(np.sqrt(np.maximum(variance, 0)), axes.T, strict=True):
        step = np.zeros(len(fit.std))
        step[known] = size * axis
        share = 1 / max(float(np.max(np.abs(step) / small)), 1)  # so far that it is still linear
        change = (place(moved(share * step)) - place(moved(-share * step))) / 2 / share
        total += (change[:, 0] * along[:, 1] - change[:, 1] * along[:, 0]) ** 2
    return np.sqrt(total)


def overlay(
    image: np.ndarray,
    camera: Camera,
    scene: Scene,
    colour: tuple[int, int, int] = CYAN,
    *,
    band_px: np.ndarray | None = None,
    window: Window | None = None,
    dots: Float[np.ndarray, "m 2"] | None = None,
) -> np.ndarray:
    """Return the image as RGB uint8 with the outline drawn on it, enlarged to some 800 pixels.

    `image` is uint8 (H, W), (H, W, 3) or (H, W, 4), of the camera's size, row 0 on top. `band_px`
    is the half width of a yellow band about each segment of the outline (`outline_sigma`, or some
    times as much): its two borders, and a tint that lets the picture be seen.
    `window` is the part shown: left, top, right, bottom in px from the upper left. `dots` (film
    coordinates, px), as `Fit.unbelieved` are, are drawn red.

    ```python
    picture = pj.plot.overlay(np.uint8(255 * mask), fit.camera, scene)  # (H', W', 3)
    ```
    """
    from PIL import Image, ImageChops, ImageDraw, ImageFilter

    check_view(camera, scene)
    _check_size("image", image, camera)
    left, top, right, bottom = window or (0, 0, camera.W, camera.H)
    W, H = right - left, bottom - top
    factor = -(-SHOWN_PX // max(W, H))
    fine = 2 * factor  # lines are drawn at twice the size and averaged down: no jagged edges
    canvas = Image.fromarray(np.ascontiguousarray(image[top:bottom, left:right])).convert("RGB")
    canvas = canvas.resize((W * fine, H * fine), Image.Resampling.NEAREST)
    corners = outline(camera, scene) * [1, -1] + [-left, camera.H - top]
    near = np.all((corners > -1e4) & (corners < 1e4), axis=(1, 2))
    if band_px is not None:
        cover = Image.new("L", canvas.size)
        draw = ImageDraw.Draw(cover)
        for (a, b), half in zip(corners[near] * fine, band_px[near] * fine, strict=True):
            across = np.array([b[1] - a[1], a[0] - b[0]])
            across *= half / max(np.linalg.norm(across), 1e-30)
            draw.polygon([tuple(p) for p in (a + across, b + across, b - across, a - across)], 255)
            draw.ellipse([*(b - half), *(b + half)], 255)
        border = ImageChops.subtract(cover, cover.filter(ImageFilter.MinFilter(7)))
        tint = cover.point([TINT * value // 255 for value in range(256)])
        canvas.paste(YELLOW, mask=ImageChops.lighter(border, tint))
    draw = ImageDraw.Draw(canvas)
    for line, width in ((DARK, 6), (colour, 3)):
        for segment in corners[near] * fine:
            draw.line([tuple(point) for point in segment], fill=line, width=width)
    if dots is not None:
        for x, y in (dots * [1, -1] + [-left, camera.H - top]) * fine:
            draw.ellipse([x - fine / 2, y - fine / 2, x + fine / 2, y + fine / 2], fill=RED)
    return np.asarray(canvas.resize((W * factor, H * factor), Image.Resampling.BOX))


def error_map(
    camera: Camera, scene: Scene, target: np.ndarray, *, window: Window | None = None
) -> np.ndarray:
    """Return as RGB uint8 where camera and mask differ, enlarged to some 800 pixels: orange where
    the camera sees more of the object than the mask, blue where less; grey is the object.

    `target` is a mask (H, W) as `fit_camera` takes it; `window` as in `overlay`.

    ```python
    differ = pj.plot.error_map(fit.camera, scene, mask)
    ```
    """
    check_view(camera, scene)
    _check_size("target", target, camera)
    left, top, right, bottom = window or (0, 0, camera.W, camera.H)
    mask = as_coverage(check_image("target", target, camera.W, camera.H))
    both = [np.asarray(silhouette(camera, scene), float), mask]
    shown, mask = (x[top:bottom, left:right, None] for x in both)
    ground = 255 - 45 * np.minimum(shown, mask).clip(0, 1)
    more, less = (np.clip(x, 0, 1) for x in (shown - mask, mask - shown))
    mixed = ground * (1 - more - less) + more * np.array(MORE) + less * np.array(LESS)
    factor = -(-SHOWN_PX // max(mixed.shape[:2]))
    return np.repeat(np.repeat(np.round(mixed).astype(np.uint8), factor, 0), factor, 1)


def object_window(camera: Camera, scene: Scene) -> Window:
    """Return the part of the picture (left, top, right, bottom, px) about the object's outline.

    ```python
    left, top, right, bottom = pj.plot.object_window(fit.camera, scene)
    ```
    """
    ends = (outline(camera, scene) * [1, -1] + [0, camera.H]).reshape(-1, 2)
    ends = ends[np.all((ends >= 0) & (ends <= [camera.W, camera.H]), axis=1)]
    if not len(ends):
        return 0, 0, camera.W, camera.H
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = 0.08 * np.max(high - low) + 2
    left, top = np.floor(np.maximum(low - margin, 0)).astype(int).tolist()
    right, bottom = np.ceil(np.minimum(high + margin, [camera.W, camera.H])).astype(int).tolist()
    return left, top, right, bottom


def _check_size(name: str, image: Any, camera: Camera) -> None:
    if np.shape(image)[:2] != (camera.H, camera.W):
        raise ValueError(
            f"`{name}`: expected the camera's size (H, W) = ({camera.H}, {camera.W}),"
            f" got {np.shape(image)[:2]}"
        )


class Svg(str):
    """SVG text, which notebooks show as a picture.

    ```python
    diagram.partition(">")[0]  # text: write it to a file as it is
    ```
    """

    def _repr_svg_(self) -> str:
        return str(self)


def off_px(fit: Fit, scene: Scene) -> list[float]:
    """Return how far (px, root mean square over the final contour's points) the outline was from
    its place at the end, at each entry of `fit.history`.

    ```python
    pj.plot.off_px(fit, scene)[-1]
    ```
    """
    check_fit(fit)
    check_view(fit.camera, scene)
    points = np.asarray(contour_points(fit.camera, scene), fit.camera.e.dtype)
    if not len(points):
        return [float("nan")] * len(fit.history)
    last = np.asarray(project(fit.camera, points), float)
    cameras = [stop.camera for stop in fit.history]
    moves = [np.asarray(project(c, points), float) - last for c in cameras]
    return [float(np.sqrt(np.mean(np.sum(m**2, axis=1)))) for m in moves]


def levels(fit: Fit) -> list[tuple[Progress, int, int]]:
    """Return each level's end with all its steps, and at which entries of `fit.history` the level
    begins (the end of the one before) and ends.

    ```python
    [end.W for end, first, last in pj.plot.levels(fit)]
    ```
    """
    check_fit(fit)
    found, last = [], 0
    for _, each in groupby(fit.history[1:], lambda stop: (stop.W, stop.H)):
        level, first = list(each), last
        last += len(level)
        end = level[-1]._replace(steps=sum(stop.steps for stop in level))
        found.append((end, first, last))
    return found


def convergence(fit: Fit, scene: Scene) -> Svg:
    """Return a diagram of how far the outline was from its last place (px) by steps, at each entry
    of `fit.history`; the levels are bands with their size in px.

    ```python
    diagram = pj.plot.convergence(fit, scene)  # SVG
    ```
    """
    off = np.maximum(off_px(fit, scene), 1e-12)
    if len(off) < 2 or not np.all(np.isfinite(off)):
        return Svg('<svg xmlns="http://www.w3.org/2000/svg" width="1" height="1"/>')
    steps = np.cumsum([stop.steps for stop in fit.history])
    shown = np.maximum(off, max(off[off > 1e-12].min(initial=1.0), 1e-9) / 10)
    low, high = np.floor(np.log10(shown.min())), np.ceil(np.log10(shown.max()) + 1e-9)
    left, top, width, height = 64, 24, 640, 260
    x = left + width * steps / max(steps[-1], 1)
    y = top + height * (high - np.log10(shown)) / (high - low)
    parts = []
    for k, (level, first, last) in enumerate(levels(fit)):
        a, b = x[first], x[last]
        parts.append(
            f'<rect x="{a:.1f}" y="{top}" width="{b - a:.1f}" height="{height}"'
            f' fill="{("#eef2f6", "#dfe7ef")[k % 2]}"><title>{level}</title></rect>'
        )
        if b - a > 44:
            words = f"{level.W} x {level.H}"
            parts.append(f'<text x="{(a + b) / 2:.1f}" y="{top - 8}" class="m">{words}</text>')
    every = max(int(high - low) // 7, 1)
    for power in range(int(low), int(high) + 1, every):
        at = top + height * (high - power) / (high - low)
        parts.append(f'<line x1="{left}" x2="{left + width}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{left - 8}" y="{at + 4:.1f}" class="e">{10.0**power:g}</text>')
    for step in np.unique(np.linspace(0, steps[-1], 8).round().astype(int)):
        at = left + width * step / max(steps[-1], 1)
        parts.append(f'<text x="{at:.1f}" y="{top + height + 18}" class="m">{step}</text>')
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    parts.append(f'<polyline points="{line}"/>')
    parts += [
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3"><title>{o:.3g} px</title></circle>'
        for a, b, o in zip(x, y, off, strict=True)
    ]
    parts.append(f'<text x="{left + width / 2}" y="{top + height + 38}" class="m">steps</text>')
    parts.append(f'<text x="{left - 8}" y="{top - 8}" class="e">px</text>')
    style = (
        "text{font:12px sans-serif;fill:#456}.m{text-anchor:middle}.e{text-anchor:end}"
        "line{stroke:#fff}polyline{fill:none;stroke:#0a6b8a;stroke-width:2}circle{fill:#0a6b8a}"
    )
    box = f"0 0 {left + width + 16} {top + height + 46}"
    return Svg(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" role="img"'
        f' aria-label="convergence"><style>{style}</style>{"".join(parts)}</svg>'
    )
