"""Progress: reported by long computations, shown on stderr to the user who waits."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

from .naming import renamed

#: Lines that stay are printed at least this often (s), a line that is overwritten is renewed this
#: often, and what takes less than `SHORT` has none.
OFTEN, RENEWED, SHORT = 10.0, 0.2, 1.0
#: JAX's events that are tracing and compiling; the first ends each program.
COMPILING = (
    "/jax/core/compile/backend_compile_duration",
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/jaxpr_trace_duration",
)
Listener = Callable[[str], Any]
#: What hears, in this thread, of the current step; of notes, which are to stay (nobody: `str`).
STEPS: ContextVar[Listener | None] = ContextVar("steps", default=None)
NOTES: ContextVar[Listener] = ContextVar("notes", default=str)


def say(words: object) -> None:
    """Report the current step to this thread's listener, if there is one."""
    if (listener := STEPS.get()) is not None:
        listener(str(words))


def tell(words: str) -> None:
    """Tell a note to this thread's listener, if there is one."""
    NOTES.get()(words)


@contextmanager
def listening(listener: Listener, to: ContextVar[Any] = STEPS) -> Iterator[None]:
    """Let a function hear of this thread's steps, or of its `NOTES`."""
    token = to.set(listener)
    try:
        yield
    finally:
        to.reset(token)


@contextmanager
def shown(
    progress: bool | Callable[[Any], Any] | None, text: str, in_words: bool = False
) -> Iterator[Callable[[Any], Any] | None]:
    """Yield the function that a fit calls as it goes on, None where nobody listens.

    A line is shown for True, and for None in a notebook. Where progress is `in_words`, a function
    hears what the fit says. Raises ValueError for other arguments.
    """
    if not (callable(progress) or progress in (True, False, None)):
        words = f"expected True, False, None or a function, got {progress!r}"
        raise ValueError(f"`progress`: {words}")
    if callable(progress) or progress is False:
        with listening(progress if in_words and progress else str):
            yield progress or None
    elif STEPS.get() is not None:
        yield say
    elif progress or (progress is None and _is_notebook()):
        with Ticker(text, live=_is_notebook() or None) as ticker:
            yield say
        if progress:
            ticker.tell(f"{text}: {ticker.elapsed():.1f} s{ticker.compiled_words()}")
    else:
        yield None


def _is_notebook() -> bool:
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


@cache
def _compiled() -> list[float]:
    """Return a running total, which JAX keeps up to date: seconds of compiling, and programs
    compiled."""
    import jax.monitoring

    total = [0.0, 0.0]

    def listen(event: str, duration_secs: float, **kwargs: Any) -> None:
        del kwargs
        total[0] += duration_secs * (event in COMPILING)
        total[1] += event == COMPILING[0]

    jax.monitoring.register_event_duration_secs_listener(listen)
    return total


class Ticker:
    """A line on stderr with the current step: on a terminal overwritten in place, elsewhere printed
    every `OFTEN` seconds; with `verbose`, every report is printed."""

    def __init__(
        self,
        text: str,
        verbose: bool = False,
        live: bool | None = None,
        names: dict[str, str] | None = None,
    ) -> None:
        self._text, self._verbose, self._names = text, verbose, names or {}
        self._live = (sys.stderr.isatty() if live is None else live) and not verbose
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._begin = self._told = time.perf_counter()
        self._before = tuple(_compiled())

    def elapsed(self) -> float:
        """Return the time (s) since the line was made."""
        return time.perf_counter() - self._begin

    def compiling(self) -> float:
        """Return the part of that time (s) in which JAX traced and compiled."""
        return _compiled()[0] - self._before[0]

    def compiled_words(self) -> str:
        """The time spent compiling and the number of programs, as text; "" if it is little."""
        seconds, programs = self.compiling(), _compiled()[1] - self._before[1]
        if seconds < SHORT or not programs:
            return ""
        return f", {seconds:.0f} s of it compiling ({programs:.0f} programs, the first time)"

    def say(self, text: str) -> None:
        self._text = text
        if self._verbose:
            self.tell(text)

    def tell(self, text: str) -> None:
        """Print a line that is to stay, with a user's names of the library's arguments."""
        self._told = time.perf_counter()
        clear = "\r\x1b[K" if self._live and not self._done.is_set() else ""
        print(f"{clear}{renamed(text, self._names)}", file=sys.stderr, flush=True)

    def __enter__(self) -> "Ticker":
        self._tokens = STEPS.set(self.say), NOTES.set(self.tell)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        STEPS.reset(self._tokens[0])
        NOTES.reset(self._tokens[1])
        self.done()

    def done(self) -> None:
        """Clear the line, to print."""
        self._done.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._done.wait(RENEWED):
            line = f"{self.elapsed():4.0f} s  {self._text}{self.compiled_words()}"
            self._overwrite(line)
            if not self._live and time.perf_counter() - self._told >= OFTEN:
                self.tell(line)
        self._overwrite("")

    def _overwrite(self, line: str) -> None:
        if self._live and self.elapsed() > SHORT:
            print(f"\r\x1b[K{line}", end="", file=sys.stderr, flush=True)
