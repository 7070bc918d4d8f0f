"""`fit_one`: a record in, a row out."""

import json
import time
from typing import TYPE_CHECKING

import pinhole_jax as pj

from .._files.progress import NOTES, listening
from .records import Record, check_id, check_record, digest_of, plain_record, setting
from .rows import Row, empty_row

if TYPE_CHECKING:
    from .. import Camera, Fit


def fit_one(record: Record, last: "Camera | None" = None) -> Row:
    """Return the row (`batch.COLUMNS`) of a record (`batch.FIELDS`).

    `last`: the camera of the frame before, to start from if the record has none of its own.

    A wrong record or file makes a row whose status is "failed", never an exception, if the record
    is a mapping with an `id`. The row depends on nothing but the record, its files, `last`, and
    JAX's float type. Meshes are kept for the records that follow.

    Raises ValueError for a record without `id`.

    ```python
    row = pj.fit_one({"id": "a", "mesh": "part.obj", "mask": "mask.png", "camera": "camera.json"})
    row["status"], row["K"], row["R"], row["t"]
    ```
    """
    from .inputs import read_inputs  # loads NumPy, which counts the cores: see `worker`

    begin = time.perf_counter()
    check_id(record)
    notes: list[str] = []
    try:
        checked = check_record(record)
        with listening(notes.append, NOTES):
            inputs = read_inputs(checked)
        size = inputs["target"].shape
        if last is not None and inputs["camera"] is None and size == (last.H, last.W):
            lens = {name: inputs.pop(name) for name in ("phi", "lens")}
            inputs["camera"] = last.replace(**lens if "K" in checked else {})
        row = _row_of(checked, pj.fit_camera(**inputs), "; ".join(notes))
    except Exception as error:  # one bad record does not stop the others
        known = isinstance(error, ValueError | OSError | ModuleNotFoundError)
        words = str(error) if known else f"{type(error).__name__}: {error}"
        row = empty_row(record, "failed", words)
    return row | {"seconds": time.perf_counter() - begin}


def _row_of(record: Record, fit: "Fit", words: str) -> Row:
    """Return a fit as a row."""
    values = {name: getattr(fit, name) for name in ("iou", "rms", "names", "std", "weak", "steps")}
    values |= {"covariance": fit.covariance.ravel(), "modes": len(fit.modes)}
    if fit.status != "non_finite":
        centres = setting(record, "pixel_centres")
        plain = pj.io.fit_to_dict(fit._replace(history=()), pixel_centres=centres)
        pose = pj.formats.object_pose(fit, pixel_centres=centres)
        values |= {name: plain[name] for name in ("e", "p", "u", "phi", "W", "H")}
        values |= {name: getattr(pose, name).ravel() for name in "KRt"}
        values |= {"lens": json.dumps(plain["lens"]), "fit": json.dumps(plain)}
    values["hash"] = digest_of(record)
    return empty_row(record, fit.status, words) | plain_record(values)
