"""Records through an executor: each comes back as a row, whatever becomes of its process."""

import itertools
import math
import multiprocessing
import os
import time
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from . import worker
from .records import Record
from .rows import Row, empty_row
from .worker import Setup

#: Workers that end as they start are started so many times.
STARTS = 3
#: So many records a worker are on their way to an executor that is not our own.
AHEAD = 4


def rows_of(
    records: Iterable[Record], executor: Executor | None, workers: int | None, setup: Setup
) -> Generator[Row, None, None]:
    """Yield a row for each record, as they come.

    Without an executor: by worker processes, each on a core of its own. One that ends takes no
    record with it: those that were being fitted are tried again, one alone in a process; what ends
    that as well has "crashed".
    """
    if executor is not None:
        yield from _by(executor, records, workers, setup)
        return
    count = workers if workers is not None else cores()
    pool = _Pool(count, setup)
    try:
        yield from _by_pool(pool, records)
    finally:
        pool.end()


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Pool:
    """Worker processes, as many as asked for; `begin` makes new ones."""

    def __init__(self, workers: int, setup: Setup):
        self.workers, self.setup = workers, setup
        self._context = multiprocessing.get_context("spawn")  # JAX does not survive a fork
        self.begin()

    def begin(self) -> None:
        """Start workers; where one ends before it can work, start again a few times.

        Raises RuntimeError where none can.
        """
        for _ in range(STARTS):
            turn = self._context.Value("i", 0)
            self._pool = ProcessPoolExecutor(
                self.workers, self._context, worker.begin, (self.setup, turn)
            )
            try:
                self._pool.submit(worker.ready).result()
                return
            except BrokenProcessPool:
                self.end()
        raise RuntimeError(
            "no worker process could start: a script that calls `fit_many` does so below"
            " `if __name__ == '__main__':`, since workers import it"
        )

    def submit(self, record: Record) -> Future[Row]:
        return self._pool.submit(worker.run, record, self.setup)

    def end(self) -> None:
        """End all workers, whatever they are at."""
        # (`kill_workers` does it from Python 3.14 on.)
        for process in list((self._pool._processes or {}).values()):
            process.kill()
        self._pool.shutdown(wait=True, cancel_futures=True)


def _by_pool(pool: _Pool, records: Iterable[Record]) -> Iterator[Row]:
    """Yield the rows that our own workers make, each of which has one record at a time."""
    waiting = iter(records)
    running: _Running = {}
    while True:
        lost = False
        while len(running) < pool.workers and (record := next(waiting, None)) is not None:
            try:
                running[pool.submit(record)] = record, time.monotonic()
            except BrokenProcessPool:  # a worker ended while it had nothing to do
                waiting, lost = itertools.chain([record], waiting), True
                break
        if not running and not lost:
            return

        # (With a limit the clock is looked at, too.)
        pause = None if pool.setup.limit is None else 1.0
        done, _ = wait(running, timeout=pause, return_when=FIRST_COMPLETED)
        lost |= any(isinstance(future.exception(), BrokenProcessPool) for future in done)
        stuck = _stuck(running, pool.setup.patience)
        for future in [f for f in running if f.done() and f.exception() is None]:
            del running[future]
            yield future.result()
        if lost or stuck:
            pool.end()
            yield from _one_by_one(pool, running, stuck)
            running = {}
            pool.begin()


_Running = dict[Future[Row], tuple[Record, float]]


def _stuck(running: _Running, patience: float) -> set[str]:
    """Return the ids of what has run for too long."""
    now = time.monotonic()
    return {record["id"] for record, since in running.values() if now - since > patience}


def _one_by_one(pool: _Pool, running: _Running, stuck: set[str]) -> Iterator[Row]:
    """Yield the rows of what was running when all workers were ended: who was stuck has had its
    time, and each of the others, which may have ended a process, has one of its own."""
    patience = pool.setup.patience
    too_long = f"took more than {pool.setup.limit} s, and did not end by itself"
    for record, _ in running.values():
        if record["id"] in stuck:
            yield empty_row(record, "timed_out", too_long, patience)
            continue
        single = _Pool(1, pool.setup)
        try:
            yield single.submit(record).result(None if patience == math.inf else patience)
        except BrokenProcessPool:
            yield empty_row(record, "crashed", "its process ended, twice")
        except TimeoutError:
            yield empty_row(record, "timed_out", too_long, patience)
        finally:
            single.end()


def _by(
    executor: Executor, records: Iterable[Record], workers: int | None, setup: Setup
) -> Iterator[Row]:
    """Yield the rows that any executor makes; a record that fails there is given once more."""
    ahead = AHEAD * (workers if workers is not None else _size(executor))
    waiting = iter(records)
    running: dict[Future[Row], tuple[Record, int]] = {}
    while True:
        while len(running) < ahead and (record := next(waiting, None)) is not None:
            running[executor.submit(worker.run, record, setup)] = record, 1
        if not running:
            return
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            record, tries = running.pop(future)
            error = future.exception()
            if error is None:
                yield future.result()
            elif tries == 1:
                running[executor.submit(worker.run, record, setup)] = record, 2
            else:
                words = f"{type(error).__name__}: {error}"
                yield empty_row(record, "crashed", words)


def _size(executor: Any) -> int:
    """Return how many workers an executor has, as far as it tells."""
    known = getattr(executor, "_max_workers", None)
    if isinstance(known, int):
        return known
    client = getattr(executor, "_client", None)  # dask.distributed's
    threads = getattr(client, "nthreads", None)
    nodes: Any = threads() if callable(threads) else {}
    return sum(nodes.values()) or 8
