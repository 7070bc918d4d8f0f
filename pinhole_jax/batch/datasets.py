"""Records of data sets on disk: BOP's, a table of paths, a folder of masks."""

import contextlib
import csv
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from reprlib import repr as brief
from typing import Any

from .records import FIELDS, PATHS, PICTURES, Record, files_of

#: The endings of meshes and tables.
MESHES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
TABLES = (".csv", ".jsonl")
#: The folders of BOP's models, beside the splits.
MODELS = ("models", "models_eval", "models_cad")
#: JSON's words as Python and spreadsheets write them.
WORDS = {"True": "true", "False": "false", "TRUE": "true", "FALSE": "false", "None": "null"}


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
    rest = {name: value for name, value in fields.items() if value is not None}
    if not place.exists():
        raise FileNotFoundError(f"`path`: expected a data set, got {str(path)!r}: no such file")
    if not place.is_dir():
        if place.suffix.lower() not in TABLES:
            words = f"expected a folder or one of {', '.join(TABLES)}, got {str(path)!r}"
            raise ValueError(f"`path`: {words}")
        return Dataset("table", lambda: _with_defaults(rest, _table_records(place)))
    camera = "scene_camera.json"
    folders = [place.resolve(), *sorted(place.resolve().iterdir())]
    scenes = [folder for folder in folders if (folder / camera).is_file()]
    if not scenes:
        return Dataset("folder", lambda: _with_defaults(rest, _folder_records(place)))
    shapes = _models(place, models)
    seen = None if detections is None else _detections(Path(detections), scenes)
    return Dataset("BOP", lambda: _with_defaults(rest, _bop_records(scenes, shapes, seen, start)))


def _with_defaults(fields: dict[str, Any], records: Iterator[Record]) -> Iterator[Record]:
    """Yield records with defaults for their missing fields; a camera of their own stays whole."""
    cameras = {"K", "fov", "camera"}
    parts = {*cameras, "pixel_centres", "dist", "start"}
    for record in records:
        own = cameras & record.keys()
        yield {**{n: v for n, v in fields.items() if not (own and n in parts)}, **record}


def _models(place: Path, models: str | os.PathLike[str] | None) -> Path:
    above = place.resolve().parents[:2]
    places = [Path(models)] if models else [folder / name for folder in above for name in MODELS]
    if existing := [folder for folder in places if folder.is_dir()]:
        return existing[0]
    words = f"got {str(models)!r}" if models else f"as there is no {' or '.join(MODELS)} beside it"
    raise ValueError(f"`models`: expected the folder of the models of {str(place)!r}, {words}")


def _bop_records(
    scenes: list[Path], models: Path, detections: dict[int, list[Any]] | None, start: bool
) -> Iterator[Record]:
    for scene in scenes:
        cameras = _json(scene / "scene_camera.json", "`path`", dict)
        if detections is None:
            objects = _ground_truth(scene, start)
        else:
            objects = _scene_detections(detections.get(int(scene.name), []))
        for image, number, object_, fields in objects:
            camera = cameras.get(image, {})
            if not isinstance(camera, dict):
                place = f"{str(scene / 'scene_camera.json')!r}, image {image!r}"
                raise ValueError(f"`path`: {place}: expected an object, got {brief(camera)}")
            K = camera.get("cam_K")
            yield {
                "id": f"{scene.parent.name}/{scene.name}/{image}/{object_}/{number}",
                "mesh": str(models / f"obj_{object_:06d}.ply"),
                **({} if K is None else {"K": K}),
                **fields,
            }


#: An image, a number in it, an object, and the fields of its record.
_Objects = Iterator[tuple[str, int, int, dict[str, Any]]]


def _ground_truth(scene: Path, start: bool) -> _Objects:
    """Yield the objects that BOP has labelled in a scene."""
    file = scene / "scene_gt.json"
    for image, poses in _json(file, "`path`", dict).items():
        place = f"`path`: {str(file)!r}, image {image!r}"
        stem = _integer(image, f"{place}: expected the image's number")
        for number, pose in enumerate(_objects(poses, place)):
            mask = scene / "mask_visib" / f"{stem:06d}_{number:06d}.png"
            fields: dict[str, Any] = {"mask": str(mask)}
            if start:
                R, t = pose.get("cam_R_m2c"), pose.get("cam_t_m2c")
                if not (isinstance(R, list) and isinstance(t, list) and (len(R), len(t)) == (9, 3)):
                    raise ValueError(f"{place}: expected `cam_R_m2c` and `cam_t_m2c` to start from")
                rows = [[*R[3 * k : 3 * k + 3], t[k]] for k in range(3)]
                fields["start"] = [*rows, [0, 0, 0, 1]]
            object_ = _integer(pose.get("obj_id"), f"{place}: expected `obj_id`, a number")
            yield image, number, object_, fields


def _detections(path: Path, scenes: list[Path]) -> dict[int, list[Any]]:
    """Return COCO's detections by the number of their scene."""
    data = _json(path, "`detections`", (list, dict))
    if isinstance(data, dict) and "annotations" in data:
        words = "expected a list of detections, as BOP's segmentation challenge has them"
        raise ValueError(f"`detections`: {words}, got COCO's annotations of its own images")
    if others := [scene.name for scene in scenes if not scene.name.isdecimal()]:
        words = "expected scenes' folders named by the `scene_id` of `detections`, as 000001"
        raise ValueError(f"`path`: {words}, got {others[0]!r}")
    by_scene: dict[int, list[Any]] = {}
    for number, detection in enumerate(_objects(data, "`detections`")):
        words = f"`detections`: expected `scene_id`, the number of a BOP scene, in number {number}"
        by_scene.setdefault(_integer(detection.get("scene_id"), words), []).append(detection)
    numbers = [int(scene.name) for scene in scenes]
    if by_scene and not by_scene.keys() & {*numbers}:
        words = f"expected `scene_id` among {brief(numbers)}, the scenes of `path`"
        raise ValueError(f"`detections`: {words}, got {brief([*by_scene])} in {str(path)!r}")
    return by_scene


def _scene_detections(detections: list[dict[str, Any]]) -> _Objects:
    """Yield the objects detected in a scene."""
    numbers: dict[int, int] = {}
    for detection in detections:
        image, object_ = (
            _integer(detection.get(name), f"`detections`: expected `{name}`, a number")
            for name in ("image_id", "category_id")
        )
        number = numbers[image] = numbers.get(image, -1) + 1
        yield str(image), number, object_, {"mask": detection.get("segmentation")}


def _json(path: Path, name: str, kind: Any) -> Any:
    """Return the data of a JSON file, of the expected type."""
    try:
        data = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise FileNotFoundError(f"{name}: expected a file, got {str(path)!r}: none") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{name}: expected JSON, got {str(path)!r}: {error}") from None
    if not isinstance(data, kind):
        raise ValueError(f"{name}: expected objects, got {str(path)!r}: {brief(data)}")
    return data


def _objects(values: Any, place: str) -> list[dict[str, Any]]:
    """Return a list of JSON objects, or raise ValueError."""
    if not isinstance(values, list) or not all(isinstance(value, dict) for value in values):
        raise ValueError(f"{place}: expected a list of objects, got {brief(values)}")
    return values


def _integer(value: Any, words: str) -> int:
    """Return a whole number, also from a text; raise ValueError with `words` for anything else."""
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        if not isinstance(value, bool) and int(value) == float(value):
            return int(value)
    raise ValueError(f"{words}, got {value!r}")


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
                    row = json.loads(text)
                    if not isinstance(row, dict):
                        raise ValueError(f"got {brief(row)}")
                    yield row
        except (ValueError, RecursionError, csv.Error) as error:
            kind = "a CSV" if is_csv else f"a JSON object in line {line}"
            raise ValueError(f"`path`: expected {kind} of {str(path)!r}: {error}") from None


def _cell_value(name: str, cell: str) -> Any:
    """Return the value of a CSV's cell: JSON where it is JSON and the field no text."""
    if name != "id" and (name not in PATHS or cell[0] in "{["):
        with contextlib.suppress(TypeError, ValueError):
            return json.loads(WORDS.get(cell, cell))
    return cell


def _folder_records(place: Path) -> Iterator[Record]:
    meshes = sorted(f for f in place.iterdir() if f.suffix.lower() in MESHES)
    if len(meshes) != 1:
        words = f"got {len(meshes)} meshes and no scene_camera.json in {str(place)!r}"
        raise ValueError(f"`path`: expected BOP's split, or a folder with one mesh, {words}")
    camera = place / "camera.json"
    known = {"camera": str(camera)} if camera.is_file() else {}
    masks = place / "masks" if (place / "masks").is_dir() else place
    for file in sorted(f for f in masks.iterdir() if f.suffix.lower() in PICTURES):
        id = file.relative_to(place).as_posix()
        yield {"id": id, "mesh": str(meshes[0]), "mask": str(file), **known}
