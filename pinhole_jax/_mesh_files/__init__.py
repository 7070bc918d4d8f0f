"""The polygons of mesh files, from a file's bytes to numbers.

trimesh cuts faces of more than three corners as fans, and passes over what it does not read:
formats have their readers here.
"""

from pathlib import Path

from .._files.paths import read_bytes
from .dae import read_dae
from .glb import MOST_BYTES as MOST_BYTES
from .gltf_mesh import read_gltf_mesh
from .obj import read_obj
from .off import read_off
from .ply import read_ply
from .polygons import (
    Polygons as Polygons,
    check_corners as check_corners,
    triangulate as triangulate,
)
from .stl import read_stl

READERS = {
    ".dae": read_dae,
    ".obj": read_obj,
    ".off": read_off,
    ".ply": read_ply,
    ".stl": read_stl,
}
MESH_ENDINGS = (*READERS, ".glb", ".gltf")


def read_polygons(file: Path) -> Polygons:
    """Return the polygons of a mesh file, by its ending.

    Raises OSError, or ValueError that says what is wrong and where.
    """
    kind, data = file.suffix.lower(), read_bytes(file, "a mesh file", MOST_BYTES)
    return READERS[kind](data) if kind in READERS else read_gltf_mesh(data, file)
