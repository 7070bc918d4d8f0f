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
    "K": "intrinsics, px: fx fy cx cy, or the 3 x 3 matrix in nine numbers or three rows",
    "dist": "OpenCV's k1 k2 p1 p2 k3 k4 k5 k6, beside K",
    "pixel_centres": 'what K counts from: "integer" (OpenCV, the default) or "half"',
    "fov": "vertical field of view in degrees, in place of K",
    "camera": "path of a camera's file to start from, in place of K",
    "start": "object's pose to start from, beside K: camera_from_object, 4 x 4, OpenCV's axes",
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
PATHS = ("mesh", "mask", "camera", "weight", "photo")
#: (Crumbs and pinholes below this share of the object are no parts that anybody models.)
SPECK = 1e-3
#: The values of fields that a record does not have.
DEFAULTS: dict[str, Any] = {
    "free": "pose",
    "pixel_centres": "integer",
    "invert": False,
    "tidy": SPECK,
}


def check_record(record: Any) -> dict[str, Any]:
    """Return a record as a dict of plain values, with paths as texts.

    Raises ValueError naming the field that is missing, unknown, or not what it should be.
    """
    check_id(record)
    if unknown := [name for name in record if name not in FIELDS]:
        known = ", ".join(FIELDS)
        raise ValueError(f"`item`: expected fields among {known}, got {unknown[0]!r}")
    plain = {n: x for n, x in plain_record(record).items() if _counts(n, x)}
    if missing := {"mesh", "mask"} - plain.keys():
        raise ValueError(f"`item`: expected `mesh` and `mask`, got no {' and no '.join(missing)}")
    for name in {"invert", "tidy"} & plain.keys():
        share = name == "tidy" and isinstance(plain[name], float)  # below which specks go
        if not (isinstance(plain[name], bool) or share):
            raise ValueError(f"`{name}`: expected true or false, got {plain[name]!r}")
    try:
        json.dumps(plain, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`item`: expected what JSON can hold, got {error}") from None
    return plain


def _counts(name: str, value: Any) -> bool:
    """Return False for a field that is as good as missing; `outlier_px` means something as null."""
    return value is not None or name == "outlier_px"


def plain_record(record: Record) -> dict[str, Any]:
    """Return a record as a dict without what JSON has not: paths are texts, arrays lists."""
    return {str(name): _plain(value) for name, value in record.items()}


def check_id(record: Any) -> None:
    """Raise ValueError unless this is a mapping with an `id`, which is what a row needs."""
    if not isinstance(record, Mapping):
        raise ValueError(f"`item`: expected a mapping of fields, got {type(record).__name__}")
    if not isinstance(record.get("id"), str) or not record["id"]:
        raise ValueError(f"`id`: expected a text, got {record.get('id')!r}")


def _plain(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return plain_record(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    # (Of any other kind it has no meaning, but is told as it was given.)
    return value if isinstance(value, str | int | float | None) else repr(value)


def shard_of(id: str, count: int) -> int:
    """Return the shard (0, 1, ...) of a record, one of this many: its id alone says so, anywhere.

    ```python
    [record["id"] for record in records if pj.batch.shard_of(record["id"], 2) == 0]
    ```
    """
    # (A file's name need be no text.)
    return int.from_bytes(hashlib.sha256(id.encode(errors="surrogatepass")).digest()[:8]) % count


def asked(record: Record, name: str) -> Any:
    """Return what a record says in one of the fields that have a default."""
    return record.get(name, DEFAULTS[name])


def settings_of(record: Record) -> dict[str, Any]:
    """Return what a plain record asks for, beside its id and where its files are."""
    return {
        name: value
        for name, value in record.items()
        if name != "id"
        and not (name in PATHS and isinstance(value, str))
        and _counts(name, value)
        and value != DEFAULTS.get(name, ...)
    }


def digest_of(record: Record) -> str:
    """Return a digest of a record's fields, but for its id, and of the contents of its files."""
    rest = {name: value for name, value in record.items() if name != "id"}
    digest = hashlib.sha256(json.dumps(rest, sort_keys=True).encode())
    for name in PATHS:
        if isinstance(path := record.get(name), str):
            try:
                with open(path, "rb") as stream:
                    digest.update(hashlib.file_digest(stream, "sha256").digest())
            except OSError:
                digest.update(bytes(32))
    return digest.hexdigest()
