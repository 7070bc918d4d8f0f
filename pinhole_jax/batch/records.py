"""A record: all that one fit of many needs, as plain values that fit into a line of a file."""

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any

#: A record as users write it: names of `FIELDS`, and values that JSON can hold.
Record = Mapping[str, Any]

#: The fields of a record. `id`, `mesh` and `mask` are needed, all else is not.
FIELDS = {
    "id": "a text that no other record of the batch has",
    "mesh": "path of the mesh",
    "mask": "path of the mask, or COCO's run lengths: size [H, W] and counts",
    "K": "intrinsics, px: fx fy cx cy, the 3 x 3 matrix by rows, or the path of a calibration",
    "dist": "OpenCV's k1 k2 p1 p2 k3 k4 k5 k6, with K",
    "pixel_centres": 'what K counts from: "integer" (OpenCV, the default) or "half"',
    "fov": "vertical field of view in degrees, in place of K",
    "camera": "path of a camera's file to start from, in place of K",
    "start": "object's pose to start from, with K: camera_from_object, 4 x 4, OpenCV's axes",
    "crop": "left top W H: the mask shows this window (px) of the picture of K or camera",
    "resize": "W H: the mask had this size (px; with crop: after it) before it was resized",
    "free": 'what to fit (default: "pose")',
    "mask_from": "how to read the mask, as `io.load_mask` has it",
    "invert": "true: what the mask covers is the background",
    "tidy": "share of the object below which crumbs and holes go (default 1e-3); true: 5e-3",
    "weight": "path of a grey image: how much each pixel counts",
    "photo": "path of the photo, to refine the camera on",
    "outlier_px": "as in `fit_camera`; null: none",
    "max_steps": "as in `fit_camera`",
    "prior": "as in `fit_camera`",
    "bounds": "as in `fit_camera`",
}
#: Fields that name files.
PATHS = ("mesh", "mask", "K", "camera", "weight", "photo")
#: Endings of pictures.
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".pgm", ".ppm")
#: Nobody models parts below this share of an object: they are crumbs and pinholes.
SPECK = 1e-3
#: Values of the fields that a record leaves out.
DEFAULTS: dict[str, Any] = {
    "free": "pose",
    "pixel_centres": "integer",
    "invert": False,
    "tidy": SPECK,
}
#: The types of fields that nothing else checks.
TYPES: dict[str, Any] = {"invert": bool, "tidy": bool | float}


def check_record(record: Record) -> dict[str, Any]:
    """Return a record with an `id` as a dict of plain values, with paths as texts.

    Raises ValueError naming the field that is missing, unknown, or not what it should be.
    """
    if unknown := [name for name in record if name not in FIELDS]:
        known = ", ".join(FIELDS)
        raise ValueError(f"`item`: expected fields among {known}, got {unknown[0]!r}")
    plain = plain_record(record)
    if missing := {"mesh", "mask"} - plain.keys():
        raise ValueError(f"`item`: expected `mesh` and `mask`, got no {' and no '.join(missing)}")
    for name, kind in TYPES.items():
        if not isinstance(plain.get(name, False), kind):
            raise ValueError(f"`{name}`: expected true or false, got {plain[name]!r}")
    try:
        json.dumps(plain, allow_nan=False)
    except ValueError as error:
        raise ValueError(f"`item`: expected what JSON can hold, got {error}") from None
    return plain


def check_id(record: Any, name: str = "record") -> None:
    """Raise ValueError unless this is a mapping with an `id`, which is what a row needs."""
    if not isinstance(record, Mapping):
        raise ValueError(f"`{name}`: expected a mapping of fields, got {type(record).__name__}")
    if not isinstance(record.get("id"), str) or not record["id"]:
        raise ValueError(f"`id`: expected a text, got {record.get('id')!r}")


def plain_record(record: Record) -> dict[str, Any]:
    """Return a record as JSON has it: paths are texts, arrays lists, missing values left out."""
    plain = json.loads(json.dumps(dict(record), default=_plain, skipkeys=True))
    # (As null, `outlier_px` means something.)
    return {name: x for name, x in plain.items() if x is not None or name == "outlier_px"}


def _plain(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return dict(value)
    # (A value of any other kind means nothing, but the row shows it.)
    return value.tolist() if hasattr(value, "tolist") else repr(value)


def shard_of(id: str, count: int) -> int:
    """Return the shard (0, 1, ...) of a record, one of this many: its id alone says so, anywhere.

    ```python
    [record["id"] for record in records if pj.batch.shard_of(record["id"], 2) == 0]
    ```
    """
    # (A file's name need be no text.)
    return int.from_bytes(hashlib.sha256(id.encode(errors="surrogatepass")).digest()[:8]) % count


def setting(record: Record, name: str) -> Any:
    """Return a field's value, or its default."""
    return record.get(name, DEFAULTS[name])


def files_of(record: Record) -> dict[str, str]:
    """Return the paths in a record, by field: texts, but for those that hold numbers."""
    texts = {name: record[name] for name in PATHS if isinstance(record.get(name), str)}
    return {name: path for name, path in texts.items() if name != "K" or not has_numbers(path)}


def has_numbers(text: str) -> bool:
    """Return True for numbers between blanks or commas."""
    try:
        return bool([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        return False


def settings_of(record: Record) -> dict[str, str]:
    """Return the fields of a plain record that change its fit, but for its id and its paths, as
    JSON."""
    others = {"id", *files_of(record)}
    changed = {n: x for n, x in record.items() if n not in others and x != DEFAULTS.get(n, ...)}
    return {name: json.dumps(x, sort_keys=True) for name, x in changed.items()}


def digest_of(record: Record) -> str:
    """Return a digest of a record's fields, but for its id, and of the contents of its files."""
    rest = {name: value for name, value in record.items() if name != "id"}
    digest = hashlib.sha256(json.dumps(rest, sort_keys=True).encode())
    for path in files_of(record).values():
        try:
            with open(path, "rb") as stream:
                digest.update(hashlib.file_digest(stream, "sha256").digest())
        except OSError:
            digest.update(bytes(32))
    return digest.hexdigest()
