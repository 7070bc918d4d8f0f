"""Small pictures of a scene from many eyes, in NumPy: no program is compiled for them.

They rank views, so they need not be exact: what a line covers of a pixel is taken from its middle,
and layers are clamped.
"""

import numpy as np

from .._scene.scene import Ball, Mesh, Scene

#: Width and height (px).
SIZE = 48
#: A line's parts within a row (px), and points of small and large spheres' outlines.
STEP, OUTLINE = 0.5, (12, 32, 96)
#: This many views have a bit of a word each; this many faces, edges or points of outlines are
#: looked at at a time.
WORD, FACES, EDGES, POINTS = 64, 1 << 14, 1 << 12, 1 << 18


def axes_inward(directions: np.ndarray) -> np.ndarray:
    """Return camera axes (N, 3, 3), rows b1, b2, v, that look against directions (N, 3)."""
    v = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
    up = np.where(np.abs(v[:, 2:]) < 0.9, [0.0, 0, 1], [1.0, 0, 0])  # never along the view
    b1 = np.cross(v, up)
    b1 /= np.linalg.norm(b1, axis=1, keepdims=True)
    return np.stack([b1, np.cross(b1, v), v], axis=1)


def thumbnails(
    scene: Scene, ball: Ball, eyes: np.ndarray, axes: np.ndarray, phi: float
) -> np.ndarray:
    """Return coverage (N, SIZE, SIZE), row 0 on top, as seen from eyes (N, 3), from the centre of
    the ball about the scene and in its radii, all outside it, with such camera axes (N, 3, 3)."""
    focal = SIZE / (2 * np.tan(phi / 2))
    place = lambda x: (np.asarray(x, float) - ball.centre) / ball.radius
    sums = np.zeros(len(eyes) * SIZE * SIZE)
    if scene.mesh is not None and scene.mesh.edge_faces.shape[0]:
        _draw_mesh(sums, scene.mesh, place(scene.mesh.vertices), eyes, axes, focal)
    if scene.spheres is not None and scene.spheres.radii.shape[0]:
        centers, radii = place(scene.spheres.centers), np.asarray(scene.spheres.radii, float)
        _draw_spheres(sums, centers, radii / ball.radius, eyes, axes, focal)
    winding = np.cumsum(sums.reshape(-1, SIZE, SIZE), axis=2)
    return np.clip(winding, 0, 1)[:, ::-1]


def _draw_mesh(
    sums: np.ndarray,
    mesh: Mesh,
    vertices: np.ndarray,
    eyes: np.ndarray,
    axes: np.ndarray,
    focal: float,
) -> None:
    """Add the contour edges of each view."""
    ends = np.asarray(mesh.edge_vertices)
    first, second = np.asarray(mesh.edge_faces).T
    border = np.flatnonzero(second < 0)
    for begin in range(0, len(eyes), WORD):
        some = slice(begin, begin + WORD)
        front = fronts(vertices, np.asarray(mesh.faces), eyes[some])
        edge = np.flatnonzero(front[first] != front[second])
        edges = np.union1d(edge, border)
        for edge in np.split(edges, np.arange(EDGES, len(edges), EDGES)):
            sides = [_bits(front[faces[edge]], len(eyes[some])) for faces in (first, second)]
            weight = sides[0] - sides[1]
            if border.size:
                weight = np.where(second[edge, None] < 0, 2 * sides[0] - 1, 2 * weight)
            which, view = np.nonzero(weight)
            weight, view = weight[which, view], view + begin
            apart = vertices[ends[edge[which]]] - eyes[view, None]
            seen = np.einsum("kij,knj->kni", axes[view], apart)
            film = seen[..., :2] / seen[..., 2:] * focal + SIZE / 2
            _draw(sums, view, film[:, 0], film[:, 1], weight)


def fronts(vertices: np.ndarray, faces: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    """Return a word (F,) for each face: a bit for each eye that is before it."""
    words = np.zeros((len(faces), WORD // 8), np.uint8)
    for begin in range(0, len(faces), FACES):
        some = slice(begin, begin + FACES)
        a, b, c = np.moveaxis(vertices[faces[some]], 1, 0)
        normal = np.cross(b - a, c - a)
        before = normal @ eyes.T > np.sum(normal * a, axis=1)[:, None]
        bits = np.packbits(before, axis=1, bitorder="little")
        words[some, : bits.shape[1]] = bits
    return words.view(np.uint64)[:, 0]


def _bits(words: np.ndarray, number: int) -> np.ndarray:
    """Return the first bits of words (n,) as integers (n, number)."""
    parts = np.ascontiguousarray(words)[:, None].view(np.uint8)
    return np.unpackbits(parts, axis=1, count=number, bitorder="little").astype(np.int8)


def _draw_spheres(
    sums: np.ndarray,
    centers: np.ndarray,
    radii: np.ndarray,
    eyes: np.ndarray,
    axes: np.ndarray,
    focal: float,
) -> None:
    """Add the outlines of each view's spheres, as polygons."""
    px = focal * radii / np.min(np.linalg.norm(eyes, axis=1))
    size = np.searchsorted(OUTLINE[:-1], 2 * np.pi * px / STEP)
    for points, chosen in ((n, np.flatnonzero(size == k)) for k, n in enumerate(OUTLINE)):
        view, sphere = (x.ravel() for x in np.mgrid[: len(eyes), : len(chosen)])
        for begin in range(0, len(view), POINTS // points):
            some = slice(begin, begin + POINTS // points)
            n, one = view[some], chosen[sphere[some]]
            centre = np.einsum("kij,kj->ki", axes[n], centers[one] - eyes[n])
            film = _outlines(centre, radii[one], points) * focal + SIZE / 2
            ends = film.reshape(-1, 2), np.roll(film, -1, axis=1).reshape(-1, 2)
            _draw(sums, np.repeat(n, points), *ends, np.ones(len(n) * points))


def _outlines(centre: np.ndarray, radius: np.ndarray, points: int) -> np.ndarray:
    """The points where rays touch spheres (K,) at centres (K, 3) from the eye: (K, points, 2), on a
    film at distance 1."""
    far = np.linalg.norm(centre, axis=1, keepdims=True)
    axis = centre / far
    first = np.cross(axis, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    sine = np.clip(radius[:, None] / far, 0, 0.999)
    angle = 2 * np.pi * np.arange(points)[:, None] / points
    across = np.cos(angle) * first[:, None] + np.sin(angle) * np.cross(axis, first)[:, None]
    circle = (np.sqrt(1 - sine**2) * axis)[:, None] + sine[:, None] * across
    return circle[..., :2] / np.maximum(circle[..., 2:], 1e-6)


def _draw(
    sums: np.ndarray, view: np.ndarray, start: np.ndarray, end: np.ndarray, weight: np.ndarray
) -> None:
    """Add lines (px, from the film's bottom left) that have this many layers more on their left."""
    falls = start[:, 1] - end[:, 1]
    weight = weight * np.sign(falls)
    swap = (falls > 0)[:, None]
    low, high = np.where(swap, end, start), np.where(swap, start, end)
    low, high = (np.clip(x, 0, SIZE) for x in (low, high))
    row = low[:, 1].astype(int)
    rows = np.where(falls == 0, 0, np.ceil(high[:, 1]).astype(int) - row)
    slope = (high - low)[:, 0] / np.maximum((high - low)[:, 1], 1e-12)
    line, step = _each(rows)
    row = row[line] + step
    bottom, top = np.maximum(row, low[line, 1]), np.minimum(row + 1, high[line, 1])
    at = lambda y: low[line, 0] + (y - low[line, 1]) * slope[line]
    left, right = at(bottom), at(top)
    height, cell = weight[line] * (top - bottom), (view[line] * SIZE + row) * SIZE
    part, step = _each(np.ceil(np.abs(right - left) / STEP).astype(int).clip(1))
    number = np.bincount(part, minlength=len(left))[part]
    x = left[part] + (step + 0.5) / number * (right - left)[part]
    column = np.minimum(x.astype(int), SIZE)
    height, share = height[part] / number, x - column
    inside = column < SIZE
    cell, column, height, share = (v[inside] for v in (cell[part], column, height, share))
    sums += np.bincount(cell + column, height * (1 - share), minlength=len(sums))
    follows = column < SIZE - 1
    after = (cell + column + 1)[follows]
    sums += np.bincount(after, (height * share)[follows], minlength=len(sums))


def _each(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, for things that come in groups of these sizes, each one's group and its number
    there."""
    of = np.repeat(np.arange(len(counts)), counts)
    return of, np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts)
