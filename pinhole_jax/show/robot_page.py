"""One HTML page about the camera that sees a robot: `pinhole-jax hand-eye --report`."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from .. import JointFit, silhouette
from ..formats import object_pose
from ..io import as_coverage
from .outline import disagreement, object_window, overlay
from .page import as_html, document, figure, items, table
from .table import HEADS, parameters

VIEW_WORDS = (
    "<p>Sigma off: a view's disagreement with the others, in standard errors. Worth: the factor by"
    " which the standard errors of the camera's pose would grow without it. Mask only: the part of"
    " the mask that the model does not cover; robot only: the part of the model outside the mask,"
    " as a share of the mask.</p>"
)


def robot_page(
    fit: JointFit,
    masks: Sequence[np.ndarray],
    pictures: Sequence[np.ndarray],
    names: Sequence[str],
    *,
    frame: str,
    halves: str | None = None,
    proposed: str | None = None,
    pixel_centres: Literal["integer", "half"] = "integer",
) -> str:
    """Return a page about a fit to masks (H, W), uint8, which come from files of these names.

    `pictures` (the masks, or photos) are drawn below the outlines. `frame` is the link whose frame
    the camera is in. `halves` and `proposed` are sentences for sections of their own.
    """
    camera = fit.cameras["camera"]
    numbers = {
        "views": str(len(fit.views)),
        "IoU of all": f"{camera.iou:.4f}",
        "picture": f"{fit.camera.W} x {fit.camera.H} px",
        "disagreement": f"{fit.excess:.1f} x mask errors",
    }
    pose = object_pose(camera, pixel_centres=pixel_centres)
    outlines, views = _views(fit, masks, pictures, names)
    well = "<p>Every parameter is well determined, and the views agree.</p>"
    sections = {
        "Outlines": outlines,
        f"The camera in the frame of {as_html(frame)}": parameters(camera, "Fitted parameters")
        + _zeros(fit)
        + "<p>A 95 % interval is 1.96 sigma to either side.</p>",
        "What the masks leave open": items([*fit.notes, *camera.weak]) or well,
        "Postures": views,
        "K, R and t": f"<pre>{as_html(str(pose))}</pre>",
    }
    for heading, words in {"Halves of the postures": halves, "Other postures": proposed}.items():
        if words is not None:
            sections[heading] = f"<pre>{as_html(words)}</pre>"
    return document("Camera of a robot", fit, numbers, sections)


def _zeros(fit: JointFit) -> str:
    if fit.joint_zeros is None:
        return ""
    rows = [row.cells() for row in fit.joint_zeros.rows]
    heads = ("joint", "add to its readings", *HEADS[2:])
    return table(heads, rows, "Zeros of the joints")


def _views(
    fit: JointFit,
    masks: Sequence[np.ndarray],
    pictures: Sequence[np.ndarray],
    names: Sequence[str],
) -> tuple[str, str]:
    """Return the views' outlines, and a table of them."""
    outlines, rows, notes = "", [], []
    for k, (view, mask, name) in enumerate(zip(fit.views, masks, names, strict=True)):
        seen = view.camera, view.scene
        drawn = overlay(pictures[k], *seen, window=object_window(*seen))
        outlines += figure(drawn, f"View {k}, {name}: the recovered outline, IoU {view.iou:.4f}.")
        there = as_coverage(mask)
        difference = there - np.asarray(silhouette(*seen), float)
        whole = max(float(there.sum()), 1.0)
        less, more = (part.clip(0).sum() / whole for part in (difference, -difference))
        errors = f"{view.iou:.4f}", f"{view.sigma:.1f}", f"{view.weight:.2f}", f"{view.worth:.2f}"
        rows.append([f"{k} {name}", *errors, f"{less:.1%}", f"{more:.1%}"])
        notes += [f"view {k}: {words}" for words in disagreement(*seen, mask)]
    heads = ("view", "IoU", "sigma off", "weight", "worth", "mask only", "robot only")
    return outlines, table(heads, rows, "Each mask", "views") + VIEW_WORDS + items(notes)
