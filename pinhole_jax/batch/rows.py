"""A row: the result of one record, as plain values that fit into a line of a file."""

import json
from typing import Any

from .. import __version__
from .records import Record, plain_record

#: A row: names of `COLUMNS`; numbers that are not finite stay floats.
Row = dict[str, Any]

#: The columns of a row with their types; null if there is no camera.
COLUMNS: dict[str, Any] = {
    "id": str,
    "status": str,  # a fit's, or one of `NO_FIT`
    "iou": float,
    "rms": float,
    "e": list[float],
    "p": list[float],
    "u": list[float],
    "phi": float,
    "W": int,
    "H": int,
    "K": list[float],  # OpenCV's, by rows, counted as the record's `pixel_centres` says
    "R": list[float],
    "t": list[float],
    "lens": str,  # JSON
    "names": list[str],
    "std": list[float],
    "covariance": list[float],  # by rows
    "weak": list[str],
    "modes": int,  # the number of other cameras that fit the mask equally well; `fit` has them
    "steps": list[int],
    "seconds": float,
    "words": str,  # the error, or notes on the files
    "version": str,
    "hash": str,  # of the record and the contents of its files
    "record": str,  # JSON
    "fit": str,  # JSON of the whole fit, as `io.fit_from_dict` reads it
}
#: The statuses of rows without a fit.
NO_FIT = {
    "failed": "bad input: `words` say which",
    "timed_out": "stopped at the time limit",
    "crashed": "ended its process, twice",
}


def empty_row(record: Record, status: str, words: str, seconds: float = 0.0) -> Row:
    """Return the row of a record without a camera."""
    row: Row = dict.fromkeys(COLUMNS)
    known = {"id": record["id"], "status": status, "seconds": seconds, "words": words}
    return row | known | {"version": __version__, "record": json.dumps(plain_record(record))}


def line_of(row: Row) -> str:
    """Return a row as a line of JSON; numbers that it has no word for are texts."""
    return json.dumps(json.loads(json.dumps(row), parse_constant=str), allow_nan=False)


def row_of(line: str) -> Row:
    """Return the row of `line_of`'s line."""
    row = json.loads(line)
    readers = {float: float, list[float]: lambda numbers: [*map(float, numbers)]}
    for name, kind in COLUMNS.items():
        if kind in readers and row.get(name) is not None:
            row[name] = readers[kind](row[name])
    return row
