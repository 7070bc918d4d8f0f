"""Files that a command writes: checked before the work begins, and named after it."""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .. import Fit, io
from .._files.naming import named
from .._files.paths import FilePath, check_writable, is_stream, written_path
from .._files.progress import Ticker


def check_outputs(**options: Any) -> None:
    """Raise ValueError if an option's file, if it has one, cannot be written."""
    for option, path in options.items():
        if path is not None:
            with named(path=option):
                check_writable(path)


@contextmanager
def say_written(*paths: FilePath, words: str = "") -> Iterator[None]:
    """Print that files were written, and which were replaced: on stderr if one went to stdout or a
    pipe."""
    line = f"written    {', '.join(map(written_path, paths))}{words}"
    yield
    print(line, file=sys.stderr if any(map(is_stream, paths)) else sys.stdout)


def write_results(
    options: argparse.Namespace,
    fit: Fit,
    drawings: Mapping[str, np.ndarray],
    page: Callable[[], str],
) -> None:
    """Write a camera, drawings by the names of their files, and a page if there is --report and
    the camera is finite; say so."""
    folder, report = Path(options.output), options.report if fit.status != "non_finite" else None
    camera, pictures = folder / "camera.json", {folder / n: x for n, x in drawings.items()}
    with say_written(camera, *pictures, *([] if report is None else [report])):
        with named(path="output"):
            io.save_fit(camera, fit, pixel_centres=options.pixel_centres)
            for path, picture in pictures.items():
                io.save_image(path, picture)
        if report is not None:
            with Ticker("drawing the page"), named(path="report"):
                io.save_text(report, page())
