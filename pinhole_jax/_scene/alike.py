"""Views from which a body looks alike: by turns of its faces, round a line, by mirror images.

Where what tells them apart is out of the outline, or small, a mask fits as many cameras. A walk
along what is nearly free does not find these: they are no neighbours. The body's shape tells.

- A ball of facets has turns that bring most of its faces to where others were, a rack shifts.
- A mug is round but for its handle: turns about its axis do not show, and flat facets make each of
  them a minimum of its own. Support functions tell: how far a body reaches in each direction. (A
  surface of revolution reaches as far all round; what sticks out of it is an outlier.)
- A silhouette from behind is a mirror image but for perspective, so a body that is near its own
  mirror image looks alike from there.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._camera.axes import axes_of, sphere_points
from .._camera.camera import Camera
from .._numerics.components import perpendicular
from .._numerics.memo import memoised
from .._rules import RULES
from .scene import grid_cells

#: The directions in which mirror images are looked at.
DIRECTIONS = sphere_points(64)

# Round bodies.
#: A body is round if its support is a circle's to within this share of its radius ... (Mugs: 1e-4,
#: prisms of 16 sides: 4e-3; elbows, cows and what else has no axis: 0.03 and more.)
ROUND = 0.02
#: ... in this many of the directions looked in; and nearly so, before the axis is made better.
MOSTLY, NEARLY = 0.6, 0.15
#: Directions looked in, about the z axis: at heights (rad) above the normal plane, all round; at
#: which of the heights each is.
ROUND_ABOUT, HEIGHTS, MIDDLE = 60, np.deg2rad([-40.0, 0.0, 40.0]), 1
LOOKS = np.array(
    [
        (np.cos(height) * np.cos(angle), np.cos(height) * np.sin(angle), np.sin(height))
        for height in HEIGHTS
        for angle in np.arange(ROUND_ABOUT) * (2 * np.pi / ROUND_ABOUT)
    ]
)
LEVELS = np.repeat(np.eye(len(HEIGHTS)), ROUND_ABOUT, axis=0)
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
SOME, CELLS, MANY = 1200, 18, 50_000

# Turns of faces.
#: Finer meshes have facets that no mask shows: they are not looked at.
MOST_FACES = 30_000
#: Corners, and lengths of edges, closer than this share of the mesh's size are alike.
ALIKE = 1e-4
#: A turn counts if this share of the area lands where faces were (a dent is missed by two), at this
#: many sampled places; in the first few, half the share is enough.
MOST, LOOKED_AT, FIRST = 0.4, 200, 20
#: A few faces of each shape are turned to all others of it: this many shapes, this many turns at
#: most.
SHAPES, TURNS = 8, 2000
#: Turns closer than this (its trace's distance) are one, and shifts closer than this share of the
#: mesh's size.
ONE, FAR = 1e-4, 0.1

#: A line's direction, a point of it, and how far off most of the rest is.
_Line = tuple[np.ndarray, np.ndarray, float]


class Revolution(NamedTuple):
    """A line that a body is round about: its direction (3,), a point of it (3,), and the angle
    (rad) at which facets repeat, or None where no such angle is found."""

    axis: np.ndarray
    centre: np.ndarray
    pitch: float | None


class Turn(NamedTuple):
    """x -> rotation x + shift."""

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class Alike:
    """What of a body looks alike: its vertices (V, 3) and faces (F, 3), and a point in its middle
    (3,)."""

    vertices: np.ndarray
    faces: np.ndarray
    centre: np.ndarray

    @cached_property
    def lines(self) -> list[Revolution]:
        """The lines that the body is round about, but for a part of it."""
        return memoised(_revolutions, self.vertices)

    @cached_property
    def turns(self) -> list[Turn]:
        """The turns that bring most of the body's faces to other faces."""
        known = 2 <= len(self.faces) <= MOST_FACES
        return memoised(_turns, self.vertices, self.faces) if known else []

    @cached_property
    def _images(self) -> list[np.ndarray]:
        """The reflections and half turns (3, 3) in principal axes that change the body little."""
        points = _some_of(self.vertices) - self.centre
        if not len(points):
            return []
        _, principal = np.linalg.eigh(points.T @ points)
        reach = np.max(points @ DIRECTIONS.T, axis=0)
        signs = np.array(np.meshgrid(*[[1, -1]] * 3)).reshape(3, 8).T[1:]
        images = [principal @ (s[:, None] * principal.T) for s in signs]
        off = lambda x: np.max(np.abs(np.max(points @ (DIRECTIONS @ x).T, axis=0) - reach))
        return [image for image in images if off(image) <= RULES.mirrored * np.max(reach)]

    def views(self, camera: Camera) -> Iterator[Camera]:
        """Views that the body shows alike: where it is near its own mirror image half turns, and
        turned so that near and far change places, which changes a silhouette only by perspective;
        turns that bring its faces to one another, unless it is round."""
        axes, rotations = axes_of(camera), []
        for image in self._images:
            turned = axes @ image
            if np.linalg.det(image) < 0:
                turned[2] = -turned[2]
            rotations.append(turned.T @ axes)
            yield rotated(camera, rotations[-1], self.centre - rotations[-1] @ self.centre)
        for turn in [] if self.lines else self.turns[: RULES.turns]:
            if all(np.linalg.norm(turn.rotation - other) > RULES.same for other in rotations):
                yield rotated(camera, *turn)


def rotated(camera: Camera, rotation: np.ndarray, shift: np.ndarray) -> Camera:
    """The camera that x -> rotation x + shift brings with it."""
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    eye = rotation @ e + shift
    dtype = np.asarray(camera.e).dtype  # (`with_pose` checks what it is given: six times as long)
    pose: Any = [x.astype(dtype) for x in (eye, eye + rotation @ (p - e), rotation @ u)]
    return eqx.tree_at(lambda c: [c.e, c.p, c.u], camera, pose)


# --- lines that a body is round about -----------------------------------------------------------


def _some_of(vertices: np.ndarray) -> np.ndarray:
    """Return vertices (n, 3), or some hundreds of many, wherever there are any."""
    if len(vertices) <= SOME:
        return vertices.astype(float)
    few: np.ndarray = np.asarray(vertices)
    if len(vertices) > MANY:  # at random: a mesh's order may be that of its rings
        few = few[np.random.default_rng(0).integers(0, len(vertices), MANY)]
    with np.errstate(all="ignore"):  # what overflows is refused afterwards
        cell = grid_cells(few, CELLS)
    _, first = np.unique(cell @ np.array([CELLS**2, CELLS, 1]), return_index=True)
    return np.asarray(few[first], float)


def _revolutions(vertices: np.ndarray) -> list[Revolution]:
    """Lines about which points look round, the roundest first."""
    some = _some_of(vertices)
    if len(some) < 4:
        return []
    with np.errstate(over="ignore", invalid="ignore"):
        middle = some.mean(axis=0)
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
        normals = np.array(perpendicular(axis))
        directions = LOOKS @ [*normals, axis]
        where = points[np.argmax(directions @ points.T, axis=1)]
        reach = np.sum(where * directions, axis=1)
        # How far it reaches: a height's radius, a shift of the line, and a tilt of it.
        tilt = np.cross(directions, where) @ normals.T
        table = np.concatenate([LEVELS, LOOKS[:, :2], tilt], axis=1)
        fitted, weighings = _robust(table, reach, weighings), MORE_WEIGHINGS
        untilted = np.r_[fitted[:5], 0, 0]
        off, rest = np.quantile(np.abs(table @ untilted - reach), [MOSTLY, NEARLY_ALL])
        if off >= allowed * fitted[MIDDLE]:
            return None
        axis = axis - np.cross(fitted[5:] @ normals, axis)
        axis, centre = axis / np.linalg.norm(axis), fitted[3:5] @ normals
    return axis, centre, float(rest)


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

    flat = (points - centre) @ np.array(perpendicular(axis)).T
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


# --- turns of its faces -----------------------------------------------------------------------


def _turns(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> list[Turn]:
    from scipy.spatial import KDTree

    corners = np.asarray(vertices, float)[faces]
    size = float(np.max(np.linalg.norm(corners - corners.mean(axis=(0, 1)), axis=-1)))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    usable = area > (ALIKE * size) ** 2
    corners, area = corners[usable], area[usable]
    if len(corners) < 2:
        return []
    middles = corners.mean(axis=1)
    tree = KDTree(middles)
    share = (np.arange(LOOKED_AT) + 0.5) / LOOKED_AT
    looked_at = middles[np.searchsorted(np.cumsum(area), share * np.sum(area))]
    few = looked_at[:: LOOKED_AT // FIRST]

    def alike(places: np.ndarray, turn: Turn) -> float:
        off, _ = tree.query(
            places @ turn.rotation.T + turn.shift, distance_upper_bound=ALIKE * size
        )
        return float(np.mean(np.isfinite(off)))

    found: list[Turn] = []
    known, tried = np.eye(3, 4)[None], 0
    for first, others in _shapes(corners, area, size):
        for begin in range(3):
            frames = _frames(np.roll(corners[others], -begin, axis=1))
            rotations = frames @ _frames(corners[first][None])[0].T
            shifts = middles[others] - rotations @ middles[first]
            tried += len(others)
            # (Teeth of a rack are shifted; of a turn one shift is enough.)
            alone = np.linalg.norm(rotations - np.eye(3), axis=(1, 2)) < ONE
            by = ONE / (FAR * size) * alone[:, None] * shifts
            keys = np.concatenate([rotations, by[..., None]], axis=2)
            # (Long faces, which are shifted along themselves, have no others to land on.)
            for turn, key, is_shift in zip(map(Turn, rotations, shifts), keys, alone, strict=True):
                if np.any(np.linalg.norm(known - key, axis=(1, 2)) < ONE):
                    continue
                most = MOST / 2 if is_shift else MOST
                if alike(few, turn) >= most / 2 and alike(looked_at, turn) >= most:
                    both = [turn, Turn(turn.rotation, -turn.shift)]
                    found += both if is_shift else [turn]
                    back = key * [1, 1, 1, -1]
                    known = np.concatenate([known, [key, back] if is_shift else [key]])
        if tried > TURNS:
            break
    return found


def _shapes(
    corners: Float[np.ndarray, "F 3 3"], area: Float[np.ndarray, "F"], size: float
) -> list[tuple[int, Int[np.ndarray, "k"]]]:
    """Return a face of each common shape, and all faces that have it: rare shapes first."""
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    key = np.sort(np.round(sides / (ALIKE * size)), axis=1)
    _, which, number = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    total = np.bincount(which, weights=area)
    order = np.argsort(-total)[:SHAPES]
    order = order[np.argsort(number[order], kind="stable")]
    members = [np.flatnonzero(which == k) for k in order if number[k] > 1]
    return [(int(m[0]), m[:TURNS]) for m in members]


def _frames(corners: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k 3 3"]:
    """Return axes of triangles in their columns: along the first side, in the plane, normal."""
    along = corners[:, 1] - corners[:, 0]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.cross(along, corners[:, 2] - corners[:, 0])
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([along, np.cross(normal, along), normal], axis=-1)
