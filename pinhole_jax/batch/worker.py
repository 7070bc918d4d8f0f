"""A process that fits records: its set-up before JAX is loaded, and its time limit.

Nothing here imports NumPy or JAX at the top: a worker's core is chosen before they count the cores.
"""

import contextlib
import ctypes
import functools
import math
import os
import secrets
import signal
import threading
import time
from collections.abc import Iterator
from multiprocessing import parent_process
from typing import Any, NamedTuple

import pinhole_jax as pj

from .fit_one import fit_one
from .records import Record
from .rows import Row, empty_row

#: A worker of our own that is stuck outside Python is ended after this many times a record's limit,
#: and this many seconds.
PATIENCE, GRACE = 2.0, 30.0

#: This process's token: no other has it.
TOKEN = secrets.token_hex(16)


class Setup(NamedTuple):
    """The settings of a worker.

    - `cached`: keep compiled programs in the user's cache folder. `limit`: a record's seconds.
    - `parent`: the `TOKEN` of the calling process, whose JAX belongs to its user.
    - `workers`: the number of workers that share this machine's cores.
    """

    cached: bool = True
    limit: float | None = None
    parent: str = ""
    workers: int = 1

    @property
    def patience(self) -> float:
        """Return the time (s) after which a stuck worker is ended."""
        return math.inf if self.limit is None else PATIENCE * self.limit + GRACE


class TimeLimit(BaseException):
    """A record took too long. (No `Exception`, which readers catch.)"""


def begin(setup: Setup, number: int) -> None:
    """Set up worker `number`: it takes its share of the cores, and leaves Ctrl-C to the caller."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent_process(),), daemon=True).start()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # NumPy's own threads would wait for one another
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        step = min(setup.workers, len(cores))
        with contextlib.suppress(OSError):  # where a container forbids it
            os.sched_setaffinity(0, cores[number % step :: step])
    _set_up(setup)


def _end_with(process: Any) -> None:
    """End this process after another one: an executor's workers would wait for ever."""
    process.join()
    os._exit(1)


def run(record: Record, setup: Setup, last: Any = None) -> Row:
    """Return a record's row within its time limit. (`last`: see `fit_one`.)"""
    _set_up(setup)
    start = time.perf_counter()
    try:
        with _within(setup.limit):
            return fit_one(record, last)
    except TimeLimit:
        seconds = time.perf_counter() - start
        return empty_row(record, "timed_out", f"took more than {setup.limit:g} s", seconds)


@functools.cache
def _set_up(setup: Setup) -> None:
    """Set up JAX as the command does, once, unless this is the user's own process."""
    if setup.parent != TOKEN:
        pj.set_up(setup.cached)


@contextlib.contextmanager
def _within(seconds: float | None) -> Iterator[None]:
    """Raise `TimeLimit` in this thread after a time (s), as soon as it runs Python again."""
    if seconds is None:
        yield
        return
    what = ctypes.c_ulong(threading.get_ident()), ctypes.py_object(TimeLimit)
    timer = threading.Timer(seconds, ctypes.pythonapi.PyThreadState_SetAsyncExc, what)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()  # what it raises arrives here, not later
