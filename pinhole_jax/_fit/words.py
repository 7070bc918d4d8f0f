"""A fit in words: its parameters with their standard errors, as a table."""

import math
from typing import Any, NamedTuple

import numpy as np

from .._names import STATUSES as STATUSES
from .parameters import LABELS


class Row(NamedTuple):
    """A fitted parameter in words, its value (None for a small turn), one sigma, the unit."""

    words: str
    value: float | None
    std: float
    unit: str


def parameters(fit: Any) -> list[Row]:
    """Return the fitted parameters with their standard errors; angles in degrees."""
    rows = []
    for name, std in zip(fit.names, fit.std.tolist(), strict=True):
        label = LABELS[name]
        factor, unit = (180 / np.pi, "deg") if label.unit == "rad" else (1.0, label.unit)
        value = None if label.value is None else factor * float(label.value(fit.camera))
        rows.append(Row(label.words, value, std * factor, unit))
    return rows


def table(fit: Any) -> str:
    """Return a fit as a short table: parameter, value, one sigma; status, IoU, what is weak."""
    lines = [f"{'parameter':<28}{'value':>16}{'one sigma':>14}  unit"]
    for row in parameters(fit):
        value = "-" if row.value is None else in_digits(row.value, row.std)
        lines.append(f"{row.words:<28}{value:>16}{row.std:>14.2g}  {row.unit}".rstrip())

    lines.append(f"status     {fit.status}   ({STATUSES[fit.status]})")
    lines.append(f"IoU        {fit.iou:.4f}   (rms of coverage {fit.rms:.2g})")
    lines += [f"note       {weak}" for weak in fit.weak]
    if fit.modes:
        views = (
            "another view explains"
            if len(fit.modes) == 1
            else f"{len(fit.modes)} other views explain"
        )
        lines.append(f"note       {views} the mask as well")
    return "\n".join(lines)


def in_digits(value: float, std: float) -> str:
    """Return a number with as many digits as its standard error leaves it, and one more."""
    if not (math.isfinite(std) and std > 0):
        return f"{value:.6g}"
    decimals = 1 - math.floor(math.log10(std))
    return f"{value:.{min(max(decimals, 0), 12)}f}"
