"""A fit's numbers as HTML: its parameters, and the card that notebooks show."""

from collections.abc import Iterable, Sequence

from .. import Camera, Fit
from ..names import STATUSES
from .page import escaped, items, table
from .space import frustum

HEADS = ("parameter", "value", "one sigma", "unit", "")
#: Behind the status: a fit to be trusted, and one that is not.
GOOD, BAD = "#2e7d4f", "#b4541a"


def parameters(fit: Fit, caption: str = "") -> str:
    """Return the fitted parameters with their standard errors as a table."""
    return table(HEADS, [row.cells() for row in fit.parameters.rows], caption)


def camera_card(camera: Camera, rows: Iterable[Sequence[str]]) -> str:
    """Return a camera as notebooks show it: its numbers and its frustum."""
    title = f"<b>Camera</b> of {camera.W} x {camera.H} px"
    return _card(title, table((), rows), frustum(camera))


def fit_card(fit: Fit) -> str:
    """Return a fit as notebooks show it.

    The picture shows the camera with the way of its eye from the start, and as rings the eyes of
    other views that explain the mask as well.
    """
    colour = GOOD if fit.status == "converged" else BAD
    pill = f"background:{colour};color:#fff;border-radius:4px;padding:2px 8px"
    title = (
        f'<b style="{pill}">{fit.status}</b> {escaped(STATUSES[fit.status])};'
        f" IoU {fit.iou:.4f}, rms {fit.rms:.2g}"
    )
    way = [stop.camera for stop in fit.history[:-1]]
    seen = frustum(fit.camera, way, [mode.camera for mode in fit.modes])
    return _card(title, parameters(fit), seen) + items(fit.notes)


def _card(title: str, *parts: str) -> str:
    style = "display:flex;flex-wrap:wrap;gap:20px;align-items:center"
    return f'<div><div>{title}</div><div style="{style}">{"".join(parts)}</div></div>'
