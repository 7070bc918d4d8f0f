"""A fit's numbers as HTML: its parameters, and its card in notebooks."""

from collections.abc import Iterable, Sequence

from .. import Camera, Fit
from ..names import STATUSES
from .page import as_html, items, table
from .space import frustum

HEADS = ("parameter", "value", "one sigma", "unit", "")
#: The background of a status: trusted or not.
GOOD, BAD = "#2e7d4f", "#b4541a"


def parameters(fit: Fit, caption: str = "") -> str:
    """Return a table of the fitted parameters with their standard errors."""
    return table(HEADS, [row.cells() for row in fit.parameters.rows], caption)


def camera_card(camera: Camera, rows: Iterable[Sequence[str]]) -> str:
    """Return a camera's card for notebooks: its numbers and its frustum."""
    title = f"<b>Camera</b> of {camera.W} x {camera.H} px"
    return _card(title, table((), rows), frustum(camera))


def fit_card(fit: Fit) -> str:
    """Return a fit's card for notebooks.

    The picture shows the camera and the path of its eye from the start. Rings are the eyes of
    other views that fit the mask equally well.
    """
    colour = GOOD if fit.status == "converged" else BAD
    pill = f"background:{colour};color:#fff;border-radius:4px;padding:2px 8px"
    title = (
        f'<b style="{pill}">{fit.status}</b> {as_html(STATUSES[fit.status])};'
        f" IoU {fit.iou:.4f}, rms {fit.rms:.2g}"
    )
    way = [stop.camera for stop in fit.history[:-1]]
    seen = frustum(fit.camera, way, [mode.camera for mode in fit.modes])
    return _card(title, parameters(fit), seen) + items(fit.notes)


def _card(title: str, *parts: str) -> str:
    style = "display:flex;flex-wrap:wrap;gap:20px;align-items:center"
    return f'<div><div>{title}</div><div style="{style}">{"".join(parts)}</div></div>'
