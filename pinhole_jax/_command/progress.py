"""How far the command has come, and how long it took."""

import sys
import threading
import time
from typing import Any


class Clock:
    """Time since it was made, and how much of it JAX spent tracing and compiling."""

    def __init__(self) -> None:
        import jax.monitoring

        self.compiling, self.programs = 0.0, 0
        self._begin = time.perf_counter()
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **kwargs: Any) -> None:
        del kwargs
        if event in (
            "/jax/core/compile/jaxpr_to_mlir_module_duration",
            "/jax/core/compile/backend_compile_duration",
            "/jax/core/compile/jaxpr_trace_duration",
        ):
            self.compiling += duration_secs
        self.programs += event == "/jax/core/compile/backend_compile_duration"

    def words(self) -> str:
        """Return how much was compiled, nothing if that is little."""
        if self.compiling < 1:
            return ""
        return f"; {self.programs} programs compiled, {self.compiling:.0f} s of it"

    def elapsed(self) -> float:
        return time.perf_counter() - self._begin


class Progress:
    """A line on the terminal that says what goes on, once it has gone on for a second.

    Where `verbose`, all of it goes to stderr line by line.
    """

    def __init__(self, text: str, verbose: bool = False) -> None:
        self._text, self._verbose = text, verbose
        self._clock: Clock | None = None
        self._done = threading.Event()
        self._thread: threading.Thread | None = None

    def say(self, text: str) -> None:
        self._text = text
        if self._verbose:
            self.tell(text)

    def tell(self, text: str) -> None:
        """Print a line that is to stay."""
        clear = "\r\x1b[K" if self._thread is not None else ""
        print(f"{clear}{text}", file=sys.stderr, flush=True)

    def count(self, clock: Clock) -> None:
        """Say from now on what a clock has seen of compiling, too."""
        self._clock = clock

    def __enter__(self) -> "Progress":
        if sys.stderr.isatty() and not self._verbose:
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.done()

    def done(self) -> None:
        """Clear the line, to print."""
        self._done.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        begin = time.perf_counter()
        shown = False
        while not self._done.wait(0.2):
            seconds = time.perf_counter() - begin
            if seconds > 1:
                shown, more = True, self._clock.words() if self._clock else ""
                line = f"\r\x1b[K{seconds:4.0f} s  {self._text}{more}"
                print(line, end="", file=sys.stderr, flush=True)
        if shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
