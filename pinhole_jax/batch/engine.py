"""Records through an executor: each comes back as a row, whatever becomes of its process."""

import itertools
import math
import multiprocessing
import time
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from .._numerics.machine import usable_cores
from . import worker
from .records import Record
from .rows import Row, empty_row
from .worker import Setup

#: Workers that end as they start are started this many times.
STARTS = 3
#: This many records a worker are on their way to an executor that is not our own.
AHEAD = 4


def rows_of(
    records: Iterable[Record], executor: Executor | None, workers: int | None, setup: Setup
) -> Generator[Row, None, None]:
    """Yield a row for each record, as they come.

    Without an executor: by worker processes that share the cores out. One that ends takes no
    record with it: those that were being fitted are tried again, each alone in a process; what
    ends that as well has "crashed".
    """
    if executor is not None:
        yield from _by(executor, records, workers, setup)
        return
    count = workers if workers is not None else usable_cores()
    pool = _Pool(count, setup._replace(workers=count))
    try:
        yield from _by_pool(pool, records)
    finally:
        pool.end()


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
        for future in [f for f in running if f.done() and not _is_broken(f)]:
            record, _ = running.pop(future)
            yield _row_of(future, record)
        if lost or stuck:
            pool.end()
            yield from _each_alone(pool, running, stuck)
            running = {}
            pool.begin()


def _is_broken(future: Future[Row]) -> bool:
    return isinstance(future.exception(), BrokenProcessPool)


def _row_of(future: Future[Row], record: Record) -> Row:
    """Return a future's row; of one that its worker could not take or give back, why."""
    error = future.exception()
    if error is None:
        return future.result()
    return empty_row(record, "failed", f"{type(error).__name__}: {error}")


_Running = dict[Future[Row], tuple[Record, float]]


def _stuck(running: _Running, patience: float) -> set[str]:
    """Return the ids of what has run for too long."""
    now = time.monotonic()
    return {record["id"] for record, since in running.values() if now - since > patience}


def _each_alone(pool: _Pool, running: _Running, stuck: set[str]) -> Iterator[Row]:
    """Yield the rows of what was running when all workers were ended: who was stuck has had its
    time, and each of the others, which may have ended a process, has one of its own."""
    patience = pool.setup.patience
    too_long = f"took more than {pool.setup.limit} s, and did not end by itself"
    suspects = []
    for record, _ in running.values():
        if record["id"] in stuck:
            yield empty_row(record, "timed_out", too_long, patience)
        else:
            suspects.append(record)
    pools: list[_Pool] = []

    def alone(record: Record) -> Row:
        single = _Pool(1, pool.setup)
        pools.append(single)
        future = single.submit(record)
        wait([future], None if patience == math.inf else patience)
        if not future.done():
            return empty_row(record, "timed_out", too_long, patience)
        if _is_broken(future):
            return empty_row(record, "crashed", "its process ended, twice")
        return _row_of(future, record)

    with ThreadPoolExecutor(pool.workers) as threads:
        try:
            yield from threads.map(alone, suspects)
        finally:
            for single in pools:
                single.end()


def _by(
    executor: Executor, records: Iterable[Record], workers: int | None, setup: Setup
) -> Iterator[Row]:
    """Yield the rows that any executor makes; a record that fails there is given once more.

    Raises RuntimeError where the executor takes no more.
    """
    ahead = AHEAD * (workers if workers is not None else _size(executor))
    waiting = iter(records)
    running: dict[Future[Row], tuple[Record, int]] = {}

    def give(record: Record, tries: int) -> None:
        try:
            running[executor.submit(worker.run, record, setup)] = record, tries
        except RuntimeError as error:  # (a broken pool's is one)
            words = "it takes no more records; what is done is kept, call again with another one"
            raise RuntimeError(f"`executor`: {words}: {error}") from error

    try:
        while True:
            while len(running) < ahead and (record := next(waiting, None)) is not None:
                give(record, 1)
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                record, tries = running.pop(future)
                error = future.exception()
                if error is None:
                    yield future.result()
                elif tries == 1:
                    give(record, 2)
                else:
                    yield empty_row(record, "crashed", f"{type(error).__name__}: {error}")
    finally:
        for future in running:
            future.cancel()


def _size(executor: Any) -> int:
    """Return how many workers an executor has, as far as it tells."""
    known = getattr(executor, "_max_workers", None)
    if isinstance(known, int):
        return known
    client = getattr(executor, "_client", None)  # dask.distributed's
    threads = getattr(client, "nthreads", None)
    nodes: Any = threads() if callable(threads) else {}
    return sum(nodes.values()) or 8
