"""Which faces share which edges, and which faces add nothing to what is seen."""

import numpy as np


def edge_records(
    faces: np.ndarray, vertices: np.ndarray | None, V: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return (E, 2) vertices and (E, 2) faces of the edge records that `Mesh` documents.

    Where the vertices (V, 3) are known, faces without area hand their edges on.
    """
    start = faces.ravel().astype(np.int64)
    end = np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    face = np.repeat(np.arange(len(faces), dtype=np.int32), 3)
    if vertices is not None:
        start, end, face = _without_slivers(start, end, face, vertices, faces)
    proper = start != end
    start, end, face = start[proper], end[proper], face[proper]
    directed = (np.minimum(start, end) * V + np.maximum(start, end)) * 2 + (start > end)
    order = np.argsort(directed, kind="stable")
    directed, start, end, face = directed[order], start[order], end[order], face[order]
    # Half-edges of one edge and direction are numbered; the n-th one way pairs with the n-th back.
    first = np.flatnonzero(np.diff(directed, prepend=-1))
    rank = np.arange(len(directed)) - np.repeat(first, np.diff(first, append=len(directed)))
    if np.any(rank):
        order = np.lexsort((directed & 1, rank, directed >> 1))
        directed, start, end, face, rank = (x[order] for x in (directed, start, end, face, rank))
    edge = directed >> 1
    paired = np.append((edge[1:] == edge[:-1]) & (rank[1:] == rank[:-1]), False)[: len(edge)]
    head = np.ones(len(edge), bool)
    head[1:] = ~paired[:-1]
    other = np.where(paired, np.roll(face, -1), -1)
    ends = np.stack([start, end], axis=1)[head].astype(np.int32)
    return ends, np.stack([face, other], axis=1)[head].astype(np.int32)


def _without_slivers(
    start: np.ndarray,
    end: np.ndarray,
    face: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the half-edges (3F,) less those of faces without area.

    The two short sides of such a face lie on its long one. They become sides of its neighbour
    there; where that is a border, they become the border. So no edge is drawn three times.
    """
    points = np.asarray(vertices, float)
    sides = points[faces[:, [1, 2, 0]]] - points[faces]
    size = np.max(np.abs(sides), axis=(1, 2), keepdims=True)
    sides = sides / np.where(size > 0, size, 1)  # squares neither overflow nor vanish
    flat = np.all(np.cross(sides[:, 0], sides[:, 1]) == 0, axis=1)
    slivers = np.flatnonzero(flat)
    if not slivers.size:
        return start, end, face
    face = face.copy()
    gone = np.zeros(len(start), bool)
    long = 3 * slivers + np.argmax(np.linalg.norm(sides[slivers], axis=2), axis=1)
    meeting = np.isin(end * len(vertices) + start, start[long] * len(vertices) + end[long])
    back: dict[tuple[int, int], list[int]] = {}
    for k in np.flatnonzero(meeting).tolist():
        back.setdefault((int(end[k]), int(start[k])), []).append(k)
    ready = list(zip(slivers.tolist(), long.tolist(), strict=True))
    behind: dict[int, list[tuple[int, int]]] = {}
    while ready:
        f, k = ready.pop()
        own = range(3 * f, 3 * f + 3)
        there = back.get((int(start[k]), int(end[k])), [])
        partner = next((h for h in there if not gone[h] and h not in own), None)
        if partner is not None and flat[face[partner]]:
            behind.setdefault(int(face[partner]), []).append((f, k))  # it goes first
            continue
        flat[f], gone[k] = False, True
        short = [h for h in own if h != k]
        if partner is None:
            gone[short] = True
        else:
            gone[partner] = True
            face[short] = face[partner]
        ready += behind.pop(f, [])
    return start[~gone], end[~gone], face[~gone]


def without_copies(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the faces (F, 3) with equal indices for those that only repeat others.

    A copy has the same corners by place, in any order. Left out are parts (of faces that share
    vertices) that repeat faces of other parts, all of them, and in parts in which every face is
    there twice the later ones. Of a single wall between two closed bodies both sides stay, since
    both bodies need it.
    """
    if len(faces) < 2:
        return faces
    name = _names(vertices, faces)
    _, group, count = np.unique(name, return_inverse=True, return_counts=True)
    doubled = count[group] > 1
    if not np.any(doubled):
        return faces
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
        if np.all(kept[group[own]]):
            out[own] = True
        elif np.all(twice > 1):
            out[own] = True
            out[own[first]] = kept[group[own[first]]]
        kept[group[own]] = True
    result = faces.copy()
    result[out] = result[out, :1]
    return result


def _names(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return a number for each face, the same for those with the same corners by place."""
    corners = np.sort(_places(vertices)[faces].astype(np.uint64), axis=1)
    # 64 bits: of a million faces two have the same by chance once in 10^7 meshes.
    factors = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    mixed = corners * factors
    mixed ^= mixed >> np.uint64(29)
    return mixed[:, 0] + (mixed[:, 1] << np.uint64(1)) + mixed[:, 2] * np.uint64(3)


def _places(vertices: np.ndarray) -> np.ndarray:
    """Return a number (V,) for each vertex, the same for those at the same place."""
    order = np.lexsort(vertices.T)
    along = vertices[order]
    new = np.any(along[1:] != along[:-1], axis=1)
    place = np.empty(len(vertices), np.int64)
    place[order] = np.concatenate([[0], np.cumsum(new)])
    return place


def _parts(faces: np.ndarray, V: int) -> np.ndarray:
    """Return a number (F,) for each face, the same for those joined by vertices."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    start, end = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    links = coo_array((np.ones(len(start), bool), (start, end)), shape=(V, V))
    return connected_components(links, directed=False)[1][faces[:, 0]]
