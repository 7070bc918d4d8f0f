"""One HTML page about the camera that sees a robot: `pinhole-jax hand-eye --report`."""

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from .. import formats, plot
from .._fit.words import STATUSES, in_digits, parameter_table
from .._joint.agreement import NORMAL_95
from .._joint.result import JointFit, ViewFit
from .._mask.target import as_coverage
from .._show import page as html_page
from .._silhouette.silhouette import silhouette


def robot_page(
    fit: JointFit,
    masks: Sequence[np.ndarray],
    pictures: Sequence[np.ndarray],
    names: Sequence[str],
    *,
    frame: str,
    halves: str | None = None,
    proposed: str | None = None,
    pixel_centres: Any = "integer",
) -> str:
    """Return a fit to the masks (H, W) of files of such names as a page; `pictures` are what
    outlines are drawn on (the masks, or photos), `frame` is the link that its camera stands in,
    `halves` what the halves of the postures say, `proposed` what other postures would tell."""
    camera = fit.cameras["camera"]
    meaning = STATUSES[fit.status][0].upper() + STATUSES[fit.status][1:]
    numbers = {
        "views": str(len(fit.views)),
        "IoU of all": f"{camera.iou:.4f}",
        "picture": f"{fit.camera.W} x {fit.camera.H} px",
        "views differ": f"{fit.excess:.1f} times as much as their masks err",
    }
    status = f'<p class="status {fit.status}"><b>{fit.status}</b> {meaning}.</p>'
    tested = "Not asked for (--holdout)." if halves is None else html.escape(halves)
    further = "Not asked for (--propose)." if proposed is None else html.escape(proposed)
    pose = html.escape(str(formats.object_pose(camera, pixel_centres=pixel_centres)))
    sections = [
        html_page.section(f"The camera in the frame of {html.escape(frame)}", _camera(fit)),
        html_page.section("What the masks do not tell", _weak(fit)),
        html_page.section("Halves of the postures", f"<p>{tested}</p>"),
        html_page.section("Postures", _views(fit, masks, names)),
        html_page.section("Other postures", f"<p>{further}</p>"),
        html_page.section("K, R and t", f"<pre>{pose}</pre>"),
        html_page.section("Outlines", _pictures(fit, pictures, names)),
    ]
    return html_page.document("Camera of a robot", status + html_page.facts(numbers), sections)


def _camera(fit: JointFit) -> str:
    rows = [
        _row(row.name, row.words, row.value, row.std, row.unit)
        for row in parameter_table(fit.cameras["camera"]).rows
    ]
    heads = ("parameter", "value", "95 % interval", "unit")
    text = html_page.table("What was fitted", heads, rows, "parameters")
    if fit.joint_zeros is not None:
        found, rows = fit.joint_zeros, []
        each = zip(found.names, found.values, found.std, found.units, strict=True)
        for name, value, std, unit in each:
            factor, unit = (180 / np.pi, "deg") if unit == "rad" else (1.0, unit)
            rows.append(_row(name, "", factor * value, factor * std, unit))
        heads = ("joint", "to be added to its readings", "95 % interval", "unit")
        text += html_page.table("Zeros of the joints", heads, rows, "parameters")
    return text


def _row(name: str, words: str, value: float, std: float, unit: str) -> list[str]:
    small = f" <small>{html.escape(words)}</small>" if words else ""
    half = NORMAL_95 * std
    interval = f"&plusmn; {half:.2g}" if np.isfinite(half) else "not determined"
    return [html.escape(name) + small, in_digits(value, std), interval, unit]


def _weak(fit: JointFit) -> str:
    words = [*fit.weak, *fit.cameras["camera"].weak]
    if fit.modes:
        words.append(f"{len(fit.modes)} other places of the camera explain the masks as well")
    if not words:
        return "<p>Every parameter is well determined, and the views agree.</p>"
    return _list(words)


def _list(words: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{html.escape(w)}.</li>' for w in words)}</ul>"


def _views(fit: JointFit, masks: Sequence[np.ndarray], names: Sequence[str]) -> str:
    rows, notes = [], []
    for k, (view, mask, name) in enumerate(zip(fit.views, masks, names, strict=True)):
        less, more = _beside(view, mask)
        cells = (view.iou, ".4f"), (view.sigma, ".1f"), (view.weight, ".2f"), (view.worth, ".2f")
        rows.append(
            [
                f"{k} <small>{html.escape(name)}</small>",
                *(f"{x:{digits}}" for x, digits in cells),
                f"{less:.1%}",
                f"{more:.1%}",
            ]
        )
        notes += [f"view {k}: {x}" for x in plot.disagreement(view.camera, view.scene, mask)]
    heads = ("view", "IoU", "sigma off", "weight", "worth", "mask only", "robot only")
    words = (
        "<p>Sigma off: how surely a view disagrees with the others, in standard errors. Worth: how"
        " many times as large the standard errors of the camera's pose would be without it. Mask"
        " only: what is masked but not in the model, as a share of the mask; robot only: what the"
        " model shows beside the mask.</p>"
    )
    return html_page.table("Each mask", heads, rows, "views") + words + _list(notes)


def _beside(view: ViewFit, mask: np.ndarray) -> tuple[float, float]:
    """Return which share of the mask the model leaves out, and by which it covers more."""
    shown, there = (
        np.asarray(silhouette(view.camera, view.scene), float),
        as_coverage(mask).clip(0, 1),
    )
    whole = max(float(there.sum()), 1.0)
    difference = there - shown
    return float(difference.clip(0).sum()) / whole, float((-difference).clip(0).sum()) / whole


def _pictures(fit: JointFit, pictures: Sequence[np.ndarray], names: Sequence[str]) -> str:
    result = ""
    for k, (view, picture, name) in enumerate(zip(fit.views, pictures, names, strict=True)):
        if picture.ndim == 2:
            picture = np.round(255 * as_coverage(picture).clip(0, 1)).astype(np.uint8)
        window = plot.object_window(view.camera, view.scene)
        drawn = plot.overlay(picture, view.camera, view.scene, window=window)
        words = f"View {k}, {html.escape(name, quote=True)}: the recovered outline, IoU"
        result += html_page.figure(drawn, f"{words} {view.iou:.4f}.")
    return result
