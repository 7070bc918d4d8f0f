"""The project's own JSON: one camera with the note's parameters, or many by name."""

import json
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._camera.camera import Camera, ResizableCamera, basis, check_camera, focal_px, principal_point
from .._camera.distortion import MODELS, Distortion
from .._camera.lens import Lens
from .._files.fields import Fields, read_fields, short
from .._files.paths import FilePath, replace_file
from .._numerics.arrays import Input
from .pinhole import KIND, Cameras, NamedCameras, check_cameras, json_cameras, save_json

CAMERA_SCHEMA = "pinhole_jax.camera/1"
CAMERAS_SCHEMA = "pinhole_jax.cameras/1"
#: Fields that say the same twice may differ by this share: what a person or float32 rounds.
SAME = 1e-4
#: The fields of a pose, in their order.
POSE = ("eye", "right", "up", "forward", "focal_px", "principal_point")


def camera_to_dict(camera: Camera) -> dict[str, object]:
    """Return the camera as JSON-ready numbers.

    - `e, p, u, phi, d, W, H`: the note's parameters (world units, rad, px); `phi_degrees` beside.
    - `lens`: null, or `principal_point` (film coordinates: px, origin bottom left, y up), `aspect`
      and, if it has one, `distortion`: `model` (BrownConrady, Rational or Fisheye) and its
      coefficients.
    - `pose`: free of the gauge. `right`, `up`, `forward` are the camera's unit axes and `eye` its
      place, in world coordinates; `focal_px` is [fx, fy].

    ```python
    data = pj.io.camera_to_dict(camera)
    ```
    """
    check_camera(camera)
    lens, pose = camera.lens, _pose(ResizableCamera(camera))
    return {
        "schema": CAMERA_SCHEMA,
        **{name: _plain(getattr(camera, name)) for name in ("e", "p", "u", "phi")},
        "phi_degrees": float(np.rad2deg(float(camera.phi))),
        "d": float(camera.d),
        "W": camera.W,
        "H": camera.H,
        "lens": lens and _lens_to_dict(lens),
        "pose": {name: _plain(value) for name, value in zip(POSE, pose, strict=True)},
    }


@eqx.filter_jit
def _pose(camera: ResizableCamera) -> tuple[Any, ...]:
    """Return the camera's pose and film, free of the gauge: the values of `POSE`."""
    focal = jnp.stack(focal_px(camera))
    return camera.e, *basis(camera.e, camera.p, camera.u), focal, principal_point(camera)


def camera_from_dict(data: Input[Mapping[str, object], "JSON"], *, fitted: bool = False) -> Camera:
    """Return the camera of `camera_to_dict`'s numbers.

    `phi_degrees` stands for `phi` where that is not there. `pose` and `phi_degrees` say again what
    the other fields do, and may be left out; where they say something else, nothing is guessed.
    `fitted`: the distortion need not hold beyond the object, as one that a fit found.

    Raises ValueError where a field is missing, is not what it should be, or contradicts others.

    ```python
    camera = pj.io.camera_from_dict(data)
    ```
    """
    return camera_from_fields(Fields(data, "the camera's fields"), fitted=fitted)


def camera_from_fields(fields: Fields, *, fitted: bool = False) -> Camera:
    """Return the camera of fields, as `camera_from_dict`."""
    if "schema" in fields:
        fields.text("schema", (CAMERA_SCHEMA,))
    e, p, u, W, H = (fields.get(name, "a camera's field") for name in ("e", "p", "u", "W", "H"))
    phi, d = _phi(fields), fields.data.get("d", 1.0)
    try:
        lens = None if fields.data.get("lens") is None else _lens(fields)
        camera = Camera(e, p, u, phi, d, W, H, None if fitted else lens)
        if fitted:  # `tree_at` skips `Camera`'s check of the lens
            camera = eqx.tree_at(lambda c: c.lens, camera, lens, is_leaf=lambda x: x is None)
    except (TypeError, ValueError) as error:
        if fields.where in str(error):
            raise
        raise ValueError(f"{error} (in {fields.where})") from None
    if fields.data.get("pose") is not None:
        _check_pose(camera, fields.part("pose"))
    return camera


def _phi(fields: Fields) -> Any:
    """Return the field of view (rad); degrees stand for radians that are not there."""
    if fields.data.get("phi_degrees") is None:
        return fields.get("phi", "the vertical field of view (rad)")
    phi = float(np.deg2rad(fields.number("phi_degrees")))
    rad = fields.number("phi", phi)
    if abs(phi - rad) > SAME * abs(rad):
        words = f"{np.rad2deg(rad):.6g}, as `phi` says ({rad:.6g} rad)"
        got = f"{np.rad2deg(phi):.6g}; leave out the one that is not meant"
        raise fields.wrong("phi_degrees", words, got)
    return fields.data.get("phi", phi)


def _check_pose(camera: Camera, pose: Fields) -> None:
    """Raise ValueError where a file's `pose` contradicts its other fields."""
    own = [np.asarray(value, float) for value in _pose(ResizableCamera(camera))]
    eye, view = np.asarray(camera.e, float), np.asarray(camera.p, float)
    far = float(np.max(np.abs([view - eye, eye])))
    # As far as the camera's float type tells a direction from e to p.
    coarse = float(np.finfo(camera.e.dtype).eps) * far
    same = SAME + 4 * coarse / max(float(np.linalg.norm(view - eye)), 1e-300)
    scales = (far, 1, 1, 1, np.max(own[4]), max(camera.W, camera.H))
    for name, value, scale in zip(POSE, own, scales, strict=True):
        given = pose.array(name, (len(value),)) if name in pose else value
        if np.max(np.abs(given / scale - value / scale)) > same:
            got = f"{short(given)}; leave out what is not meant (`pose` may be left out)"
            raise pose.wrong("pose", f"{name} = {short(value)}, as e, p, u, phi and lens say", got)


def _lens_to_dict(lens: Lens) -> dict[str, Any]:
    data = {"principal_point": _plain(lens.principal_point), "aspect": float(lens.aspect)}
    if lens.distortion is not None:
        data["distortion"] = distortion_to_dict(lens.distortion)
    return data


def distortion_to_dict(distortion: Distortion) -> dict[str, Any]:
    """Return a lens's distortion as JSON-ready values: `model`, and its coefficients by name."""
    return {"model": type(distortion).__name__, **distortion.coefficients()}


def _lens(fields: Fields) -> Lens:
    """Return the lens of a camera's fields."""
    lens, distortion = fields.part("lens", only=("principal_point", "aspect", "distortion")), None
    if lens.data.get("distortion") is not None:
        model = MODELS[lens.part("distortion").text("model", [*MODELS])]
        part = dict(lens.part("distortion", only=("model", *model.powers)).data)
        del part["model"]
        distortion = model(**part)
    centre = lens.get("principal_point", "x and y, px")
    return Lens(centre, lens.data.get("aspect", 1.0), distortion)


def save_camera(path: FilePath, camera: Camera, **more: object) -> None:
    """Write a camera as JSON (see `camera_to_dict`); `more` are further fields.

    Raises ValueError for what is no camera, fields that JSON cannot hold (NaN is one), and a path
    that cannot be written.

    ```python
    pj.io.save_camera("camera.json", camera)
    ```
    """
    data = camera_to_dict(camera)
    if hidden := sorted(data.keys() & more.keys()):
        raise ValueError(f"`more`: expected fields that no camera has, got {hidden}")
    try:
        text = json.dumps({**data, **more}, indent=1, allow_nan=False) + "\n"
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"`more`: expected what JSON can hold, got {sorted(more)}: {error}"
        ) from error
    replace_file(path, text.encode())


def load_camera(path: FilePath) -> Camera:
    """Return the camera of a JSON file that `save_camera` wrote.

    Raises FileNotFoundError, or ValueError naming the field that is missing or wrong.

    ```python
    camera = pj.io.load_camera("camera.json")
    ```
    """
    return camera_from_fields(read_fields(path, KIND))


def _plain(numbers: Any) -> Any:
    """Return a number or a row of numbers as Python's."""
    return np.asarray(numbers, float).tolist()


def read_json(path: FilePath) -> Cameras:
    """Return the cameras of the project's own JSON: one (`io.save_camera`) or many.

    Frisvad's parameters: world units, and `phi`, the VERTICAL field of view in rad. The principal
    point is in film coordinates: px from the bottom-left corner, y up, pixel centres at halves.

    ```python
    pj.formats.write_json("left.json", {"left.png": camera})
    cameras = pj.formats.read_json("left.json")
    ```
    """
    return json_cameras(path, camera_from_fields)


def write_json(path: FilePath, cameras: NamedCameras) -> None:
    """Write the project's own JSON: one camera as `io.save_camera` does, many by name.

    ```python
    pj.formats.write_json("left.json", {"left.png": camera})
    ```
    """
    check_cameras(cameras)
    if len(cameras) == 1:
        ((name, camera),) = cameras.items()
        save_camera(path, camera, name=name)
    else:
        own = {name: camera_to_dict(camera) for name, camera in cameras.items()}
        save_json(path, {"schema": CAMERAS_SCHEMA, "cameras": own})
