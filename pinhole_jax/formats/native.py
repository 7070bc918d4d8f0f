"""The project's own JSON: one camera with the note's parameters, or many by name."""

import json
import os
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import equinox as eqx
import numpy as np

from .._camera.camera import Basis, Camera, camera_basis, focal_px, principal_point
from .._camera.distortion import MODELS
from .._camera.lens import Lens
from .._files.paths import read_json as read_json_file, replace_file
from .fields import Fields, add_named, check_names, load_json, save_json

CAMERA_SCHEMA = "pinhole_jax.camera/1"
CAMERAS_SCHEMA = "pinhole_jax.cameras/1"


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """Return the camera as JSON-ready numbers.

    - `e, p, u, phi, d, W, H`: the note's parameters (world units, rad, px); `phi_degrees` beside.
    - `lens`: null, or `principal_point` (film coordinates: px, origin bottom left, y up), `aspect`
      and, if it has one, `distortion`: `model` (BrownConrady, Rational or Fisheye) and its
      coefficients.
    - `pose`: free of the gauge. `right`, `up`, `forward` are the camera's unit axes and `eye` its
      place, in world coordinates; `focal_px` is [fx, fy].
    """
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


def camera_from_dict(data: Any) -> Camera:
    """Return the camera of `camera_to_dict`'s numbers; `pose` and `phi_degrees` are not read.

    Raises ValueError where a field is missing or is not what it should be.
    """
    return Camera(*_numbers_and_lens(data))


def fitted_camera_from_dict(data: Any) -> Camera:
    """Return the camera of `camera_to_dict`'s numbers as a fit found it: its distortion need not
    hold beyond the object."""
    *numbers, lens = _numbers_and_lens(data)
    camera = Camera(*numbers)
    return eqx.tree_at(lambda c: c.lens, camera, lens, is_leaf=lambda x: x is None)


def _numbers_and_lens(data: Any) -> tuple[Any, ...]:
    """Return a camera's arguments."""
    if not isinstance(data, dict):
        raise ValueError(f"`camera`: expected a JSON object, got {type(data).__name__}")
    schema = data.get("schema", CAMERA_SCHEMA)
    if schema != CAMERA_SCHEMA:
        raise ValueError(f"`schema`: expected {CAMERA_SCHEMA!r}, got {schema!r}")
    missing = [name for name in ("e", "p", "u", "phi", "W", "H") if name not in data]
    if missing:
        raise ValueError(f"`camera`: expected the field {missing[0]!r}, got {sorted(data)}")
    lens = data.get("lens")
    if lens is not None:
        lens = _lens_from_dict(lens)
    numbers = (data["e"], data["p"], data["u"], data["phi"], data.get("d", 1.0))
    return *numbers, data["W"], data["H"], lens


def _lens_to_dict(lens: Lens) -> dict[str, Any]:
    data = {"principal_point": _numbers(lens.principal_point), "aspect": float(lens.aspect)}
    if lens.distortion is None:
        return data
    return {
        **data,
        "distortion": {"model": type(lens.distortion).__name__, **lens.distortion.coefficients()},
    }


def _lens_from_dict(data: Any) -> Lens:
    if not isinstance(data, dict) or "principal_point" not in data:
        raise ValueError(f"`lens`: expected principal_point and aspect, got {data!r}")
    if unknown := sorted(set(data) - {"principal_point", "aspect", "distortion"}):
        raise ValueError(f"`lens`: expected principal_point and aspect, got also {unknown}")
    bent = data.get("distortion")
    if bent is not None:
        model = MODELS.get(str(bent.get("model"))) if isinstance(bent, dict) else None
        names = {field.name for field in fields(model)} if model else set()
        if model is None or set(bent) - names - {"model"}:
            words = f"a model ({', '.join(MODELS)}) and its coefficients"
            raise ValueError(f"`distortion`: expected {words}, got {bent!r}")
        bent = model(**{name: bent[name] for name in bent if name != "model"})
    return Lens(data["principal_point"], data.get("aspect", 1.0), bent)


def save_camera(path: str | os.PathLike[str], camera: Camera, **more: Any) -> None:
    """Write a camera as JSON (see `camera_to_dict`); `more` are further fields.

    Raises ValueError for what is no camera, fields that JSON cannot hold (NaN is one), and a path
    that cannot be written.
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
    """Write the project's own JSON: one camera as `io.save_camera` does, many by name."""
    check_names(cameras, "JSON")
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
