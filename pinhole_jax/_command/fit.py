"""`pinhole-jax fit`: the camera of a mask."""

import argparse
from pathlib import Path

import pinhole_jax as pj

from .. import formats, report
from .._files.progress import Ticker
from ..batch.inputs import read_inputs
from ..plot import disagreement, overlay
from .options import record_of
from .outputs import check_outputs, write_results


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Fit, print and write; return 0, or 1 for a fit not to trust."""
    check_outputs(output=Path(options.output) / "camera.json", report=options.report)
    if options.refine and options.image is None:
        raise ValueError("`refine`: expected a photo, got none: add --image PHOTO")
    inputs = read_inputs(record_of(options))
    scene, mask, centres = inputs["scene"], inputs["target"], options.pixel_centres
    picture = inputs.get("photo", mask)
    if not options.refine:
        inputs["photo"] = None
    progress.say("fitting (the first time compiles, some seconds)")
    fit = pj.fit_camera(**inputs, record=options.report is not None)

    progress.say("drawing")
    drawing = overlay(picture, fit.camera, scene)
    notes = () if fit.status == "non_finite" else disagreement(fit.camera, scene, mask)
    progress.done()
    print(fit)
    for note in notes:
        print(f"note       {note}")
    if fit.status != "non_finite":
        print(formats.object_pose(fit, pixel_centres=centres))
    compiling = progress.compiling()
    print(f"time       {compiling:.1f} s compile, {progress.elapsed() - compiling:.1f} s run")
    title = f"Camera of {Path(options.mesh).name} from {Path(options.mask).name}"
    page = lambda: report.page(fit, scene, mask, picture, title, pixel_centres=centres)
    write_results(options, fit, {"overlay.png": drawing}, page)
    return 0 if fit.status == "converged" else 1
