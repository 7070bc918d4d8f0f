"""`fit_many`: any number of records through any executor; a stopped run resumes."""

import itertools
import json
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from datetime import timedelta
from functools import partial
from typing import Any, NamedTuple

from .._files.paths import FilePath
from ..names import STATUSES
from .engine import rows_of, tracked_rows
from .parts import Place, Results, Writer, places_of
from .records import Record, check_id, plain_record, settings_of, shard_of
from .rows import NO_FIT, Row
from .worker import TOKEN, Setup

#: This many records at a time are sorted by mesh, so that workers open few meshes at once.
WINDOW = 4096
#: The default time limit of a record (s).
TIME_LIMIT = 600.0


class Count(NamedTuple):
    """The progress of `fit_many`.

    - `done`: rows of this run. `before`: rows that were there before.
    - `total`: all records, None if their number is not known.
    - `statuses`: how many of the rows done have each status. `seconds`: since the start.

    ```python
    show = lambda count: print(count)  # "2 of 2, 3.1 a second, ..."
    with ThreadPoolExecutor(1) as threads:
        rows = pj.fit_many(records, executor=threads, progress=show)
    ```
    """

    done: int
    total: int | None
    before: int
    statuses: Mapping[str, int]
    seconds: float

    def __str__(self) -> str:
        """Return the progress as a line."""
        rate = self.done / max(self.seconds, 1e-9)
        words = f"{self.done + self.before}"
        if self.total is not None:
            words += f" of {self.total}"
        words += f", {rate:.1f} a second" if rate >= 1 else f", {60 * rate:.1f} a minute"
        if self.total is not None and self.done:
            left = int((self.total - self.done - self.before) / rate)
            words += f", {timedelta(seconds=left)} left"
        others = self.done - self.statuses.get("converged", 0)
        return words + (f"; {others} not converged" if others else "")


def fit_many(
    items: Iterable[Record],
    *,
    executor: Executor | None = None,
    workers: int | None = None,
    out: FilePath | None = None,
    progress: Callable[[Count], object] | None = None,
    shard: tuple[int, int] = (1, 1),
    time_limit: float | None = TIME_LIMIT,
    cached: bool = True,
    retry: Collection[str] = (),
    track: bool = False,
) -> Sequence[Row] | Results:
    """Return a row (`batch.COLUMNS`) for each record: a list in their order, or the rows in `out`.

    - `items`: records (`batch.FIELDS`): mappings with an `id`, the paths of a mesh and of a mask,
      and the known parts of the camera. They may come from a generator.
    - `executor`: any `concurrent.futures.Executor`: dask.distributed's
      (`Client.get_executor()`), mpi4py's, loky's. None: worker processes on this machine, each with
      its share of the cores, in float64, on the CPU (unless `JAX_PLATFORMS` is set), with one
      cache of compiled programs (`cached`: in the user's cache folder). Other processes are set up
      likewise; threads use the JAX of this process.
    - `workers`: the number of processes (None: one a core), or of the executor's workers.
    - `out`: a folder to append rows to, in parts that appear whole or not at all, some seconds
      apart. Records whose ids it holds are not fitted again, so call again to resume. A record
      with new settings needs another folder; its paths may change.
    - `progress` is called with a `Count` after each row.
    - `shard` (i, n): fit the i-th (1 to n) of n parts of the records, chosen by their ids. Other
      machines fit the other parts, into the same folder or their own.
    - `time_limit`: the most seconds for a record, compilation included; None: no limit. (In an
      executor's workers it takes effect as soon as Python runs again.)
    - `retry`: fit rows of these statuses ("failed", "timed_out", "crashed", ...) anew.
    - `track`: the records are frames of one object: fit them in this process in their order, each
      from the last camera that converged.

    No record stops the others: bad input makes a row with the status "failed", a record that takes
    too long one with "timed_out". If a process ends, its record gets one more try, alone; then it
    "crashed". Rows that are done survive an interrupt.

    In a script, call this below if __name__ == "__main__", unless you give an executor.

    Raises ValueError for arguments of other kinds, for items without an `id` or with the same one,
    and for finished ones with other settings; RuntimeError if no worker starts.

    ```python
    records = [{"id": id, "mesh": "part.obj", "mask": "mask.png", "fov": 34.4} for id in "ab"]
    with ThreadPoolExecutor(2) as threads:
        results = pj.fit_many(records, executor=threads, out="results")
    ```
    """
    _check(items, executor, workers, shard, time_limit, retry)
    if track and executor is not None:
        raise ValueError("`executor`: expected None with `track`, got one")
    results = None if out is None else Results(out)
    places = {} if results is None else places_of(results.folder)
    done = {id: place for id, place in places.items() if place.status not in retry}
    is_done = partial(_is_done, done=done)
    total, before = None, 0
    if not isinstance(items, Iterator):  # all ids are checked: none ends a run of hours
        finished = [is_done(record) for record in _shard_records(items, shard)]
        total, before = len(finished), sum(finished)
    rows_by_id: dict[str, Row] = {}

    def unfinished() -> Iterator[Record]:
        for record in _shard_records(items, shard):
            if not is_done(record):
                if results is None:
                    rows_by_id[record["id"]] = {}  # its place
                yield plain_record(record)  # processes can be handed plain values only

    waiting, setup = _by_mesh(unfinished()), Setup(cached, time_limit, TOKEN)
    rows = tracked_rows(waiting, setup) if track else rows_of(waiting, executor, workers, setup)
    writer = None if results is None else Writer(results.folder)
    statuses: Counter[str] = Counter()
    begin = time.perf_counter()
    try:
        for row in rows:
            if writer is None:
                rows_by_id[row["id"]] = row
            else:
                writer.add(row)
            statuses[row["status"]] += 1
            if progress is not None:
                seconds = time.perf_counter() - begin
                progress(Count(statuses.total(), total, before, dict(statuses), seconds))
    finally:
        rows.close()  # ends the workers, also after an interrupt
        if writer is not None:
            writer.flush()
    return [*rows_by_id.values()] if results is None else results


def _check(
    items: Any, executor: Any, workers: Any, shard: Any, time_limit: Any, retry: Any
) -> None:
    known, is_count = (*STATUSES, *NO_FIT), lambda x: type(x) is int and x >= 1
    one_by_one = isinstance(items, Iterable) and not isinstance(items, str | Mapping)
    _expect(one_by_one, "records, one after another", items=items)
    is_executor = executor is None or isinstance(executor, Executor)
    _expect(is_executor, "a concurrent.futures.Executor", executor=executor)
    _expect(workers is None or is_count(workers), "an integer of at least 1", workers=workers)
    is_pair = isinstance(shard, tuple) and len(shard) == 2 and all(map(is_count, shard))
    _expect(is_pair and shard[0] <= shard[1], "(i, n) with i from 1 to n", shard=shard)
    is_time = time_limit is None or (isinstance(time_limit, int | float) and time_limit > 0)
    _expect(is_time, "positive seconds", time_limit=time_limit)
    are_known = not isinstance(retry, str) and {*retry} <= {*known}
    _expect(are_known, f"a list of statuses among {', '.join(known)}", retry=retry)


def _expect(is_right: bool, expected: str, **argument: object) -> None:
    """Raise ValueError for a wrong argument, given by its name."""
    if not is_right:
        ((name, value),) = argument.items()
        raise ValueError(f"`{name}`: expected {expected}, got {value!r}")


def _shard_records(items: Iterable[Record], shard: tuple[int, int]) -> Iterator[Record]:
    """Yield the records of a shard; raise ValueError for a missing id, or the same one again."""
    number, count = shard
    seen: set[str] = set()
    for k, record in enumerate(items):
        check_id(record, f"items[{k}]")
        if record["id"] in seen:
            raise ValueError(f"`items`: expected ids that differ, got {record['id']!r} twice")
        seen.add(record["id"])
        if shard_of(record["id"], count) == number - 1:
            yield record


def _is_done(record: Record, done: Mapping[str, Place]) -> bool:
    """Return True for a finished record; raise ValueError if its settings have changed."""
    id = record["id"]
    if id not in done:
        return False
    now, then = map(settings_of, (plain_record(record), json.loads(done[id].row()["record"])))
    if now == then:
        return True
    other = next(name for name in now | then if now.get(name) != then.get(name))
    values = f"{then.get(other)!s:.80}, and now {now.get(other)!s:.80}"
    words = f"expected unchanged records, got {id!r}, whose {other!r} was {values}"
    raise ValueError(f"`out`: {words}; use another folder for new settings")


def _by_mesh(records: Iterator[Record]) -> Iterator[Record]:
    """Yield records, some thousands at a time sorted by mesh, which is then opened once."""
    while window := list(itertools.islice(records, WINDOW)):
        yield from sorted(window, key=lambda record: str(record.get("mesh")))
