"""`fit_one`: a record in, a row out."""

import contextlib
import functools
import json
import math
import os
import threading
import time
import warnings
from typing import Any

from .._files.naming import named
from .records import Record, asked, check_id, check_record, digest_of
from .rows import Row, empty_row

#: This many shapes are kept open.
OPEN = 8
#: Threads open one file after another: what is opened is kept, and warnings are caught.
_opening = threading.Lock()


def fit_one(record: Record) -> Row:
    """Return what becomes of a record (`batch.FIELDS`), as a row (`batch.COLUMNS`).

    What is wrong with a record or its files makes a row whose status is "failed", never an
    exception, as long as it is a mapping with an `id`. It depends on nothing but the record and its
    files, and JAX's float type; a shape that was opened is kept for records that follow.

    Raises ValueError for what has no `id`.

    ```python
    row = pj.fit_one({"id": "a", "mesh": "part.obj", "mask": "mask.png", "camera": "camera.json"})
    row["status"], row["K"], row["R"], row["t"]
    ```
    """
    begin = time.perf_counter()
    check_id(record)
    said: list[str] = []
    try:
        checked = check_record(record)
        fit = _joint(checked, said) if "views" in checked else _single(checked, said)
        row = _row_of(checked, fit, "; ".join(said))
    except Exception as error:  # whatever a file makes a reader do: the others go on
        known = isinstance(error, ValueError | OSError | ModuleNotFoundError)
        words = str(error) if known else f"{type(error).__name__}: {error}"
        row = empty_row(record, "failed", words)
    return row | {"seconds": time.perf_counter() - begin}


def mask_of(record: Record) -> Any:
    """Return the pixels (H, W) of a record's one mask, uint8."""
    return _mask(record, record["mask"], [])


def scene_of(record: Record) -> Any:
    """Return the scene of a record's mesh."""
    with _opening:
        return _scene(*_state(record["mesh"]))[0]


def _single(record: Record, said: list[str]) -> Any:
    """Return the fit of one mask."""
    from .. import io
    from .._fit.fit_camera import fit_camera

    mask = _mask(record, record["mask"], said)
    H, W = mask.shape
    arguments = dict(_start(record, W, H))
    for name in ("outlier_px", "max_steps", "prior", "bounds"):
        if name in record:
            arguments[name] = record[name]
    with named(path="weight"):
        if "weight" in record:
            arguments["weight"] = io.load_mask(record["weight"], "luminance") / 255.0
    with named(path="photo"):
        if "photo" in record:
            arguments["photo"] = io.load_image(record["photo"])[..., :3]
    with named(path="mesh", vertices="mesh"), _opening:
        scene, words = _scene(*_state(record["mesh"]))
    said += words
    return fit_camera(scene, mask, free=asked(record, "free"), **arguments)


def _joint(record: Record, said: list[str]) -> Any:
    """Return the camera's fit of a robot's views."""
    from .._joint.fit_joint import fit_joint
    from .._joint.views import JointView

    with named(path="robot"), _opening:
        robot = _robot(*_state(record["robot"]), tuple(record.get("leave_out", ())))
    hand = record.get("in_hand")
    views = []
    for view in record["views"]:
        poses = robot.poses(view["angles"])
        if hand is not None and hand not in poses:
            raise ValueError(f"`in_hand`: expected a link among {', '.join(poses)}, got {hand!r}")
        mount = None if hand is None else poses[hand]
        views.append(JointView(robot.at(poses), _mask(record, view["mask"], said), mount=mount))
    H, W = views[0].target.shape
    start, free = _start(record, W, H), asked(record, "free")
    search = start["camera"] is None
    camera = start["camera"] if not search else _anywhere(start, free, W, H)
    more = {name: record[name] for name in ("outlier_px", "max_steps") if name in record}
    fit = fit_joint(views, camera, free, search=search, **more)
    said += [words for words in fit.weak if words not in fit.cameras["camera"].weak]
    return fit.cameras["camera"]._replace(status=fit.status)


def _anywhere(start: dict[str, Any], free: Any, W: int, H: int) -> Any:
    """Return a camera that has the lens alone of one to look for."""
    from .._camera.camera import unplaced
    from .._solver.parameters import as_names

    phi = start.get("phi")
    if phi is None and not {"phi", "d"} & {*as_names(free)}:
        raise ValueError("`K`: expected the intrinsics (or `fov`, or phi among `free`), got none")
    phi = 0.7 if phi is None else phi
    return unplaced(phi, W, H, start.get("lens"))


def _mask(record: Record, mask: Any, said: list[str]) -> Any:
    """Return a mask's pixels, uint8."""
    from .. import io

    with named(path="mask", rle="mask"):
        invert = asked(record, "invert")
        if isinstance(mask, str):
            image = io.load_mask(mask, record.get("mask_from"), said.append, invert=invert)
        else:
            image = io.mask_of_rle(mask)
            image = 255 - image if invert else image
    if asked(record, "tidy"):
        image, done = io.tidy_mask(image)
        said += done
    return image


def _start(record: Record, W: int, H: int) -> dict[str, Any]:
    """Return `fit_camera`'s `camera`, `phi` and `lens`.

    Raises ValueError for fields that do not go together.
    """
    from .. import formats

    ways = [name for name in ("camera", "K", "fov") if name in record]
    if len(ways) > 1:
        raise ValueError(f"`{ways[1]}`: expected none beside `{ways[0]}`")
    for name in {"start", "dist", "pixel_centres"} & record.keys():
        if ways != ["K"]:
            raise ValueError(f"`{name}`: expected `K` beside it, got none")
    if ways == ["camera"]:
        with named(path="camera"):
            return {"camera": formats.read_one(record["camera"])}
    if ways == ["fov"]:
        fov = record["fov"]
        if not isinstance(fov, int | float) or not 0 < fov < 180:
            raise ValueError(f"`fov`: expected degrees between 0 and 180, got {fov!r}")
        return {"camera": None, "phi": math.radians(fov)}
    if not ways:
        return {"camera": None}
    camera = _of_K(record, W, H)
    if "start" in record:
        return {"camera": camera}
    return {"camera": None, "phi": camera.phi, "lens": camera.lens}


def _of_K(record: Record, W: int, H: int) -> Any:
    """Return the camera of `K`, `dist` and `start`; without a start at the origin."""
    import numpy as np

    from .._camera.distortion import BrownConrady, Rational
    from ..formats import from_opencv

    numbers = _numbers("K", record["K"], (4, 9))
    K = numbers.reshape(3, 3) if len(numbers) == 9 else _matrix(*numbers)
    if not (0 <= K[0, 2] <= W and 0 <= K[1, 2] <= H):
        words = f"inside the picture of {W} x {H} px, got ({K[0, 2]:g}, {K[1, 2]:g})"
        raise ValueError(
            f"`K`: expected a principal point {words}: are cx and cy exchanged, was it resized?"
        )
    pose = np.eye(4)
    if "start" in record:
        pose = _numbers("start", record["start"], (16,)).reshape(4, 4)
    distortion = None
    if "dist" in record:
        dist = _numbers("dist", record["dist"], (4, 5, 8))
        distortion = (Rational if len(dist) == 8 else BrownConrady)(*dist.tolist())
    centres = asked(record, "pixel_centres")
    return from_opencv(
        K, pose[:3, :3], pose[:3, 3], W, H, pixel_centres=centres, distortion=distortion
    )


def _matrix(fx: float, fy: float, cx: float, cy: float) -> Any:
    import numpy as np

    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _numbers(name: str, value: Any, counts: tuple[int, ...]) -> Any:
    """Return a field's numbers in a row, of one of these counts; texts hold them between blanks."""
    import numpy as np

    with contextlib.suppress(TypeError, ValueError):
        parts = value.replace(",", " ").split() if isinstance(value, str) else value
        numbers = np.asarray(parts, float).ravel()
        if len(numbers) in counts and np.all(np.isfinite(numbers)):
            return numbers
    few = " or ".join(map(str, counts))
    raise ValueError(f"`{name}`: expected {few} finite numbers, got {value!r}")


def _state(path: str) -> tuple[str, float]:
    """Return a path and when its file changed: one that is written anew is read anew."""
    try:
        return path, os.stat(path).st_mtime
    except (OSError, TypeError, ValueError):
        return path, 0.0  # its reader says why


@functools.lru_cache(OPEN)
def _scene(path: str, changed: float) -> tuple[Any, list[str]]:
    """Return a mesh's scene, and what is to be said of it."""
    del changed
    from .. import io
    from .._scene.scene import Scene

    words: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = Scene(mesh=io.load_mesh(path, say=words.append))
    return scene, words + [str(warning.message) for warning in caught]


@functools.lru_cache(OPEN)
def _robot(path: str, changed: float, leave_out: tuple[str, ...]) -> Any:
    del changed
    from ..robots import load_urdf

    return load_urdf(path, leave_out)


def _row_of(record: Record, fit: Any, words: str) -> Row:
    """Return a fit as a row."""
    import numpy as np

    from ..formats import to_opencv
    from ..formats.native import camera_to_dict
    from ..io.fits import fit_to_dict

    row = empty_row(record, fit.status, words) | {"hash": digest_of(record)}
    row |= {
        "iou": float(fit.iou),
        "rms": float(fit.rms),
        "names": list(fit.names),
        "std": np.asarray(fit.std, float).tolist(),
        "covariance": np.asarray(fit.covariance, float).ravel().tolist(),
        "weak": list(fit.weak),
        "modes": len(fit.modes),
        "steps": [int(n) for n in fit.steps],
    }
    if fit.status == "non_finite":
        return row
    centres = asked(record, "pixel_centres")
    K, R, t = to_opencv(fit.camera, pixel_centres=centres)
    camera = camera_to_dict(fit.camera)
    plain = fit_to_dict(fit._replace(history=()), pixel_centres=centres)
    return row | {
        **{name: camera[name] for name in ("e", "p", "u", "phi", "W", "H")},
        **{name: x.ravel().tolist() for name, x in (("K", K), ("R", R), ("t", t))},
        "lens": json.dumps(camera["lens"]),
        "fit": json.dumps(plain),
    }
