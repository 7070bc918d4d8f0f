"""The independent answer: exact coverage by uniting polygons, in NumPy and shapely alone.

Nothing of the renderer: not its camera, not its contours. Each triangle is projected by itself and
counts from both sides; under distortion its sides are polygons of many corners. A sphere is the
circle in space where rays touch it, as a polygon of 40 000 corners whose area is the circle's.
Within each pixel the parts are united.
"""

import numpy as np
import shapely
from _scenes import View

#: Corners of a sphere's outline, and pieces to a world unit of a side that a lens bends: both stray
#: from the curve by less than 1e-6 px.
RIM, PIECES = 40_000, 800
MANY = 1000


def coverage(view: View, only: np.ndarray | None = None) -> np.ndarray:
    """Return the coverage (H, W), row 0 on top; `only` these pixels, the others are 0."""
    found = [*triangles(view), *rims(view)]
    inside = np.ones((view.H, view.W), bool) if only is None else only
    return union_per_pixel(np.array(found, dtype=object), inside)


def union_per_pixel(polygons: np.ndarray, only: np.ndarray) -> np.ndarray:
    """Return the area of the union within each pixel's square.

    Pixel by pixel: a union of everything at once loses area where edges nearly agree.
    """
    H, W = only.shape
    polygons = in_rows(polygons[shapely.area(polygons) > 0], W, H)
    row, column = np.nonzero(only)
    left, bottom = column, H - 1 - row
    squares = shapely.box(left, bottom, left + 1, bottom + 1)
    area = np.zeros(len(squares))
    square, of = shapely.STRtree(polygons).query(squares, predicate="intersects")
    shapely.prepare(polygons)
    area[square[shapely.covers(polygons[of], squares[square])]] = 1
    partly = area[square] == 0
    square, of = square[partly], of[partly]
    parts = shapely.intersection(polygons[of], squares[square])
    order = np.argsort(square, kind="stable")
    starts = np.flatnonzero(np.diff(square[order], prepend=-1))
    for group in np.split(order, starts[1:]) if len(order) else []:
        area[square[group[0]]] = shapely.area(shapely.union_all(parts[group]))
    image = np.zeros(only.shape)
    image[row, column] = area
    return image


def in_rows(polygons: np.ndarray, W: int, H: int) -> np.ndarray:
    """Return the polygons, those of very many corners cut into the film's rows: a pixel is then cut
    out of a few of these corners."""
    many = shapely.get_num_coordinates(polygons) > MANY
    bottom = np.arange(H)
    rows = shapely.box(-1, bottom, W + 1, bottom + 1)
    parts = shapely.intersection(polygons[many][:, None], rows[None]).ravel()
    return np.concatenate([polygons[~many], parts[shapely.area(parts) > 0]])


def in_camera(view: View, points: np.ndarray) -> np.ndarray:
    """Return points as (right, up, forward) from the eye."""
    return (points - view.e) @ view.axes.T


def lifted(view: View, points: np.ndarray) -> np.ndarray:
    """Return (x z, y z, z), x and y on the ideal film: also for points behind the eye."""
    x, y, z = np.moveaxis(in_camera(view, points), -1, 0)
    fx, fy = view.focal_px
    cx, cy = view.principal_point
    return np.stack([fx * x + cx * z, fy * y + cy * z, z], axis=-1)


def through_lens(view: View, points: np.ndarray) -> np.ndarray:
    """Return film points; OpenCV's models, whose y runs down."""
    x, y, z = np.moveaxis(in_camera(view, points), -1, 0)
    x, y = x / z, -y / z
    square = x * x + y * y
    if view.model == "fisheye":
        radius = np.sqrt(square)
        theta = np.arctan(radius)
        powers = sum(k * theta ** (2 * n + 2) for n, k in enumerate(view.coefficients))
        stretch = theta * (1 + powers) / radius
        x, y = x * stretch, y * stretch
    else:
        k1, k2, p1, p2, k3 = view.coefficients
        radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        )
    fx, fy = view.focal_px
    cx, cy = view.principal_point
    return np.stack([fx * x + cx, cy - fy * y], axis=-1)


def clipped(corners: np.ndarray, view: View) -> list:
    """Return a convex polygon of lifted points, clipped to the film (a pixel larger)."""
    W, H = view.W, view.H
    for plane in ([1, 0, 1], [0, 1, 1], [-1, 0, W + 1], [0, -1, H + 1]):
        side, after = corners @ plane, np.roll(corners, -1, axis=0)
        if np.all(side > 0):
            continue
        beyond = np.roll(side, -1)
        kept = []
        for a, b, one, two in zip(corners, after, side, beyond, strict=True):
            kept += [a] if one > 0 else []
            kept += [a + one / (one - two) * (b - a)] if (one > 0) != (two > 0) else []
        if len(kept) < 3:
            return []
        corners = np.array(kept)
    corners = corners[corners[:, 2] > 0]
    film = (corners[:, :2] / corners[:, 2:]).astype(float)
    hull = shapely.convex_hull(shapely.multipoints(film))
    return [hull] if hull.geom_type == "Polygon" else []


def triangles(view: View) -> list:
    """Return the projected triangles as polygons."""
    if view.model != "none":
        return bent_triangles(view)
    corners = lifted(view, view.vertices)[view.faces]
    ahead = np.all(corners[..., 2] > 1e-6, axis=1)
    film = corners[ahead, :, :2] / corners[ahead, :, 2:]
    partly = [polygon for triangle in corners[~ahead] for polygon in clipped(triangle, view)]
    return [*shapely.polygons(film), *partly]


def bent_triangles(view: View) -> list:
    """Return the triangles with sides of many pieces; neighbours share each corner of these."""
    found = []
    for face in view.faces:
        ring = []
        for a, b in zip(face, np.roll(face, -1), strict=True):
            low, high = view.vertices[min(a, b)], view.vertices[max(a, b)]
            # As many wherever the camera is: a difference must not see the number change.
            n = int(np.ceil(PIECES * np.linalg.norm(high - low)))
            share = np.arange(n + 1)[:, None] / n
            side = through_lens(view, (1 - share) * low + share * high)
            ring.append((side if a < b else side[::-1])[:-1])
        found.append(shapely.Polygon(np.concatenate(ring)))
    return found


def rims(view: View) -> list:
    """Return the spheres' outlines as polygons."""
    found = []
    angle = 2 * np.pi * np.arange(RIM)[:, None] / RIM
    same_area = np.sqrt((2 * np.pi / RIM) / np.sin(2 * np.pi / RIM))
    for centre, radius in zip(view.centers, view.radii, strict=True):
        distance = np.linalg.norm(centre - view.e)
        axis = (centre - view.e) / distance
        aside = np.cross(axis, [0.36, 0.48, 0.8])
        aside /= np.linalg.norm(aside)
        around = np.cos(angle) * aside + np.sin(angle) * np.cross(axis, aside)
        touch = np.sqrt(distance**2 - radius**2)
        middle = view.e + touch**2 / distance * axis
        points = middle + same_area * radius * touch / distance * around
        if view.model == "none":
            found += clipped(lifted(view, points), view)
        else:
            found.append(shapely.Polygon(through_lens(view, points)))
    return found
