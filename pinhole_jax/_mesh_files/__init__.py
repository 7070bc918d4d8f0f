"""The polygons of mesh files. Each format has its reader here, from the file's bytes to numbers.

General libraries cut faces of more than three corners as a fan, and pass over what they do not
know in a glTF file: shapes that are wrong and do not say so.
"""

from pathlib import Path

from .._files.paths import read_bytes
from .accessors import MOST_BYTES
from .dae import read_dae
from .gltf import read_gltf
from .obj import read_obj
from .off import read_off
from .ply import read_ply
from .polygons import Polygons as Polygons, triangulated as triangulated
from .stl import read_stl

READERS = {".dae": read_dae, ".obj": read_obj, ".off": read_off, ".ply": read_ply, ".stl": read_stl}
MESH_ENDINGS = (*READERS, ".glb", ".gltf")


def read_polygons(file: Path) -> Polygons:
    """Return the polygons of a mesh file, by its ending; indices are not checked.

    Raises OSError, or ValueError that says what is wrong and where.
    """
    kind, data = file.suffix.lower(), read_bytes(file, "a mesh file", MOST_BYTES)
    return READERS[kind](data) if kind in READERS else read_gltf(data, file)
