"""A fit's file: the project's own camera JSON, with a field `fit` that has all else of the fit.

The command writes it, and whatever reads cameras reads its camera. JSON has no word for what is not
finite: NaN is null, infinities are texts; a standard error is null where it is either.
"""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from .._camera.camera import Camera
from .._camera.matrices import Centres
from .._files.fields import Fields, read_fields, short
from .._files.paths import FilePath
from .._fit.result import Fit, MaskError, Progress, check_fit
from .._fit.words import STATUSES
from .._numerics.arrays import Input
from ..formats.native import (
    camera_from_fields,
    camera_to_dict,
    distortion_to_dict,
    save_camera,
)
from ..formats.object_pose import object_pose

FIT_SCHEMA = "pinhole_jax.fit/1"
#: Fields of a fit that a file has under their names.
AS_THEY_ARE = ("status", "iou", "rms", "names", "covariance", "independent_covariance",
               "mask_error", "unbelieved", "weak")  # fmt: skip
#: What JSON has no number for; what is none at all is null.
INFINITE = {np.inf: "Infinity", -np.inf: "-Infinity"}
#: What a file says of its covariances.
CAMERA_FRAME = (
    "small turns (rad) of the camera about its own axes right, up, forward (rotation_b1, _b2, _v);"
    " its eye in the frame of the mesh (e_x, e_y, e_z, in its units); px for the principal point"
)
OBJECT_FRAME = (
    "small turns (rad) of the object about the camera's axes right, down, forward, then t in these"
    " axes (units of the mesh)"
)


def fit_to_dict(
    fit: Fit, *, pixel_centres: Input[Centres, "of K"] = "integer"
) -> dict[str, object]:
    """Return the fit as JSON-ready numbers: its camera's (`camera_to_dict`), and in `fit` the rest.

    - `dtype`: the camera's float type.
    - `std`: by name; null where the mask does not determine a parameter.
    - `covariance`: of `names`, in their order, in the frame that `covariance_frame` says; NaN is
      null there, infinity "Infinity".
    - `independent_covariance`, `mask_error` (`px`, `over_px`), `unbelieved` (points): null where
      the fit has none.
    - `object_in_camera`: the object's pose in the camera's frame (`formats.object_pose`): OpenCV's
      `K` by its `pixel_centres`, `R`, `t`, `object_covariance` and its frame, the transforms
      `camera_from_world` and `world_from_camera` (4, 4), and `distortion` (null, or a model and its
      coefficients). It is not read back.
    - `modes`: each is a fit of its own. `history`: `camera`, `W`, `H`, `steps` of each.
    - all else as a `Fit` has it.

    ```python
    data = pj.io.fit_to_dict(fit)
    ```
    """
    check_fit(fit)
    return {**camera_to_dict(fit.camera), "fit": _rest(fit, pixel_centres)}


def fit_from_dict(data: Input[Mapping[str, object], "JSON"]) -> Fit:
    """Return the fit of `fit_to_dict`'s numbers, equal to the last bit.

    A camera of float64 becomes one of float32 where JAX has no other (`jax_enable_x64` is off).

    Raises ValueError where a field is missing or is not what it should be.

    ```python
    fit = pj.io.fit_from_dict(data)
    ```
    """
    return _fit(Fields(data, "`fit`"))


def save_fit(
    path: FilePath, fit: Fit, *, pixel_centres: Input[Centres, "of K"] = "integer"
) -> None:
    """Write a fit as JSON (see `fit_to_dict`); `load_camera` and `formats.read` read its camera.

    Raises ValueError for what is no fit, a camera that is not finite, and a path that cannot be
    written.

    ```python
    pj.io.save_fit("fit.json", fit)
    ```
    """
    rest = fit_to_dict(fit, pixel_centres=pixel_centres)["fit"]
    save_camera(path, fit.camera, fit=rest)


def load_fit(path: FilePath) -> Fit:
    """Return the fit of a JSON file that `save_fit` (or the command) wrote, as `fit_from_dict`.

    Raises FileNotFoundError, or ValueError naming the field that is missing or wrong.

    ```python
    fit = pj.io.load_fit("fit.json")  # to the last bit of its float type
    ```
    """
    return _fit(read_fields(path, "a fit's file"))


def _rest(fit: Fit, pixel_centres: Any) -> dict[str, Any]:
    std = _plain(np.where(np.isfinite(fit.std), fit.std, np.nan))
    return {
        "schema": FIT_SCHEMA,
        "dtype": np.dtype(fit.camera.e.dtype).name,
        **{name: _plain(getattr(fit, name)) for name in AS_THEY_ARE},
        "std": dict(zip(fit.names, std, strict=True)),
        "covariance_frame": CAMERA_FRAME,
        "object_in_camera": _pose(fit, pixel_centres),
        "steps": [int(count) for count in fit.steps],
        "modes": [fit_to_dict(mode, pixel_centres=pixel_centres) for mode in fit.modes],
        "history": [
            {**step._asdict(), "camera": camera_to_dict(step.camera)} for step in fit.history
        ],
    }


def _pose(fit: Fit, pixel_centres: Any) -> dict[str, Any] | None:
    if fit.status == "non_finite":
        return None
    pose = object_pose(fit, pixel_centres=pixel_centres)
    names = ("K", "R", "t", "camera_from_world", "world_from_camera")
    return {
        "pixel_centres": pose.pixel_centres,
        **{name: _plain(getattr(pose, name)) for name in names},
        "object_frame": OBJECT_FRAME,
        "object_covariance": _plain(pose.covariance),
        "distortion": None if pose.distortion is None else distortion_to_dict(pose.distortion),
    }


def _plain(value: Any) -> Any:
    """Return a number, a text, an array or a record as JSON has it, with words for what is not
    finite."""
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, MaskError):
        return value._asdict()
    if np.ndim(value):
        return [_plain(part) for part in value]
    return float(value) if np.isfinite(value) else INFINITE.get(float(value))


def _fit(fields: Fields) -> Fit:
    rest = fields.part("fit", "the field that `save_fit` writes beside a camera")
    rest.text("schema", (FIT_SCHEMA,))
    status = rest.text("status", [*STATUSES])
    dtype = np.dtype(rest.text("dtype", ("float32", "float64")))
    names = _texts(rest, "names")
    square = (len(names), len(names))
    error = rest.get("mask_error", "`px` and `over_px`, or null") and rest.part("mask_error")
    return Fit(
        camera=_camera(fields, dtype),
        status=status,
        names=names,
        covariance=rest.array("covariance", square, finite=False),
        rms=_number(rest, "rms"),
        iou=_number(rest, "iou"),
        steps=tuple(rest.counts("steps")),
        weak=_texts(rest, "weak"),
        modes=tuple(_fit(mode) for mode in rest.parts("modes")),
        history=tuple(_progress(step, dtype) for step in rest.parts("history")),
        independent_covariance=_optional_array(rest, "independent_covariance", square),
        mask_error=error and MaskError(_number(error, "px"), _number(error, "over_px")),
        unbelieved=_optional_array(rest, "unbelieved", (-1, 2)),
    )


def _camera(fields: Fields, dtype: np.dtype) -> Camera:
    known = jax.dtypes.canonicalize_dtype(dtype)
    camera = camera_from_fields(fields, fitted=True)
    return jax.tree.map(lambda leaf: leaf.astype(known), camera)


def _progress(fields: Fields, dtype: np.dtype) -> Progress:
    camera = _camera(fields.part("camera"), dtype)
    return Progress(camera, fields.integer("W"), fields.integer("H"), fields.integer("steps", 0))


def _texts(fields: Fields, name: str) -> tuple[str, ...]:
    value = fields.items(name, kind="a list of texts")
    if not all(isinstance(text, str) for text in value):
        raise fields.wrong(name, "a list of texts", short(value))
    return tuple(value)


def _number(fields: Fields, name: str) -> float:
    return float(fields.array(name, (), expected="a number", finite=False))


def _optional_array(fields: Fields, name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return numbers of this shape; None for null."""
    if fields.get(name, f"numbers of shape {shape}, or null") is None:
        return None
    return fields.array(name, shape, finite=False)
