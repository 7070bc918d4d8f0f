"""`pinhole-jax fit`: the camera of a mask."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from .. import Fit, fit_camera, formats, io, report
from .._files.naming import named
from .._files.pictures import three_channels
from .._files.progress import Clock, Ticker
from ..plot import disagreement, overlay
from .inputs import check_order, mask_of, photo_beside, scene_of, tidied
from .known import known, names_of
from .outputs import check_outputs, replaced

#: The command's names of the arguments of `fit_camera`.
ASKED = {
    "target": "MASK",
    "scene": "MESH",
    "camera": "--camera",
    "free": "--free",
    "phi": "--fov",
    "weight": "--weight",
    "photo": "--image",
}


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Fit, print and write; return 0, or 1 for a fit that is not to be trusted."""
    clock = Clock()
    progress.clock = clock
    written = [Path(options.output) / name for name in ("camera.json", "overlay.png")]
    check_outputs(output=written[0], report=options.report)
    check_order(options.mesh)
    free = names_of(options.free)
    mask = _mask(options, progress)
    camera, phi, lens = known(options, free, (mask.shape[1], mask.shape[0]), progress.tell)
    weight, picture = _beside(options, mask)
    scene = scene_of(options.mesh, progress.tell)
    progress.say("fitting (the first time compiles, some seconds)")
    with named(**ASKED):
        fit = fit_camera(
            scene,
            mask,
            camera,
            free,
            phi=phi,
            lens=lens,
            weight=weight,
            photo=three_channels(picture) if options.refine else None,
            record=options.report is not None,
        )
    progress.say("drawing")
    drawing = overlay(picture, fit.camera, scene)
    finite = fit.status != "non_finite"
    notes = disagreement(fit.camera, scene, mask) if finite else ()
    progress.done()
    _print(fit, notes, clock, options.pixel_centres)
    written += [options.report] if options.report is not None and finite else []
    words = f"written    {', '.join(map(str, written))}{replaced(written)}"
    centres = options.pixel_centres
    with named(path="--output"):
        io.save_fit(written[0], fit, pixel_centres=centres)
        io.save_image(written[1], drawing)
    for path in written[2:]:
        title = f"Camera of {Path(options.mesh).name} from {Path(options.mask).name}"
        with Ticker("drawing the page"), named(path="--report"):
            report.write(path, fit, scene, mask, picture, title, pixel_centres=centres)
    print(words)
    return 0 if fit.status == "converged" else 1


def _mask(options: argparse.Namespace, progress: Ticker) -> np.ndarray:
    mask = mask_of(options.mask, options.mask_from, progress.tell, invert=options.invert)
    return mask if options.no_tidy else tidied(mask, options.tidy, progress.tell)


def _beside(options: argparse.Namespace, mask: np.ndarray) -> tuple[Any, np.ndarray]:
    """Return the weights of `--weight`, None without, and the picture to draw on."""
    if options.refine and options.image is None:
        raise ValueError("`--refine`: expected a photo, --image PHOTO")
    weight = None
    if options.weight is not None:
        with named(path="--weight"):
            weight = io.load_mask(options.weight, "luminance") / 255.0
    picture = mask if options.image is None else photo_beside(options.image, mask, "--image")
    return weight, picture


def _print(fit: Fit, notes: Any, clock: Clock, pixel_centres: Any) -> None:
    print(fit)
    for note in notes:
        print(f"note       {note}")
    if fit.status != "non_finite":
        print(formats.object_pose(fit, pixel_centres=pixel_centres))
    running = clock.elapsed() - clock.compiling
    print(f"time       {clock.compiling:.1f} s compile, {running:.1f} s run")
