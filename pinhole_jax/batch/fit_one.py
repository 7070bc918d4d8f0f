"""`fit_one`: a record in, a row out."""

import contextlib
import functools
import json
import math
import os
import re
import threading
import time
import warnings
from collections.abc import Iterator
from typing import Any

import pinhole_jax as pj

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
        row = _row_of(checked, _fit(checked, said), "; ".join(said))
    except Exception as error:  # whatever a file makes a reader do: the others go on
        known = isinstance(error, ValueError | OSError | ModuleNotFoundError)
        words = str(error) if known else f"{type(error).__name__}: {error}"
        row = empty_row(record, "failed", words)
    return row | {"seconds": time.perf_counter() - begin}


def _fit(record: Record, said: list[str]) -> Any:
    """Return the fit of a record's mask; what is to be said of its files is added to `said`."""
    mask = _mask(record, said)
    arguments = _start(record, *mask.shape)
    for name in {"outlier_px", "max_steps", "prior", "bounds"} & record.keys():
        arguments[name] = record[name]
    if "weight" in record:
        with _named("weight"):
            arguments["weight"] = pj.io.load_mask(record["weight"], "luminance") / 255.0
    if "photo" in record:
        with _named("photo"):
            arguments["photo"] = pj.io.load_image(record["photo"])[..., :3]
    with _named("mesh"), _opening:
        scene, words = _scene(record["mesh"], _changed(record["mesh"]))
    said += words
    return pj.fit_camera(scene, mask, free=asked(record, "free"), **arguments)


@contextlib.contextmanager
def _named(field: str) -> Iterator[None]:
    """Name a record's field in errors that name the argument of a reader."""
    try:
        yield
    except (ValueError, OSError) as error:
        text = re.sub("`(path|rle|vertices)`", f"`{field}`", str(error))
        raise ValueError(text) from error


def _mask(record: Record, said: list[str]) -> Any:
    """Return the pixels of a record's mask, uint8."""
    mask, invert = record["mask"], asked(record, "invert")
    with _named("mask"):
        if isinstance(mask, str):
            image = pj.io.load_mask(mask, record.get("mask_from"), said.append, invert=invert)
        else:
            image = pj.io.mask_of_rle(mask)
            image = 255 - image if invert else image
    if speck := asked(record, "tidy"):
        image, done = pj.io.tidy_mask(image, *([] if speck is True else [speck]))
        said += [x for x in done if speck is True or x.endswith(("dropped", "filled"))]
    return image


def _start(record: Record, H: int, W: int) -> dict[str, Any]:
    """Return `fit_camera`'s `camera`, `phi` and `lens`.

    Raises ValueError for fields that do not go together.
    """
    ways = [name for name in ("camera", "K", "fov") if name in record]
    if len(ways) > 1:
        raise ValueError(f"`{ways[1]}`: expected none beside `{ways[0]}`")
    for name in {"start", "dist", "pixel_centres"} & record.keys():
        if ways != ["K"]:
            raise ValueError(f"`{name}`: expected `K` beside it, got none")
    if ways == ["camera"]:
        with _named("camera"):
            return {"camera": pj.formats.read_one(record["camera"])}
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

    K = _numbers("K", record["K"], (4, 9))
    if len(K) == 4:
        K = np.array([K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1])
    K = K.reshape(3, 3)
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
        distortion = (pj.Rational if len(dist) == 8 else pj.BrownConrady)(*dist.tolist())
    more = {"pixel_centres": asked(record, "pixel_centres"), "distortion": distortion}
    return pj.formats.from_opencv(K, pose[:3, :3], pose[:3, 3], W, H, **more)


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


def _changed(path: str) -> float:
    """Return when a file changed: one that is written anew is read anew."""
    try:
        return os.stat(path).st_mtime
    except (OSError, TypeError, ValueError):
        return 0.0  # its reader says why


@functools.lru_cache(OPEN)
def _scene(path: str, changed: float) -> tuple[Any, list[str]]:
    """Return a mesh's scene, and what is to be said of it."""
    del changed
    words: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = pj.Scene(mesh=pj.load_mesh(path, say=words.append))
    return scene, words + [str(warning.message) for warning in caught]


def _row_of(record: Record, fit: Any, words: str) -> Row:
    """Return a fit as a row."""
    row = empty_row(record, fit.status, words) | {
        "hash": digest_of(record),
        "iou": float(fit.iou),
        "rms": float(fit.rms),
        "names": list(fit.names),
        "std": fit.std.astype(float).tolist(),
        "covariance": fit.covariance.astype(float).ravel().tolist(),
        "weak": list(fit.weak),
        "modes": len(fit.modes),
        "steps": [int(n) for n in fit.steps],
    }
    if fit.status == "non_finite":
        return row
    centres = asked(record, "pixel_centres")
    K, R, t = pj.formats.to_opencv(fit.camera, pixel_centres=centres)
    plain = pj.io.fit_to_dict(fit._replace(history=()), pixel_centres=centres)
    return row | {
        **{name: plain[name] for name in ("e", "p", "u", "phi", "W", "H")},
        **{name: x.ravel().tolist() for name, x in (("K", K), ("R", R), ("t", t))},
        "lens": json.dumps(plain["lens"]),
        "fit": json.dumps(plain),
    }
