"""A fit as notebooks show it: its status, its parameters with their standard errors, its camera."""

import html
from typing import Any

import numpy as np

from .._camera.camera import picture
from .._camera.drawing import card, table
from .words import STATUSES, in_digits, notes, parameter_table

#: Behind the status: what is to be trusted, and what is not.
GOOD, BAD = "#2e7d4f", "#b4541a"


def fit_card(fit: Any) -> str:
    """Return a fit as HTML: complete in itself, all words escaped.

    The picture shows the camera with the way of its eye from the start, and as rings the eyes of
    other views that explain the mask as well.
    """
    rows = []
    for row in parameter_table(fit).rows:
        sigma = f"{row.std:.2g}" if np.isfinite(row.std) else "not determined"
        rows.append([row.name, in_digits(row.value, row.std), sigma, row.unit, row.words])
    parameters = table(rows, ("parameter", "value", "one sigma", "unit", ""))
    colour = GOOD if fit.status == "converged" else BAD
    pill = f"background:{colour};color:#fff;border-radius:4px;padding:2px 8px"
    title = (
        f'<b style="{pill}">{html.escape(fit.status)}</b> {html.escape(STATUSES[fit.status])};'
        f" IoU {fit.iou:.4f}, rms {fit.rms:.2g}"
    )
    said = "".join(f"<li>{html.escape(words)}</li>" for words in notes(fit))
    way = [stop.camera for stop in fit.history[:-1]]
    seen = picture(fit.camera, way, [mode.camera for mode in fit.modes])
    return card(title, parameters, seen) + (f"<ul>{said}</ul>" if said else "")
