"""The workpiece of a session: a mesh and a photo, read once and shared by all tabs."""

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .. import Camera, Lens, Scene, io
from .._files.naming import named
from ..batch.inputs import read_scene
from .hand import Extent, extent_of, frame_object

#: A guess of the field of view (rad), if nobody gives one.
PHI = 0.7
#: A photo is shown with at most this many pixels on a side.
SHOWN_PX = 4096


class Workpiece(NamedTuple):
    """A mesh and a photo.

    - `mesh`, `photo`: their files. `picture`: the photo, uint8 (H, W, 3).
    - `extent`: around the mesh. `start`: the first camera of a session.
    - `phi`: the field of view (rad) that an option, a file or the photo gives; None: it is a guess.
    """

    mesh: str
    photo: str
    scene: Scene
    picture: np.ndarray
    extent: Extent
    start: Camera
    phi: float | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Return the photo's W, H in px."""
        return self.picture.shape[1], self.picture.shape[0]


def workpiece_of(
    mesh: str,
    photo: str,
    camera: Camera | None = None,
    say: Callable[[str], Any] | None = None,
    *,
    phi: float | None = None,
    lens: Lens | None = None,
    up: str = "y",
) -> Workpiece:
    """Return the workpiece of two files.

    `camera` (of the photo's size) is where to begin; None: one that sees all of the mesh, upright
    along `up`, with the field of view `phi`, the one in the photo's EXIF data, or a guess.

    Raises FileNotFoundError or ValueError as `load_mesh` and `load_image` do.
    """
    with named(path="photo"):
        picture = io.load_image(photo, rgb=True)
    H, W = picture.shape[:2]
    if camera is not None and (camera.W, camera.H) != (W, H):
        raise ValueError(
            f"`camera`: expected one of the photo's size {W} x {H}, got {camera.W} x {camera.H}"
        )
    scene = read_scene(mesh, say or (lambda words: None))
    assert scene.mesh is not None
    extent = extent_of(np.asarray(scene.mesh.vertices, float))
    if camera is not None:
        phi = float(camera.phi)
    elif phi is None and (fov := io.photo_fov(photo)) is not None:
        phi = fov.phi
    if camera is None:
        phi_or_guess = PHI if phi is None else phi
        start = Camera([0, 0, 1], [0, 0, 0], [0, 1, 0], phi_or_guess, 1.0, W, H, lens)
        camera = frame_object(start, extent, up)
    return Workpiece(str(Path(mesh)), str(Path(photo)), scene, picture, extent, camera, phi)


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
