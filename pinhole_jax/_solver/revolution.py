"""About which axis a body looks the same all round, but for a part of it, and how facets repeat.

A mug is round but for its handle: where that is out of the outline, turns about the axis do not
show, and flat facets make each of them a minimum of its own. Support functions tell: how far a body
reaches in each direction. (A surface of revolution reaches as far all round; what sticks out of it
is an outlier.)
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from .._mask.search import sphere_points
from .._numerics.memo import memoised

#: A body is round if its support is a circle's to within this share of its radius ... (Mugs: 1e-4,
#: prisms of 16 sides: 4e-3; elbows, cows and what else has no axis: 0.03 and more.)
ROUND = 0.02
#: ... in this many of the directions looked in; and nearly so, before the axis is made better.
MOST, NEARLY = 0.6, 0.15
#: Directions looked in: angles about the axis, and heights above its normal plane (rad).
ROUND_ABOUT, HEIGHTS, MIDDLE = 60, np.deg2rad([-40.0, 0.0, 40.0]), 1
ALL_ROUND = sphere_points(256)
#: Rounds of making the axis better, and of weighing outliers less in the first and the others.
ROUNDS, WEIGHINGS, MORE_WEIGHINGS = 5, 8, 30
#: Of several lines one is the body's if the rest is so much nearer to it, but for a few.
CLEARLY, NEARLY_ALL = 0.5, 0.75
#: Directions tried where the principal axes may not do; the cosine between axes that differ.
AROUND, APART = sphere_points(24), 0.5
#: A share of the sum of squares that keeps what is not determined (a ball's tilt) at 0.
RIDGE = 1e-9
#: Facets may repeat this often; the support, turned by one facet, then differs by this share of its
#: usual difference, and by rounding at least.
SECTIONS, REPEATS, ROUNDING = np.arange(10, 181), 0.25, 1e-6
#: Angles at which the support in the plane is looked at for that; how many vertices, and how many
#: corners of their hull, have facets that matter.
FINE, POINTS, CORNERS = 3600, 200_000, 2000
#: Of more vertices than these one in each cell of a grid is taken, of many more some at random.
SOME, CELLS, MANY = 1200, 14, 50_000


#: A line's direction, a point of it, and how far off most of the rest is.
_Line = tuple[np.ndarray, np.ndarray, float]


class Revolution(NamedTuple):
    """A line that a body is round about: its direction (3,), a point of it (3,), and the angle
    (rad) at which facets repeat, or None where no such angle is found."""

    axis: np.ndarray
    centre: np.ndarray
    pitch: float | None


def revolutions(vertices: np.ndarray) -> list[Revolution]:
    """Return the lines that vertices (n, 3) are round about, but for a part of them."""
    return memoised(_revolutions, vertices)


def some_of(vertices: np.ndarray) -> np.ndarray:
    """Return vertices (n, 3), or some hundreds of many, wherever there are any."""
    if len(vertices) <= SOME:
        return vertices.astype(float)
    few: np.ndarray = np.asarray(vertices)
    if len(vertices) > MANY:  # at random: a mesh's order may be that of its rings
        few = few[np.random.default_rng(0).integers(0, len(vertices), MANY)]
    low, high = few.min(axis=0), few.max(axis=0)
    with np.errstate(all="ignore"):  # what overflows is refused afterwards
        cell = (CELLS * (few - low) / np.maximum(high - low, np.finfo(few.dtype).tiny)).astype(int)
    number = np.clip(cell, 0, CELLS - 1) @ [CELLS**2, CELLS, 1]
    first = np.full(CELLS**3, -1)
    first[number[::-1]] = np.arange(len(few))[::-1]
    return np.asarray(few[first[first >= 0]], float)


def _revolutions(vertices: np.ndarray) -> list[Revolution]:
    some = some_of(vertices)
    if len(some) < 4:
        return []
    middle = some.mean(axis=0)
    with np.errstate(over="ignore"):
        size = float(np.max(np.linalg.norm(some - middle, axis=1)))
    if not 0 < size < np.inf:
        return []
    points = (some - middle) / size
    # Those that something sticks out with are many, but they reach farthest in few directions.
    outer = points[np.argmax(ALL_ROUND @ points.T, axis=1)]
    outer = outer - outer.mean(axis=0)
    lines = [_line(points, axis) for axis in np.linalg.eigh(outer.T @ outer)[1].T]
    if any(lines):  # near a ball the principal axes say little
        lines += [_line(points, axis) for axis in AROUND if axis[2] > 0]
    lines = _different(line for line in lines if line is not None)
    if len(lines) > 1 and lines[0][2] < CLEARLY * lines[1][2]:
        lines = lines[:1]
    some = (vertices[:: max(len(vertices) // POINTS, 1)] - middle) / size
    result = [
        Revolution(axis, middle + size * centre, _pitch(some, axis, centre))
        for axis, centre, _ in lines
    ]
    faceted = [line for line in result if line.pitch is not None]
    return faceted if len(faceted) == 1 else result


def _different(lines: Iterable[_Line]) -> list[_Line]:
    """The lines that fit best, of near ones the best."""
    distinct: list[_Line] = []
    for line in sorted(lines, key=lambda line: line[2]):
        if all(abs(line[0] @ other[0]) < APART for other in distinct):
            distinct.append(line)
    return distinct


def _line(points: np.ndarray, axis: np.ndarray) -> _Line | None:
    """Return the line (direction, point) near an axis that points (n, 3) of size 1 are round
    about, and how far off most of the rest is."""
    centre, rest, weighings = np.zeros(3), 0.0, WEIGHINGS
    for allowed in (*np.geomspace(NEARLY, 2 * ROUND, ROUNDS), ROUND):
        normals = _normal_to(axis)
        across, height, directions = _directions(axis, normals)
        where = points[np.argmax(directions @ points.T, axis=1)]
        reach = np.sum(where * directions, axis=1)
        # How far it reaches: a height's radius, a shift of the line, and a tilt of it.
        level = (height[:, None] == HEIGHTS).astype(float)
        shift = np.cos(height)[:, None] * (across @ normals.T)
        table = np.concatenate([level, shift, np.cross(directions, where) @ normals.T], axis=1)
        fitted, weighings = _robust(table, reach, weighings), MORE_WEIGHINGS
        untilted = np.r_[fitted[:5], 0, 0]
        off, rest = np.quantile(np.abs(table @ untilted - reach), [MOST, NEARLY_ALL])
        if off >= allowed * fitted[MIDDLE]:
            return None
        axis = axis - np.cross(fitted[5:] @ normals, axis)
        axis, centre = axis / np.linalg.norm(axis), fitted[3:5] @ normals
    return axis, centre, float(rest)


def _normal_to(axis: np.ndarray) -> np.ndarray:
    """Return two directions (2, 3) that make right angles with an axis and each other."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)])


def _directions(axis: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points in the plane (D, 3), heights above it (D,) and the directions there (D, 3)."""
    angle = np.arange(ROUND_ABOUT) * (2 * np.pi / ROUND_ABOUT)
    flat = np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ normals
    height = np.repeat(HEIGHTS, ROUND_ABOUT)
    across = np.tile(flat, (len(HEIGHTS), 1))
    directions = np.cos(height)[:, None] * across + np.sin(height)[:, None] * axis
    return across, height, directions


def _robust(table: np.ndarray, values: np.ndarray, weighings: int) -> np.ndarray:
    """Return x for which most of table x - values is small, outliers or not (Cauchy's loss)."""
    weight, x = np.ones(len(values)), np.zeros(table.shape[1])
    for _ in range(weighings):
        weighted = table.T * weight
        normal = weighted @ table
        x = np.linalg.solve(
            normal + RIDGE * np.trace(normal) * np.eye(len(normal)), weighted @ values
        )
        off = np.abs(table @ x - values)
        scale = max(1.5 * float(np.median(off)), RIDGE)
        weight = 1 / (scale**2 + off**2)
    return x


def _pitch(points: np.ndarray, axis: np.ndarray, centre: np.ndarray) -> float | None:
    """Return the angle at which facets repeat about a line, the smallest; None: they do not."""
    from scipy.spatial import ConvexHull

    flat = (points - centre) @ _normal_to(axis).T
    corners = flat[ConvexHull(flat, qhull_options="QJ").vertices]
    if len(corners) > CORNERS:
        return None
    angles = np.linspace(-np.pi, np.pi, FINE, endpoint=False)
    reach = np.max(corners @ np.stack([np.cos(angles), np.sin(angles)]), axis=0)
    after = angles[:, None] + 2 * np.pi / SECTIONS
    off = np.abs(np.interp(after, angles, reach, period=2 * np.pi) - reach[:, None])
    differ = np.median(off, axis=0)
    least = float(np.min(differ))
    rounding = ROUNDING * float(np.mean(reach))
    if least > max(REPEATS * float(np.median(differ)), rounding):
        return None
    # What repeats n times repeats every second, third time, too.
    multiple = SECTIONS % SECTIONS[np.argmin(differ)] == 0
    return float(2 * np.pi / np.max(SECTIONS[multiple & (differ <= 2 * least + rounding)]))
