"""One page about many fits: totals, how they are spread, and the worst of them in pictures."""

import html
import json
import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from .._files.paths import replace_file
from ..names import STATUSES
from ..show.page import document, facts, figure, table
from .parts import Results
from .rows import NO_FIT, Row
from .tables import fit_of

#: This many of the worst rows are shown, and how large their pictures are (px).
WORST, SHOWN_PX = 12, 400
BINS = 32


def write(
    path: str | os.PathLike[str], results: Results, title: str = "Cameras of a data set"
) -> None:
    """Write a page about all rows: how many have each status, how IoU, standard errors and seconds
    are spread, and the worst rows with the outline on the mask.

    Raises ValueError for a path that cannot be written.
    """
    numbers = _Numbers(results)
    count = len(numbers.status)
    good = numbers.status.count("converged")
    head = facts(
        {
            "rows": str(count),
            "converged": f"{good} ({good / max(count, 1):.1%})",
            "seconds in all": f"{np.sum(numbers.seconds):.0f}",
        }
    )
    sections = {
        "Status": _statuses(numbers.status),
        "Spread": "".join(_spread(numbers)),
        "The worst": _worst(results, numbers),
    }
    replace_file(path, document(title, head, sections).encode(errors="backslashreplace"))


class _Numbers:
    """What the page needs of all rows, as numbers: rows themselves do not stay in memory."""

    def __init__(self, results: Results):
        self.id: list[str] = []
        self.status: list[str] = []
        self.iou: list[float] = []
        self.turn: list[float] = []
        self.seconds: list[float] = []
        for row in results:
            self.id.append(row["id"])
            self.status.append(row["status"])
            self.iou.append(np.nan if row["iou"] is None else row["iou"])
            self.turn.append(_turn(row))
            self.seconds.append(row["seconds"] or 0.0)


def _turn(row: Row) -> float:
    """Return the largest standard error of a rotation, in degrees; NaN where there is none."""
    names = row["names"] or []
    turns = [x for n, x in zip(names, row["std"] or [], strict=True) if n.startswith("rotation")]
    return float(np.rad2deg(max(turns))) if turns else np.nan


def _statuses(found: Sequence[str]) -> str:
    meaning = {**STATUSES, **NO_FIT}
    counts = {name: found.count(name) for name in meaning}
    rows = [
        (name, str(number), f"{number / max(len(found), 1):.1%}", meaning[name])
        for name, number in counts.items()
        if number
    ]
    return table(("status", "rows", "share", "meaning"), rows, "Of all rows", "statuses")


def _spread(numbers: _Numbers) -> Iterable[str]:
    words = "The largest standard error of a turn, degrees"
    yield _histogram("IoU", np.array(numbers.iou), np.linspace, "")
    yield _histogram(words, np.array(numbers.turn), np.geomspace, " deg")
    yield _histogram("Seconds", np.array(numbers.seconds), np.geomspace, " s")


def _histogram(name: str, values: np.ndarray, spaced: Callable[..., np.ndarray], unit: str) -> str:
    """Return a bar chart of how values are spread, as SVG."""
    values = values[np.isfinite(values) & (values > 0)]
    if not values.size:
        return f"<p>{name}: of no row.</p>"
    low, high = float(values.min()), float(values.max())
    if low == high:
        return f"<p>{name}: {low:.4g}{unit} of all {values.size} rows.</p>"
    counts, edges = np.histogram(values, spaced(low, high, BINS + 1))
    W, H, foot = 640, 90, 24
    step = W / BINS
    bars = "".join(
        f'<rect x="{k * step:.1f}" y="{H - H * n / counts.max():.1f}" width="{step - 1:.1f}"'
        f' height="{H * n / counts.max():.1f}"><title>{edges[k]:.3g} to {edges[k + 1]:.3g}{unit}:'
        f" {n}</title></rect>"
        for k, n in enumerate(counts)
    )
    middle = float(np.median(values))
    labels = (
        f'<text x="0" y="{H + 18}">{low:.3g}{unit}</text>'
        f'<text x="{W}" y="{H + 18}" text-anchor="end">{high:.3g}{unit}</text>'
    )
    axis = "" if spaced is np.linspace else ", on a logarithmic axis"
    caption = f"{name}{axis}: median {middle:.3g}{unit}, {values.size} rows, {counts.max()} at most"
    return (
        f'<figure class="histogram"><svg viewBox="0 0 {W} {H + foot}" role="img"'
        f' aria-label="{caption}" fill="currentColor" font-size="13">{bars}{labels}</svg>'
        f"<figcaption>{caption}.</figcaption></figure>"
    )


def _worst(results: Results, numbers: _Numbers) -> str:
    """Return the rows that most want to be looked at: those that failed, then the lowest IoU."""
    failed = np.array([status in NO_FIT for status in numbers.status], bool)
    score = np.where(failed, -1.0, np.nan_to_num(np.array(numbers.iou)))
    order = np.argsort(score, kind="stable")[:WORST]
    rows = results.rows(numbers.id[k] for k in order)
    return "".join(map(_shown, rows)) or "<p>No rows.</p>"


def _shown(row: Row) -> str:
    """Return a row: its words, and the outline on its mask where there is a camera."""
    iou = "" if row["iou"] is None else f", IoU {row['iou']:.4f}"
    weak = "; ".join(row["weak"] or [])
    words = html.escape(" ".join(filter(None, (row["words"], weak))))
    head = f"<h3>{html.escape(row['id'])}: {row['status']}{iou}</h3><p>{words}</p>"
    try:
        picture = _picture(row)
    except (ValueError, OSError) as error:  # files may have gone since
        return f"{head}<p>No picture: {html.escape(str(error))}</p>"
    return head if picture is None else head + figure(picture, "The outline on the mask.")


def _picture(row: Row) -> Any:
    """Return the outline on the mask, None where there is no camera of one mesh."""
    from PIL import Image

    from ..plot import overlay
    from .fit_one import mask_of, scene_of

    record = json.loads(row["record"])
    if row["fit"] is None or "mesh" not in record:
        return None
    drawn = overlay(mask_of(record), fit_of(row).camera, scene_of(record))
    small = Image.fromarray(drawn)
    small.thumbnail((SHOWN_PX, SHOWN_PX))
    return np.asarray(small)
