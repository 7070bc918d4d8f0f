"""Records through an executor: each comes back as a row, even if its process crashes."""

import itertools
import multiprocessing
import time
from collections.abc import Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from functools import partial
from typing import Any

from .._files.machine import usable_cores
from . import worker
from .records import Record
from .rows import Row, empty_row
from .tables import fit_of
from .worker import Setup

#: The number of records handed ahead to each worker of a user's executor.
AHEAD = 4
NOT_STARTED = (
    "no worker process could start: call `fit_many` below `if __name__ == '__main__':` in your"
    " script, since workers import it"
)
NO_MORE = "`executor`: expected one that takes more records; call again with another to continue"


def rows_of(
    records: Iterable[Record], executor: Executor | None, workers: int | None, setup: Setup
) -> Generator[Row, None, None]:
    """Yield a row for each record, as they come.

    Without an executor, worker processes share the cores. A record that ends its process, or
    fails in an executor, gets one more try; then it has "crashed".

    Raises RuntimeError if no worker starts, or the executor takes no more records.
    """
    waiting = iter(records)
    own: list[_Worker] = []
    if executor is None:
        first = [*itertools.islice(waiting, workers or usable_cores())]
        waiting = itertools.chain(first, waiting)
        setup = setup._replace(workers=len(first))
        own = [_Worker(setup, number) for number in range(len(first))]
    most = AHEAD * (workers or getattr(executor, "_max_workers", 8))
    idle: list[Any] = [*own] or [executor] * most
    running: dict[Future[Row], tuple[Record, Any, float]] = {}
    tried: set[str] = set()
    try:
        while True:
            while idle and (record := next(waiting, None)) is not None:
                place = idle.pop()
                try:
                    future = place.submit(worker.run, record, setup)
                except RuntimeError as error:  # (a broken pool's is one)
                    words = NOT_STARTED if own else f"{NO_MORE}: {error}"
                    raise RuntimeError(words) from error
                running[future] = record, place, time.monotonic()
            if not running:
                return
            for future in wait(running, 1.0, FIRST_COMPLETED).done:  # (Ctrl-C waits no longer)
                record, place, since = running.pop(future)
                idle.append(place)
                if (error := future.exception()) is None:
                    yield future.result()
                elif own and time.monotonic() - since > setup.patience:
                    words = f"took more than {setup.limit} s, and did not end by itself"
                    yield empty_row(record, "timed_out", words, setup.patience)
                elif record["id"] in tried:
                    yield empty_row(record, "crashed", f"{type(error).__name__}: {error}")
                else:
                    tried.add(record["id"])
                    waiting = itertools.chain([record], waiting)
            for _, place, since in running.values():
                if own and time.monotonic() - since > setup.patience:
                    place.end()  # stuck outside Python; its future ends with it
    finally:
        for future in running:
            future.cancel()
        for process in own:
            process.end()


def tracked_rows(records: Iterable[Record], setup: Setup) -> Generator[Row, None, None]:
    """Yield the rows of records that are fitted in this process, one after another, each from the
    camera of the last one with the same mesh that converged."""
    last: dict[str, Any] = {}
    for record in records:
        mesh = str(record.get("mesh"))
        row = worker.run(record, setup, last.get(mesh))
        if row["status"] == "converged":
            last[mesh] = fit_of(row).camera
        yield row


class _Worker:
    """A process that has one record at a time, and is started anew after a crash."""

    def __init__(self, setup: Setup, number: int):
        context = multiprocessing.get_context("spawn")  # JAX does not survive a fork
        self._new = partial(ProcessPoolExecutor, 1, context, worker.begin, (setup, number))
        self._begin()

    def _begin(self) -> None:
        self._pool = self._new()
        self._ready = self._pool.submit(int)

    def submit(self, *call: Any) -> Future[Row]:
        """Hand over a call when the process has started; return its result's future."""
        self._ready.result()
        try:
            return self._pool.submit(*call)
        except RuntimeError:  # it has ended
            self._begin()
            return self.submit(*call)

    def end(self) -> None:
        """Kill the process."""
        # (From Python 3.14 on, `kill_workers` does it.)
        for process in list((self._pool._processes or {}).values()):
            process.kill()
        self._pool.shutdown(wait=True, cancel_futures=True)
