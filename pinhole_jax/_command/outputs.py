"""Files that a command writes: checked before the work begins, and named after it."""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .. import Fit, io
from .._files.naming import named
from .._files.paths import check_writable, is_stream
from .._files.progress import Ticker


def check_outputs(**options: Any) -> None:
    """Raise ValueError if an option's file, if it has one, cannot be written."""
    for option, path in options.items():
        if path is not None:
            with named(path=option):
                check_writable(path)


def replacement_words(paths: Sequence[str | Path]) -> str:
    """Return the end of a line about files to write: those that are replaced, if any."""
    there = [str(path) for path in paths if not is_stream(path) and Path(path).is_file()]
    return f" (replaced {', '.join(there)})" if there else ""


def written_words(paths: Sequence[str | Path]) -> str:
    """Return the line about files to write, and which of them are replaced."""
    return f"written    {', '.join(map(str, paths))}{replacement_words(paths)}"


def write_results(
    options: argparse.Namespace,
    fit: Fit,
    drawings: Mapping[str, np.ndarray],
    page: Callable[[], str],
) -> None:
    """Write a camera, drawings by the names of their files, and a page if there is --report and
    the camera is finite; say so."""
    folder, report = Path(options.output), options.report if fit.status != "non_finite" else None
    written = [folder / name for name in ("camera.json", *drawings)]
    words = written_words(written if report is None else [*written, report])
    with named(path="output"):
        io.save_fit(written[0], fit, pixel_centres=options.pixel_centres)
        for path, drawing in zip(written[1:], drawings.values(), strict=True):
            io.save_image(path, drawing)
    if report is not None:
        with Ticker("drawing the page"), named(path="report"):
            io.save_text(report, page())
    print(words)


@contextmanager
def say_written(path: str, words: str) -> Iterator[None]:
    """Print that a file was written: on stderr if it went to stdout or a pipe."""
    there = ", replaced" * bool(replacement_words([path]))
    yield
    print(f"written    {path} ({words}{there})", file=sys.stderr if is_stream(path) else sys.stdout)
