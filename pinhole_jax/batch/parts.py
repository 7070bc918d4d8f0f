"""Rows on disk: parts that appear whole or not at all. What has been done is what they hold."""

import hashlib
import itertools
import json
import os
import secrets
import sys
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from reprlib import repr as brief
from typing import NamedTuple

from .._files.paths import replace_file
from .records import Record, plain_record, settings_of
from .rows import Row, line_of, row_of

#: Rows wait in memory for a part of this many, or this many seconds: what a crash loses.
ROWS, SECONDS = 500, 10.0


def write_lines(path: str | os.PathLike[str], lines: Iterable[str]) -> int:
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
    """Rows go to a folder in parts: `add` one, `flush` at the end. Several may write at a time."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._waiting: list[str] = []
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None

    def add(self, row: Row) -> None:
        """Append a row; it is on disk after `flush`, or some rows or seconds later."""
        with self._lock:
            self._waiting.append(line_of(row))
            if self._timer is None:
                self._timer = threading.Timer(SECONDS, self.flush)
                self._timer.daemon = True
                self._timer.start()
        if len(self._waiting) >= ROWS:
            self.flush()

    def flush(self) -> None:
        """Write what waits as a part."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            if self._waiting:
                # (Named by time: of one record's rows the last one counts.)
                name = f"part-{time.time_ns():020d}-{secrets.token_hex(4)}.jsonl"
                write_lines(self.folder / name, self._waiting)
                self._waiting = []


class _Place(NamedTuple):
    """A row's part, the bytes before it there, its status, and a digest of its settings."""

    path: Path
    offset: int
    status: str
    settings: bytes


class Results:
    """The rows in a folder that `fit_many` wrote: iterate over them, sorted by id.

    One row at a time is in memory. Of a record's rows the last one counts. Raises ValueError for a
    file in place of a folder; one that is not there has no rows.

    ```python
    results = pj.batch.Results("results")
    len(results), results.counts(), results.row("a")["iou"]
    ```
    """

    folder: Path

    def __init__(self, folder: str | os.PathLike[str]):
        self.folder = Path(folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"`out`: expected a folder, got {str(folder)!r}: a file")

    def ids(self, but: Collection[str] = ()) -> set[str]:
        """Return the ids of all rows, but for those of some statuses."""
        return {id for id, place in self._places().items() if place.status not in but}

    def __len__(self) -> int:
        return len(self._places())

    def __iter__(self) -> Iterator[Row]:
        places = self._places()
        yield from _read(places[id] for id in sorted(places))

    def rows(self, ids: Iterable[str]) -> list[Row]:
        """Return the rows of some ids, in their order; raise ValueError where there is none."""
        places, asked = self._places(), [*ids]
        if missing := [id for id in asked if id not in places]:
            words = f"expected one of the rows in {str(self.folder)!r}, got {missing[0]!r}"
            raise ValueError(f"`id`: {words}")
        return [*_read(places[id] for id in asked)]

    def row(self, id: str) -> Row:
        """Return the row of an id, or raise ValueError where there is none."""
        return self.rows([id])[0]

    def counts(self) -> dict[str, int]:
        """Return the number of rows of each status, the most frequent first."""
        return dict(Counter(place.status for place in self._places().values()).most_common())

    def done(self, but: Collection[str] = ()) -> "Done":
        """Return what has been done: all rows, but for those of some statuses."""
        places = self._places()
        return Done(self, {id: x.settings for id, x in places.items() if x.status not in but})

    def _places(self) -> dict[str, _Place]:
        """Return where each row is; of those of one id the last."""
        places: dict[str, _Place] = {}
        for path in sorted(self.folder.glob("part-*.jsonl")):
            offset = 0
            with open(path, "rb") as stream:
                for line in stream:
                    id, status, settings = _head_of(line, path)
                    places[id] = _Place(path, offset, sys.intern(status), settings)
                    offset += len(line)
        return places


class Done(NamedTuple):
    """Results, and a digest of the settings of each record that has been done."""

    results: Results | None = None
    settings: dict[str, bytes] = {}  # noqa: RUF012

    def has(self, record: Record) -> bool:
        """Return True for a record that has its row.

        Raises ValueError where the row is of another record, which had that id then.
        """
        id = record["id"]
        if self.results is None or id not in self.settings:
            return False
        now = settings_of(plain_record(record))
        if self.settings[id] == _digest(now):
            return True
        then = settings_of(json.loads(self.results.row(id)["record"]))
        other = next(name for name in now | then if now.get(name) != then.get(name))
        words = f"expected rows of records as they are now, got {id!r} with {other!r}"
        values = f"{brief(then.get(other))}, which is {brief(now.get(other))} now"
        raise ValueError(f"`out`: {words} {values}; other settings want another folder")


def _digest(settings: Record) -> bytes:
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).digest()[:8]


def _read(places: Iterable[_Place]) -> Iterator[Row]:
    """Yield the rows at places."""
    for path, offset, *_ in places:
        with open(path, "rb") as stream:
            stream.seek(offset)
            yield row_of(stream.readline().decode())


def _head_of(line: bytes, path: Path) -> tuple[str, str, bytes]:
    """Return a row's id and status, and its record's settings."""
    try:
        data = json.loads(line)
        return data["id"], data["status"], _digest(settings_of(json.loads(data["record"])))
    except (ValueError, KeyError, TypeError, AttributeError):
        words = f"expected rows as `fit_many` writes them, got {path.name}"
        cure = "where a disk has lost it, remove it: its records are fitted again"
        raise ValueError(f"`out`: {words}; {cure}") from None
