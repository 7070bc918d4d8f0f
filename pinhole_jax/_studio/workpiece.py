"""The workpiece of a session: a mesh and a photo, read once and shared by all tabs."""

from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .. import Scene, io
from .._files.naming import named
from ..batch.inputs import read_scene
from ..show.space import points_of
from .hand import Extent, extent_of

#: A photo is shown with at most this many pixels on a side.
SHOWN_PX = 4096


class Workpiece(NamedTuple):
    """A mesh and a photo.

    - `mesh`, `photo`: their files, by whole paths. `picture`: the photo, uint8 (H, W, 3).
    - `extent`: around the mesh.
    """

    mesh: str
    photo: str
    scene: Scene
    picture: np.ndarray
    extent: Extent

    @property
    def size(self) -> tuple[int, int]:
        """Return the photo's W, H in px."""
        return self.picture.shape[1], self.picture.shape[0]


def workpiece_of(mesh: str, photo: str) -> Workpiece:
    """Return the workpiece of two files; the last one is kept.

    Raises FileNotFoundError or ValueError as `load_mesh` and `load_image` do.
    """
    return _workpiece(*(str(Path(file).resolve()) for file in (mesh, photo)))


@lru_cache(1)
def _workpiece(mesh: str, photo: str) -> Workpiece:
    with named(path="photo"):
        picture = io.load_image(photo, rgb=True)
    scene = read_scene(mesh)
    return Workpiece(mesh, photo, scene, picture, extent_of(points_of(scene)))


def photo_file(workpiece: Workpiece) -> bytes:
    """Return the photo as a JPEG file, upright, no larger than a browser draws with ease."""
    from PIL import Image

    image, data = Image.fromarray(workpiece.picture), BytesIO()
    image.thumbnail((SHOWN_PX, SHOWN_PX))
    image.save(data, "JPEG", quality=92)
    return data.getvalue()


def mesh_file(workpiece: Workpiece) -> bytes:
    """Return the mesh for the page's shader: the middle of its box (3 float64), the number of
    vertices and of faces (uint32), the vertices from that middle (float32), the faces (uint32)."""
    mesh = workpiece.scene.mesh
    assert mesh is not None
    vertices = np.asarray(mesh.vertices, float) - workpiece.extent.centre
    faces = np.asarray(mesh.faces)
    counts = np.array([len(vertices), len(faces)], "<u4")
    centre = workpiece.extent.centre.astype("<f8")
    parts = (centre, counts, vertices.astype("<f4"), faces.astype("<u4"))
    return b"".join(part.tobytes() for part in parts)
