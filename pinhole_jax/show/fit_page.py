"""One HTML page about a fit: pictures, parameters, what the mask does not determine."""

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
    outline_sigma,
    overlay,
)
from .page import Html, document, escaped, facts, figure, items, status, table
from .space import scene_view
from .table import parameters

#: The file that shows each format; a folder's files are shown one after another.
FILES = {
    "json": "camera.json",
    "opencv": "camera.yaml",
    "colmap": "colmap",
    "nerf": "transforms.json",
    "blender-script": "camera.py",
    "gltf": "camera.gltf",
    "pytorch3d": "pytorch3d.json",
    "mitsuba": "camera.xml",
}
#: An object that takes less than this share of the picture is shown enlarged, too.
SMALL = 0.3
DIFFERENCE = (
    "Orange: the camera sees the object where the mask has none; blue: the mask has it and the"
    " camera does not; grey: both."
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
    """Return a fit as an HTML page.

    `target` is the mask as `fit_camera` took it, `photo` what to draw the outline on (uint8 of the
    camera's size; None: the mask). `pixel_centres` is where the reader of K puts them, as in
    `formats.to_opencv`.

    Raises ValueError for images that are not of the camera's size, and for a fit that is not
    finite: there is no camera to show.

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
    seen = "The object, and the camera's frustum up to the film through the object; the tick is up."
    sections = {
        "Outline": _outline(fit, scene, photo),
        "Where mask and camera differ": differs,
        "Parameters": f"{parameters(fit, 'What was fitted, with standard errors')}<p>Pitch, yaw and"
        f" roll are the camera's in the world. {_assumed(fit)}</p><h3>K, R and t, and the object's"
        f" pose</h3><pre>{escaped(str(pose))}</pre>",
        "Correlations": _correlations(fit),
        "What the mask does not tell": _unknown(fit),
        "Convergence": _convergence(fit, scene),
        "Object and camera": figure(scene_view(camera, scene), seen),
        "The camera for other programs": "".join(_files(camera)),
    }
    return document(title, status(fit) + facts(numbers), sections)


def _outline(fit: Fit, scene: Scene, photo: np.ndarray) -> str:
    sigma = outline_sigma(fit, scene)
    shown = sigma[sigma > 0]
    words = "The recovered outline. The mask determines no parameter: no band."
    if shown.size:
        words = (
            "The recovered outline (cyan) and its one-sigma band (yellow): one sigma is"
            f" {np.median(shown):.2g} px (median; largest {shown.max():.2g} px)"
        )
        lost = int(np.sum(~np.isfinite(fit.std)))
        words += f"; {lost} parameters are not determined and left out." if lost else "."
    if fit.unbelieved is not None:
        words += " Red: the mask's edge that was not believed, of something before the object."
    drawn_on = lambda window: overlay(
        photo, fit.camera, scene, band_px=sigma, window=window, dots=fit.unbelieved
    )
    left, top, right, bottom = window = object_window(fit.camera, scene)
    if (right - left) * (bottom - top) > SMALL * fit.camera.W * fit.camera.H:
        return figure(drawn_on(None), words)
    return figure(drawn_on(None), "The whole picture.") + figure(drawn_on(window), words)


def _assumed(fit: Fit) -> str:
    """Return a sentence that says what the standard errors take the mask and the mesh for."""
    other = fit.independent_covariance
    if fit.mask_error is not None:
        mask = f"The mask's outline errs by {fit.mask_error}, which the sigmas allow for"
    elif other is None or np.array_equal(fit.covariance, other, equal_nan=True):
        mask = "The sigmas take the mask's pixels to err independently, by what the residuals say"
    else:
        mask = "The sigmas allow for residuals that go together along the outline"
    return f"{mask}; the mesh is taken to be without error."


def _correlations(fit: Fit) -> str:
    rows, covariance = fit.parameters
    names, std = [row.name for row in rows], np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix = covariance / np.outer(std, std)
    lines = [[name, *map(_correlation, line)] for name, line in zip(names, matrix, strict=True)]
    return (
        table(("", *names), lines, "Correlations of the parameters", "matrix")
        + "<p>Near 1 or -1, the mask tells a combination of two parameters far better than each of"
        " them.</p>"
    )


def _correlation(r: float) -> str:
    if not np.isfinite(r):
        return "–"
    hue = "230,90,20" if r > 0 else "30,110,210"
    return Html(f'<span style="background:rgba({hue},{abs(r) * 0.6:.2f})">{r:.2f}</span>')


def _unknown(fit: Fit) -> str:
    words = [*fit.weak]
    for n, mode in enumerate(fit.modes, 1):
        eye = ", ".join(f"{float(x):.4g}" for x in mode.camera.e)
        words.append(f"View {n} explains the mask as well: eye ({eye}), IoU {mode.iou:.4f}.")
    well = "Every parameter that was fitted is well determined; no other view was found."
    return items(words) or f"<p>{well}</p>"


def _convergence(fit: Fit, scene: Scene) -> str:
    if not fit.history:
        return "<p>The way to the camera was not recorded.</p>"
    off = off_px(fit, scene)
    rows = [["start", "0", f"{off[0]:.3g}"]]
    for level, _, last in levels(fit):
        rows.append([f"{level.W} x {level.H} px", str(level.steps), f"{off[last]:.3g}"])
    words = (
        "How far the outline is from its last place, by steps; each band is a level of the picture,"
        " coarse to fine."
    )
    heads = ("level", "steps", "outline off, px")
    return figure(convergence(fit, scene), words) + table(
        heads, rows, "Steps, level by level", "levels"
    )


def _files(camera: Camera) -> Iterator[str]:
    """Yield each format's text, or why it cannot hold the camera."""
    with tempfile.TemporaryDirectory() as folder:
        for name, file in FILES.items():
            path = Path(folder) / file
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
