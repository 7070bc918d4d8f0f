"""How much room a fit's buffers have: few sizes, since a program is compiled for each."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from .._mask.edges import crossings
from .._mask.search import sphere_points
from .._mask.target import inside_of
from .._mask.thumbnails import axes_inward, fronts
from .._numerics.memo import memoised
from .._scene.scene import Mesh, Scene
from .residuals import Capacity

#: What the smallest buffers hold, and how much larger the next ones are.
LEAST_CAPACITY, GROWTH = Capacity(edges=1024, pieces=2048, arc_pieces=2048, arcs=1024), 2
#: From this many sides a mesh's contour is measured, this many of its radii away; of 4 views about
#: 3 fit into the first buffers.
SIDES, FAR, MOST = 16, 5.0, 0.75
#: This many rows of its arrays tell a mesh from others.
ROWS = 1 << 14
#: ... and if it has more than this many edges, some of them stand for all: of 5M faces' 8M edges
#: some 260 of these are on the contour, whose number errs by 6 %.
MEASURED = 1 << 18
#: This share of a mask's rows and columns, at either end, may be crumbs.
CRUMBS = 0.005


def first_capacity(scene: Scene, image: np.ndarray, coarser: float = 1.0) -> Capacity:
    """Return the buffers that most views of a scene need that are as large as in a mask (H, W), or
    on a level that is this much `coarser`."""
    spheres = 0 if scene.spheres is None else scene.spheres.radii.shape[0]
    inside = inside_of(image)
    crossed = sum(len(x) for x in crossings(inside)) if spheres else 0
    arc_pieces = int(crossed / coarser) + 8 * spheres
    edges = pieces = 0
    if scene.mesh is not None and scene.mesh.edge_faces.shape[0]:
        number, length = contours(scene.mesh)
        needed = number + length * diagonal_of(inside) / coarser
        edges, pieces = (int(np.quantile(x, MOST)) for x in (number, needed))
    _, _, *arcs = grown(Capacity(1, 1, 1, 1), Capacity(0, 0, arc_pieces, 0))
    if not edges:
        return Capacity(1, 1, *arcs)
    least = LEAST_CAPACITY
    return Capacity(_grown(least.edges, 1.25 * edges), _grown(least.pieces, 1.25 * pieces), *arcs)


def contours(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return, from some sides, how many contour edges a mesh has (n,), and how many pixels' sides
    they cross (n,) for each pixel of the view's extent."""
    arrays = (mesh.vertices, mesh.faces, mesh.edge_vertices, mesh.edge_faces)
    vertices, faces, *edges = (np.asarray(x) for x in arrays)
    # Some rows tell a mesh from others well enough for this: to read all takes longer than a fit.
    few = (x[:: -(-len(x) // ROWS)] for x in (vertices, faces))
    sizes = np.array([len(vertices), len(faces)])
    return memoised(_contours, *few, sizes, given=(vertices, faces, *edges))


def _contours(
    vertices: np.ndarray, faces: np.ndarray, edge_vertices: np.ndarray, edge_faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    low, high = (np.asarray(f(vertices, axis=0), float) for f in (np.min, np.max))
    directions = sphere_points(SIDES)
    radius = max(np.linalg.norm(high - low) / 2, 1e-300)
    points = (np.asarray(vertices, float) - (low + high) / 2) / radius
    each = -(-len(edge_faces) // MEASURED)
    edge_vertices, sides = edge_vertices[::each], edge_faces[::each]
    used, place = np.unique(sides, return_inverse=True)
    first, second = fronts(points, faces[used], FAR * directions)[place.reshape(sides.shape).T]
    differ, border = first ^ second, sides[:, 1] < 0
    number, length = np.zeros(SIDES, int), np.zeros(SIDES)
    for side, axes in enumerate(axes_inward(directions)):
        on = np.flatnonzero(border | ((differ >> np.uint64(side)) & np.uint64(1)).astype(bool))
        film = points[edge_vertices[on]] @ axes[:2].T
        extent = np.hypot(*np.ptp(film.reshape(-1, 2), axis=0)) if on.size else 0.0
        number[side] = each * on.size
        length[side] = each * np.sum(np.abs(film[:, 1] - film[:, 0])) / max(extent, 1e-9)
    return number, length


def diagonal_of(inside: np.ndarray) -> float:
    """Return the length (px) of the diagonal of what is inside a mask, but for crumbs."""
    spans = []
    for axis in (0, 1):
        upto = np.cumsum(np.sum(inside.view(np.uint8), axis=axis, dtype=np.int32), dtype=np.int64)
        low, high = np.searchsorted(upto, upto[-1] * np.array([CRUMBS, 1 - CRUMBS]))
        spans.append(high - low + 1)
    return float(np.hypot(*spans))


def size_of(pieces: int) -> int:
    """Return which of the sizes a number of pieces needs, 0 the smallest."""
    size = 0
    while LEAST_CAPACITY.pieces * GROWTH**size < pieces:
        size += 1
    return size


def grown(have: Capacity, need: Iterable[Any]) -> Capacity:
    """Return what is 9/8 of the need as it is, of the rest the next of few sizes that is 3/2 of
    it."""
    capacities = []
    for least, capacity, load in zip(LEAST_CAPACITY, have, need, strict=True):
        if 8 * capacity < 9 * int(load):
            capacity = _grown(max(capacity, least), 1.5 * int(load))
        capacities.append(capacity)
    return Capacity(*capacities)


def _grown(capacity: int, need: float) -> int:
    """Return the first of few sizes, from a room on, that holds what is needed."""
    while capacity < need:
        capacity *= GROWTH
    return capacity
