"""All rows as one table: Parquet, JSON lines, or BOP's results."""

import itertools
import json
import os
from collections.abc import Iterator
from typing import Any

from .._files.paths import path_of, replace_file
from .parts import Results
from .rows import COLUMNS, Row, line_of

#: So many rows at a time are in memory.
GROUP = 1000
#: What a path's ending asks for.
ENDINGS = (".parquet", ".jsonl", ".csv")


def merge(results: Results, path: str | os.PathLike[str]) -> int:
    """Write all rows, sorted by id, as one table; return how many.

    - .parquet: columns as `batch.COLUMNS` has them; needs pyarrow.
    - .jsonl: a line of JSON for each row, without pyarrow.
    - .csv: BOP's results (scene_id,im_id,obj_id,score,R,t,time) of the rows with a camera whose ids
      come from a BOP data set; the score is the IoU, lengths are the models' (there mm).

    Raises ValueError for other endings, and for a file that cannot be written.
    """
    ending = path_of(path).suffix.lower()
    if ending == ".parquet":
        return _to_parquet(results, path)
    if ending == ".jsonl":
        lines = [line_of(row) for row in results]
    elif ending == ".csv":
        lines = [_bop_line(row) for row in results if row["R"] is not None and _bop_ids(row)]
        lines = ["scene_id,im_id,obj_id,score,R,t,time", *lines]
    else:
        raise ValueError(f"`path`: expected one of {', '.join(ENDINGS)}, got {str(path)!r}")
    replace_file(path, "".join(f"{line}\n" for line in lines).encode())
    return len(lines) - (ending == ".csv")


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
            writer.write_table(pa.Table.from_pylist(rows, schema))
            count += len(rows)
    replace_file(path, sink.getvalue().to_pybytes())
    return count


def _groups(rows: Iterator[Row]) -> Iterator[list[Row]]:
    while group := list(itertools.islice(rows, GROUP)):
        yield group


def _bop_ids(row: Row) -> tuple[int, int, int] | None:
    """Return a row's scene, image and object, None where its id has none."""
    parts = row["id"].split("/")
    try:
        scene, image, object_, _ = map(int, parts[-4:])
    except ValueError:
        return None
    return scene, image, object_


def _bop_line(row: Row) -> str:
    numbers = lambda values: " ".join(repr(float(x)) for x in values)
    scene, image, object_ = _bop_ids(row) or (0, 0, 0)
    R, t = numbers(row["R"]), numbers(row["t"])
    return f"{scene},{image},{object_},{row['iou']!r},{R},{t},{row['seconds']:.3f}"


def fit_of(row: Row) -> Any:
    """Return the `Fit` of a row, with covariance and modes; its `camera` goes into any format
    (`formats.write`).

    Raises ValueError for a row without a camera.
    """
    from ..io.fits import fit_from_dict

    if row["fit"] is None:
        words = f"expected a row with a camera, got {row['id']!r}: {row['status']}, {row['words']}"
        raise ValueError(f"`row`: {words}")
    return fit_from_dict(json.loads(row["fit"]))
