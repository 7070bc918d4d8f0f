"""The project's own JSON: one camera with the note's parameters, or many by name."""

import json
import os
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import equinox as eqx
import jax
import numpy as np

from .._camera.camera import Basis, Camera, camera_basis, check_camera, focal_px, principal_point
from .._camera.distortion import MODELS, Distortion
from .._camera.lens import Lens
from .._files.paths import read_json as read_json_file, replace_file
from .._numerics.arrays import Input
from .fields import Fields, add_named, check_cameras, load_json, save_json, short

CAMERA_SCHEMA = "pinhole_jax.camera/1"
CAMERAS_SCHEMA = "pinhole_jax.cameras/1"
#: Fields that say the same twice may differ by this share: what a person or float32 rounds.
SAME = 1e-4


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
    (b1, b2, v), focal, principal = _pose(camera)
    lens = camera.lens
    return {
        "schema": CAMERA_SCHEMA,
        "e": _numbers(camera.e),
        "p": _numbers(camera.p),
        "u": _numbers(camera.u),
        "phi": float(camera.phi),
        "phi_degrees": float(np.rad2deg(float(camera.phi))),
        "d": float(camera.d),
        "W": camera.W,
        "H": camera.H,
        "lens": None if lens is None else _lens_to_dict(lens),
        "pose": {
            "eye": _numbers(camera.e),
            "right": _numbers(b1),
            "up": _numbers(b2),
            "forward": _numbers(v),
            "focal_px": [float(f) for f in focal],
            "principal_point": _numbers(principal),
        },
    }


@eqx.filter_jit
def _pose(camera: Camera) -> tuple[Basis, Any, Any]:
    """Return the axes, the focal length (px) and the principal point (px)."""
    return camera_basis(camera), focal_px(camera), principal_point(camera)


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
    *numbers, lens = _numbers_and_lens(data)
    camera = Camera(*numbers, lens=None if fitted else lens)
    if fitted:
        camera = eqx.tree_at(lambda c: c.lens, camera, lens, is_leaf=lambda x: x is None)
    _check_pose(camera, data.get("pose"))
    return camera


def _numbers_and_lens(data: Any) -> tuple[Any, ...]:
    """Return a camera's arguments."""
    if not isinstance(data, dict):
        raise ValueError(f"`camera`: expected a JSON object, got {type(data).__name__}")
    schema = data.get("schema", CAMERA_SCHEMA)
    if schema != CAMERA_SCHEMA:
        raise ValueError(f"`schema`: expected {CAMERA_SCHEMA!r}, got {schema!r}")
    phi = _phi(data)
    missing = [name for name in ("e", "p", "u", "W", "H") if name not in data]
    missing += ["phi"] if phi is None and "phi" not in data else []
    if missing:
        raise ValueError(f"`camera`: expected the field {missing[0]!r}, got {sorted(data)}")
    lens = data.get("lens")
    if lens is not None:
        lens = _lens_from_dict(lens)
    numbers = (data["e"], data["p"], data["u"], phi, data.get("d", 1.0))
    return *numbers, data["W"], data["H"], lens


def _phi(data: dict[str, Any]) -> Any:
    """Return a file's field of view (rad), None where it has none; degrees stand for radians."""
    phi, given = data.get("phi"), data.get("phi_degrees")
    if given is None:
        return phi
    (degrees,) = _given({"phi_degrees": given}, "phi_degrees", 1)
    if "phi" not in data:
        return float(np.deg2rad(degrees))
    if (
        phi is not None
        and _is_number(phi)
        and not abs(np.deg2rad(degrees) - phi) <= SAME * abs(phi)
    ):
        raise ValueError(
            f"`phi_degrees`: expected {np.rad2deg(phi):.6g}, as `phi` says ({phi:.6g} rad), got"
            f" {degrees:.6g}; leave out the one that is not meant"
        )
    return phi


def _check_pose(camera: Camera, pose: Any) -> None:
    """Raise ValueError where a file's `pose` says something else than its other fields."""
    if pose is None:
        return
    if not isinstance(pose, dict):
        raise ValueError(f"`pose`: expected an object with names, got {type(pose).__name__}")
    (b1, b2, v), focal, principal = jax.tree.map(lambda x: np.asarray(x, float), _pose(camera))
    eye, view = (np.asarray(x, float) for x in (camera.e, camera.p))
    far = max(float(np.max(np.abs(view - eye))), float(np.max(np.abs(eye))))
    size = max(camera.W, camera.H)
    # As far as the camera's float type tells a direction from e to p.
    coarse = float(np.finfo(np.asarray(camera.e).dtype).eps) * far
    axis = 1.0 + 4 * coarse / max(float(np.linalg.norm(view - eye)), 1e-300) / SAME
    own = {
        "eye": (eye, far, "e"),
        "right": (b1, axis, "e, p, u"),
        "up": (b2, axis, "e, p, u"),
        "forward": (v, axis, "e, p"),
        "focal_px": (np.stack(focal), float(np.max(focal)), "phi and lens"),
        "principal_point": (principal, size, "lens"),
    }
    for name in own.keys() & pose.keys():
        value, scale, source = own[name]
        given = _given(pose, name, len(value))
        with np.errstate(over="ignore"):
            same = np.all(np.abs(given - value) <= SAME * scale)
        if not same:
            raise ValueError(
                f"`pose`: expected {name} = {short(value)}, as {source} say, got {short(given)};"
                " leave out what is not meant (`pose` may be left out)"
            )


def _given(data: dict[str, Any], name: str, count: int) -> np.ndarray:
    """Return a field's numbers (count,), or raise ValueError where it has others."""
    value = data[name]
    numbers = value if isinstance(value, list) else [value]
    if len(numbers) != count or not all(map(_is_number, numbers)):
        raise ValueError(f"`{name}`: expected {count} finite numbers, got {short(value)}")
    return np.array(numbers, float)


def _is_number(value: Any) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and bool(np.isfinite(value))


def _lens_to_dict(lens: Lens) -> dict[str, Any]:
    data = {"principal_point": _numbers(lens.principal_point), "aspect": float(lens.aspect)}
    if lens.distortion is None:
        return data
    return {
        **data,
        "distortion": distortion_to_dict(lens.distortion),
    }


def distortion_to_dict(distortion: Distortion) -> dict[str, Any]:
    """Return a lens's distortion as JSON-ready values: `model`, and its coefficients by name."""
    return {"model": type(distortion).__name__, **distortion.coefficients()}


def _lens_from_dict(data: Any) -> Lens:
    if not isinstance(data, dict) or "principal_point" not in data:
        raise ValueError(f"`lens`: expected principal_point and aspect, got {data!r}")
    if unknown := sorted(set(data) - {"principal_point", "aspect", "distortion"}):
        raise ValueError(f"`lens`: expected principal_point and aspect, got also {unknown}")
    distortion = data.get("distortion")
    if distortion is not None:
        model = MODELS.get(str(distortion.get("model"))) if isinstance(distortion, dict) else None
        names = {field.name for field in fields(model)} if model else set()
        if model is None or set(distortion) - names - {"model"}:
            words = f"a model ({', '.join(MODELS)}) and its coefficients"
            raise ValueError(f"`distortion`: expected {words}, got {distortion!r}")
        distortion = model(**{name: distortion[name] for name in distortion if name != "model"})
    return Lens(data["principal_point"], data.get("aspect", 1.0), distortion)


def save_camera(path: str | os.PathLike[str], camera: Camera, **more: object) -> None:
    """Write a camera as JSON (see `camera_to_dict`); `more` are further fields.

    Raises ValueError for what is no camera, fields that JSON cannot hold (NaN is one), and a path
    that cannot be written.

    ```python
    pj.io.save_camera("camera.json", camera)
    ```
    """
    if not isinstance(camera, Camera):
        raise ValueError(f"`camera`: expected a Camera, got {type(camera).__name__}")
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


def load_camera(path: str | os.PathLike[str]) -> Camera:
    """Return the camera of a JSON file that `save_camera` wrote.

    Raises FileNotFoundError, or ValueError naming the field that is missing or wrong.

    ```python
    camera = pj.io.load_camera("camera.json")
    ```
    """
    data = read_json_file(path, "a camera file")
    try:
        return camera_from_dict(data)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{error} (in {str(path)!r})") from error


def _numbers(array: Any) -> list[float]:
    return [float(x) for x in np.asarray(array)]


def read_json(path: str | os.PathLike[str]) -> dict[str, Camera]:
    """Return the cameras of the project's own JSON: one (`io.save_camera`) or many.

    Frisvad's parameters: world units, `phi` the VERTICAL field of view in rad, the principal point
    in film coordinates (px from the film's bottom-left corner, y up; pixel centres at halves).

    ```python
    pj.formats.write_json("left.json", {"left.png": camera})
    cameras = pj.formats.read_json("left.json")
    ```
    """
    top = load_json(path)
    if top.data.get("schema") != CAMERAS_SCHEMA:
        return {top.text("name", default="camera"): _own(top)}
    cameras: dict[str, Camera] = {}
    parts = top.part("cameras")
    for name in parts.data:
        add_named(cameras, name, _own(parts.part(name)), top.where)
    return cameras


def write_json(path: str | os.PathLike[str], cameras: Mapping[str, Camera]) -> None:
    """Write the project's own JSON: one camera as `io.save_camera` does, many by name.

    ```python
    pj.formats.write_json("left.json", {"left.png": camera})
    ```
    """
    check_cameras(cameras, "JSON")
    if len(cameras) == 1:
        ((name, camera),) = cameras.items()
        save_camera(path, camera, name=name)
    else:
        own = {name: camera_to_dict(camera) for name, camera in cameras.items()}
        save_json(path, {"schema": CAMERAS_SCHEMA, "cameras": own})


def _own(fields: Fields) -> Camera:
    try:
        return camera_from_dict(fields.data)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{error} (in {fields.where})") from None
