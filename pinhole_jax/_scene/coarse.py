"""A mesh as it looks from afar: vertices near one another are merged.

A small picture of a mesh of millions of faces shows no more than one of some ten thousand. Whatever
the map of vertices is, a closed mesh's image is closed and has as many layers: coinciding faces
cancel.
"""

import numpy as np
from jaxtyping import Float, Int

from .scene import Mesh, grid_cells, with_arrays
from .topology import edge_records

#: A mesh is coarsened from this many faces on.
FINE = 1 << 17
#: Cells along the longest side of a mesh's box: vertices in a cell are merged.
CELLS = 96


def seen_from_afar(mesh: Mesh) -> Mesh:
    """Return a mesh of a few ten thousand faces that looks like a fine one, to within a cell.

    Coarse meshes are returned as they are. For pictures that are drawn from the edge records
    (`_mask.search`) only: edges are in no order.
    """
    if mesh.faces.shape[0] < FINE:
        return mesh
    vertices, faces = _joined(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    edges = edge_records(faces, None, len(vertices))
    return with_arrays(mesh, (vertices, faces, *edges))


def _joined(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """Return the mean vertex of each cell of a grid, and the faces with corners in three cells."""
    cell = grid_cells(vertices, CELLS) @ np.array([CELLS**2, CELLS, 1])
    _, name, count = np.unique(cell, return_inverse=True, return_counts=True)
    middles = [np.bincount(name, x) / count for x in vertices.T]
    a, b, c = corners = name.astype(np.int32)[faces].T
    return np.stack(middles, axis=1), corners[:, (a != b) & (b != c) & (c != a)].T
