"""`load_mesh`: the triangles of a mesh file."""

import warnings
from collections.abc import Callable

import numpy as np

from .._files.paths import FilePath, as_path, open_file, refusal
from .._mesh_files import MESH_ENDINGS, MOST_BYTES, check_corners, read_polygons, triangulate
from .._scene.scene import Mesh, rounding_warning
from .._scene.topology import by_place

#: Files of solids and scenes, which programs export as triangles.
SOLIDS = (".step", ".stp", ".iges", ".igs", ".brep", ".sldprt", ".f3d", ".fcstd", ".ipt", ".blend",
          ".fbx", ".3ds", ".usd", ".usdz")  # fmt: skip


def load_mesh(path: FilePath, say: Callable[[str], object] | None = None) -> Mesh:
    """Return the triangles of a mesh file (dae, glb, gltf, obj, off, ply, stl), as one mesh.

    Polygons of any shape in any plane are cut into triangles that run the way they do. Vertices at
    exactly the same place are merged so that faces share edges. Axes and lengths are the file's.

    - A glTF scene has its nodes' transforms; triangles and strips count, lines and points do not.
      Buffers are read from the file's folder and below.
    - Of an obj file all polygons count; the material files that it names are not opened.
    - A Collada scene (needs pycollada and lxml, which `[robots]` installs) has its nodes'
      transforms, and is in metres by its `<unit>`; `<up_axis>` turns nothing.
    - Of a ply file the faces and triangle strips count.

    Far from the origin float32 numbers, as those of binary stl files, have wide steps. Where these
    are not small beside the object, `say` is called with a text (None: a UserWarning).

    Raises FileNotFoundError, or ValueError where the file is no mesh, has no faces, or fewer or
    more data than its header says. Also for vertices that are not finite, faces that name vertices
    it does not have, and polygons whose sides cross. Nor may a polygon take more than seconds to
    cut (some 100 000 corners, unless the first sees them all). The feature, field or face is
    named. Not read are curved surfaces (obj), binary or not three dimensions (off), skins and
    polygons with holes (dae). Of glTF: skins, morph targets whose weights are not 0, instances,
    fans, sparse or normalised positions, compression (Draco, meshopt), other required extensions.

    What else trimesh reads (3mf), `pj.Mesh(trimesh.load_mesh(path))` takes, unchecked.

    ```python
    mesh = pj.load_mesh("part.off")
    ```
    """
    open_file(path, "a mesh file", MOST_BYTES).close()
    file = as_path(path)
    if file.suffix.lower() not in MESH_ENDINGS:
        words = f"expected one of {', '.join(MESH_ENDINGS)}, got {file.name!r}"
        hint = "; export it as STL" if file.suffix.lower() in SOLIDS else ""
        raise ValueError(f"`path`: {words}{hint}")
    with refusal(path, "a readable mesh", Exception):  # whatever a reader did not expect
        polygons = check_corners(read_polygons(file))
        faces = triangulate(polygons)
        if not len(faces):
            raise ValueError("no faces")
    merged, place = weld(polygons.points, faces)
    merged = merged.astype(float)
    try:
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # see below
            mesh = Mesh(merged, place)
    except ValueError as error:  # too large for float32
        raise ValueError(f"{error} (in {str(path)!r})") from error
    with np.errstate(over="ignore"):  # (what float32 cannot hold is not float32's)
        in_file = bool(np.all(merged == merged.astype(np.float32)))
    if (in_file or mesh.vertices.dtype == np.float32) and (words := rounding_warning(merged)):
        cure = " (the file itself has float32 numbers)" if in_file else ", or set jax_enable_x64"
        words = f"`path`: {words}{cure} (in {str(path)!r})"
        warnings.warn(words, stacklevel=2) if say is None else say(words)
    return mesh


def weld(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points that faces use, each place once and in order, and the faces of these."""
    used = np.zeros(len(points), bool)
    used[faces] = True
    places = points[used]
    order, first = by_place(places)
    number = np.empty(len(points), np.int32)
    number[np.flatnonzero(used)[order]] = np.cumsum(first, dtype=np.int32) - 1
    return places[order[first]], number[faces]
