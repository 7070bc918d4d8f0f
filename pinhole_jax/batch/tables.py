"""All rows as one table: Parquet, JSON lines, BOP's results, or a flat one."""

import csv
import itertools
import json
import os
from collections.abc import Iterable, Iterator
from io import StringIO
from typing import TYPE_CHECKING, Any

from .._files.paths import path_of, replace_file
from .parts import Results
from .rows import COLUMNS, Row, line_of

if TYPE_CHECKING:
    from .._fit.result import Fit
else:
    Fit = Any  # it needs JAX, which takes a second

#: This many rows at a time are in memory.
GROUP = 1000
#: What a path's ending asks for.
ENDINGS = (".parquet", ".jsonl", ".csv")
#: The columns of a flat table whose numbers are parts of a row's lists, and which parts.
PARTS = {
    "K": {"fx": 0, "fy": 4, "cx": 2, "cy": 5},
    "R": {f"R{k // 3 + 1}{k % 3 + 1}": k for k in range(9)},
    "t": {"tx": 0, "ty": 1, "tz": 2},
}


def merge(results: Results, path: str | os.PathLike[str]) -> int:
    """Write all rows, sorted by id, as one table; return how many.

    - .parquet: columns as `batch.COLUMNS` has them; needs pyarrow.
    - .jsonl: a line of JSON for each row, without pyarrow.
    - .csv: BOP's results (scene_id,im_id,obj_id,score,R,t,time) if all ids come from a BOP data
      set: the rows with a camera; the score is the IoU, lengths are the models' (there mm). Of
      other data a line for every row: id, status, iou, rms, fx, fy, cx, cy, R11 to R33, tx, ty, tz
      (as `K`, `R` and `t` of the row), standard errors (sigma_) and words.

    Raises ValueError for other endings, and for a file that cannot be written.

    ```python
    pj.batch.merge(results, "table.jsonl")
    ```
    """
    ending = path_of(path).suffix.lower()
    if ending == ".parquet":
        return _to_parquet(results, path)
    if ending not in ENDINGS:
        raise ValueError(f"`path`: expected one of {', '.join(ENDINGS)}, got {str(path)!r}")
    count = 0

    def lines() -> Iterator[bytes]:
        nonlocal count
        for line in _csv_lines(results) if ending == ".csv" else map(line_of, results):
            count += 1
            yield f"{line}\n".encode(errors="backslashreplace")

    replace_file(path, lines())
    return count - (ending == ".csv")  # its first line has the names


def _to_parquet(results: Results, path: str | os.PathLike[str]) -> int:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ModuleNotFoundError as error:
        words = "Parquet is written by pyarrow: pip install 'pinhole-jax[batch]'"
        raise ModuleNotFoundError(words, name=error.name) from error
    kinds = {
        str: pa.string(),
        float: pa.float64(),
        int: pa.int64(),
        list[float]: pa.list_(pa.float64()),
        list[int]: pa.list_(pa.int64()),
        list[str]: pa.list_(pa.string()),
    }
    schema = pa.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()])
    sink = pa.BufferOutputStream()
    count = 0
    with parquet.ParquetWriter(sink, schema, compression="zstd") as writer:
        for rows in _groups(iter(results)):
            writer.write_table(pa.Table.from_pylist([*map(_in_text, rows)], schema))
            count += len(rows)
    replace_file(path, sink.getvalue().to_pybytes())
    return count


def _in_text(row: Row) -> Row:
    """Return a row whose texts are UTF-8: a file's name need be none."""
    text = lambda x: x.encode(errors="backslashreplace").decode() if isinstance(x, str) else x
    return {name: text(value) for name, value in row.items()}


def _groups(rows: Iterator[Row]) -> Iterator[list[Row]]:
    while group := list(itertools.islice(rows, GROUP)):
        yield group


def _csv_lines(results: Results) -> Iterator[str]:
    """Yield the lines of a CSV: BOP's results if all ids are BOP's."""
    ids = results.ids()
    if ids and all(_bop_ids(id) for id in ids):
        return _bop_lines(results)
    return _flat_lines(results)


def _flat_lines(results: Results) -> Iterator[str]:
    sigmas = [*dict.fromkeys(name for row in results for name in row["names"] or ())]
    parts = [name for names in PARTS.values() for name in names]
    errors = [f"sigma_{name}" for name in sigmas]
    yield _csv_line(["id", "status", "iou", "rms", *parts, *errors, "words"])
    for row in results:
        found = dict(zip(row["names"] or (), row["std"] or (), strict=True))
        numbers = [
            "" if row[field] is None else row[field][k]
            for field, names in PARTS.items()
            for k in names.values()
        ]
        first = [row["id"], row["status"], row["iou"], row["rms"]]
        yield _csv_line([*first, *numbers, *(found.get(name) for name in sigmas), row["words"]])


def _csv_line(values: Iterable[object]) -> str:
    line = StringIO()
    csv.writer(line, lineterminator="").writerow(values)
    return line.getvalue()


def _bop_ids(id: str) -> tuple[int, int, int] | None:
    """Return the scene, image and object of a row's id, None where it has none."""
    try:
        scene, image, object_, _ = map(int, id.split("/")[-4:])
    except ValueError:
        return None
    return scene, image, object_


def _bop_lines(results: Results) -> Iterator[str]:
    """Yield BOP's results. The time is a whole image's in each of its lines, as BOP's tools ask."""
    seconds: dict[tuple[int, int], float] = {}
    for row in results:
        if row["R"] is not None and (ids := _bop_ids(row["id"])):
            seconds[ids[:2]] = seconds.get(ids[:2], 0.0) + row["seconds"]
    numbers = lambda values: " ".join(repr(float(x)) for x in values)
    yield "scene_id,im_id,obj_id,score,R,t,time"
    for row in results:
        if row["R"] is not None and (ids := _bop_ids(row["id"])):
            scene, image, object_ = ids
            R, t = numbers(row["R"]), numbers(row["t"])
            time = f"{seconds[scene, image]:.6f}"
            yield f"{scene},{image},{object_},{row['iou']!r},{R},{t},{time}"


def fit_of(row: Row) -> Fit:
    """Return the `Fit` of a row, with covariance and modes; its `camera` goes into any format
    (`formats.write`).

    Raises ValueError for a row without a camera.

    ```python
    fit = pj.batch.fit_of(results.row("a"))
    pj.formats.write("camera.yaml", {"a": fit.camera})
    ```
    """
    from ..io.fits import fit_from_dict

    if row["fit"] is None:
        words = f"expected a row with a camera, got {row['id']!r}: {row['status']}, {row['words']}"
        raise ValueError(f"`row`: {words}")
    return fit_from_dict(json.loads(row["fit"]))
