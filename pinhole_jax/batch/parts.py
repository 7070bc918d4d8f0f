"""Rows on disk: parts that appear whole or not at all. What has been done is what they hold."""

import contextlib
import json
import os
import secrets
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from .._files.paths import path_of, replace_file
from .rows import Row, line_of, row_of

#: Rows wait in memory for a part of so many, or so many seconds: what a crash loses.
ROWS, SECONDS = 500, 10.0
#: So many parts are open at a time while rows are read.
MOST_OPEN = 128


class Writer:
    """Rows go to a folder in parts: `add` one, `flush` at the end. Several may write at a time."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._waiting: list[str] = []
        self._since = time.monotonic()

    def add(self, row: Row) -> None:
        """Append a row; it is on disk after `flush`, or some rows or seconds later."""
        self._waiting.append(line_of(row))
        if len(self._waiting) >= ROWS or time.monotonic() - self._since > SECONDS:
            self.flush()

    def flush(self) -> None:
        """Write what waits as a part."""
        if self._waiting:
            data = "".join(f"{line}\n" for line in self._waiting).encode()
            # (Named by time, so that parts are read as they were written.)
            name = f"part-{time.time_ns():020d}-{secrets.token_hex(4)}.jsonl"
            replace_file(self.folder / name, data)
        self._waiting, self._since = [], time.monotonic()


class Results:
    """The rows in a folder that `fit_many` wrote: iterate over them, sorted by id.

    One row at a time is in memory. A row that two parts hold counts once. Raises ValueError for a
    file in place of a folder; one that is not there has no rows.
    """

    def __init__(self, folder: str | os.PathLike[str]):
        self.folder = path_of(folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"`out`: expected a folder, got {str(folder)!r}: a file")

    def ids(self) -> set[str]:
        """Return the ids of all rows: what has been done."""
        return set(self._places())

    def __len__(self) -> int:
        return len(self._places())

    def __iter__(self) -> Iterator[Row]:
        places = self._places()
        with contextlib.ExitStack() as open_files:
            streams: dict[Path, BinaryIO] = {}
            for id in sorted(places):
                path, offset = places[id]
                if path not in streams:
                    if len(streams) >= MOST_OPEN:
                        streams.pop(next(iter(streams))).close()
                    streams[path] = open_files.enter_context(open(path, "rb"))
                yield _row_at(streams[path], offset)

    def row(self, id: str) -> Row:
        """Return the row of an id, or raise ValueError where there is none."""
        place = self._places().get(id)
        if place is None:
            raise ValueError(f"`id`: expected one of the rows in {str(self.folder)!r}, got {id!r}")
        with open(place[0], "rb") as stream:
            return _row_at(stream, place[1])

    def counts(self) -> dict[str, int]:
        """Return how many rows have each status, the most frequent first."""
        return dict(Counter(row["status"] for row in self).most_common())

    def _places(self) -> dict[str, tuple[Path, int]]:
        """Return the file of each row, and where in it; the first of those of one id."""
        places: dict[str, tuple[Path, int]] = {}
        for path in sorted(self.folder.glob("part-*.jsonl")):
            offset = 0
            with open(path, "rb") as stream:
                for line in stream:
                    places.setdefault(_id_of(line, path), (path, offset))
                    offset += len(line)
        return places


def _row_at(stream: BinaryIO, offset: int) -> Row:
    stream.seek(offset)
    return row_of(stream.readline().decode())


def _id_of(line: bytes, path: Path) -> str:
    try:
        return json.loads(line)["id"]
    except (ValueError, KeyError, TypeError):
        words = f"expected rows as `fit_many` writes them, got {path.name}"
        raise ValueError(f"`out`: {words}") from None
