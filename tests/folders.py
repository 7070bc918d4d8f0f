"""Files of a test's own, and what meshes hold."""

import numpy as np
import trimesh


def put(folder, name, content):
    """Write a text or bytes to a file, and return its path."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def triangles_of(mesh):
    """Return the corners (F, 3, 3) of a mesh's triangles."""
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)]


def in_trimesh(mesh):
    """Return a mesh as trimesh's, its vertices as they are."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
