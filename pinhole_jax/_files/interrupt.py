"""Ctrl-C ends the command as soon as Python hears of it, but never halfway through a file.

An exception will not do: Python drops it where JAX's C++ calls back, imports turn it into others,
and at an exit that waits for nobody compiling threads crash.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

#: The exit status of a process that a signal ended: 128 and SIGINT.
STATUS = 130

_writing = False


@contextmanager
def ending_at_once(words: str) -> Iterator[None]:
    """Let Ctrl-C print some words and end the process; while a file is written, be an exception.

    Where it means something else (ignored in the background, an application's), it stays so.
    """

    def end(number: int, frame: Any) -> None:
        del number, frame
        if _writing:
            raise KeyboardInterrupt
        clear = "\r\x1b[K" if sys.stderr.isatty() else ""
        os.write(2, f"{clear}{words}\n".encode(errors="backslashreplace"))
        os._exit(STATUS)

    own = threading.current_thread() is threading.main_thread()  # signals are this one's
    if not (own and signal.getsignal(signal.SIGINT) is signal.default_int_handler):
        yield
        return
    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def interrupts_raise() -> Iterator[None]:
    """Let Ctrl-C be an exception, so that what is half written is removed."""
    global _writing
    before, _writing = _writing, True
    try:
        yield
    finally:
        _writing = before
