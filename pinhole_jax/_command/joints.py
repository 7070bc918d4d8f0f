"""Files of joint angles: JOINTS and --propose of `hand-eye` and `check`."""

import csv
import math

import numpy as np

from .._files.fields import Fields
from ..io import load_json, load_text
from ..robots import Robot

#: Units of angles, in rad.
UNITS = {"rad": 1.0, "deg": math.pi / 180}
#: Readings may exceed a joint's limits by this much (rad, m): its zero may be off.
BEYOND = 0.1


def joint_angles(path: str, robot: Robot) -> list[dict[str, float]]:
    """Return a file's postures: angles by joint (rad; of sliding joints m).

    The file is a CSV whose first line has the names, or JSON with `names` and `postures`, and
    perhaps `unit`. Raises FileNotFoundError, or ValueError for other files, and for angles beyond
    the reach of the robot's joints, as degrees usually are.
    """
    is_json = path.lower().endswith(".json")
    fields = Fields(load_json(path) if is_json else _table(path), repr(path))
    if others := sorted(fields.data.keys() - {"names", "postures", "unit"}):
        raise fields.wrong(others[0], "names, postures and unit alone", "also it")
    names = [str(name) for name in fields.items("names")]
    unit = UNITS[fields.text("unit", [*UNITS], "rad")]
    rows = fields.array("postures", (-1, len(names)), expected=f"{len(names)} angles in each row")
    if not len(rows):
        raise fields.wrong("postures", "at least one row of angles", "none")
    units = np.array([1.0 if name in robot.sliding else unit for name in names])
    postures = [dict(zip(names, row, strict=True)) for row in (rows * units).tolist()]
    for number, posture in enumerate(postures, 1):
        for name, value in posture.items():
            _check_reach(robot, name, value, f"row {number} of {path!r}")
    return postures


def _table(path: str) -> dict[str, object]:
    """Return a CSV's `names` and `postures`, as JSON has them."""
    names, *rows = [row for row in csv.reader(load_text(path).splitlines()) if row] or [[]]
    try:
        return {"names": [name.strip() for name in names], "postures": np.array(rows, float)}
    except ValueError as error:
        words = f"expected numbers, as many in each row as names, got {error}"
        raise ValueError(f"`path`: {words} (in {path!r})") from None


def _check_reach(robot: Robot, name: str, value: float, where: str) -> None:
    slides = name in robot.sliding
    turn = math.inf if slides else 2 * math.pi
    least, most = robot.limits.get(name, (-turn, turn))
    if least - BEYOND <= value <= most + BEYOND:
        return
    unit, hint = (
        ("m", "other units?")
        if slides
        else ("rad", 'degrees? Then give JSON with "unit": "deg", or rad')
    )
    reach = "the URDF's limits" if name in robot.limits else "a turn to either side"
    raise ValueError(
        f"`path`: expected {least:.4g} to {most:.4g} {unit} of joint {name!r}, {reach}, got"
        f" {value:.4g} in {where}: {hint}"
    )
