"""Tracing without Python's garbage collector looking on, and what it leaves given back."""

import ctypes
import gc
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

#: What takes longer (s) has compiled something, or is so large that giving back costs nothing.
COMPILED = 1.0


@contextmanager
def collector_at_rest() -> Iterator[None]:
    """Leave Python's garbage collector out until the end (or, as a decorator, the function's).

    Tracing a program makes some hundred thousand objects, that nearly all stay: looking through
    them again and again took 0.4 of 1.1 s for a mask, and of 1.5 s for a fit.

    A compiler leaves its memory to the process, in holes (glibc: 0.57 of 1.4 GB after four fits'
    programs): that goes back to the system.
    """
    on, begin = gc.isenabled(), time.perf_counter()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()
        if time.perf_counter() - begin > COMPILED:
            give_back()


def give_back() -> None:
    """Give memory that is free, but in holes, back to the system."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another C library has no such function
            ctypes.CDLL("libc.so.6").malloc_trim(0)
