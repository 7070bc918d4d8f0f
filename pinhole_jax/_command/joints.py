"""Files of joint angles: JOINTS and --propose of `hand-eye` and `check`."""

import csv
import math
from typing import Any, NamedTuple

from ..io import load_json, load_text
from ..robots import Robot

#: The names of units, and their size in rad.
UNITS: dict[str, float] = {
    **dict.fromkeys(("rad", "radian", "radians"), 1.0),
    **dict.fromkeys(("deg", "degree", "degrees"), math.pi / 180),
}
#: Readings may exceed a joint's limits by this much (rad, m): its zero may be off.
BEYOND = 0.1


class JointTable(NamedTuple):
    """A file's rows of joint angles, and its unit in rad."""

    names: list[str]
    rows: list[list[float]]
    unit: float


def joint_angles(path: str, robot: Robot) -> list[dict[str, float]]:
    """Return a file's postures: angles by joint (rad; of sliding joints m).

    The file is a CSV whose first line has the names, or JSON with `names` and `postures`, and
    perhaps `unit`. Raises FileNotFoundError, or ValueError for other files, and for angles beyond
    the reach of the robot's joints, as degrees usually are.
    """
    table = _table(path)
    postures = []
    for number, row in enumerate(table.rows, 1):
        posture = {}
        for name, value in zip(table.names, row, strict=True):
            value *= 1.0 if name in robot.sliding else table.unit
            _check_reach(robot, name, value, f"row {number} of {path!r}")
            posture[name] = value
        postures.append(posture)
    return postures


def _check_reach(robot: Robot, name: str, value: float, where: str) -> None:
    slides = name in robot.sliding
    turn = math.inf if slides else 2 * math.pi
    least, most = robot.limits.get(name, (-turn, turn))
    if not math.isfinite(value) or least - BEYOND <= value <= most + BEYOND:
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


def _table(path: str) -> JointTable:
    """The joints' names, angles and unit in a CSV or JSON file."""
    data: dict[str, Any] = {}
    if path.lower().endswith(".json"):
        content = load_json(path)
        data = content if isinstance(content, dict) else {}
        postures = data.get("postures")
        rows = [data.get("names"), *(postures if isinstance(postures, list) else [])]
    else:
        lines = load_text(path).splitlines()
        rows = [[cell.strip() for cell in row] for row in csv.reader(lines) if row]
    if len(rows) < 2 or not all(isinstance(row, list) and row for row in rows):
        words = "a line of joint names (JSON: names, postures) and at least one of angles"
        raise ValueError(f"`path`: expected {words}, got none (in {path!r})")
    names, *postures = rows
    numbers = [_numbers(row, number, len(names), path) for number, row in enumerate(postures, 1)]
    return JointTable([str(name) for name in names], numbers, _unit(data, path))


def _unit(data: dict[str, Any], path: str) -> float:
    """Return the unit of a file in rad."""
    unit = 1.0
    for name, value in data.items():
        if "unit" not in name.lower() and name.lower() not in UNITS:
            continue
        if str(value).lower() not in UNITS:
            words = f'expected "unit": "rad" or "deg", got {name[:60]!r}: {str(value)[:60]!r}'
            raise ValueError(f"`path`: {words} (in {path!r})")
        unit = UNITS[str(value).lower()]
    return unit


def _numbers(row: list[Any], number: int, count: int, path: str) -> list[float]:
    try:
        values = [float(x) for x in row]
    except (TypeError, ValueError) as error:
        raise ValueError(f"`path`: expected numbers in row {number}, got {row}") from error
    if len(values) != count:
        words = f"expected {count} angles in row {number}, got {len(values)}"
        raise ValueError(f"`path`: {words} (in {path!r})")
    return values
