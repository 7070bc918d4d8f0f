"""The polygons of mesh files, from a file's bytes to numbers.

trimesh cuts faces of more than three corners as fans: formats that have them have readers here. The
others it reads, after a look for what it would pass over.
"""

from pathlib import Path

from .._files.paths import read_bytes
from .dae import read_dae
from .obj import read_obj
from .off import read_off
from .plain_gltf import MOST_BYTES
from .ply import read_ply
from .polygons import Polygons as Polygons, triangulate as triangulate
from .scenes import read_scene

READERS = {".dae": read_dae, ".obj": read_obj, ".off": read_off, ".ply": read_ply}
MESH_ENDINGS = (*READERS, ".stl", ".glb", ".gltf")


def read_polygons(file: Path) -> Polygons:
    """Return the polygons of a mesh file, by its ending.

    Raises OSError, or ValueError that says what is wrong and where.
    """
    kind, data = file.suffix.lower(), read_bytes(file, "a mesh file", MOST_BYTES)
    return READERS[kind](data) if kind in READERS else read_scene(data, file)
