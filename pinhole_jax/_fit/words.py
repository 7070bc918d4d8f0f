"""A fit as text: its parameters with their standard errors, as a table."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .._solver.heading import carried, heading
from .._solver.parameters import LABELS
from ..names import STATUSES as STATUSES

#: What small turns about the camera's axes are told as.
TURNS = {"rotation_b1": "pitch", "rotation_b2": "yaw", "rotation_v": "roll"}
PLACE = ("e_x", "e_y", "e_z")
#: Lengths in the world have the unit of the mesh, which no mesh file says.
UNIT = "units of the mesh"
WORDS = {
    **dict.fromkeys(PLACE, f"eye, {UNIT}"),
    "phi": "vertical field of view",
    "d": "camera constant",
    "aspect": "fx / fy",
}


class Estimate(NamedTuple):
    """A fitted parameter: name, value, one sigma, unit, and a description where the name is not
    enough."""

    name: str
    value: float
    std: float
    unit: str
    words: str

    def cells(self) -> tuple[str, str, str, str, str]:
        """Return it as text: a number has the digits that its error leaves it, and one more."""
        sigma = f"{self.std:.2g}" if math.isfinite(self.std) else "not determined"
        return self.name, in_digits(self.value, self.std), sigma, self.unit, self.words


class ParameterTable(NamedTuple):
    """The fitted parameters (`rows`), angles in degrees, and their `covariance`."""

    rows: list[Estimate]
    covariance: Float[np.ndarray, "n n"]


def parameter_table(fit: Any) -> ParameterTable:
    """Return the fitted parameters with their standard errors.

    Small turns become pitch, yaw and roll (`heading`), whose covariance is carried along.
    """
    number = len(fit.names)
    looks = heading(fit.camera)
    turned = [k for k, name in enumerate(fit.names) if name in TURNS]
    about = [[*TURNS].index(fit.names[k]) for k in turned]
    derivative = np.eye(number)
    derivative[np.ix_(turned, turned)] = looks.derivative[np.ix_(about, about)]
    in_degrees = [LABELS[name].unit == "rad" for name in fit.names]
    derivative[in_degrees] *= 180 / np.pi
    covariance = carried(fit.covariance, derivative)

    ways = (
        f"up from level, where {looks.up} is up",
        f"about {looks.up}, from {looks.ahead}",
        "right side down",
    )
    turns = dict(zip(TURNS, zip(looks.angles.tolist(), ways, strict=True), strict=True))
    rows = []
    for k, name in enumerate(fit.names):
        _, unit, of = LABELS[name]
        if of is None:
            value, words = turns[name]
        else:
            value, words = float(of(fit.camera)), WORDS.get(name, "")
        factor, unit = (180 / np.pi, "deg") if in_degrees[k] else (1.0, unit)
        std = float(np.sqrt(covariance[k, k]))
        own = TURNS.get(name) or name
        rows.append(Estimate(own, factor * value, std, unit, words))
    return ParameterTable(rows, covariance)


def parameter_lines(table: ParameterTable) -> list[str]:
    """The lines of a table: parameter, value, one sigma, unit, description."""
    lines = [f"{'parameter':<16}{'value':>16}{'one sigma':>14}  unit"]
    for row in table.rows:
        value = in_digits(row.value, row.std)
        lines.append(
            f"{row.name:<16}{value:>16}{row.std:>14.2g}  {row.unit:<6} {row.words}".rstrip()
        )
    return lines


def accuracy(names: Sequence[str], covariance: np.ndarray) -> str:
    """The largest standard errors of turns and of places as a sentence, "" where no pose was
    fitted or one is not determined."""
    sizes = []
    for known in (TURNS, PLACE):
        own = [k for k, name in enumerate(names) if name in known]
        part = np.asarray(covariance)[np.ix_(own, own)]
        if not (own and np.all(np.isfinite(part))):
            return ""
        sizes.append(float(np.sqrt(max(np.linalg.eigvalsh(part)[-1], 0.0))))
    turn, place = np.rad2deg(sizes[0]), sizes[1]
    return f"rotation +-{turn:.2g} degrees, position +-{place:.2g} {UNIT} (1 sigma)"


def in_digits(value: float, std: float) -> str:
    """Return a number with as many digits as its standard error leaves it, and one more."""
    if not (math.isfinite(std) and std > 0):
        return f"{value:.6g}"
    decimals = 1 - math.floor(math.log10(std))
    return f"{value:.{min(max(decimals, 0), 12)}f}"
