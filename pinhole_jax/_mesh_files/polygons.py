"""Polygons of any number of corners, in any plane of space, cut into triangles.

A fan from the first corner is right only where that corner sees all others. A polygon is therefore
laid into the plane of its Newell normal, the sum of its fan's area vectors, and cut there. Quads
are cut by the diagonal that leaves both halves facing the normal's way, others as a fan where that
is right, else by ear clipping. A triangle runs the way its polygon runs.

The triangles' areas have to add up to the polygon's own. Where those of ear clipping do not, the
cut of least area is taken. Where that fails too, by more than the rounding of 32 bits, the sides
cross.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

#: Ear clipping takes up to n^2 steps for n corners, at most a nanosecond each: seconds in all.
MOST_EAR_STEPS = 10**10
#: The least area takes n^3 / 6 steps.
MOST_LEAST_AREA = 400
#: ... and this many steps for all faces of a file (some seconds).
MOST_LEAST_AREA_STEPS = 6 * 10**8
#: A small file can stand for more corners than these: instances of instances.
MOST_CORNERS = 1 << 26
#: Areas agree where they differ by less than this, the polygon being of size 1.
EXACT = 1e-9


class Polygons(NamedTuple):
    """Faces of a file: `points` (V, 3); the corners of all faces in a row, as indices of points;
    and how many of them each face has.
    """

    points: Float[np.ndarray, "V 3"]
    corners: Int[np.ndarray, "K"]
    counts: Int[np.ndarray, "F"]


def assembled(parts: Iterable[tuple[Polygons, np.ndarray]]) -> Polygons:
    """Return parts as one, each moved to its place (4, 4); a mirror turns its polygons round.

    Raises ValueError for corners that a part does not have, and for more than `MOST_CORNERS`.
    """
    points, corners, counts, start, total = [np.empty((0, 3))], [], [], 0, 0
    for part, place in parts:
        number = len(part.points)
        total += number + len(part.corners)
        if total > MOST_CORNERS:
            raise ValueError(f"expected at most {MOST_CORNERS} corners in all, got more")
        if part.corners.size and not 0 <= np.min(part.corners) <= np.max(part.corners) < number:
            raise ValueError(f"expected indices of {number} vertices, got {np.max(part.corners)}")
        still = np.array_equal(place, np.eye(4))
        points.append(part.points if still else part.points @ place[:3, :3].T + place[:3, 3])
        step = -1 if np.linalg.det(place[:3, :3]) < 0 else 1
        corners.append(start + part.corners[::step])
        counts.append(part.counts[::step])
        start += number
    none = np.empty(0, int)
    joined = (np.concatenate([none, *arrays]) for arrays in (corners, counts))
    return Polygons(np.concatenate(points), *joined)


def triangulated(polygons: Polygons) -> Int[np.ndarray, "T 3"]:
    """Return the polygons' triangles in the order of the polygons, as indices of points.

    Faces of fewer than three corners cover nothing and are left out, as are corners at the same
    place as the one before. All corners have to name points.

    Raises ValueError for a polygon whose sides cross, and for more corners than can be cut in
    seconds.
    """
    points, corners, counts = polygons
    if counts.size and np.all(counts == 3):
        return corners.reshape(-1, 3)

    corners, counts, numbers = _without_repeats(points, corners, counts)
    starts = np.cumsum(counts) - counts
    triangles, owners, uneven = [np.empty((0, 3), int)], [np.empty(0, int)], []

    for count in np.unique(counts[counts >= 3]):
        alike = np.flatnonzero(counts == count)
        shared = corners[starts[alike, None] + np.arange(count)]
        local, right = _fans(points[shared])
        triangles.append(
            np.take_along_axis(shared[right, None], local[right], axis=2).reshape(-1, 3)
        )
        owners.append(np.repeat(alike[right], count - 2))
        uneven += [(int(alike[k]), shared[k]) for k in np.flatnonzero(~right)]

    _check_time(uneven, numbers)
    left = MOST_LEAST_AREA_STEPS
    for k, corner in uneven:
        cut, steps = _cut(points[corner], int(numbers[k]), left)
        left -= steps
        triangles.append(corner[cut])
        cut = triangles[-1]
        owners.append(np.full(len(cut), k))

    order = np.argsort(np.concatenate(owners), kind="stable")
    return np.concatenate(triangles)[order]


def strips_cut(corners: Int[np.ndarray, "K"], counts: Int[np.ndarray, "S"]) -> np.ndarray:
    """Return the triangles (T, 3) of strips, which -1 ends as well.

    Every other triangle runs the other way round. Those that name a corner twice only join strips.
    """
    at, strip = np.arange(len(corners)), np.repeat(np.arange(len(counts)), counts)
    begins = np.r_[True, strip[1:] != strip[:-1]][: len(corners)]
    begins[1:] |= corners[:-1] == -1
    odd = (at - np.maximum.accumulate(np.where(begins, at, 0))) % 2 == 1

    triangles = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=-1)
    flipped = odd[: len(triangles)]
    triangles[flipped] = triangles[flipped][:, [0, 2, 1]]
    a, b, c = triangles.T
    within = (strip[:-2] == strip[2:]) & np.all(triangles != -1, axis=-1)
    return triangles[within & (a != b) & (b != c) & (c != a)]


def _check_time(uneven: list[tuple[int, np.ndarray]], numbers: np.ndarray) -> None:
    if sum(len(corner) ** 2 for _, corner in uneven) > MOST_EAR_STEPS:
        k, corner = max(uneven, key=lambda face: len(face[1]))
        raise ValueError(
            f"face {numbers[k]}: {len(corner)} corners, not all seen from the first; that many take"
            " more than seconds to cut"
        )


def _without_repeats(
    points: np.ndarray, corners: np.ndarray, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corners and counts without corners at the place of the one before, and the faces'
    numbers in the file, from 1. Triangles stay as they are.
    """
    numbers = np.arange(1, len(counts) + 1)
    some = counts > 0
    counts, numbers = counts[some], numbers[some]
    starts = np.cumsum(counts) - counts

    before = np.arange(len(corners)) - 1
    before[starts] = starts + counts - 1
    repeated = np.all(points[corners] == points[corners[before]], axis=-1)
    repeated &= np.repeat(counts > 3, counts)
    return corners[~repeated], counts - np.add.reduceat(repeated, starts, dtype=int), numbers


def _fans(space: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (m, n - 2, 3) triangles of (m, n, 3) polygons, and where they are right (m,).

    They are fans of the corners 0 to n - 1 from the first, or of quads from the second.
    """
    m, n = space.shape[:2]
    fans = np.tile(_fan(n), (m, 1, 1))
    if n == 3:
        return fans, np.ones(m, bool)

    flat, _ = _laid_flat(space)
    right = _fans_are_right(flat)
    if n == 4:
        other = ~right & _fans_are_right(np.roll(flat, -1, axis=1))
        fans[other] = [[1, 2, 3], [1, 3, 0]]
        right |= other
    return fans, right


def _fan(n: int) -> np.ndarray:
    """Return the triangles (n - 2, 3) of n corners that all have the first."""
    return np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=-1)


def _laid_flat(space: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (m, n, 2) corners in the planes of the Newell normals, counter-clockwise and of size
    1. Also the largest rounding error of these corners, in machine epsilons.
    """
    # By powers of two, which change no digit: squares are not to overflow or vanish.
    exponent = np.frexp(np.max(np.abs(space), axis=(1, 2)))[1]
    space = np.ldexp(space, -exponent[:, None, None])
    arms = space - space[:, :1]
    size = np.max(np.abs(arms), axis=(1, 2))
    size = np.where(size > 0, size, 1.0)
    arms = arms / size[:, None, None]

    areas = np.cross(arms[:, 1:-1], arms[:, 2:])
    normal = np.sum(areas, axis=1)
    largest = np.argmax(np.sum(areas**2, axis=-1), axis=1)
    widest = np.take_along_axis(areas, largest[:, None, None], axis=1)[:, 0]
    # The two lobes of an evenly crossed polygon cancel: its plane is that of any of its triangles.
    cancelled = np.linalg.norm(normal, axis=-1) <= 1e-12 * np.linalg.norm(widest, axis=-1)
    normal = np.where(cancelled[:, None], widest, normal)

    # An axis that is far from the normal, and the two directions that are perpendicular to both.
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=-1)]
    x = _unit(np.cross(axis, normal))
    y = np.cross(_unit(normal), x)
    flat = np.stack([np.sum(arms * x[:, None], axis=-1), np.sum(arms * y[:, None], axis=-1)], -1)

    return flat, 4 * np.max(np.abs(space), axis=(1, 2)) / size


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


def _fans_are_right(flat: np.ndarray) -> np.ndarray:
    """Return True (m,) for fans from the first corners that turn one way, at most once around."""
    arms = flat[:, 1:] - flat[:, :1]
    cross = _cross(arms[:, :-1], arms[:, 1:])
    dot = np.sum(arms[:, :-1] * arms[:, 1:], axis=-1)

    # Corners in line as seen from the first are no harm; a turn by half a circle is no fan's.
    ahead = (cross > 1e-15) | ((np.abs(cross) <= 1e-15) & (dot > 0))
    around = np.sum(np.arctan2(cross, dot), axis=-1)
    return np.all(ahead, axis=-1) & (around <= 2 * np.pi + 1e-9)


def _cut(space: np.ndarray, number: int, left: int) -> tuple[np.ndarray, int]:
    """Return the triangles (t, 3) of one polygon (n, 3) as corners 0 to n - 1, and the steps used
    of those that are `left` for cuts of least area."""
    (flat,), (rounding,) = _laid_flat(space[None])
    own = float(np.sum(_areas(flat, _fan(len(flat)))))
    sides = float(np.sum(np.linalg.norm(flat - np.roll(flat, 1, axis=0), axis=-1)))
    excess = lambda triangles: abs(float(np.sum(np.abs(_areas(flat, triangles)))) - own)

    triangles = _ears(flat)
    if excess(triangles) <= (EXACT + rounding * np.finfo(float).eps) * sides:
        return triangles, 0
    # Ear clipping loses its way where sides touch; the least area does not, but takes n^3 steps.
    steps = len(flat) ** 3
    if len(flat) <= MOST_LEAST_AREA and steps > left:
        raise ValueError(f"face {number}: like many before it, its sides touch: too many to cut")
    if len(flat) <= MOST_LEAST_AREA:
        triangles = _least_area(flat)
        if excess(triangles) <= (EXACT + rounding * np.finfo(np.float32).eps) * sides:
            return triangles, steps
    raise ValueError(f"face {number}: its sides cross, so that it has no inside")


def _ears(flat: np.ndarray) -> np.ndarray:
    """Return the triangles (t, 3) of one polygon (n, 2), counter-clockwise, by ear clipping."""
    import mapbox_earcut

    ring = np.array([len(flat)], np.uint32)
    cut = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), ring)
    triangles = cut.astype(int).reshape(-1, 3)
    if np.sum(_areas(flat, triangles)) < 0:  # all run one way, which without area has no sign
        triangles = triangles[:, ::-1]
    return np.concatenate([triangles, _fillers(triangles, len(flat))])


def _least_area(flat: np.ndarray) -> np.ndarray:
    """Return the n - 2 triangles of one polygon (n, 2) whose areas add up to the least.

    Of all ways to cut it, those without overlap have the polygon's own area, and no other less. It
    takes no decision that rounding could turn round.
    """
    n = len(flat)
    least, middle = np.zeros((n, n)), np.zeros((n, n), int)
    for gap in range(2, n):
        first = np.arange(n - gap)[:, None]
        between, last = first + np.arange(1, gap), first + gap
        corners = np.stack(np.broadcast_arrays(first, between, last), axis=-1)
        area = np.abs(_areas(flat, corners.reshape(-1, 3))).reshape(between.shape)
        total = least[first, between] + least[between, last] + area
        best = np.argmin(total, axis=1)
        least[first[:, 0], last[:, 0]] = total[np.arange(len(best)), best]
        middle[first[:, 0], last[:, 0]] = between[np.arange(len(best)), best]

    triangles, waiting = [], [(0, n - 1)]
    while waiting:
        a, c = waiting.pop()
        if c - a > 1:
            b = int(middle[a, c])
            triangles.append((a, b, c))
            waiting += [(a, b), (b, c)]
    return np.array(triangles)


def _fillers(triangles: np.ndarray, n: int) -> np.ndarray:
    """Return the triangles without area that ear clipping left out.

    It drops corners that lie on the line between their neighbours. The polygon's sides less its
    triangles' sides are loops without area. With them filled, the triangles meet edge to edge, and
    the mesh stays closed.
    """
    sides = np.stack([np.arange(n), np.roll(np.arange(n), -1)], axis=-1)
    cut = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    codes = lambda edges: edges[:, 0] * n + edges[:, 1]
    inner = np.concatenate([sides, cut[:, ::-1]])
    unmet = lambda edges, others: edges[~np.isin(codes(edges), codes(others))]
    # What neither a side nor another triangle runs along, the wrong way round, and bare sides.
    left = np.concatenate([unmet(sides, cut), unmet(cut, inner)[:, ::-1]])

    fans = [np.take(loop, _fan(len(loop))) for loop in _loops(left.tolist())]
    return np.concatenate([np.empty((0, 3), int), *fans])


def _loops(edges: list[list[int]]) -> Iterator[list[int]]:
    """Yield the loops that directed edges make, each through a vertex once."""
    after = defaultdict(list)
    for a, b in edges:
        after[a].append(b)

    for first in list(after):
        path, place = [first], {first: 0}
        while after[path[-1]]:
            vertex = after[path[-1]].pop()
            if vertex not in place:
                place[vertex] = len(path)
                path.append(vertex)
                continue
            at = place[vertex] + 1
            yield [vertex, *path[at:]]
            for passed in path[at:]:
                del place[passed]
            del path[at:]


def _areas(flat: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return twice the triangles' areas, positive where they run counter-clockwise."""
    a, b, c = np.moveaxis(flat[triangles], 1, 0)
    return _cross(b - a, c - a)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
