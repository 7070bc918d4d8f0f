"""`fit_many`: any number of records through any executor; what stops is resumed."""

import itertools
import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple, TypeGuard

from ..names import STATUSES
from .engine import rows_of
from .parts import Done, Results, Writer
from .records import Record, check_id, plain_record, shard_of
from .rows import NO_FIT, Row
from .tracking import tracked_rows
from .worker import TOKEN, Setup

#: This many records at a time are sorted, so that a worker meets one mesh after another.
WINDOW = 4096
#: A record's seconds, unless others are asked for.
TIME_LIMIT = 600.0


class Count(NamedTuple):
    """How far `fit_many` has come: rows that this run has `done`, of how many in all (None where
    nobody knows), how many there were `before`, the `statuses` of those done, and the `seconds`.

    ```python
    told = lambda count: print(count)  # "2 of 2, 3.1 a second, ..."
    with ThreadPoolExecutor(1) as threads:
        rows = pj.fit_many(records, executor=threads, progress=told)
    ```
    """

    done: int
    total: int | None
    before: int
    statuses: Mapping[str, int]
    seconds: float

    def __str__(self) -> str:
        """Return it as a line."""
        rate = self.done / max(self.seconds, 1e-9)
        words = f"{self.done + self.before}"
        if self.total is not None:
            words += f" of {self.total}"
        words += f", {rate:.1f} a second" if rate >= 1 else f", {60 * rate:.1f} a minute"
        if self.total is not None and self.done:
            left = (self.total - self.done - self.before) / rate
            words += f", {int(left) // 3600}:{int(left) // 60 % 60:02d}:{int(left) % 60:02d} left"
        not_so = self.done - self.statuses.get("converged", 0)
        return words + (f"; {not_so} not converged" if not_so else "")


def fit_many(
    items: Iterable[Record],
    *,
    executor: Executor | None = None,
    workers: int | None = None,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[Count], object] | None = None,
    shard: tuple[int, int] = (1, 1),
    time_limit: float | None = TIME_LIMIT,
    cached: bool = True,
    retry: Collection[str] = (),
    track: bool = False,
) -> Sequence[Row] | Results:
    """Return a row (`batch.COLUMNS`) for each record: a list in their order, or what is in `out`.

    - `items`: records (`batch.FIELDS`): mappings with an `id`, the paths of a mesh and of a mask,
      and what is known of the camera. They may come from a generator.
    - `executor`: any `concurrent.futures.Executor`: dask.distributed's
      (`Client.get_executor()`), mpi4py's, loky's. None: worker processes on this machine, each with
      its share of the cores, in float64, on the CPU (unless `JAX_PLATFORMS` is set), with one
      cache of compiled programs (`cached`: in the user's cache folder). Other processes are set up
      likewise; threads have this one's JAX.
    - `workers`: how many processes (None: one a core); of an executor, how many it has.
    - `out`: a folder that rows are appended to, in parts that appear whole or not at all, some
      seconds apart. Records whose ids it holds are not fitted again: to resume is to call again.
      Where one of them says something else now (paths may have moved), that wants another folder.
    - `progress` is called with a `Count` after each row.
    - `shard` (i, n): the i-th (1 to n) of n parts of the records, by their ids: other machines take
      the others, into the same folder or their own.
    - `time_limit`: seconds that a record may take, compilation included; None: no limit. (In an
      executor's workers it holds as soon as Python runs again; our own are ended.)
    - `retry`: rows of these statuses ("failed", "timed_out", "crashed", ...) are made anew.
    - `track`: records are frames of one object: they are fitted in this process one after another,
      each from the camera of the last one that converged.

    No record ends the rest: one that is bad input makes a row with the status "failed", one that
    takes too long "timed_out". A process that ends costs its record one more try, alone; then it
    "crashed". Interrupted, what is done stays.

    A script that calls this without an executor does so below if __name__ == "__main__".

    Raises ValueError for arguments of other kinds, for items that have no `id` or one twice, and
    for those that are done already with other settings;
    RuntimeError where no worker starts.

    ```python
    records = [{"id": id, "mesh": "part.obj", "mask": "mask.png", "fov": 34.4} for id in "ab"]
    with ThreadPoolExecutor(2) as threads:
        results = pj.fit_many(records, executor=threads, out="results")
    ```
    """
    _check(items, executor, workers, shard, time_limit, retry)
    if track and executor is not None:
        raise ValueError("`executor`: expected None beside `track`, got one")
    results = None if out is None else Results(out)
    done = Done() if results is None else results.done(but=retry)
    total, before = _planned(items, shard, done)
    kept: dict[str, Row] = {}
    waiting = _sorted(_left(items, shard, done, kept))
    setup = Setup(cached, time_limit, TOKEN)
    found = tracked_rows(waiting, setup) if track else rows_of(waiting, executor, workers, setup)
    writer = None if results is None else Writer(results.folder)
    statuses: Counter[str] = Counter()
    begin = time.perf_counter()
    try:
        for row in found:
            if writer is None:
                kept[row["id"]] = row
            else:
                writer.add(row)
            statuses[row["status"]] += 1
            if progress is not None:
                seconds = time.perf_counter() - begin
                progress(Count(statuses.total(), total, before, dict(statuses), seconds))
    finally:
        found.close()  # ends the workers, also of what was interrupted
        if writer is not None:
            writer.flush()
    return [*kept.values()] if results is None else results


def _check(
    items: Any, executor: Any, workers: Any, shard: Any, time_limit: Any, retry: Any
) -> None:
    if isinstance(items, str | Mapping) or not isinstance(items, Iterable):
        words = f"expected records, one after another, got {type(items).__name__}"
        raise ValueError(f"`items`: {words}")
    if executor is not None and not isinstance(executor, Executor):
        words = f"expected a concurrent.futures.Executor, got {type(executor).__name__}"
        raise ValueError(f"`executor`: {words}")
    if workers is not None and not (_is_integer(workers) and workers >= 1):
        raise ValueError(f"`workers`: expected an integer of at least 1, got {workers!r}")
    pair = isinstance(shard, tuple) and len(shard) == 2 and all(map(_is_integer, shard))
    if not pair or not 1 <= shard[0] <= shard[1]:
        raise ValueError(f"`shard`: expected (i, n) with i from 1 to n, got {shard!r}")
    if time_limit is not None and not (isinstance(time_limit, int | float) and time_limit > 0):
        raise ValueError(f"`time_limit`: expected positive seconds, got {time_limit!r}")
    for name in [retry] if isinstance(retry, str) else retry:
        known = [*STATUSES, *NO_FIT]
        if isinstance(retry, str) or name not in known:
            words = f"expected a list of statuses among {', '.join(known)}, got {name!r}"
            raise ValueError(f"`retry`: {words}")


def _is_integer(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _planned(items: Iterable[Record], shard: tuple[int, int], done: Done) -> tuple[int | None, int]:
    """Return how many records there are in a shard, and how many of them are done.

    What can be gone through only once does not tell. All else is checked here: an id that is
    missing ends no run of hours.
    """
    if isinstance(items, Iterator):
        return None, 0
    total = before = 0
    for record in _checked(items, shard):
        total += 1
        before += done.has(record)
    return total, before


def _left(
    items: Iterable[Record],
    shard: tuple[int, int],
    done: Done,
    kept: dict[str, Row],
) -> Iterator[Record]:
    """Yield the records that are not done; rows that stay in memory get their places."""
    for record in _checked(items, shard):
        if not done.has(record):
            if done.results is None:
                kept[record["id"]] = {}
            yield plain_record(record)  # no worker is asked what a process cannot be handed


def _checked(items: Iterable[Record], shard: tuple[int, int]) -> Iterator[Record]:
    """Yield the records of a shard.

    Raises ValueError for what has no id, or one that was there before.
    """
    number, count = shard
    seen: set[str] = set()
    for record in items:
        check_id(record)
        if record["id"] in seen:
            raise ValueError(f"`items`: expected ids that differ, got {record['id']!r} twice")
        seen.add(record["id"])
        if shard_of(record["id"], count) == number - 1:
            yield record


def _sorted(records: Iterator[Record]) -> Iterator[Record]:
    """Yield records, some thousands at a time by their shape: it is opened once, and what serves
    one mask of it serves the next."""
    while window := list(itertools.islice(records, WINDOW)):
        yield from sorted(window, key=_shape_of)


def _shape_of(record: Record) -> tuple[str, str]:
    return str(record.get("mesh")), str(record.get("free"))
