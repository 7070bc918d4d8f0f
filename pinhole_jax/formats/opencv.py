"""OpenCV calibration files: YAML as `cv::FileStorage` writes it.

Axes: x right, y down, z forward; `R`, `t` are camera_from_world: `X_camera = R X_world + t`.
Focal lengths in px (`camera_matrix`), no field of view. Pixel centres lie at integers, unless the
file's `pixel_centres` says "half".
"""

import os
from collections.abc import Mapping

import numpy as np

from .._camera.camera import Camera
from .._camera.distortion import BrownConrady, Distortion, Fisheye, Rational
from .._camera.matrices import Centres, half_pixel
from .._camera.poses import inverse
from .._files.paths import read_text
from .._numerics.arrays import Input
from . import yaml
from .fields import KIND, Fields, Size, check_cameras, save_text, short
from .matrices import to_opencv
from .pinhole import OPENCV, Pinhole, camera_of, distortion_of, model_of, rotation
from .rotations import matrix_of_vector, vector_of_matrix

#: The names under which a field is known; case and underscores do not count.
NAMES: dict[str, tuple[str, ...]] = {
    "camera_matrix": ("cameramatrix", "k"),
    "distortion_coefficients": ("distortioncoefficients", "distcoeffs", "d"),
    "distortion_model": ("distortionmodel",),
    "R": ("r", "rotation", "rotationmatrix"),
    "rvec": ("rvec",),
    "t": ("t", "tvec", "translation"),
    "extrinsic_parameters": ("extrinsicparameters",),
    "image_width": ("imagewidth", "width"),
    "image_height": ("imageheight", "height"),
    "camera_names": ("cameranames",),
    "pixel_centres": ("pixelcentres",),
}
COEFFICIENTS = (
    *("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    *("s1", "s2", "s3", "s4", "tau_x", "tau_y"),
)
FISHEYE = ("k1", "k2", "k3", "k4")
#: What a file may call its model (the names are ROS's, too).
FISHEYES = ("fisheye", "equidistant")
PLAIN = ("plumb_bob", "rational_polynomial")
#: A rotation vector that is longer (rad) has lost its angle to rounding.
MOST_ANGLE = 1e4


def read_opencv(
    path: str | os.PathLike[str], *, size: Size | None = None, pixel_centres: str | None = None
) -> dict[str, Camera]:
    """Return the cameras of an OpenCV YAML file, by name.

    One camera where the file has `R` (3, 3) or `rvec` (3,) and `t`, several where it has
    `extrinsic_parameters` (N, 6), rvec and tvec in each row, as OpenCV's calibration writes.
    `camera_matrix` is K in px; `image_width`, `image_height` in px, or `size` where there are none.
    `pixel_centres` ("integer", "half") overrules the file, which is "integer" if it says nothing.

    `distortion_coefficients` are k1, k2, p1, p2, k3, k4, k5, k6, or of a fisheye (k1 to k4) where
    the file's `distortion_model` is "fisheye" or "equidistant" (OpenCV's own files do not tell).

    Raises ValueError naming file and field where something is missing or wrong, and where
    coefficients of other models are not zero.

    ```python
    pj.formats.write_opencv("left.yaml", {"left.png": camera})
    cameras = pj.formats.read_opencv("left.yaml")
    ```
    """
    fields = _known(yaml.parse(read_text(path, KIND), repr(str(path))), repr(str(path)))
    K = fields.array("camera_matrix", (3, 3))
    if np.any(K[2] != [0, 0, 1]) or K[1, 0] != 0 or abs(K[0, 1]) > 1e-9 * abs(K[0, 0]):
        raise fields.wrong("camera_matrix", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", K)
    centres = fields.text("pixel_centres", ("integer", "half"), "integer")
    half = half_pixel(centres if pixel_centres is None else pixel_centres)
    W, H = fields.size("image_width", "image_height", size)
    view = Pinhole(K[0, 0], K[1, 1], K[0, 2] + half, K[1, 2] + half, W, H)
    poses = _poses(fields)
    names, distortion = _names(fields, len(poses)), _distortion(fields)
    return {
        name: camera_of(view, inverse(pose), OPENCV, fields, distortion)
        for name, pose in zip(names, poses, strict=True)
    }


def write_opencv(
    path: str | os.PathLike[str],
    cameras: Mapping[str, Camera],
    *,
    pixel_centres: Input[Centres, "of K"] = "integer",
) -> None:
    """Write cameras as OpenCV YAML: `camera_matrix`, then `R` and `t`, or many poses.

    A file has one K and one image size: several cameras must share them; their poses are then
    `extrinsic_parameters`, rvec and tvec (camera_from_world). The file also says `pixel_centres`
    and `distortion_model`, which OpenCV does not read.

    ```python
    pj.formats.write_opencv("left.yaml", {"left.png": camera})
    ```
    """
    check_cameras(cameras, "OpenCV", yaml.can_hold)
    matrices = [to_opencv(camera, pixel_centres=pixel_centres) for camera in cameras.values()]
    sizes = [(camera.W, camera.H) for camera in cameras.values()]
    models = [distortion_of(camera) for camera in cameras.values()]
    distortion = [{} if m is None else {type(m).__name__: m.coefficients()} for m in models]
    K = matrices[0][0]
    for name, size, (other, _, _), own in zip(cameras, sizes, matrices, distortion, strict=True):
        if size != sizes[0] or np.abs(other - K).max() > 1e-9 or own != distortion[0]:
            raise ValueError(
                "`cameras`: expected one K, lens and image size in an OpenCV file, got others in"
                f" {name!r} than in {next(iter(cameras))!r}; write one file each"
            )
    text = f"%YAML:1.0\n---\nimage_width: {sizes[0][0]}\nimage_height: {sizes[0][1]}\n"
    text += f"pixel_centres: {yaml.quoted(pixel_centres)}\n"
    text += "camera_names: [ " + ", ".join(yaml.quoted(name) for name in cameras) + " ]\n"
    text += yaml.matrix("camera_matrix", K)
    if isinstance(models[0], Fisheye):
        text += 'distortion_model: "fisheye"\n'
    model = models[0] or BrownConrady()
    values = np.array(list(model.coefficients().values()))
    text += yaml.matrix("distortion_coefficients", values[:, None])
    if len(matrices) == 1:
        _, R, t = matrices[0]
        text += yaml.matrix("R", R) + yaml.matrix("t", t[:, None])
    else:
        rows = [np.r_[vector_of_matrix(R), t] for _, R, t in matrices]
        text += yaml.matrix("extrinsic_parameters", np.stack(rows))
    save_text(path, text)


def _known(data: dict, where: str) -> Fields:
    """Return the fields under the names of `NAMES`; a vector may lie or stand."""
    plain = {key: name for name, keys in NAMES.items() for key in keys}
    known = {}
    for key, value in data.items():
        name = plain.get(key.lower().replace("_", ""))
        if name is None:
            continue
        if name in known:
            raise ValueError(f"`{name}`: expected one such field, got {key!r} too (in {where})")
        flat = isinstance(value, np.ndarray) and 1 in value.shape
        known[name] = value.ravel() if flat and name != "extrinsic_parameters" else value
    return Fields(known, where)


def _poses(fields: Fields) -> list[np.ndarray]:
    """Return camera_from_world, (4, 4), of every view."""
    poses = []
    if "extrinsic_parameters" in fields:
        if {"R", "rvec", "t"} & fields.data.keys():
            words = "both it and R or t"
            raise fields.wrong("extrinsic_parameters", "one kind of pose", words)
        rows = fields.array("extrinsic_parameters", (-1, 6))
        name = "extrinsic_parameters"
        parts = [(_rotation(row[:3], fields, name), row[3:]) for row in rows]
    elif "rvec" in fields:
        if "R" in fields:
            raise fields.wrong("rvec", "one kind of pose", "both it and R")
        rvec = fields.array("rvec", (3,))
        parts = [(_rotation(rvec, fields, "rvec"), fields.array("t", (3,)))]
    elif "R" in fields and np.ndim(fields.data["R"]) == 1:
        rvec = fields.array("R", (3,))
        parts = [(_rotation(rvec, fields, "R"), fields.array("t", (3,)))]
    else:
        if "R" not in fields:
            words = "no pose: a file of intrinsics alone is no camera; see `from_opencv`"
            raise fields.wrong("R", "R and t, or extrinsic_parameters", words)
        parts = [(rotation(fields.array("R", (3, 3)), fields, "R"), fields.array("t", (3,)))]
    for R, t in parts:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R, t
        poses.append(pose)
    return poses


def _rotation(rvec: np.ndarray, fields: Fields, name: str) -> np.ndarray:
    if np.any(np.abs(rvec) > MOST_ANGLE):
        raise fields.wrong(name, f"a turn of at most {MOST_ANGLE:g} rad", rvec)
    return matrix_of_vector(rvec)


def _names(fields: Fields, count: int) -> list[str]:
    if "camera_names" not in fields:
        return [str(k) for k in range(count)] if count > 1 else ["camera"]
    names = fields.data["camera_names"]
    if not isinstance(names, list) or len({str(n) for n in names}) != count or len(names) != count:
        raise fields.wrong("camera_names", f"{count} different names", short(names))
    return [str(name) for name in names]


def _distortion(fields: Fields) -> Distortion | None:
    name = "distortion_coefficients"
    fisheye = fields.text("distortion_model", (*FISHEYES, *PLAIN), PLAIN[0]) in FISHEYES
    models = (Fisheye,) if fisheye else (BrownConrady, Rational)
    if name not in fields:
        return model_of({}, fields, models)
    values = np.atleast_1d(fields.array(name, np.shape(fields.data[name])))
    if values.ndim != 1 or len(values) not in (0, 1, 4, 5, 8, 12, 14):
        raise fields.wrong(name, "4, 5, 8, 12 or 14 coefficients", values)
    names = FISHEYE if fisheye else COEFFICIENTS
    return model_of(dict(zip(names, values.tolist(), strict=fisheye)), fields, models)
