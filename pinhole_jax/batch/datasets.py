"""Records of data sets on disk: BOP's, a table of paths, a folder of masks."""

import contextlib
import csv
import json
import os
from collections.abc import Callable, Iterator
from functools import partial
from operator import index
from pathlib import Path
from reprlib import repr as brief
from typing import Any

from .records import FIELDS, PATHS, PICTURES, Record, files_of

#: The endings of meshes and tables.
MESHES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
TABLES = (".csv", ".jsonl")
#: The file of a BOP scene's cameras, and the folders of its models, beside the splits.
CAMERAS, MODELS = "scene_camera.json", ("models", "models_eval", "models_cad")


class Dataset:
    """Records, read anew at each iteration: none stays in memory.

    ```python
    [record["id"] for record in data]
    ```
    """

    kind: str

    def __init__(self, kind: str, records: Callable[[], Iterator[Record]]):
        self.kind, self._records = kind, records

    def __iter__(self) -> Iterator[Record]:
        return self._records()

    def __repr__(self) -> str:
        return f"<Dataset: {self.kind}>"


def read_dataset(
    path: str | os.PathLike[str],
    *,
    start: bool = False,
    models: str | os.PathLike[str] | None = None,
    detections: str | os.PathLike[str] | None = None,
    **fields: object,
) -> Dataset:
    """Return the records of a data set.

    - BOP: the folder of a split, or of one scene: `scene_camera.json`, `scene_gt.json` (the object
      of each mask; with `start` also its starting pose), `mask_visib`. `models` is the folder of
      obj_000001.ply and so on (None: beside the split). `detections` is a JSON of COCO's, as in
      BOP's segmentation challenge (with `scene_id`), whose masks replace `mask_visib`. Ids are
      split/scene/image/object/number.
    - A table (.csv, .jsonl): a record a row; paths are relative to it. A CSV's K, dist, start, crop
      and resize are numbers between blanks.
    - A folder: one mesh, masks (those in `masks`, if there is such a folder), and the camera in
      `camera.json` or in `fields`. An id is a mask's path.

    `fields` are defaults for all records: `free`, `K`, `fov`, ...

    Raises FileNotFoundError, or ValueError for other files and folders.

    ```python
    data = pj.batch.read_dataset("data.csv", free="pose,phi")
    list(data)
    ```
    """
    if unknown := [name for name in fields if name not in FIELDS]:
        raise ValueError(f"`{unknown[0]}`: expected fields among {', '.join(FIELDS)}")
    place = Path(path)
    if not place.exists():
        raise FileNotFoundError(f"`path`: expected a data set, got {str(path)!r}: no such file")
    kind, records = "table", partial(_table_records, place)
    if place.is_dir():
        inside = [place.resolve(), *sorted(place.resolve().iterdir())]
        kind, records = "folder", partial(_folder_records, place)
        if scenes := [folder for folder in inside if (folder / CAMERAS).is_file()]:
            found = None if detections is None else _detections(Path(detections), scenes)
            shapes = _models(place, models)
            kind, records = "BOP", partial(_bop_records, scenes, shapes, found, start)
    elif place.suffix.lower() not in TABLES:
        words = f"expected a folder or one of {', '.join(TABLES)}, got {str(path)!r}"
        raise ValueError(f"`path`: {words}")
    defaults = {name: value for name, value in fields.items() if value is not None}
    return Dataset(kind, lambda: (_with_defaults(defaults, record) for record in records()))


def _with_defaults(fields: dict[str, Any], record: Record) -> Record:
    """Return a record with defaults for its missing fields; a camera of its own stays whole."""
    cameras = {"K", "fov", "camera"}
    own = cameras | {"pixel_centres", "dist", "start"} if cameras & record.keys() else set()
    return {**{name: value for name, value in fields.items() if name not in own}, **record}


def _models(place: Path, models: str | os.PathLike[str] | None) -> Path:
    above = place.resolve().parents[:2]
    places = [Path(models)] if models else [folder / name for folder in above for name in MODELS]
    if existing := [folder for folder in places if folder.is_dir()]:
        return existing[0]
    words = f"got {str(models)!r}" if models else f"as there is no {' or '.join(MODELS)} beside it"
    raise ValueError(f"`models`: expected the folder of the models of {str(place)!r}, {words}")


#: The objects of each scene's images, as BOP labels them; those detected have a `segmentation`.
_Labels = dict[int, dict[str, list[dict[str, Any]]]]


def _bop_records(
    scenes: list[Path], models: Path, detections: _Labels | None, start: bool
) -> Iterator[Record]:
    needed = "objects with `obj_id`" + ", `cam_R_m2c` and `cam_t_m2c` to start from" * start
    for scene in scenes:
        file, cameras = scene / "scene_gt.json", _json(scene / CAMERAS, "path", dict)
        if detections is None:
            labels = _json(file, "path", dict)
        else:
            labels = detections.get(_number(scene), {})
        for image, objects in labels.items():
            words = f"`path`: expected a camera in {str(scene / CAMERAS)!r}, image {image!r}"
            with _expecting(words, cameras.get(image)):
                K = cameras.get(image, {}).get("cam_K")
            with _expecting(
                f"`path`: expected {needed} in {str(file)!r}, image {image!r}", objects
            ):
                stem = f"{int(image):06d}"
                fields = [_object_fields(label, start) for label in objects]
            for number, (object_, own) in enumerate(fields):
                yield {
                    "id": f"{scene.parent.name}/{scene.name}/{image}/{object_}/{number}",
                    "mesh": str(models / f"obj_{object_:06d}.ply"),
                    "mask": str(scene / "mask_visib" / f"{stem}_{number:06d}.png"),
                    **({} if K is None else {"K": K}),
                    **own,
                }


def _number(scene: Path) -> int:
    """Return the number of a scene's folder, -1 for another name."""
    return int(scene.name) if scene.name.isdecimal() else -1


def _object_fields(label: dict[str, Any], start: bool) -> tuple[int, dict[str, Any]]:
    """Return a labelled object's number, and its mask and pose as a record has them."""
    fields = {"mask": label["segmentation"]} if "segmentation" in label else {}
    if start and not fields:
        R, t = label["cam_R_m2c"], label["cam_t_m2c"]
        rows = [[*R[3 * k : 3 * k + 3], t[k]] for k in range(3)]
        fields["start"] = [*rows, [0, 0, 0, 1]]
    return index(label["obj_id"]), fields


def _detections(path: Path, scenes: list[Path]) -> _Labels:
    """Return COCO's detections as labels."""
    found: _Labels = {}
    words = "`detections`: expected objects with `scene_id`, `image_id` and `category_id`"
    for place, detection in enumerate(_json(path, "detections", list)):
        with _expecting(f"{words} in number {place} of {str(path)!r}", detection):
            scene, image, object_ = (
                index(detection[name]) for name in ("scene_id", "image_id", "category_id")
            )
            label = {"obj_id": object_, "segmentation": detection.get("segmentation")}
        found.setdefault(scene, {}).setdefault(str(image), []).append(label)
    if found and not found.keys() & {*map(_number, scenes)}:
        known = brief([scene.name for scene in scenes])
        words = f"expected `scene_id` among the folders of `path`, {known}"
        raise ValueError(f"`detections`: {words}, got {brief([*found])} in {str(path)!r}")
    return found


def _json(path: Path, field: str, kind: Any) -> Any:
    """Return the data of a JSON file, of the expected type."""
    try:
        data = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise FileNotFoundError(f"`{field}`: expected a file, got {str(path)!r}: none") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"`{field}`: expected JSON, got {str(path)!r}: {error}") from None
    if not isinstance(data, kind):
        words = f"expected a JSON {'list' if kind is list else 'object'} in {str(path)!r}"
        raise ValueError(f"`{field}`: {words}, got {brief(data)}")
    return data


@contextlib.contextmanager
def _expecting(words: str, value: Any) -> Iterator[None]:
    """Raise ValueError with these words where a value has not what its reader takes from it."""
    try:
        yield
    except (AttributeError, LookupError, TypeError, ValueError):
        raise ValueError(f"{words}, got {brief(value)}") from None


def _table_records(path: Path) -> Iterator[Record]:
    is_csv = path.suffix.lower() == ".csv"
    for number, row in enumerate(_rows(path, is_csv), 1):
        record = {n: _cell_value(n, x) if is_csv else x for n, x in row.items() if x != ""}
        record["id"] = str(number if record.get("id") is None else record["id"])
        for name, value in files_of(record).items():
            record[name] = str(path.parent / value)
        yield record


def _rows(path: Path, is_csv: bool) -> Iterator[dict[str, Any]]:
    """Yield the objects of a table's lines, or raise ValueError that names file and line."""
    line = 0
    with open(path, encoding="utf-8-sig", newline="") as stream:
        try:
            if is_csv:
                yield from csv.DictReader(stream)
                return
            for text in stream:
                line += 1
                if text.strip():
                    yield {**json.loads(text)}
        except (TypeError, ValueError, RecursionError, csv.Error) as error:
            kind = "a CSV" if is_csv else f"a JSON object in line {line}"
            raise ValueError(f"`path`: expected {kind} of {str(path)!r}: {error}") from None


def _cell_value(name: str, cell: str) -> Any:
    """Return the value of a CSV's cell: JSON where it is JSON and the field no text."""
    if name != "id" and (name not in PATHS or cell[0] in "{["):
        with contextlib.suppress(TypeError, ValueError):
            return json.loads(cell.lower() if cell.lower() in ("true", "false") else cell)
    return cell


def _folder_records(place: Path) -> Iterator[Record]:
    meshes = sorted(f for f in place.iterdir() if f.suffix.lower() in MESHES)
    if len(meshes) != 1:
        words = f"got {len(meshes)} meshes and no {CAMERAS} in {str(place)!r}"
        raise ValueError(f"`path`: expected BOP's split, or a folder with one mesh, {words}")
    camera = place / "camera.json"
    known = {"camera": str(camera)} if camera.is_file() else {}
    masks = place / "masks" if (place / "masks").is_dir() else place
    for file in sorted(f for f in masks.iterdir() if f.suffix.lower() in PICTURES):
        id = file.relative_to(place).as_posix()
        yield {"id": id, "mesh": str(meshes[0]), "mask": str(file), **known}
