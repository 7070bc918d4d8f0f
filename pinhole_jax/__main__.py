"""The command line: `pinhole-jax fit`, `render`, `hand-eye`, `check`, `batch`, `studio`, `convert`;
also `python -m pinhole_jax`."""

import argparse
import atexit
import gc
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from io import TextIOWrapper
from typing import Any

from ._command.arguments import parse
from ._files.interrupt import STATUS, ending_at_once
from ._files.naming import renamed
from ._files.progress import Ticker

#: The exit status when nobody reads the output, as a shell gives it after SIGPIPE.
PIPE = 141


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 for a fit not to trust, 2 on bad input, 130 if interrupted."""
    try:
        try:
            return _run(arguments)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # the reader has enough; Python would report it again at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE


def _run(arguments: Sequence[str] | None) -> int:
    """Run the verb of a command line; print its errors, and return its exit status."""
    options = parse(arguments)
    command = f"pinhole-jax {options.command}"
    for stream in (sys.stdout, sys.stderr):  # a file's name may be no text that can be printed
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        with (
            ending_at_once(f"{command}: interrupted"),
            Ticker("reading", options.verbose, names=options.names) as progress,
        ):
            _set_up_jax(options)
            return _verb(options.command).run(options, progress)
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(f"{command}: {renamed(str(error), options.names)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # a file that was being written is whole or not there
        print(f"{command}: interrupted", file=sys.stderr)
        return STATUS


def _verb(name: str) -> Any:
    """Return a command's module, whose imports take most of a second."""
    return import_module(f"pinhole_jax._command.{name.replace('-', '_')}")


def _set_up_jax(options: argparse.Namespace) -> None:
    """Set JAX up for the command, and let Python's garbage collector run rarely."""
    from ._files.process import set_up

    # Tracing makes objects that stay: looking for garbage among them takes a third of the start.
    gc.set_threshold(1_000_000)
    atexit.register(gc.freeze)
    set_up(not options.no_cache)


if __name__ == "__main__":
    sys.exit(main())
