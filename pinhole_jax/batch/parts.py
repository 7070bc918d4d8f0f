"""Rows on disk, in parts that appear whole or not at all: the record of finished work."""

import itertools
import json
import secrets
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from .._files.paths import FilePath, replace_file
from .rows import Row, line_of, row_of

#: A part is written after this many rows or seconds: a crash loses no more.
ROWS, SECONDS = 500, 10.0


def write_lines(path: FilePath, lines: Iterable[str]) -> int:
    """Write lines to a file, whole or not at all; return their number.

    Raises ValueError for a path that cannot be written.
    """
    count = itertools.count()
    data = (
        f"{line}\n".encode(errors="backslashreplace") for line, _ in zip(lines, count, strict=False)
    )
    replace_file(path, data, lasting=True)
    return next(count)


class Writer:
    """A writer of rows to a folder in parts: `add` each, `flush` at the end. Several may write."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._waiting: list[str] = []
        self._flushed = time.monotonic()

    def add(self, row: Row) -> None:
        """Append a row, and write those of the last seconds as a part, now and then."""
        self._waiting.append(line_of(row))
        if len(self._waiting) >= ROWS or time.monotonic() - self._flushed >= SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write the waiting rows as a part."""
        if self._waiting:
            # Named by time: the last row of a record counts.
            name = f"part-{time.time_ns():020d}-{secrets.token_hex(4)}.jsonl"
            write_lines(self.folder / name, self._waiting)
        self._waiting, self._flushed = [], time.monotonic()


class Place(NamedTuple):
    """A row's part, the bytes before it there, and its status."""

    path: Path
    offset: int
    status: str

    def row(self) -> Row:
        """Return the row."""
        with open(self.path, "rb") as stream:
            stream.seek(self.offset)
            return row_of(stream.readline().decode())


class Results:
    """The rows in a folder that `fit_many` wrote: iterate over them, sorted by id.

    One row at a time is in memory; the last row of a record counts. A missing folder has no rows.
    Raises ValueError for a file in place of a folder.

    ```python
    results = pj.batch.Results("results")
    len(results), results.counts(), results.row("a")["iou"]
    ```
    """

    folder: Path

    def __init__(self, folder: FilePath):
        self.folder = Path(folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"`out`: expected a folder, got {str(folder)!r}: a file")

    def ids(self) -> set[str]:
        """Return the ids of all rows."""
        return {*places_of(self.folder)}

    def __len__(self) -> int:
        return len(places_of(self.folder))

    def __iter__(self) -> Iterator[Row]:
        places = places_of(self.folder)
        return (places[id].row() for id in sorted(places))

    def rows(self, ids: Iterable[str]) -> list[Row]:
        """Return the rows of these ids, in their order; raise ValueError for an unknown id."""
        places, wanted = places_of(self.folder), [*ids]
        if missing := [id for id in wanted if id not in places]:
            words = f"expected one of the rows in {str(self.folder)!r}, got {missing[0]!r}"
            raise ValueError(f"`id`: {words}")
        return [places[id].row() for id in wanted]

    def row(self, id: str) -> Row:
        """Return the row of an id; raise ValueError for an unknown id."""
        return self.rows([id])[0]

    def counts(self) -> dict[str, int]:
        """Return the number of rows of each status, the most frequent first."""
        statuses = (place.status for place in places_of(self.folder).values())
        return dict(Counter(statuses).most_common())


def places_of(folder: Path) -> dict[str, Place]:
    """Return the place of each id's last row in a folder; raise ValueError for other files."""
    places: dict[str, Place] = {}
    for path in sorted(folder.glob("part-*.jsonl")):
        offset = 0
        with open(path, "rb") as stream:
            for line in stream:
                try:
                    row = json.loads(line)
                    places[row["id"]] = Place(path, offset, row["status"])
                except (ValueError, KeyError, TypeError):
                    words = f"expected rows of `fit_many`, got {path.name}"
                    cure = "if it is damaged, delete it: its records are fitted again"
                    raise ValueError(f"`out`: {words}; {cure}") from None
                offset += len(line)
    return places
