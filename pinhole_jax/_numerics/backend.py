"""Which machines what is traced now is for."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar

import jax

_here: ContextVar[bool] = ContextVar("_here", default=False)


@contextmanager
def for_this_machine() -> Iterator[None]:
    """Let programs that are traced within run on this process's machine alone: where that is a CPU,
    what is for other machines is not traced (of a fit's program a quarter of the time)."""
    with for_cpus() if jax.default_backend() == "cpu" else nullcontext():
        yield


@contextmanager
def for_cpus() -> Iterator[None]:
    """Let what is traced within be for CPUs alone: a branch of a program that is theirs."""
    before = _here.set(True)
    try:
        yield
    finally:
        _here.reset(before)


def is_for_cpus() -> bool:
    """Return whether what is traced now is for CPUs alone."""
    return _here.get()
