"""One HTML page about a fit, complete in itself: pictures, parameters, what the mask cannot tell.

Nothing is loaded from elsewhere; pictures are PNG in data URIs, the diagram is SVG.
"""

import base64
import html
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from . import formats, plot
from ._camera.camera import Camera
from ._camera.matrices import Centres
from ._files.paths import replace_file
from ._fit.result import Fit, check_fit
from ._fit.words import STATUSES, ParameterTable, in_digits, parameter_table
from ._mask.target import as_coverage, check_image
from ._numerics.arrays import Input
from ._scene.scene import Scene, check_view
from ._show import page as html_page

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
#: A band is drawn wider by a round factor until its median half width is about this (px).
BAND_PX = 2.5
#: An object that takes less than this share of the picture is shown enlarged, too.
SMALL = 0.3


def write(
    path: str | os.PathLike[str],
    fit: Fit,
    scene: Scene,
    target: np.ndarray,
    photo: np.ndarray | None = None,
    title: str = "Camera from a mask",
    *,
    pixel_centres: Input[Centres, "of K"] = "integer",
) -> None:
    """Write `page` to a file, whole or not at all.

    Raises ValueError as `page` does, and for a path that cannot be written.

    ```python
    pj.report.write("page.html", fit, scene, mask)
    ```
    """
    text = page(fit, scene, target, photo, title, pixel_centres=pixel_centres)
    replace_file(path, text.encode(errors="backslashreplace"))  # files' names need be no text


def page(
    fit: Fit,
    scene: Scene,
    target: np.ndarray,
    photo: np.ndarray | None = None,
    title: str = "Camera from a mask",
    *,
    pixel_centres: Input[Centres, "of K"] = "integer",
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
    check_view(fit.camera, scene)
    if fit.status == "non_finite":
        raise ValueError("`fit`: expected a finite camera, got status non_finite")
    mask = check_image("target", target, fit.camera.W, fit.camera.H)
    if photo is None:
        photo = np.round(255 * as_coverage(mask).clip(0, 1)).astype(np.uint8)
    parameters = parameter_table(fit)
    table = _parameter_table(fit, parameters) + _pose(fit, pixel_centres)
    sections = [
        html_page.section("Outline", _outline_pictures(fit, scene, photo)),
        html_page.section("Where mask and camera differ", _error_picture(fit, scene, mask)),
        html_page.section("Parameters", table),
        html_page.section("Correlations", _correlation_table(parameters)),
        html_page.section("What the mask does not tell", _unknown(fit)),
        html_page.section("Convergence", _convergence(fit, scene)),
        html_page.section("Object and camera", _view(fit, scene)),
        html_page.section("The camera for other programs", "".join(_files(fit.camera))),
    ]
    camera = fit.camera
    meaning = STATUSES[fit.status][0].upper() + STATUSES[fit.status][1:]
    numbers = {
        "IoU": f"{fit.iou:.4f}",
        "rms of coverage": f"{fit.rms:.2g}",
        "steps": str(sum(fit.steps)),
        "picture": f"{camera.W} x {camera.H} px",
    }
    status = f'<p class="status {fit.status}"><b>{fit.status}</b> {meaning}.</p>'
    return html_page.document(title, status + html_page.facts(numbers), sections)


def _outline_pictures(fit: Fit, scene: Scene, photo: np.ndarray) -> str:
    sigma = plot.outline_sigma(fit, scene)
    shown = sigma[sigma > 0]
    if shown.size:
        middle = float(np.median(shown))
        factor = 1.0 if middle >= BAND_PX / 2 else 10.0 ** np.round(np.log10(BAND_PX / middle))
        drawn = "" if factor == 1 else f", drawn {factor:g} times as wide"
        words = f"The recovered outline (cyan) and its one-sigma band (yellow{drawn})."
        words += f" One sigma is {middle:.2g} px (median; largest {shown.max():.2g} px)"
        lost = int(np.sum(~np.isfinite(fit.std)))
        words += f"; {lost} parameters are not determined and left out." if lost else "."
    else:
        factor, words = 1.0, "The recovered outline. The mask determines no parameter: no band."
    band = factor * sigma
    if fit.unbelieved is not None:
        words += " Red: the mask's edge that was not believed, of something before the object."
    drawn_on = lambda window: plot.overlay(
        photo, fit.camera, scene, band_px=band, window=window, dots=fit.unbelieved
    )
    whole = drawn_on(None)
    left, top, right, bottom = window = plot.object_window(fit.camera, scene)
    if (right - left) * (bottom - top) > SMALL * fit.camera.W * fit.camera.H:
        return html_page.figure(whole, words)
    part = drawn_on(window)
    return html_page.figure(whole, "The whole picture.") + html_page.figure(part, words)


def _error_picture(fit: Fit, scene: Scene, mask: np.ndarray) -> str:
    window = plot.object_window(fit.camera, scene)
    image = plot.error_map(fit.camera, scene, mask, window=window)
    picture = html_page.figure(
        image,
        "Orange: the camera sees the object where the mask has none; blue: the mask has it and the"
        " camera does not; grey: both.",
    )
    return picture + _list(plot.disagreement(fit.camera, scene, mask))


def _assumed(fit: Fit) -> str:
    """Return a sentence that says what the standard errors take the mask and the mesh for."""
    if fit.mask_error is not None:
        mask = f"The mask's outline errs by {fit.mask_error}, which the sigmas allow for"
    elif _is_same(fit.covariance, fit.independent_covariance):
        mask = "The sigmas take the mask's pixels to err independently, by what the residuals say"
    else:
        mask = "The sigmas allow for residuals that go together along the outline"
    return f"{mask}; the mesh is taken to be without error."


def _is_same(covariance: np.ndarray, other: np.ndarray | None) -> bool:
    return other is None or np.array_equal(covariance, other, equal_nan=True)


def _parameter_table(fit: Fit, parameters: ParameterTable) -> str:
    rows = []
    for row in parameters.rows:
        known = np.isfinite(row.std)
        words = f" <small>{html.escape(row.words)}</small>" if row.words else ""
        sigma = f"{row.std:.2g}" if known else "not determined"
        rows.append([html.escape(row.name) + words, in_digits(row.value, row.std), sigma, row.unit])
    heads = ("parameter", "value", "one sigma", "unit")
    return (
        html_page.table("What was fitted, with standard errors", heads, rows, "parameters")
        + f"<p>Pitch, yaw and roll are the camera's in the world. {_assumed(fit)}</p>"
    )


def _pose(fit: Fit, pixel_centres: Any) -> str:
    words = html.escape(str(formats.object_pose(fit, pixel_centres=pixel_centres)))
    return f"<h3>K, R and t, and the object's pose</h3><pre>{words}</pre>"


def _correlation_table(parameters: ParameterTable) -> str:
    names = [html.escape(row.name) for row in parameters.rows]
    std = np.array([row.std for row in parameters.rows])
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix = parameters.covariance / np.outer(std, std)
    rows = [[name, *map(_correlation, line)] for name, line in zip(names, matrix, strict=True)]
    return (
        html_page.table("Correlations of the parameters", ("", *names), rows, "matrix")
        + "<p>Near 1 or -1, the mask tells a combination of two parameters far better than each of"
        " them.</p>"
    )


def _correlation(r: float) -> str:
    if not np.isfinite(r):
        return "–"
    hue = "230,90,20" if r > 0 else "30,110,210"
    return f'<td style="background:rgba({hue},{abs(r) * 0.6:.2f})">{r:.2f}</td>'


def _unknown(fit: Fit) -> str:
    words = [html.escape(w) for w in fit.weak]
    for n, mode in enumerate(fit.modes, 1):
        eye = ", ".join(f"{float(x):.4g}" for x in mode.camera.e)
        words.append(f"View {n} explains the mask as well: eye ({eye}), IoU {mode.iou:.4f}.")
    if not words:
        return "<p>Every parameter that was fitted is well determined; no other view was found.</p>"
    return _list(words)


def _list(words: Iterable[str]) -> str:
    """Return sentences as a list, nothing if there are none."""
    sentences = [f"<li>{w[:1].upper()}{w[1:].removesuffix('.')}.</li>" for w in words]
    return f"<ul>{''.join(sentences)}</ul>" if sentences else ""


def _convergence(fit: Fit, scene: Scene) -> str:
    if not fit.history:
        return "<p>The way to the camera was not recorded.</p>"
    off = plot.off_px(fit, scene)
    rows = [["start", "0", f"{off[0]:.3g}"]]
    for level, _, last in plot.levels(fit):
        rows.append([f"{level.W} x {level.H} px", str(level.steps), f"{off[last]:.3g}"])
    heads = ("level", "steps", "outline off, px")
    return (
        f'<figure class="diagram">{plot.convergence(fit, scene)}<figcaption>How far the outline is'
        " from its last place, by steps; each band is a level of the picture, coarse to fine."
        f"</figcaption></figure>{html_page.table('Steps, level by level', heads, rows, 'levels')}"
    )


def _view(fit: Fit, scene: Scene) -> str:
    words = (
        "The object, and the camera's frustum up to the film through the object; the tick is up."
    )
    return html_page.figure(plot.scene_view(fit.camera, scene), words)


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
            written = sorted(path.iterdir()) if path.is_dir() else [path]
            for part in written:
                text = part.read_text(encoding="utf-8")
                data = base64.b64encode(text.encode()).decode()
                yield (
                    f"<details><summary>{name} <code>{part.name}</code></summary>"
                    f'<a download="{part.name}" href="data:text/plain;base64,{data}">save</a>'
                    f"<pre>{html.escape(text)}</pre></details>"
                )
