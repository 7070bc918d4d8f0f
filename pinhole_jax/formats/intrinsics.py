"""Intrinsics alone, from whatever file holds them: calibrations, COLMAP's cameras, JSON."""

from collections.abc import Mapping
from os.path import isdir
from pathlib import Path

import numpy as np

from .._camera.camera import Camera
from .._camera.distortion import COEFFICIENTS
from .._camera.matrices import Centres
from .._camera.poses import rigid
from .._files.fields import Fields, Size
from .._files.paths import FilePath, file_and_name, read_json
from .._numerics.arrays import Input
from .colmap import colmap_intrinsics
from .native import camera_from_fields
from .opencv import known_name, opencv_intrinsics
from .pinhole import KIND, OPENGL, camera_from_pinhole, chosen, pinhole
from .unknown import CAMCHAIN, unknown

#: Names of fx, fy, cx, cy, one by one.
FOCAL = ("f", "focal", "focal_length", "focal_px", "focallength_px")
NUMBERS = (("fx", "fl_x", *FOCAL), ("fy", "fl_y", *FOCAL), ("cx",), ("cy",))
COLMAP = ("cameras.bin", "cameras.txt")
#: Fields of the project's own cameras.
OWN = {"e", "p", "u", "phi"}
#: A focal length of fewer px is of a picture whose width counts as 1.
LEAST_PX = 10.0


def read_intrinsics(
    path: FilePath,
    *,
    size: Size | None = None,
    pixel_centres: Input[Centres, "of K"] = "integer",
) -> Camera:
    """Return the camera of a file's intrinsics and lens, one unit before the origin: poses are not
    read.

    - Calibrations of OpenCV, ROS, Kalibr, EuRoC, ORB-SLAM (YAML, XML, JSON).
    - COLMAP's cameras.txt, cameras.bin or the folder of them.
    - JSON with K, intrinsics, ...: 3 x 3, nine numbers, or fx, fy, cx, cy. Or with fx, fy, cx, cy
      by name, as networks and NeRF's transforms.json have them. This project's own.

    FILE:NAME is one of several (COLMAP's number, Kalibr's cam1).
    `size` is the picture's (W, H) in px, and `pixel_centres` where its first pixel's centre is, for
    files that do not say.

    Raises FileNotFoundError, or ValueError naming file and field.

    ```python
    pj.formats.write_opencv("left.yaml", {"left": camera})
    lens = pj.formats.read_intrinsics("left.yaml").lens
    ```
    """
    place, name = file_and_name(path)
    if isdir(place):
        place /= next((model for model in COLMAP if (place / model).exists()), COLMAP[-1])
    if place.name in COLMAP:
        view, fields = chosen(colmap_intrinsics(place), name, repr(str(place)))
    elif (fields := _fields(place, name)).data.keys() >= OWN:
        view = pinhole(camera_from_fields(fields), distorted=True)
    else:
        view = opencv_intrinsics(fields, size, pixel_centres)
        if 0 < view.fx < LEAST_PX:
            words = f"fx = {view.fx:g}: of a picture whose sides count as 1? Multiply by its size"
            raise fields.wrong("K", "px", words)
    return camera_from_pinhole(view, rigid(np.eye(3), np.array([0, 0, 1.0])), OPENGL, fields)


def _fields(place: Path, camera: str | None) -> Fields:
    """Return a file's fields, those of the intrinsics as OpenCV's calibrations name them."""
    from . import storage

    if place.suffix.lower() == ".json" and isinstance(data := read_json(place, KIND), list):
        fields = Fields({"K": data}, repr(str(place)))
    else:
        fields = storage.load(place)
    data = {str(name).rpartition(".")[2]: value for name, value in fields.data.items()}
    chain = {name: part for name, part in data.items() if CAMCHAIN.fullmatch(name)}
    if chain or camera is not None:
        data = dict(Fields(chosen(chain, camera, fields.where), fields.where).data)
    for name in ("camera", "intrinsics", "projection_parameters"):
        if isinstance(part := data.get(name), Mapping) and "data" not in part:
            data |= data.pop(name)
    if data.keys() >= OWN:
        return fields
    if isinstance(both := data.pop("resolution", None), list) and len(both) == 2:
        data["image_width"], data["image_height"] = both
    bent = {name: data.pop(name) for name in COEFFICIENTS if data.get(name) is not None}
    if any(bent.values()):
        data["distortion_coefficients"] = bent
    if "camera_matrix" not in map(known_name, data):
        names = [next((n for n in known if n in data), known[0]) for known in NUMBERS]
        if missing := [name for name in names if name not in data]:
            got = unknown(fields.data) or f"no {', no '.join(missing)}"
            raise fields.wrong("path", "K, or fx, fy, cx, cy (px)", got)
        data["camera_matrix"] = [data[name] for name in names]
        if "fl_x" in names:  # NeRF's
            data["pixel_centres"] = "half"
    return Fields(data, fields.where)
