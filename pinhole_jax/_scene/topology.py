"""Edges and the faces that share them; faces that add nothing to the image."""

import numpy as np

#: Faces at a time: intermediate arrays stay in the processor's cache.
BLOCK = 1 << 14


def edge_records(
    faces: np.ndarray, vertices: np.ndarray | None, V: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return (E, 2) vertices and (E, 2) faces of the edge records that `Mesh` documents.

    Where the vertices (V, 3) are known, faces without area hand their edges on.
    """
    start = faces.ravel().astype(np.int64)
    end = np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    directed = (np.minimum(start, end) * V + np.maximum(start, end)) * 2 + (start > end)
    order = np.flatnonzero(start != end)
    order = order[np.argsort(directed[order], kind="stable")]
    directed = directed[order]
    edge = directed >> 1
    paired = edge[1:] == edge[:-1]
    if np.any(directed[1:] == directed[:-1]):
        # Half-edges of one edge and direction are numbered; the n-th one way pairs with the n-th
        # back.
        first = np.flatnonzero(np.diff(directed, prepend=-1))
        rank = np.arange(len(directed)) - np.repeat(first, np.diff(first, append=len(directed)))
        again = np.lexsort((directed & 1, rank, edge))
        order, edge, rank = order[again], edge[again], rank[again]
        paired = (edge[1:] == edge[:-1]) & (rank[1:] == rank[:-1])
    head = np.flatnonzero(np.append(True, ~paired)[: len(edge)])
    back = np.where(np.append(paired, False)[head], np.roll(order, -1)[head], -1)
    pairs = np.stack([order[head], back], axis=1)
    beside = pairs // 3  # a half-edge's face
    if vertices is not None and (long := _long_sides(vertices, faces)).size:
        beside = _handed_on(len(faces), long, pairs)[beside]
        pairs, beside = (np.where(beside[:, :1] < 0, x[:, ::-1], x) for x in (pairs, beside))
        differ = beside[:, 0] != beside[:, 1]
        pairs, beside = pairs[differ], beside[differ]
    ends = np.stack([start, end], axis=1)[pairs[:, 0]]
    return ends.astype(np.int32), beside.astype(np.int32)


def _long_sides(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the half-edge that is the longest side of each face without area."""
    found = [np.zeros(0, int)]
    for begin in range(0, len(faces), BLOCK):
        corners = np.asarray(vertices[faces[begin : begin + BLOCK]], float)
        sides = np.roll(corners, -1, axis=1) - corners
        size = np.max(np.abs(sides), axis=(1, 2), keepdims=True)
        sides /= np.where(size > 0, size, 1)  # no square overflows or vanishes
        flat = np.flatnonzero(np.all(np.cross(sides[:, 0], sides[:, 1]) == 0, axis=1))
        longest = np.argmax(np.linalg.norm(sides[flat], axis=2), axis=1)
        found.append(3 * (begin + flat) + longest)
    return np.concatenate(found)


def _handed_on(F: int, long: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the face (F + 1,) that has each face's sides: its own; none (-1) has none's, the last.

    The two short sides of a face without area lie on its long one. They become sides of its
    neighbour there; where that is a border, they become the border. So no edge is drawn three
    times.
    """
    both = pairs[pairs[:, 1] >= 0]
    beyond = np.full(3 * F, -1)
    beyond[both] = both[:, ::-1] // 3
    owner = np.append(np.arange(F), -1)
    owner[long // 3] = beyond[long]
    for _ in range(len(long).bit_length()):  # (the neighbour may have no area, too)
        owner = owner[owner]
    return owner


def without_copies(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the faces (F, 3), with equal indices for those that only repeat others.

    A copy has the same corners by place, in any order. Removed are parts (of faces that share
    vertices) all of whose faces repeat those of other parts; and the later copies in parts in which
    every face is there twice. Both sides of a wall between two closed bodies stay.
    """
    if len(faces) < 2:
        return faces
    # Sums of a random number of each place. Of 64 bits: of a million faces two have the same by
    # chance once in 10^7 meshes.
    order, new = by_place(vertices)
    number = np.random.default_rng(0).integers(2**64, size=len(order), dtype=np.uint64)
    name = np.empty_like(number)
    name[order] = number[np.cumsum(new) - 1]
    _, group, count = np.unique(name[faces].sum(axis=1), return_inverse=True, return_counts=True)
    if len(count) == len(faces):
        return faces
    doubled = count[group] > 1
    part = _parts(faces, len(vertices))
    whole = np.bincount(part, weights=~doubled) == 0  # parts all of whose faces have copies
    if not np.any(whole[part]):
        return faces
    kept = np.zeros(len(count), bool)
    kept[group[~whole[part]]] = True
    out = np.zeros(len(faces), bool)
    order = np.argsort(part, kind="stable")
    for own in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        if not whole[part[own[0]]]:
            continue
        _, first, twice = np.unique(group[own], return_index=True, return_counts=True)
        if np.all(kept[group[own]]) or np.all(twice > 1):
            out[own] = True
            out[own[first]] = kept[group[own[first]]]
        kept[group[own]] = True
    result = faces.copy()
    result[out] = result[out, :1]
    return result


def by_place(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the order (n,) of points (n, 3) by x, then y, then z.

    And, in this order, True for the first point at each place (n,).
    """
    order = np.lexsort(points.T[::-1])
    along = points[order]
    return order, np.append(True, np.any(along[1:] != along[:-1], axis=1))[: len(order)]


def _parts(faces: np.ndarray, V: int) -> np.ndarray:
    """Return a number (F,) for each face, the same for those joined by vertices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    start, end = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_array((np.ones(len(start), bool), (start, end)), shape=(V, V))
    return connected_components(links, directed=False)[1][faces[:, 0]]
