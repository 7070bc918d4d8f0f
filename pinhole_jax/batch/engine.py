"""Records through an executor: each comes back as a row, even if its process crashes."""

import itertools
import multiprocessing
import time
from collections.abc import Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from . import worker
from .records import Record
from .rows import Row, empty_row
from .worker import Setup

#: The number of attempts to start a worker.
STARTS = 3
#: The number of records handed ahead to each worker of a user's executor.
AHEAD = 4


def rows_of(
    records: Iterable[Record], executor: Executor | None, workers: int | None, setup: Setup
) -> Generator[Row, None, None]:
    """Yield a row for each record, as they come.

    Without an executor, worker processes share the cores. A record that ends its process, or
    fails in an executor, gets one more try; then it has "crashed".

    Raises RuntimeError if no worker starts, or the executor takes no more records.
    """
    waiting = iter(records)
    if executor is None:
        ahead = workers if workers is not None else worker.usable_cores()
        first = [*itertools.islice(waiting, ahead)]
        waiting = itertools.chain(first, waiting)
        own = [_Worker(k, setup._replace(workers=ahead)) for k in range(len(first))]
    else:
        ahead, own = AHEAD * (workers or getattr(executor, "_max_workers", 8)), []
    running: dict[Future[Row], tuple[Record, int, float]] = {}

    def give(record: Record, tries: int) -> None:
        if executor is None:
            future = next(w for w in own if w.future not in running).give(record)
        else:
            future = _submit(executor, record, setup)
        running[future] = record, tries, time.monotonic()

    try:
        while True:
            while len(running) < ahead and (record := next(waiting, None)) is not None:
                give(record, 1)
            if not running:
                return
            # With a time limit, the clock counts, too.
            wait(running, None if setup.limit is None else 1.0, FIRST_COMPLETED)
            for future, (record, tries, since) in [*running.items()]:
                late = own and time.monotonic() - since > setup.patience
                if not future.done() and not late:
                    continue
                del running[future]
                if not future.done():
                    next(w for w in own if w.future is future).begin()
                    words = f"took more than {setup.limit} s, and did not end by itself"
                    yield empty_row(record, "timed_out", words, setup.patience)
                elif (error := future.exception()) is None:
                    yield future.result()
                elif tries == 1:
                    give(record, 2)
                else:
                    yield empty_row(record, "crashed", f"{type(error).__name__}: {error}")
    finally:
        for future in running:
            future.cancel()
        for process in own:
            process.end()


def _submit(executor: Executor, record: Record, setup: Setup) -> Future[Row]:
    try:
        return executor.submit(worker.run, record, setup)
    except RuntimeError as error:  # (a broken pool's is one)
        words = "expected one that takes more records; call again with another to continue"
        raise RuntimeError(f"`executor`: {words}: {error}") from error


class _Worker:
    """A worker process, and the `future` of its last record: it has one record at a time."""

    _pool: ProcessPoolExecutor | None = None

    def __init__(self, number: int, setup: Setup):
        self._arguments = setup, number
        self.begin()

    def begin(self) -> None:
        """Start the process anew."""
        self.end()
        context = multiprocessing.get_context("spawn")  # JAX does not survive a fork
        self._pool = ProcessPoolExecutor(1, context, worker.begin, self._arguments)
        self.future = self._ready = self._pool.submit(worker.ready)

    def give(self, record: Record) -> Future[Row]:
        """Hand over a record when the process has started; return its row's future."""
        for _ in range(STARTS):
            try:
                self._ready.result()
                assert self._pool is not None
                self.future = self._pool.submit(worker.run, record, self._arguments[0])
                return self.future
            except BrokenProcessPool:
                self.begin()
        raise RuntimeError(
            "no worker process could start: call `fit_many` below `if __name__ == '__main__':` in"
            " your script, since workers import it"
        )

    def end(self) -> None:
        """Kill the process."""
        # (From Python 3.14 on, `kill_workers` does it.)
        if self._pool is not None:
            for process in list((self._pool._processes or {}).values()):
                process.kill()
            self._pool.shutdown(wait=True, cancel_futures=True)
