"""Records of data sets on disk: BOP's, a table of paths, a folder of masks."""

import contextlib
import csv
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from reprlib import repr as brief
from typing import Any

from .._files.paths import FilePath, read_json
from .records import FIELDS, PATHS, PICTURES, Record, files_of, plain_record

#: The endings of meshes and tables.
MESHES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
TABLES = (".csv", ".jsonl")
#: The most bytes of a JSON file: a challenge's detections.
MOST_BYTES = 1 << 31
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
    path: FilePath,
    *,
    start: bool = False,
    models: FilePath | None = None,
    detections: FilePath | None = None,
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
            shapes = _models(place, models)
            kind, records = "BOP", partial(_bop_records, scenes, shapes, detections, start)
    elif place.suffix.lower() not in TABLES:
        words = f"expected a folder or one of {', '.join(TABLES)}, got {str(path)!r}"
        raise ValueError(f"`path`: {words}")
    defaults = {name: value for name, value in fields.items() if value is not None}
    return Dataset(kind, lambda: (_with_defaults(defaults, record) for record in records()))


def _with_defaults(fields: dict[str, Any], record: Record) -> Record:
    """Return a record with defaults for its missing fields; a camera of its own stays whole."""
    cameras, known = {"K", "fov", "camera"}, plain_record(record)
    own = cameras | {"pixel_centres", "dist", "start"} if cameras & known.keys() else set()
    return {**{name: value for name, value in fields.items() if name not in own}, **known}


def _models(place: Path, models: FilePath | None) -> Path:
    above = place.resolve().parents[:2]
    places = [Path(models)] if models else [folder / name for folder in above for name in MODELS]
    for folder in filter(Path.is_dir, places):
        return folder
    words = f"got {str(models)!r}" if models else f"as there is no {' or '.join(MODELS)} beside it"
    raise ValueError(f"`models`: expected the folder of the models of {str(place)!r}, {words}")


def _bop_records(
    scenes: list[Path], models: Path, detections: FilePath | None, start: bool
) -> Iterator[Record]:
    from .._files.fields import Fields, read_fields  # load NumPy, which counts the cores

    found = {} if detections is None else _detections(detections)
    names = [scene.name for scene in scenes]
    if found and found.keys().isdisjoint(name.zfill(6) for name in names):
        words = f"expected `scene_id` among the folders of `path`, {brief(names)}"
        raise ValueError(f"`detections`: {words}, got {brief([*found])} in {str(detections)!r}")
    for scene in scenes:
        cameras = read_fields(scene / CAMERAS, "a scene's cameras", MOST_BYTES)
        if detections is None:
            labels = read_fields(scene / "scene_gt.json", "a scene's labels", MOST_BYTES)
        else:
            labels = Fields(found.get(scene.name.zfill(6), {}), repr(str(detections)))
        for image in labels.data:
            K = cameras.part(image).data.get("cam_K")
            for number, label in enumerate(labels.parts(image)):
                object_ = label.integer("obj_id", 0)
                mask = scene / "mask_visib" / f"{image:0>6}_{number:06d}.png"
                yield {
                    "id": f"{scene.parent.name}/{scene.name}/{image}/{object_}/{number}",
                    "mesh": str(models / f"obj_{object_:06d}.ply"),
                    "mask": str(mask) if detections is None else label.data["segmentation"],
                    "K": K,
                    "start": _pose(label) if start and detections is None else None,
                }


def _pose(label: Any) -> list[Any]:
    """Return the labelled pose of an object, 4 x 4."""
    import numpy as np  # counts the cores

    R, t = label.array("cam_R_m2c", (9,)).reshape(3, 3), label.array("cam_t_m2c", (3,))
    return [*np.c_[R, t].tolist(), [0, 0, 0, 1]]


def _detections(path: FilePath) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Return COCO's detections as BOP labels objects: by scene (six digits) and image."""
    from .._files.fields import Fields

    found: dict[str, Any] = {}
    data = {"detections": read_json(path, "detections", MOST_BYTES)}
    for one in Fields(data, repr(str(path))).parts("detections"):
        scene, image, number = (
            one.integer(name, 0) for name in ("scene_id", "image_id", "category_id")
        )
        label = {"obj_id": number, "segmentation": one.data.get("segmentation")}
        found.setdefault(f"{scene:06d}", {}).setdefault(str(image), []).append(label)
    return found


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
                yield from csv.DictReader(stream, restkey="a cell too many", restval="")
                return
            for text in stream:
                line += 1
                if text.strip():
                    yield {**json.loads(text)}
        except (TypeError, ValueError, RecursionError, csv.Error) as error:
            kind = "a CSV" if is_csv else f"a JSON object in line {line}"
            raise ValueError(f"`path`: expected {kind} of {str(path)!r}: {error}") from None


def _cell_value(name: str, cell: Any) -> Any:
    """Return the value of a CSV's cell: JSON where it is JSON and the field no text."""
    if name != "id" and (name not in PATHS or cell[0] in "{["):
        with contextlib.suppress(AttributeError, RecursionError, ValueError):
            return json.loads(cell.lower() if cell.lower() in ("true", "false") else cell)
    return cell


def _folder_records(place: Path) -> Iterator[Record]:
    meshes = sorted(f for f in place.iterdir() if f.suffix.lower() in MESHES)
    if len(meshes) != 1:
        words = f"got {len(meshes)} meshes and no {CAMERAS} in {str(place)!r}"
        raise ValueError(f"`path`: expected BOP's split, or a folder with one mesh, {words}")
    camera = place / "camera.json"
    known = str(camera) if camera.is_file() else None
    masks = place / "masks" if (place / "masks").is_dir() else place
    for file in sorted(f for f in masks.iterdir() if f.suffix.lower() in PICTURES):
        id = file.relative_to(place).as_posix()
        yield {"id": id, "mesh": str(meshes[0]), "mask": str(file), "camera": known}
