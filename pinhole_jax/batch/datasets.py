"""Records of data sets as they lie on disk: BOP's, a table of paths, a folder of masks."""

import contextlib
import csv
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from reprlib import repr as brief
from typing import Any

from .._files.naming import named
from .._files.paths import (
    existing,
    is_folder,
    parse_json,
    path_of,
    read_bytes,
    read_json,
    text_of,
)
from .records import FIELDS, MAY_BE_NONE, PATHS, Record

#: The endings of meshes, masks and tables.
MESHES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
MASKS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".pgm")
TABLES = (".csv", ".jsonl", ".parquet")
#: Where BOP keeps its models, beside the splits.
MODELS = ("models", "models_eval", "models_cad")
#: What Python and spreadsheets write of JSON's words.
WORDS = {"True": "true", "False": "false", "TRUE": "true", "FALSE": "false", "None": "null"}
#: A table may be large.
MOST_BYTES = 1 << 32


class Dataset:
    """Records that are read anew each time they are gone through: none stays in memory.

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

    - BOP: the folder of a split, or of one scene: `scene_camera.json`, `scene_gt.json` (which
      object each mask shows; with `start` also where to start), `mask_visib`. `models` is the
      folder of obj_000001.ply and so on (None: beside the split). `detections`: a JSON of COCO's,
      as BOP's segmentation challenge has them (with `scene_id`), whose masks take the place of
      `mask_visib`. Ids are split/scene/image/object/number.
    - A table (.csv, .jsonl, .parquet): a record a row; paths are relative to it. A CSV's K, dist
      and start are numbers between blanks.
    - A folder: one mesh, masks (those in `masks`, if there is one), and a camera's file
      `camera.json` or what `fields` say. An id is a mask's path.

    `fields` stand in records that have none of their own: `free`, `K`, `fov`, ...

    Raises FileNotFoundError, or ValueError for what is none of these.

    ```python
    data = pj.batch.read_dataset("data.csv", free="pose,phi")
    list(data)
    ```
    """
    if unknown := [name for name in fields if name not in FIELDS]:
        raise ValueError(f"`{unknown[0]}`: expected fields among {', '.join(FIELDS)}")
    place = path_of(path)
    rest = {name: value for name, value in fields.items() if value is not None}
    if not is_folder(place):
        existing(place, "a data set", MOST_BYTES)
        if place.suffix.lower() not in TABLES:
            words = f"expected a folder or one of {', '.join(TABLES)}, got {str(path)!r}"
            raise ValueError(f"`path`: {words}")
        return Dataset("table", lambda: _with(rest, _of_table(place)))
    scenes = _scenes(place)
    if scenes:
        shapes = _models(place, models)
        seen = None if detections is None else _detected(detections, scenes)
        return Dataset("BOP", lambda: _with(rest, _of_bop(scenes, shapes, seen, start)))
    return Dataset("folder", lambda: _with(rest, _of_folder(place)))


def _with(fields: dict[str, Any], records: Iterator[Record]) -> Iterator[Record]:
    """Yield records with what they do not say themselves of the camera, and of all else."""
    ways = {"K", "fov", "camera"}
    of_way = {*ways, "pixel_centres", "dist", "start"}
    for record in records:
        own = ways & record.keys()
        yield {**{n: v for n, v in fields.items() if not (own and n in of_way)}, **record}


def _scenes(place: Path) -> list[Path]:
    """Return the folders of BOP's scenes at a path, itself or those in it."""
    if (place / "scene_camera.json").is_file():
        return [place.resolve()]
    return sorted(f for f in place.resolve().iterdir() if (f / "scene_camera.json").is_file())


def _models(place: Path, models: str | os.PathLike[str] | None) -> Path:
    if models is not None:
        if not is_folder(models):
            raise ValueError(f"`models`: expected a folder, got {str(models)!r}")
        return path_of(models)
    above = place.resolve().parents[:2]
    found = [folder / name for folder in above for name in MODELS if (folder / name).is_dir()]
    if not found:
        raise ValueError(
            f"`models`: expected the folder of the models, as there is no {' or '.join(MODELS)}"
            f" beside {str(place)!r}"
        )
    return found[0]


def _of_bop(
    scenes: list[Path], models: Path, detections: dict[Path, list[Any]] | None, start: bool
) -> Iterator[Record]:
    for scene in scenes:
        cameras = _by_image(scene / "scene_camera.json", "BOP's cameras")
        if detections is None:
            found = _labelled(scene, _by_image(scene / "scene_gt.json", "BOP's objects"), start)
        else:
            found = _segmented(detections.get(scene, []))
        for image, number, object_, fields in found:
            id = f"{scene.parent.name}/{scene.name}/{image}/{object_}/{number}"
            camera = cameras.get(image)
            K = camera.get("cam_K") if isinstance(camera, dict) else None
            mesh = models / f"obj_{object_:06d}.ply"
            yield {"id": id, "mesh": str(mesh), **({} if K is None else {"K": K}), **fields}


def _by_image(path: Path, kind: str) -> dict[str, Any]:
    data = read_json(path, kind)
    if not isinstance(data, dict):
        raise ValueError(f"`path`: expected {kind} by image, got {str(path)!r}: {brief(data)}")
    return data


def _labelled(
    scene: Path, objects: dict[str, list[dict[str, Any]]], start: bool
) -> Iterator[tuple[str, int, int, dict[str, Any]]]:
    """Yield the image, the number in it, the object, and the mask of each that BOP has labelled."""
    for image, poses in objects.items():
        place = f"`path`: {scene / 'scene_gt.json'}, image {image!r}"
        file = _whole(image, f"{place}: expected the image's number")
        for number, pose in enumerate(_items(poses, place)):
            object_ = _whole(pose.get("obj_id"), f"{place}: expected `obj_id`, a number")
            fields: dict[str, Any] = {
                "mask": str(scene / "mask_visib" / f"{file:06d}_{number:06d}.png")
            }
            if start:
                R, t = pose.get("cam_R_m2c"), pose.get("cam_t_m2c")
                if not (isinstance(R, list) and isinstance(t, list) and (len(R), len(t)) == (9, 3)):
                    raise ValueError(f"{place}: expected `cam_R_m2c` and `cam_t_m2c` to start from")
                rows = [[*R[3 * k : 3 * k + 3], t[k]] for k in range(3)]
                fields["start"] = [*rows, [0, 0, 0, 1]]
            yield image, number, object_, fields


def _detected(path: str | os.PathLike[str], scenes: list[Path]) -> dict[Path, list[Any]]:
    """Return COCO's detections by the folder of their scene."""
    with named(path="detections"):
        text = text_of(read_bytes(path, "COCO's detections", MOST_BYTES), path, "JSON")
        data = parse_json(text, path)
    if isinstance(data, dict) and "annotations" in data:
        words = "expected a list of detections, as BOP's segmentation challenge has them"
        raise ValueError(f"`detections`: {words}, got COCO's annotations of its own images")
    folders = {int(scene.name): scene for scene in scenes if scene.name.isdecimal()}
    if others := [scene.name for scene in scenes if not scene.name.isdecimal()]:
        words = "expected scenes' folders named by the `scene_id` of `detections`, as 000001"
        raise ValueError(f"`path`: {words}, got {others[0]!r}")
    found: dict[Path, list[Any]] = {}
    for number, one in enumerate(_items(data, "`detections`")):
        words = f"`detections`: expected `scene_id`, the number of a BOP scene, in number {number}"
        scene = _whole(one.get("scene_id"), words)
        if scene in folders:
            found.setdefault(folders[scene], []).append(one)
    return found


def _segmented(found: list[Any]) -> Iterator[tuple[str, int, int, dict[str, Any]]]:
    """Yield the image, the number in it, the object, and the mask of each detection."""
    numbers: dict[int, int] = {}
    for one in found:
        image, object_ = (
            _whole(one.get(name), f"`detections`: expected `{name}`, a number")
            for name in ("image_id", "category_id")
        )
        number = numbers[image] = numbers.get(image, -1) + 1
        yield str(image), number, object_, {"mask": one.get("segmentation")}


def _items(values: Any, place: str) -> list[dict[str, Any]]:
    """Return a list of JSON objects, or raise ValueError."""
    if not isinstance(values, list) or not all(isinstance(one, dict) for one in values):
        raise ValueError(f"{place}: expected a list of objects, got {brief(values)}")
    return values


def _whole(value: Any, words: str) -> int:
    """Return a whole number, also of a text; raise ValueError with some words for what is none."""
    with contextlib.suppress(TypeError, ValueError):
        if not isinstance(value, bool) and int(value) == float(value):
            return int(value)
    raise ValueError(f"{words}, got {value!r}")


def _of_table(path: Path) -> Iterator[Record]:
    for number, row in enumerate(_table_rows(path), 1):
        record = {n: x for n, x in row.items() if x not in (None, "") or n in MAY_BE_NONE}
        record["id"] = str(record.get("id", number))
        for name in PATHS:
            if isinstance(value := record.get(name), str):
                record[name] = str(path.parent / value)
        views = record.get("views")
        for view in views if isinstance(views, list) else ():
            if isinstance(view, dict) and isinstance(mask := view.get("mask"), str):
                view["mask"] = str(path.parent / mask)
        yield record


def _table_rows(path: Path) -> Iterator[dict[str, Any]]:
    ending = path.suffix.lower()
    if ending == ".parquet":
        try:
            from pyarrow import parquet
        except ModuleNotFoundError as error:
            words = "Parquet is read by pyarrow: pip install 'pinhole-jax[batch]'"
            raise ModuleNotFoundError(words, name=error.name) from error
        for batch in parquet.ParquetFile(path).iter_batches(1000):
            yield from batch.to_pylist()
        return
    with open(path, encoding="utf-8-sig", newline="") as stream:
        if ending == ".csv":
            yield from map(_of_cells, csv.DictReader(stream))
            return
        for number, line in enumerate(filter(str.strip, stream), 1):
            row = json.loads(line)
            if not isinstance(row, dict):
                raise ValueError(f"`path`: expected an object in line {number} of {path.name}")
            yield row


def _of_cells(cells: dict[str, Any]) -> dict[str, Any]:
    """Return a CSV's cells as a record's values: what JSON reads is that, but for texts."""
    row: dict[str, Any] = {}
    for name, cell in cells.items():
        row[name] = cell
        is_text = name == "id" or (name in PATHS and not str(cell).startswith("{"))
        if not is_text and isinstance(cell, str):
            with contextlib.suppress(ValueError):
                row[name] = json.loads(WORDS.get(cell, cell))
    return row


def _of_folder(place: Path) -> Iterator[Record]:
    meshes = sorted(f for f in place.iterdir() if f.suffix.lower() in MESHES)
    if len(meshes) != 1:
        words = f"got {len(meshes)} meshes and no scene_camera.json in {str(place)!r}"
        raise ValueError(f"`path`: expected BOP's split, or a folder with one mesh, {words}")
    camera = place / "camera.json"
    known = {"camera": str(camera)} if camera.is_file() else {}
    masks = place / "masks" if (place / "masks").is_dir() else place
    for file in sorted(f for f in masks.iterdir() if f.suffix.lower() in MASKS):
        yield {
            "id": file.relative_to(place).as_posix(),
            "mesh": str(meshes[0]),
            "mask": str(file),
            **known,
        }
