"""One HTML page about a fit: pictures, parameters, and the directions that the mask leaves open."""

import base64
import html
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from .. import Camera, Fit, Scene, formats
from ..io import save_text
from .convergence import convergence, levels, off_px
from .outline import (
    check_fit,
    coverage_of,
    disagreement,
    error_map,
    object_window,
    overlay,
)
from .page import ENDINGS, Html, as_html, document, figure, items, table
from .space import scene_view
from .table import parameters
from .trust import trust

#: An object smaller than this share of the picture is also shown enlarged.
SMALL = 0.3
DIFFERENCE = (
    "Orange: only the camera sees the object there; blue: only the mask has it; grey: both."
)
MAP = (
    "Colours: by how much a point there, as far away as the object, would move. Line: the outline."
)


def write(
    path: str | os.PathLike[str],
    fit: Fit,
    scene: Scene,
    target: np.ndarray,
    photo: np.ndarray | None = None,
    title: str = "Camera from a mask",
    *,
    pixel_centres: Literal["integer", "half"] = "integer",
) -> None:
    """Write `page` to a file, whole or not at all.

    Raises ValueError as `page` does, and for a path that cannot be written.

    ```python
    pj.report.write("page.html", fit, scene, mask)
    ```
    """
    save_text(path, page(fit, scene, target, photo, title, pixel_centres=pixel_centres))


def page(
    fit: Fit,
    scene: Scene,
    target: np.ndarray,
    photo: np.ndarray | None = None,
    title: str = "Camera from a mask",
    *,
    pixel_centres: Literal["integer", "half"] = "integer",
) -> str:
    """Return an HTML page about a fit.

    - `target`: the mask, as `fit_camera` took it.
    - `photo`: draw the outline on this (uint8, of the camera's size; None: the mask).
    - `pixel_centres`: the convention of the printed K, as in `formats.to_opencv`.

    Raises ValueError for images of another size, and for a fit that is not finite.

    ```python
    html = pj.report.page(fit, scene, mask)
    ```
    """
    check_fit(fit)
    if fit.status == "non_finite":
        raise ValueError("`fit`: expected a finite camera, got status non_finite")
    camera, mask = fit.camera, coverage_of(target, fit.camera)
    photo = np.round(255 * mask).astype(np.uint8) if photo is None else photo
    difference = error_map(camera, scene, mask, window=object_window(camera, scene))
    differs = figure(difference, DIFFERENCE) + items(disagreement(camera, scene, mask))
    numbers = {
        "IoU": f"{fit.iou:.4f}",
        "rms of coverage": f"{fit.rms:.2g}",
        "steps": str(sum(fit.steps)),
        "picture": f"{camera.W} x {camera.H} px",
    }
    pose = formats.object_pose(fit, pixel_centres=pixel_centres)
    seen = "The object, and the camera's frustum up to the object; the tick points up."
    shown = trust(fit, scene)
    sections = {
        "Outline": _outline(fit, scene, photo, shown.outline),
        "Where the error shows": figure(shown.picture, f"{shown} {MAP}"),
        "Where mask and camera differ": differs,
        "Parameters": f"{parameters(fit, 'Fitted parameters with standard errors')}<p>Pitch, yaw"
        f" and roll are the camera's in the world. {_assumption(fit)}</p><h3>K, R and t, and the"
        f" object's pose</h3><pre>{as_html(str(pose))}</pre>",
        "Correlations": _correlations(fit),
        "What the mask leaves open": _open_questions(fit),
        "Convergence": _convergence(fit, scene),
        "Object and camera": figure(scene_view(camera, scene), seen),
        "The camera for other programs": "".join(_files(camera)),
    }
    return document(title, fit, numbers, sections)


def _outline(fit: Fit, scene: Scene, photo: np.ndarray, sigma: np.ndarray) -> str:
    shown = sigma[sigma > 0]
    words = "The recovered outline. The mask determines no parameter, so there is no band."
    if shown.size:
        words = (
            "The recovered outline (cyan) and its one-sigma band (yellow): one sigma is"
            f" {np.median(shown):.2g} px (median; largest {shown.max():.2g} px)"
        )
        lost = int(np.sum(~np.isfinite(fit.std)))
        words += f"; undetermined, and left out: {lost}." if lost else "."
    if fit.unbelieved is not None:
        words += " Red: edges of the mask that were ignored; something may be in front."
    drawn_on = lambda window: overlay(
        photo, fit.camera, scene, band_px=sigma, window=window, dots=fit.unbelieved
    )
    left, top, right, bottom = window = object_window(fit.camera, scene)
    if (right - left) * (bottom - top) > SMALL * fit.camera.W * fit.camera.H:
        return figure(drawn_on(None), words)
    return figure(drawn_on(None), "The whole picture.") + figure(drawn_on(window), words)


def _assumption(fit: Fit) -> str:
    """Return a sentence on the errors of mask and mesh that the standard errors allow for."""
    other = fit.independent_covariance
    if fit.mask_error is not None:
        mask = f"The sigmas allow for an error of the mask's outline of {fit.mask_error}"
    elif other is None or np.array_equal(fit.covariance, other, equal_nan=True):
        mask = "The sigmas assume that pixels err independently, as much as the residuals show"
    else:
        mask = "The sigmas allow for residuals that are correlated along the outline"
    return f"{mask}; they assume an exact mesh."


def _correlations(fit: Fit) -> str:
    rows, covariance = fit.parameters
    names, std = [row.name for row in rows], np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix = covariance / np.outer(std, std)
    lines = [[name, *map(_correlation, line)] for name, line in zip(names, matrix, strict=True)]
    return (
        table(("", *names), lines, "Correlations of the parameters", "matrix")
        + "<p>Near 1 or -1, the mask determines a combination of two parameters far better than"
        " either of them.</p>"
    )


def _correlation(r: float) -> str:
    if not np.isfinite(r):
        return "–"
    hue = "230,90,20" if r > 0 else "30,110,210"
    return Html(f'<span style="background:rgba({hue},{abs(r) * 0.6:.2f})">{r:.2f}</span>')


def _open_questions(fit: Fit) -> str:
    words = [*fit.weak]
    for n, mode in enumerate(fit.modes, 1):
        eye = ", ".join(f"{float(x):.4g}" for x in mode.camera.e)
        words.append(f"View {n} fits the mask equally well: eye ({eye}), IoU {mode.iou:.4f}.")
    well = "Every fitted parameter is well determined, and no other view fits."
    return items(words) or f"<p>{well}</p>"


def _convergence(fit: Fit, scene: Scene) -> str:
    if not fit.history:
        return "<p>The steps of this fit were not recorded.</p>"
    off = off_px(fit, scene)
    rows = [["start", "0", f"{off[0]:.3g}"]]
    for level, _, last in levels(fit):
        rows.append([f"{level.W} x {level.H} px", str(level.steps), f"{off[last]:.3g}"])
    words = "The outline's distance from its final place; a band for each level, coarse to fine."
    heads = ("level", "steps", "outline off, px")
    return figure(convergence(fit, scene), words) + table(
        heads, rows, "Steps, level by level", "levels"
    )


def _files(camera: Camera) -> Iterator[str]:
    """Yield each format's text, or the reason why it cannot hold the camera."""
    with tempfile.TemporaryDirectory() as folder:
        for name, ending in ENDINGS.items():
            if name == "colmap-binary":
                continue
            path = Path(folder) / f"camera{ending}"
            try:
                formats.write(path, {"camera": camera}, name)
            except ValueError as error:
                words = html.escape(str(error))
                yield f"<details><summary>{name}</summary><p>{words}</p></details>"
                continue
            for part in sorted(path.iterdir()) if path.is_dir() else [path]:
                text = part.read_text(encoding="utf-8")
                data = base64.b64encode(text.encode()).decode()
                yield (
                    f"<details><summary>{name} <code>{part.name}</code></summary>"
                    f'<a download="{part.name}" href="data:text/plain;base64,{data}">save</a>'
                    f"<pre>{html.escape(text)}</pre></details>"
                )
