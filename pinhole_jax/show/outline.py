"""The outline over a photo, its uncertainty, and its differences from a mask: pictures (uint8 RGB)
and sentences.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import Camera, Fit, Scene, contour_points, outline, silhouette
from ..io import as_coverage
from .space import from_top, places_of

CYAN, RED = (0, 240, 255), (235, 40, 60)
DARK, YELLOW = (0, 30, 60), (255, 220, 0)
#: The opacity of a band, of 255.
TINT = 50
MORE, LESS = (230, 90, 20), (30, 110, 210)
#: Pictures are enlarged to about this many pixels.
SHOWN_PX = 800
#: Outline and mask differ if they are farther apart than this (px) along more than this share:
#: thin parts between pixels' centres do not count.
APART_PX, LEAST = 3.0, 0.02
CUT_OFF = "the picture's border cuts off {:.0%} of the object's outline"
MISSING = (
    "{:.0%} of the model's outline (near {}) is more than 3 px from the mask's edge: is the mask"
    " cut off or covered there? Give those pixels the weight 0"
)
EXTRA = (
    "{:.0%} of the mask's edge (near {}) is more than 3 px from the model's outline: holes, specks"
    " or background in the mask? Try --tidy"
)

Window = tuple[int, int, int, int]


def outline_sigma(fit: Fit, scene: Scene) -> Float[np.ndarray, "n"]:
    """Return the motion (px) of each segment of `outline(fit.camera, scene)` across itself at one
    standard error of the camera.

    To first order: points of the contour stay on the object while the camera moves along each
    principal axis of its covariance. Parameters that the mask does not determine are left out.

    ```python
    sigma = pj.plot.outline_sigma(fit, scene)  # px, for each segment
    ```
    """
    from scipy.spatial import KDTree

    check_fit(fit)
    camera, segments = fit.camera, from_top(fit.camera, outline(fit.camera, scene))
    if not len(segments):
        return np.zeros(0)
    place = lambda camera: places_of(camera, points)
    points = np.asarray(contour_points(camera, scene))
    points = points[KDTree(place(camera)).query(segments.mean(axis=1))[1]]
    far = float(np.linalg.norm(np.mean(points - np.asarray(camera.e), axis=0)))
    along = segments[:, 1] - segments[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)
    across = sigma_moves(fit, place, far) @ [[0, -1], [1, 0]]
    return np.linalg.norm(np.sum(across * along, axis=-1), axis=0)


def sigma_moves(
    fit: Fit, value: Callable[[Camera], np.ndarray], far: float
) -> Float[np.ndarray, "k n d"]:
    """Return the changes of a camera's values (n, d) by one sigma along each principal axis of its
    covariance, to first order; the object is `far` away (world units).

    Parameters that the mask does not determine are left out.
    """
    known = np.isfinite(fit.std)
    large = {"e": far, "d": float(fit.camera.d), "principal": fit.camera.H}
    small = 1e-3 * np.array([large.get(name.split("_")[0], 1.0) for name in fit.names])
    variance, axes = np.linalg.eigh(np.where(np.outer(known, known), fit.covariance, 0.0))
    changes = []
    for step in (np.sqrt(np.maximum(variance, 0)) * axes).T:
        share = 1 / max(float(np.max(np.abs(step) / small)), 1)  # within the linear range
        ends = (value(fit.displaced(sign * share * step)) for sign in (1, -1))
        changes.append(np.subtract(*ends) / 2 / share)
    return np.stack(changes)


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

    - `image`: uint8 (H, W), (H, W, 3) or (H, W, 4), of the camera's size, row 0 on top.
    - `band_px`: the half width of a yellow band about each segment of the outline, as
      `outline_sigma` or a multiple of it; the picture shows through.
    - `window`: show this part alone: left, top, right, bottom in px from the upper left.
    - `dots`: film coordinates (px) of red dots, as `Fit.unbelieved`.

    ```python
    picture = pj.plot.overlay(np.uint8(255 * mask), fit.camera, scene)  # (H', W', 3)
    ```
    """
    from PIL import Image, ImageDraw

    _check_size("image", image, camera)
    left, top, right, bottom = window or (0, 0, camera.W, camera.H)
    W, H = right - left, bottom - top
    # Lines are drawn at twice the size and averaged down: no jagged edges.
    fine = 2 * -(-SHOWN_PX // max(W, H))
    shown = lambda film: (from_top(camera, film) - [left, top]) * fine
    canvas = Image.fromarray(np.ascontiguousarray(image)).convert("RGB")
    canvas = canvas.resize((W * fine, H * fine), Image.Resampling.NEAREST, window)
    corners = shown(outline(camera, scene))
    near = np.all(np.abs(corners) < 1e4 * fine, axis=(1, 2))
    if band_px is not None:
        _draw_band(canvas, corners[near], band_px[near] * fine)
    draw = ImageDraw.Draw(canvas)
    for line, width in ((DARK, 6), (colour, 3)):
        for segment in corners[near].reshape(-1, 4).tolist():
            draw.line(segment, fill=line, width=width)
    for dot in () if dots is None else shown(dots):
        draw.circle(dot.tolist(), fine / 2, RED)
    return np.asarray(canvas.reduce(2))


def _draw_band(canvas: Any, segments: np.ndarray, half: np.ndarray) -> None:
    from PIL import Image, ImageChops, ImageDraw, ImageFilter

    cover = Image.new("L", canvas.size)
    draw = ImageDraw.Draw(cover)
    for (a, b), wide in zip(segments, half, strict=True):
        draw.line([*a, *b], 255, max(round(2 * wide), 1))
        draw.circle(b.tolist(), wide, 255)
    border = ImageChops.subtract(cover, cover.filter(ImageFilter.MinFilter(7)))
    tint = cover.point([TINT * value // 255 for value in range(256)])
    canvas.paste(YELLOW, mask=ImageChops.lighter(border, tint))


def error_map(
    camera: Camera, scene: Scene, target: np.ndarray, *, window: Window | None = None
) -> np.ndarray:
    """Return a picture (RGB uint8) of the differences, enlarged to some 800 pixels: orange where
    the camera sees more of the object than the mask has, blue where less; grey is the object.

    `target` is a mask (H, W) as `fit_camera` takes it; `window` as in `overlay`.

    ```python
    differ = pj.plot.error_map(fit.camera, scene, mask)
    ```
    """
    left, top, right, bottom = window or (0, 0, camera.W, camera.H)
    both = np.asarray(silhouette(camera, scene), float), coverage_of(target, camera)
    shown, mask = (x[top:bottom, left:right, None] for x in both)
    ground = 255 - 45 * np.minimum(shown, mask)
    more, less = (np.clip(x, 0, 1) for x in (shown - mask, mask - shown))
    mixed = ground * (1 - more - less) + more * np.array(MORE) + less * np.array(LESS)
    factor = -(-SHOWN_PX // max(mixed.shape[:2]))
    return np.round(mixed).astype(np.uint8).repeat(factor, 0).repeat(factor, 1)


def object_window(camera: Camera, scene: Scene) -> Window:
    """Return the window (left, top, right, bottom, px) around the object's outline.

    ```python
    left, top, right, bottom = pj.plot.object_window(fit.camera, scene)
    ```
    """
    size = np.array([camera.W, camera.H])
    ends = from_top(camera, outline(camera, scene)).reshape(-1, 2)
    ends = ends[np.all((ends >= 0) & (ends <= size), axis=1)]
    if not len(ends):
        return 0, 0, camera.W, camera.H
    margin = 0.08 * np.max(np.ptp(ends, axis=0)) + 2
    corners = np.floor(ends.min(axis=0) - margin), np.ceil(ends.max(axis=0) + margin)
    left, top, right, bottom = np.clip(corners, 0, size).astype(int).ravel().tolist()
    return left, top, right, bottom


def disagreement(camera: Camera, scene: Scene, target: np.ndarray) -> tuple[str, ...]:
    """Return a sentence for each difference between a camera's outline and a mask (H, W): cut off
    by the film, lost from the mask, added to it. None if they agree.

    ```python
    for sentence in pj.plot.disagreement(fit.camera, scene, mask):
        print(sentence)
    ```
    """
    from scipy.ndimage import binary_dilation, binary_erosion
    from scipy.spatial import KDTree

    mask = coverage_of(target, camera) > 0.5
    lines = outline(camera, scene)
    if not len(lines) or np.all(mask) or not np.any(mask):
        return ()
    middle, length = lines.mean(axis=1), np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    is_in = np.all((middle > 0) & (middle < [camera.W, camera.H]), axis=1)
    share = lambda weights, chosen: np.sum(weights[chosen]) / np.sum(weights)
    cases = [(CUT_OFF, share(length, ~is_in), middle)]
    if np.any(is_in):
        middle, length = middle[is_in], length[is_in]
        edge = np.not_equal(binary_dilation(mask), binary_erosion(mask, border_value=1))
        pixels = from_top(camera, np.argwhere(edge)[:, ::-1] + 0.5)
        is_far = lambda points, others: KDTree(others).query(points)[0] > APART_PX
        lost, extra = is_far(middle, pixels), is_far(pixels, middle)
        cases.append((MISSING, share(length, lost), middle[lost]))
        cases.append((EXTRA, np.mean(extra), pixels[extra]))
    return tuple(
        words.format(part, _place(camera, points)) for words, part, points in cases if part > LEAST
    )


def _place(camera: Camera, points: np.ndarray) -> str:
    """Return the pixel of the film point nearest to the median of several."""
    off = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    x, y = points[np.argmin(off)]
    return f"column {int(x)}, row {int(camera.H - y)}"


def coverage_of(target: np.ndarray, camera: Camera) -> np.ndarray:
    """Return a mask of the camera's size as coverage."""
    _check_size("target", target, camera)
    return as_coverage(target)


def check_fit(fit: Any) -> None:
    """Raise ValueError for anything but a `Fit`."""
    if not isinstance(fit, Fit):
        raise ValueError(f"`fit`: expected a Fit, got {type(fit).__name__}")


def _check_size(name: str, image: Any, camera: Camera) -> None:
    size, expected = np.shape(image)[:2], (camera.H, camera.W)
    if size != expected:
        words = f"expected the camera's size (H, W) = {expected}, got {size}"
        raise ValueError(f"`{name}`: {words}")
