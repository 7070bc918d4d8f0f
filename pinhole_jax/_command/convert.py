"""`pinhole-jax convert`: the cameras of a file as another program's."""

import argparse

from .. import formats
from .._files.naming import named
from .._files.progress import Ticker
from .outputs import say_written


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Read and write; return 0."""
    size = options.size and tuple(options.size)
    with named(path="input", format="from"):
        cameras = formats.read(options.input, getattr(options, "from"), size=size)
    target = options.to or formats.guess_write(options.output)
    sizes = ", ".join(dict.fromkeys(f"{camera.W} x {camera.H}" for camera in cameras.values()))
    count = f"{len(cameras)} camera{'s' * (len(cameras) != 1)}"
    progress.done()
    words = f" ({target}, {count}, {sizes})"
    with (
        say_written(options.output, words=words),
        named(path="output", format="to", cameras="input"),
    ):
        formats.write(options.output, cameras, options.to)
    return 0
