"""OpenCV calibration files: YAML, XML or JSON as `cv::FileStorage` writes it.

Axes: x right, y down, z forward; `R`, `t` are camera_from_world: `X_camera = R X_world + t`.
Focal lengths in px (`camera_matrix`), no field of view. Pixel centres lie at integers, unless the
file's `pixel_centres` says "half".
"""

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from .._camera.distortion import COEFFICIENTS, BrownConrady, Distortion, Fisheye
from .._camera.matrices import Centres, half_pixel
from .._camera.poses import Pose, exponential, inverse, pose_of
from .._files.fields import Fields, Size, as_numbers, short
from .._files.paths import FilePath, replace_file
from .._numerics.arrays import Input
from .pinhole import (
    OPENCV,
    Cameras,
    NamedCameras,
    Pinhole,
    by_name,
    camera_from_pinhole,
    check_cameras,
    pinhole,
    pose_from_matrix,
    read_distortion,
    read_matrix,
)
from .unknown import unknown

#: The names under which a field is known; case, underscores, dots and hyphens do not count.
NAMES = {
    "camera_matrix": "cameramatrix k camk intrinsics intrinsic intrinsicmatrix cameraintrinsics",
    "distortion_coefficients": "distortioncoefficients distortioncoeffs distortioncoeff"
    " distortioncoef distortionparameters distortionparams distortion distortions distcoeffs"
    " distcoeff distcoefs distcoef dist d",
    "R": "r rotation rotationmatrix",
    "rvec": "rvec",
    "t": "t tvec translation",
    "extrinsic_parameters": "extrinsicparameters",
    "image_width": "imagewidth width w",
    "image_height": "imageheight height h",
    "camera_names": "cameranames",
    "pixel_centres": "pixelcentres",
}
PLAIN_NAMES = {plain: name for name, known in NAMES.items() for plain in known.split()}
#: A pose's fields, and their shapes.
POSES: dict[str, list[tuple[int, ...]]] = {
    "extrinsic_parameters": [(-1, 6)],
    "rvec": [(3,)],
    "R": [(3,), (3, 3)],
}
#: What looks like coefficients of a lens, one number or several, under a name that is not known.
LENS_NUMBER = re.compile(r"(.*[_.\-\s])?([kp][1-6]|xi)", re.I)
LENS_NUMBERS = re.compile(
    r".*((?i:(?<!un)distor|coef|radial|tangential|dist\d*$)|(^|[_.\-\s])[Dd]\d*$|[a-z]D\d*$).*|kc"
)
#: Fields that may name the lens's model, those that do, and those that say yes or no to a fisheye.
MAYBE_MODELS = re.compile(r"\w*(model|type|lens|projection)\w*")
MODELS = re.compile(
    r"(distortion|lens|projection)(model|type)|distmodel|cameramodel(type)?|modeltype"
)
FLAGS = ("fisheyemodel", "isfisheye", "usefisheye", "fisheye")
#: Models by the names that OpenCV, ROS, Kalibr, camodocal and COLMAP have for them, and words that
#: say nothing of the distortion.
FISHEYES = re.compile(r"(opencv)?fisheye|(pinhole)?equi|equidist(ant)?|kannalabrandt[48]?|kb4?")
BENT = re.compile(
    r"plumbbob|rational(polynomial)?|(pinhole)?radtan|radialtangential|(simple)?radial"
    r"|brown(conrady)?|fullopencv"
)
NEITHER = ("pinhole", "simplepinhole", "perspective", "standard", "opencv", "none", "")
MENTIONED = re.compile(r"fisheye|equidist|kannala")
#: What YAML and JSON write where there is nothing.
NULLS = (None, "~", "null", "")
#: The coefficients in their order; what follows those of `Rational` is not read.
ORDER = (*COEFFICIENTS, "s1", "s2", "s3", "s4", "tau_x", "tau_y")
#: A rotation vector that is longer (rad) has lost its angle to rounding.
MOST_ANGLE = 1e4
#: What YAML cannot hold as it stands, or takes for the end of a line.
UNPRINTABLE = re.compile("[\0-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")
#: The longest text that FileStorage reads.
MOST_BYTES = 4095


def read_opencv(
    path: FilePath, *, size: Size | None = None, pixel_centres: str | None = None
) -> Cameras:
    """Return the cameras of an OpenCV calibration, by name: YAML, XML or JSON.

    A file with `R` (3, 3) or `rvec` (3,) and `t` has one camera. With `extrinsic_parameters` (N,
    6), as OpenCV's calibration writes, it has several: rvec and tvec in each row. `camera_matrix`
    is K in px; `image_width`, `image_height` in px, or `size` where there are none. `pixel_centres`
    ("integer", "half") overrules the file, which is "integer" if it says nothing.

    `distortion_coefficients` (also `dist`, `D`, `DistCoeff`, ...) are k1, k2, p1, p2, k3, k4, k5,
    k6. They are k1 to k4 of a fisheye where the file says so: `fisheye_model: 1`, or a
    `distortion_model`, `camera_model`, `lens`, ... of fisheye, equidistant or KANNALA_BRANDT.

    Raises ValueError naming file and field where something is missing or wrong. Also for other
    models, and for coefficients of other models that are not zero.

    ```python
    pj.formats.write_opencv("left.yaml", {"left.png": camera})
    cameras = pj.formats.read_opencv("left.yaml")
    ```
    """
    from . import storage  # PyYAML: of no use to who reads other files

    file = storage.load(path)
    named = {known_name(key) for key in file.data}
    if named.isdisjoint(POSES) and (whose := unknown(file.data)):
        raise ValueError(f"`path`: expected OpenCV's calibration, got {whose} (in {file.where})")
    fields = _known(file)
    view = _intrinsics(fields, size, pixel_centres)
    poses = _poses(fields)
    names = [str(k) for k in range(len(poses))] if len(poses) > 1 else ["camera"]
    if isinstance(alone := fields.data.get("camera_names"), str) and len(poses) == 1:
        names = [alone]
    elif "camera_names" in fields:
        names = fields.items("camera_names", len(poses), f"{len(poses)} different names")
    cameras = (camera_from_pinhole(view, inverse(pose), OPENCV, fields) for pose in poses)
    return by_name(zip(map(str, names), cameras, strict=True), fields.where)


def opencv_intrinsics(file: Fields, size: Size | None, pixel_centres: str) -> Pinhole:
    """Return the intrinsics of a calibration's fields; `size` and `pixel_centres` where they do not
    say."""
    fields = _known(file)
    known = None if "image_width" in fields or "image_height" in fields else size
    return _intrinsics(fields, known, fields.data.get("pixel_centres", pixel_centres))


def _intrinsics(fields: Fields, size: Size | None, pixel_centres: str | None) -> Pinhole:
    centres = fields.text("pixel_centres", ("integer", "half"), "integer")
    half = half_pixel(centres if pixel_centres is None else pixel_centres)
    view = read_matrix(fields, "camera_matrix", 1, 1, half)
    W, H = fields.size("image_width", "image_height", size)
    return view._replace(W=W, H=H, distortion=_distortion(fields))


def write_opencv(
    path: FilePath,
    cameras: NamedCameras,
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
    can_hold = lambda text: len(text.encode()) <= MOST_BYTES and not UNPRINTABLE.search(text)
    check_cameras(cameras, "OpenCV", can_hold)  # FileStorage reads a quoted text as it was
    views = {name: pinhole(camera, distorted=True) for name, camera in cameras.items()}
    (name, first), *others = views.items()
    for other, view in others:
        if np.abs(np.subtract(view[:4], first[:4])).max() > 1e-9 or view[4:] != first[4:]:
            raise ValueError(
                "`cameras`: expected one K, lens and image size in an OpenCV file, got others in"
                f" {other!r} than in {name!r}; write one file each"
            )
    poses = [inverse(pose_of(camera)) for camera in cameras.values()]
    model = first.distortion or BrownConrady()
    coefficients = np.array([*model.coefficients().values()])
    text = f"%YAML:1.0\n---\nimage_width: {first.W}\nimage_height: {first.H}\n"
    text += f"pixel_centres: {json.dumps(pixel_centres)}\n"
    text += f"camera_names: [ {json.dumps([*cameras], ensure_ascii=False)[1:-1]} ]\n"
    text += _matrix("camera_matrix", first.matrix(half_pixel(pixel_centres)))
    text += 'distortion_model: "fisheye"\n' * isinstance(model, Fisheye)
    text += _matrix("distortion_coefficients", coefficients[:, None])
    if len(poses) == 1:
        text += _matrix("R", poses[0][:3, :3]) + _matrix("t", poses[0][:3, 3:])
    else:
        from scipy.spatial.transform import Rotation

        rows = [np.r_[Rotation.from_matrix(x[:3, :3]).as_rotvec(), x[:3, 3]] for x in poses]
        text += _matrix("extrinsic_parameters", np.stack(rows))
    replace_file(path, text.encode())


def _known(file: Fields) -> Fields:
    """Return the fields under the names of `NAMES`, and whether the lens is a `fisheye`; a vector
    may lie or stand."""
    from . import storage

    known: dict[str, Any] = {}
    written: dict[str, str] = {}
    for key, value in file.data.items():
        name = known_name(key)
        if isinstance(value, str | None) and value in NULLS:
            continue
        if name is None:
            fisheye = _is_fisheye(file, str(key), value)
            if fisheye is None:
                _check_no_lens(file, str(key), value)
            elif known.setdefault("fisheye", fisheye) != fisheye:
                words = "a fisheye here and none in another field"
                raise file.wrong(str(key), "one model of the lens", words)
        elif name in known:
            raise file.wrong(name, "one such field", f"{str(key)!r} too")
        else:
            value = storage.matrix_array(file, name, value)
            flat = name != "extrinsic_parameters" and 1 in getattr(as_numbers(value), "shape", ())
            known[name] = np.ravel(value) if flat else value
            written[name] = str(key)
    return Fields(known, file.where, written)


def known_name(key: Any) -> str | None:
    """Return the name of `NAMES` that a field's name stands for, if it is known."""
    return PLAIN_NAMES.get(_plain(key))


def _plain(key: Any) -> str:
    return re.sub(r"[\W_]", "", str(key)).lower()


def _is_fisheye(file: Fields, key: str, value: Any) -> bool | None:
    """True or False for a field that names the lens's model, None for one that does not."""
    plain, word = _plain(key), _plain(value)
    if plain in FLAGS:
        return file.flag(key)
    if not (isinstance(value, str) and MAYBE_MODELS.fullmatch(plain)) or word in NEITHER:
        return None
    if FISHEYES.fullmatch(word) or BENT.fullmatch(word):
        return FISHEYES.fullmatch(word) is not None
    if MODELS.fullmatch(plain) or MENTIONED.search(word):
        words = "a model of OpenCV's (plumb_bob, rational_polynomial, fisheye, ...)"
        raise file.wrong(key, words, short(value))
    return None


def _check_no_lens(file: Fields, key: str, value: Any) -> None:
    """Raise ValueError where a field looks like coefficients other than 0, in a map or not."""
    if isinstance(value, Mapping) and "data" not in value:
        for name, part in value.items():
            _check_no_lens(file, f"{key}.{name}", part)
        return
    numbers = as_numbers(value["data"] if isinstance(value, Mapping) else value)
    if numbers is None or not np.any(numbers):
        return
    if (LENS_NUMBERS if numbers.size > 1 else LENS_NUMBER).fullmatch(key):
        words = "a lens's coefficients as `distortion_coefficients: [k1, k2, p1, p2, k3]`"
        raise file.wrong(key, words, f"a field {key[:60]!r}, whose meaning is not known")


def _poses(fields: Fields) -> list[Pose]:
    """Return camera_from_world of every view."""
    kinds = [name for name in POSES if name in fields]
    if not kinds:
        words = "no pose: intrinsics alone are no camera; see `from_opencv` (or --K FILE)"
        raise fields.wrong("R", "R and t, or extrinsic_parameters", words)
    name, *others = kinds
    others += ["t"] if name == "extrinsic_parameters" and "t" in fields else []
    if others:
        raise fields.wrong(name, "one kind of pose", f"both it and {others[0]}")
    rows = fields.array(name, *POSES[name])
    if name != "extrinsic_parameters":
        shift = fields.array("t", (3,))
        if rows.ndim > 1:
            return [pose_from_matrix(np.c_[rows, shift], fields, name)]
        rows = np.r_[rows, shift][None]
    if np.any(np.abs(rows[:, :3]) > MOST_ANGLE):
        raise fields.wrong(name, f"a turn of at most {MOST_ANGLE:g} rad", rows)
    return [exponential(row) for row in rows]


def _distortion(fields: Fields) -> Distortion | None:
    name, fisheye = "distortion_coefficients", fields.data.get("fisheye", False)
    names, sizes = (Fisheye.powers, (4,)) if fisheye else (ORDER, (4, 5, 8, 12, 14))
    if isinstance(fields.data.get(name), Mapping):
        part = fields.part(name)
    else:
        values = np.ravel(fields.array(name)) if name in fields else ()
        if len(values) not in (0, *sizes):
            words = " or ".join(map(str, sizes)) + " coefficients"
            raise fields.wrong(name, words + " of a fisheye" * fisheye, values)
        part = Fields(dict(zip(names, values, strict=False)), fields.where)
    return read_distortion(part, fisheye, names=part.data)


def _matrix(name: str, array: np.ndarray) -> str:
    """Return a matrix as FileStorage writes it."""
    data = ",\n       ".join(str(row)[1:-1] for row in array.tolist())
    rows, cols = array.shape
    return (
        f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n"
        f"   data: [ {data} ]\n"
    )
