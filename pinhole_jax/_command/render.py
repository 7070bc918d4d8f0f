"""`pinhole-jax render`: the mask that a camera sees."""

import argparse

import numpy as np

from .. import formats, io, silhouette
from .._files.naming import named
from .._files.progress import Ticker
from ..batch.inputs import read_scene
from .outputs import say_written


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Render and write; return 0."""
    progress.say("rendering")
    with named(path="camera"):
        camera = formats.read_one(options.camera)
    if camera.W * camera.H > io.MOST_PIXELS:
        words = f"at most {io.MOST_PIXELS} pixels, got {camera.W} x {camera.H}"
        raise ValueError(f"`camera`: expected {words} (in {options.camera!r})")
    scene = read_scene(options.mesh)
    image = np.asarray(silhouette(camera, scene))
    progress.done()
    words = f" ({camera.W} x {camera.H}, {image.mean():.1%} covered)"
    with say_written(options.output, words=words), named(path="output"):
        io.save_image(options.output, image)
    return 0
