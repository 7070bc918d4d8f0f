"""Tables of all rows, as JSON lines or CSV; a row's fit."""

import csv
import json
import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pinhole_jax as pj

from .._files.paths import FilePath
from ..names import STATUSES
from .parts import Results, write_lines
from .rows import NO_FIT, Row, line_of

#: A CSV's first columns, and those for numbers in a row's lists: the list and the place in it.
FIRST = ("id", "status", "iou", "rms")
NUMBERS = {
    **{name: ("K", k) for name, k in {"fx": 0, "fy": 4, "cx": 2, "cy": 5}.items()},
    **{f"R{k // 3 + 1}{k % 3 + 1}": ("R", k) for k in range(9)},
    **{f"t{axis}": ("t", k) for k, axis in enumerate("xyz")},
}
#: An id of a BOP data set ends with a scene, an image, an object and a number.
BOP = re.compile(r"(.*/)?\d+/\d+/\d+/\d+")
#: The first words of parameters in rad.
ANGLES = ("rotation", "phi")


def merge(results: Results, path: FilePath) -> int:
    """Write all rows, sorted by id, as one table; return their number.

    - .jsonl: a line of JSON for each row.
    - .csv: BOP's results (scene_id,im_id,obj_id,score,R,t,time) if all ids come from a BOP data
      set: the rows with a camera; the score is the IoU, lengths are in the models' unit (mm). For
      other data a line for every row: id, status, iou, rms, fx, fy, cx, cy, R11 to R33, tx, ty, tz
      (from the row's `K`, `R` and `t`), standard errors (sigma_) and words: in px, in the mesh's
      unit and in rad. The most trustworthy rows come first: by status, then by the standard
      errors of the rotation.

    Raises ValueError for other endings, and for a file that cannot be written.

    ```python
    pj.batch.merge(results, "table.jsonl")
    ```
    """
    ending = Path(path).suffix.lower()
    if ending not in (".jsonl", ".csv"):
        raise ValueError(f"`path`: expected .jsonl or .csv, got {str(path)!r}")
    if ending == ".jsonl":
        return write_lines(path, map(line_of, results))
    ids = results.ids()
    table = _bop_table if ids and all(map(BOP.fullmatch, ids)) else _flat_table
    as_text: Any = SimpleNamespace(write=str)  # a writer's lines are what this returns
    line = csv.writer(as_text, lineterminator="").writerow
    return write_lines(path, map(line, table(results))) - 1


def _flat_table(results: Results) -> Iterator[list[Any]]:
    sigmas = [*dict.fromkeys(name for row in results for name in row["names"] or ())]
    names = [*NUMBERS, *(f"sigma_{name}{'_rad' * name.startswith(ANGLES)}" for name in sigmas)]
    yield [*FIRST, *names, "words"]
    for row in sorted(results, key=_distrust):
        numbers = [row[field][k] if row[field] else None for field, k in NUMBERS.values()]
        yield [*map(row.get, FIRST), *numbers, *map(_std(row).get, sigmas), row["words"]]


def _distrust(row: Row) -> tuple[int, float]:
    """Return the sorting key of a row: less trustworthy rows come later."""
    turns = [std for name, std in _std(row).items() if name.startswith("rotation")]
    return [*STATUSES, *NO_FIT].index(row["status"]), max(turns, default=math.inf)


def _std(row: Row) -> dict[str, float]:
    """Return a row's standard errors by name."""
    return dict(zip(row["names"] or (), row["std"] or (), strict=True))


def _bop_table(results: Results) -> Iterator[list[Any]]:
    """Yield BOP's results; each line has the time of its whole image, as BOP's tools require."""
    seconds: Counter[tuple[int, int]] = Counter()
    place = lambda row: [*map(int, row["id"].split("/")[-4:])]
    with_camera = lambda: ((place(row), row) for row in results if row["R"])
    for (scene, image, *_), row in with_camera():
        seconds[scene, image] += row["seconds"]
    yield ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
    for (scene, image, object_, _), row in with_camera():
        time = f"{seconds[scene, image]:.6f}"
        R, t = (" ".join(map(repr, row[name])) for name in "Rt")
        yield [scene, image, object_, row["iou"], R, t, time]


def fit_of(row: Row) -> "pj.Fit":
    """Return the `Fit` of a row, with covariance and modes; its `camera` goes into any format
    (`formats.write`).

    Raises ValueError for a row without a camera.

    ```python
    fit = pj.batch.fit_of(results.row("a"))
    pj.formats.write("camera.yaml", {"a": fit.camera})
    ```
    """
    if row["fit"] is None:
        words = f"expected a row with a camera, got {row['id']!r}: {row['status']}, {row['words']}"
        raise ValueError(f"`row`: {words}")
    return pj.io.fit_from_dict(json.loads(row["fit"]))
