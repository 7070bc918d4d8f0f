"""The least work that a mask of a mesh before the eye needs, as plain loops, compiled by numba.

It finds which faces show their front, which edges bound what is seen, and where these are on the
film. By Green's theorem it adds what they cover of the pixels that they cross along each row.
Layers add up: it is right where no contour overlaps another. Planes and edges are worked out once
per mesh, as the library's are; nothing is behind the eye.

The derivative of a pixel is the contour's length in it times its normal velocity, which is linear
along an edge: each piece adds the middle's, once for each column. A step of a fit needs it of the
pixels that the contour crosses, and no others.
"""

from typing import NamedTuple

import numba
import numpy as np

COLUMNS = 7  # e, p, phi


class Shape(NamedTuple):
    """A mesh as the loops read it: vertices, planes, edges and the faces beside them."""

    vertices: np.ndarray
    normal: np.ndarray
    corner: np.ndarray
    edge_vertices: np.ndarray
    edge_faces: np.ndarray


class Film(NamedTuple):
    """The eye, the film's matrix (3, 4) from world to px from the upper left corner, and how it
    changes with each of the 7 parameters."""

    eye: np.ndarray
    matrix: np.ndarray
    slopes: np.ndarray
    W: int
    H: int


def shape_of(vertices: np.ndarray, faces: np.ndarray) -> Shape:
    """Return a closed mesh whose faces are counter-clockwise from outside."""
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    normal = np.cross(b - a, c - a).astype(np.float32)
    sides = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])
    face, up = np.tile(np.arange(len(faces)), 3), sides[:, 0] < sides[:, 1]
    first, second = (np.flatnonzero(x)[np.lexsort(np.sort(sides[x]).T)] for x in (up, ~up))
    beside = np.stack([face[first], face[second]], axis=1)
    return Shape(vertices, normal, a.astype(np.float32), sides[first], beside)


def film_of(parameters: np.ndarray, up: np.ndarray, W: int, H: int) -> Film:
    """Return the film of a camera given as e, p and phi in one vector (7,)."""
    at = np.asarray(parameters, float)
    steps = 1e-6 * np.eye(COLUMNS)
    central = [(_matrix(at + s, up, W, H) - _matrix(at - s, up, W, H)) / 2e-6 for s in steps]
    return Film(at[:3].astype(np.float32), _matrix(at, up, W, H), np.array(central), W, H)


def _matrix(parameters: np.ndarray, up: np.ndarray, W: int, H: int) -> np.ndarray:
    e, p, phi = parameters[:3], parameters[3:6], parameters[6]
    v = (p - e) / np.linalg.norm(p - e)
    b1 = np.cross(v, up) / np.linalg.norm(np.cross(v, up))
    b2 = np.cross(b1, v)
    focal = H / (2 * np.tan(phi / 2))
    rows = np.stack([focal * b1 + W / 2 * v, -focal * b2 + H / 2 * v, v])
    return np.concatenate([rows, -(rows @ e)[:, None]], axis=1)


def mask(shape: Shape, film: Film) -> np.ndarray:
    """Return the coverage, (H, W)."""
    image = np.zeros((film.H, film.W + 2), np.float32)
    edges = _edges(shape, film)
    _covered(edges, shape.vertices, shape.edge_vertices, film.matrix, image)
    return _summed(image)


def mask_and_jacobian(shape: Shape, film: Film) -> tuple[np.ndarray, np.ndarray]:
    """Return the coverage, (H, W), and its derivatives, (H, W, 7)."""
    image = np.zeros((film.H, film.W + 2), np.float32)
    jacobian = np.zeros((film.H * film.W, COLUMNS), np.float32)
    edges = _edges(shape, film)
    ends = shape.vertices, shape.edge_vertices
    _covered(edges, *ends, film.matrix, image)
    every = np.zeros((0, 0), np.int32)
    _moved(edges, *ends, film.matrix, film.slopes, film.W, film.H, every, jacobian)
    return _summed(image), jacobian.reshape(film.H, film.W, COLUMNS)


def step(shape: Shape, film: Film, target: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the sum of squared differences from a target (H, W), and a damped step (7,) that makes
    it less (Levenberg-Marquardt)."""
    image = np.zeros((film.H, film.W + 2), np.float32)
    edges = _edges(shape, film)
    ends = shape.vertices, shape.edge_vertices
    _covered(edges, *ends, film.matrix, image)
    slot = np.zeros((film.H, film.W), np.int32)
    rows = np.zeros((4 * (film.H + film.W), COLUMNS), np.float32)
    rows = _moved(edges, *ends, film.matrix, film.slopes, film.W, film.H, slot, rows)
    squares, normal, along = _normal_equations(_summed(image), target, slot, rows)
    damping = 1e-3 * np.trace(normal) / COLUMNS
    return squares, np.linalg.solve(normal + damping * np.eye(COLUMNS), -along)


def _edges(shape: Shape, film: Film) -> np.ndarray:
    threads = numba.get_num_threads()
    return _contour(film.eye, shape.normal, shape.corner, shape.edge_faces, threads)


@numba.njit(parallel=True, cache=True)
def _contour(eye, normal, corner, edge_faces, parts):
    """Return the edges between a front and a back: the edge's number, negative (-1 - it) where the
    second of its faces is the front."""
    F, E = len(normal), len(edge_faces)
    front = np.empty(F, np.bool_)
    for f in numba.prange(F):
        x = normal[f, 0] * (eye[0] - corner[f, 0])
        y = normal[f, 1] * (eye[1] - corner[f, 1])
        z = normal[f, 2] * (eye[2] - corner[f, 2])
        front[f] = x + y + z > 0
    found = np.empty(E, np.int32)
    number = np.zeros(parts, np.int64)
    for part in numba.prange(parts):
        begin, count = part * E // parts, 0
        for edge in range(begin, (part + 1) * E // parts):
            first = front[edge_faces[edge, 0]]
            if first != front[edge_faces[edge, 1]]:
                found[begin + count] = edge if first else -1 - edge
                count += 1
        number[part] = count
    starts = [part * E // parts for part in range(parts)]
    edges = np.empty(number.sum(), np.int32)
    place = 0
    for part in range(parts):
        edges[place : place + number[part]] = found[starts[part] : starts[part] + number[part]]
        place += number[part]
    return edges


@numba.njit(cache=True, inline="always")
def _ends(edge, edge_vertices):
    """Return an edge's vertices, so that the covered side is on its left."""
    if edge < 0:
        return edge_vertices[-1 - edge, 1], edge_vertices[-1 - edge, 0]
    return edge_vertices[edge, 0], edge_vertices[edge, 1]


@numba.njit(cache=True, inline="always")
def _on_film(matrix, point):
    """Return column, row and depth."""
    x = matrix[0, 0] * point[0] + matrix[0, 1] * point[1] + matrix[0, 2] * point[2] + matrix[0, 3]
    y = matrix[1, 0] * point[0] + matrix[1, 1] * point[1] + matrix[1, 2] * point[2] + matrix[1, 3]
    z = matrix[2, 0] * point[0] + matrix[2, 1] * point[1] + matrix[2, 2] * point[2] + matrix[2, 3]
    return x / z, y / z, z


@numba.njit(cache=True)
def _covered(edges, vertices, edge_vertices, matrix, image):
    """Add to each pixel what the contour covers of it, and to the next what it covers of all others
    in the row."""
    W = image.shape[1] - 2
    for edge in edges:
        tail, head = _ends(edge, edge_vertices)
        x0, y0, _ = _on_film(matrix, vertices[tail])
        x1, y1, _ = _on_film(matrix, vertices[head])
        if y0 == y1:
            continue
        sign = 1.0
        if y0 > y1:
            x0, y0, x1, y1, sign = x1, y1, x0, y0, -1.0
        slope = (x1 - x0) / (y1 - y0)
        for row in range(max(0, int(y0)), min(len(image), int(np.ceil(y1)))):
            low, high = max(y0, row), min(y1, row + 1)
            a, b = x0 + (low - y0) * slope, x0 + (high - y0) * slope
            _add_row(image[row], a, b, sign * (high - low), W)


@numba.njit(cache=True, inline="always")
def _add_row(row, a, b, height, W):
    """Add a line from column a to column b that is `height` high."""
    if a > b:
        a, b = b, a
    if b <= 0:
        row[0] += height
        return
    if a >= W:
        return
    across = b - a
    if a < 0:
        row[0] += height * (-a / across)
        height *= b / across
        a, across = 0.0, b
    last = min(int(b), W - 1)
    for column in range(int(a), last + 1):
        low, high = max(a, column), min(b, column + 1)
        part = height if across == 0 else height * ((high - low) / across)
        beyond = part * ((low + high) / 2 - column)
        row[column] += part - beyond
        row[column + 1] += beyond


@numba.njit(parallel=True, cache=True)
def _summed(image):
    """Return the sums along rows, between 0 and 1."""
    H, W = image.shape[0], image.shape[1] - 2
    out = np.empty((H, W), np.float32)
    for row in numba.prange(H):
        total = np.float32(0)
        for column in range(W):
            total += image[row, column]
            out[row, column] = min(max(total, np.float32(0)), np.float32(1))
    return out


@numba.njit(cache=True)
def _moved(edges, vertices, edge_vertices, matrix, slopes, W, H, slot, rows):
    """Return rows, one of each pixel, to which the contour's length in it times its normal
    velocities is added: of all pixels, or in the order in which they are met if there are slots
    (H, W) for their rows' numbers, from 1 on."""
    flow, met = np.empty((2, COLUMNS)), 0
    for edge in edges:
        tail, head = _ends(edge, edge_vertices)
        x0, y0, z0 = _on_film(matrix, vertices[tail])
        x1, y1, z1 = _on_film(matrix, vertices[head])
        across, down = x1 - x0, y1 - y0
        for k in range(COLUMNS):
            flow[0, k] = _outwards(slopes[k], vertices[tail], x0, y0, z0, across, down)
            flow[1, k] = _outwards(slopes[k], vertices[head], x1, y1, z1, across, down)
        # Along the edge from one pixel's side to the next: s runs from 0 to 1.
        s, column, row = 0.0, int(np.floor(x0)), int(np.floor(y0))
        while s < 1:
            to_column = ((column + (across > 0)) - x0) / across if across != 0 else np.inf
            to_row = ((row + (down > 0)) - y0) / down if down != 0 else np.inf
            until = min(to_column, to_row, 1.0)
            if 0 <= column < W and 0 <= row < H and until > s:
                middle = (s + until) / 2
                place = row * W + column
                if slot.size:
                    if slot[row, column] == 0:
                        met += 1
                        slot[row, column] = met
                        if met == len(rows):
                            rows = np.concatenate((rows, np.zeros_like(rows)))
                    place = slot[row, column]
                for k in range(COLUMNS):
                    here = (1 - middle) * flow[0, k] + middle * flow[1, k]
                    rows[place, k] += here * (until - s)
            if to_column <= to_row:
                column += 1 if across > 0 else -1
            else:
                row += 1 if down > 0 else -1
            s = max(s, until)
    return rows


@numba.njit(cache=True)
def _normal_equations(image, target, slot, rows):
    """Return the sum of squared residuals, J^T J and J^T r."""
    squares, normal, along = 0.0, np.zeros((COLUMNS, COLUMNS)), np.zeros(COLUMNS)
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            r = image[row, column] - target[row, column]
            squares += r * r
            if slot[row, column]:
                jacobian = rows[slot[row, column]]
                for k in range(COLUMNS):
                    along[k] += jacobian[k] * r
                    for m in range(k + 1):
                        normal[k, m] += jacobian[k] * jacobian[m]
    for k in range(COLUMNS):
        for m in range(k):
            normal[m, k] = normal[k, m]
    return squares, normal, along


@numba.njit(cache=True, inline="always")
def _outwards(slope, point, x, y, z, across, down):
    """Return a film point's velocity times an edge's outward normal of the edge's length."""
    u = slope[0, 0] * point[0] + slope[0, 1] * point[1] + slope[0, 2] * point[2] + slope[0, 3]
    v = slope[1, 0] * point[0] + slope[1, 1] * point[1] + slope[1, 2] * point[2] + slope[1, 3]
    w = slope[2, 0] * point[0] + slope[2, 1] * point[1] + slope[2, 2] * point[2] + slope[2, 3]
    return (v - y * w) / z * across - (u - x * w) / z * down
