"""One HTML page about a fit, complete in itself: pictures, parameters, what the mask cannot tell.

Nothing is loaded from elsewhere; pictures are PNG in data URIs, the diagram is SVG.
"""

import base64
import html
import io as bytes_io
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from . import formats, plot
from ._camera.camera import Camera
from ._files.paths import replace_file
from ._fit.result import Fit, check_fit
from ._fit.target import check_image, shares
from ._fit.words import STATUSES, Told, in_digits, told
from ._scene.scene import Scene, check_view

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
    pixel_centres: Any = "integer",
) -> None:
    """Write `page` to a file, whole or not at all.

    Raises ValueError as `page` does, and for a path that cannot be written.
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
    pixel_centres: Any = "integer",
) -> str:
    """Return a fit as an HTML page.

    `target` is the mask as `fit_camera` took it, `photo` what to draw the outline on (uint8 of the
    camera's size; None: the mask). `pixel_centres` is where the reader of K puts them, as in
    `formats.to_opencv`.

    Raises ValueError for images that are not of the camera's size, and for a fit that is not
    finite: there is no camera to show.
    """
    check_fit(fit)
    check_view(fit.camera, scene)
    if fit.status == "non_finite":
        raise ValueError("`fit`: expected a finite camera, got status non_finite")
    from . import __version__

    mask = check_image("target", target, fit.camera.W, fit.camera.H)
    if photo is None:
        photo = np.round(255 * shares(mask).clip(0, 1)).astype(np.uint8)
    parameters = told(fit)
    sections = [
        _section("Outline", _outline_pictures(fit, scene, photo)),
        _section("Where mask and camera differ", _error_picture(fit, scene, mask)),
        _section("Parameters", _parameter_table(fit, parameters) + _pose(fit, pixel_centres)),
        _section("Correlations", _correlation_table(parameters)),
        _section("What the mask does not tell", _unknown(fit)),
        _section("Convergence", _convergence(fit, scene)),
        _section("Object and camera", _view(fit, scene)),
        _section("The camera for other programs", "".join(_files(fit.camera))),
    ]
    camera, name = fit.camera, html.escape(title)
    meaning = STATUSES[fit.status][0].upper() + STATUSES[fit.status][1:]
    facts = {
        "IoU": f"{fit.iou:.4f}",
        "rms of coverage": f"{fit.rms:.2g}",
        "steps": str(sum(fit.steps)),
        "picture": f"{camera.W} x {camera.H} px",
    }
    shown = "".join(f"<div><dt>{k}</dt><dd>{v}</dd></div>" for k, v in facts.items())
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}</title><style>{STYLE}</style></head><body>"
        f"<header><h1>{name}</h1>"
        f'<p class="status {fit.status}"><b>{fit.status}</b> {meaning}.</p>'
        f"<dl>{shown}</dl></header><main>{''.join(sections)}</main>"
        f"<footer>pinhole_jax {__version__}</footer></body></html>\n"
    )


def _section(heading: str, body: str) -> str:
    key = heading.lower().replace(" ", "-")
    return f'<section id="{key}"><h2>{heading}</h2>{body}</section>\n'


def _figure(image: np.ndarray, words: str) -> str:
    from PIL import Image

    buffer = bytes_io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode()
    return (
        f'<figure><img alt="{words}" src="data:image/png;base64,{data}">'
        f"<figcaption>{words}</figcaption></figure>"
    )


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
    whole = plot.overlay(photo, fit.camera, scene, band_px=band)
    left, top, right, bottom = window = plot.object_window(fit.camera, scene)
    if (right - left) * (bottom - top) > SMALL * fit.camera.W * fit.camera.H:
        return _figure(whole, words)
    part = plot.overlay(photo, fit.camera, scene, band_px=band, window=window)
    return _figure(whole, "The whole picture.") + _figure(part, words)


def _error_picture(fit: Fit, scene: Scene, mask: np.ndarray) -> str:
    window = plot.object_window(fit.camera, scene)
    image = plot.error_map(fit.camera, scene, mask, window=window)
    picture = _figure(
        image,
        "Orange: the camera sees the object where the mask has none; blue: the mask has it and the"
        " camera does not; grey: both.",
    )
    return picture + _list(plot.disagreement(fit.camera, scene, mask))


def _table(caption: str, heads: Iterable[str], rows: Iterable[Iterable[str]], kind: str) -> str:
    """Return a table: each row's first cell is its head, and cells may bring their own tag."""
    columns = "".join(f'<th scope="col">{head}</th>' for head in heads)
    lines = []
    for head, *cells in rows:
        filled = "".join(x if x.startswith("<td") else f"<td>{x}</td>" for x in cells)
        lines.append(f'<tr><th scope="row">{head}</th>{filled}</tr>')
    return (
        f'<div class="wide"><table class="{kind}"><caption>{caption}</caption>'
        f"<thead><tr>{columns}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
    )


def _assumed(fit: Fit) -> str:
    """Return in words what the standard errors take the mask and the mesh for."""
    if fit.mask_error is not None:
        mask = f"The mask's outline errs by {fit.mask_error}, which the sigmas allow for"
    elif _is_same(fit.covariance, fit.independent_covariance):
        mask = "The sigmas take the mask's pixels to err independently, by what the residuals say"
    else:
        mask = "The sigmas allow for residuals that go together along the outline"
    return f"{mask}; the mesh is taken to be without error."


def _is_same(covariance: np.ndarray, other: np.ndarray | None) -> bool:
    return other is None or np.array_equal(covariance, other, equal_nan=True)


def _parameter_table(fit: Fit, parameters: Told) -> str:
    rows = []
    for row in parameters.rows:
        known = np.isfinite(row.std)
        words = f" <small>{html.escape(row.words)}</small>" if row.words else ""
        sigma = f"{row.std:.2g}" if known else "not determined"
        rows.append([html.escape(row.name) + words, in_digits(row.value, row.std), sigma, row.unit])
    heads = ("parameter", "value", "one sigma", "unit")
    return (
        _table("What was fitted, with standard errors", heads, rows, "parameters")
        + f"<p>Pitch, yaw and roll are the camera's in the world. {_assumed(fit)}</p>"
    )


def _pose(fit: Fit, pixel_centres: Any) -> str:
    words = html.escape(str(formats.object_pose(fit, pixel_centres=pixel_centres)))
    return f"<h3>K, R and t, and the object's pose</h3><pre>{words}</pre>"


def _correlation_table(parameters: Told) -> str:
    names = [html.escape(row.name) for row in parameters.rows]
    std = np.array([row.std for row in parameters.rows])
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix = parameters.covariance / np.outer(std, std)
    rows = [[name, *map(_correlation, line)] for name, line in zip(names, matrix, strict=True)]
    return (
        _table("Correlations of the parameters", ("", *names), rows, "matrix")
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
        f"</figcaption></figure>{_table('Steps, level by level', heads, rows, 'levels')}"
    )


def _view(fit: Fit, scene: Scene) -> str:
    words = (
        "The object, and the camera's frustum up to the film through the object; the tick is up."
    )
    return _figure(plot.scene_view(fit.camera, scene), words)


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


STYLE = """
:root{color-scheme:light dark;--ink:#1c2b36;--paper:#fff;--muted:#566b7a;--line:#d8e0e6;
 --soft:#f4f7f9;--good:#dff1e4;--bad:#fbe5d6;--one:#eef2f6;--two:#dfe7ef;--curve:#0a6b8a}
@media (prefers-color-scheme:dark){:root{--ink:#e4ebf0;--paper:#14191d;--muted:#9db0bd;
 --line:#33414b;--soft:#1d252b;--good:#1d4a2b;--bad:#5a3318;--one:#222c33;--two:#2b3740;
 --curve:#5cc8e8}}
body{margin:0 auto;max-width:880px;padding:24px;color:var(--ink);background:var(--paper);
 font:16px/1.5 system-ui,sans-serif}
h1{font-size:26px;margin:0 0 8px;overflow-wrap:anywhere}
h2{font-size:19px;margin:40px 0 10px;padding-top:14px;border-top:1px solid var(--line)}
h3{font-size:16px;margin:24px 0 8px}
.status{padding:10px 14px;border-radius:6px;background:var(--bad)}
.status.converged{background:var(--good)}
.status b{margin-right:6px}
dl{display:flex;flex-wrap:wrap;gap:8px 36px;margin:0}
dt{font-size:13px;color:var(--muted)}dd{margin:0;font-size:20px}
figure{margin:0 0 18px}img{max-width:100%;height:auto;display:block;border-radius:4px}
svg{width:100%;min-width:520px;height:auto}.diagram{overflow-x:auto}
.diagram svg text{fill:var(--muted)}.diagram svg line{stroke:var(--paper)}
.diagram svg rect{fill:var(--one)}.diagram svg rect:nth-of-type(even){fill:var(--two)}
.diagram svg polyline{stroke:var(--curve)}.diagram svg circle{fill:var(--curve)}
figcaption,p,li{font-size:15px}figcaption,footer,caption,small{color:var(--muted)}
.wide{overflow-x:auto}
table{border-collapse:collapse;font-size:14px;font-variant-numeric:tabular-nums}
caption{text-align:left;font-size:13px;padding-bottom:4px}
th{text-align:left;font-weight:500}thead th{color:var(--muted);font-size:13px}
td,th{padding:4px 14px 4px 0;border-bottom:1px solid var(--line)}
thead th+th,td{text-align:right}.parameters th:last-child,.parameters td:last-child{text-align:left}
small{display:block;font-size:12px}
.matrix td,.matrix thead th{padding:5px 8px}
details{margin:6px 0}summary{cursor:pointer}
pre{overflow:auto;max-height:340px;background:var(--soft);padding:12px;border-radius:4px;
 font-size:13px}
footer{margin-top:48px;font-size:13px}
@media (max-width:560px){body{padding:14px}td,th{padding-right:8px}
 .matrix{font-size:11px}.matrix td,.matrix th,.matrix thead th{padding:4px 2px;font-size:11px}}
@media print{:root{color-scheme:light;--ink:#000;--paper:#fff;--muted:#444;--line:#bbb;
 --soft:#f4f7f9;--good:#dff1e4;--bad:#fbe5d6;--one:#eef2f6;--two:#dfe7ef;--curve:#0a6b8a}
 body{max-width:none;padding:0;font-size:11pt;print-color-adjust:exact;
 -webkit-print-color-adjust:exact}
 figure,table,p,li{break-inside:avoid}h2{break-after:avoid}img{max-height:16cm}
 a[download]{display:none}pre{max-height:none;white-space:pre-wrap}.wide{overflow:visible}}
"""
