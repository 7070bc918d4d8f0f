"""Files of joint angles: JOINTS and --propose of `hand-eye` and `check`."""

import csv
import math
from typing import Any

from ..io import load_json, load_text
from ..robots import Robot

#: The names of units, and their size in rad.
UNITS: dict[str, float] = {
    **dict.fromkeys(("rad", "radian", "radians"), 1.0),
    **dict.fromkeys(("deg", "degree", "degrees"), math.pi / 180),
}
#: Readings may exceed a joint's limits by this much (rad, m): its zero may be off.
BEYOND = 0.1


def joint_angles(path: str, robot: Robot) -> list[dict[str, float]]:
    """Return a file's postures: angles by joint (rad; of sliding joints m).

    The file is a CSV whose first line has the names, or JSON with `names` and `postures`, and
    perhaps `unit`. Raises FileNotFoundError, or ValueError for other files, and for angles beyond
    the reach of the robot's joints, as degrees usually are.
    """
    names, *rows = _rows(data := _data(path), path)
    unit, postures = _unit(data, path), []
    for number, row in enumerate(rows, 1):
        values = _numbers(row, number, len(names), path)
        posture = {}
        for name, value in zip(map(str, names), values, strict=True):
            posture[name] = value * (1.0 if name in robot.sliding else unit)
            _check_reach(robot, name, posture[name], f"row {number} of {path!r}")
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


def _data(path: str) -> dict[str, Any]:
    """Return a file's data: of a CSV `names` and `postures`, as JSON has them."""
    if path.lower().endswith(".json"):
        data = load_json(path)
        return data if isinstance(data, dict) else {}
    lines = csv.reader(load_text(path).splitlines())
    names, *postures = [[cell.strip() for cell in row] for row in lines if row] or [None]
    return {"names": names, "postures": postures}


def _rows(data: dict[str, Any], path: str) -> list[list[Any]]:
    """Return the names, and at least one row of angles below them."""
    postures = data.get("postures")
    rows = [data.get("names"), *(postures if isinstance(postures, list) else [])]
    if len(rows) < 2 or not all(isinstance(row, list) and row for row in rows):
        words = "a line of joint names (JSON: names, postures) and at least one of angles"
        raise ValueError(f"`path`: expected {words}, got none (in {path!r})")
    return rows


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
