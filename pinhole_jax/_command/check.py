"""`pinhole-jax check`: has a camera moved since its fit, and do its error bars hold?"""

import argparse
from collections.abc import Callable
from typing import Any

from .. import (
    Camera,
    Fit,
    JointFit,
    drift,
    fit_camera,
    fit_joint,
    formats,
    io,
    outline_halves,
    split_check,
)
from .._files.naming import named
from .._files.progress import Ticker
from ..batch.inputs import read_mask, read_scene
from ..names import STATUSES
from .hand_eye import read_views
from .options import record_of
from .outputs import check_outputs, say_written

#: The exit status when the masks cannot tell.
UNTOLD = 3
#: What masks show, how to fit a camera to all or a half of it, and how to halve it after a fit.
CheckData = tuple[Any, Callable[..., Fit | JointFit], Callable[..., tuple[Any, Any]]]


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Fit from the camera; print its motion, or with --split how far halves of the masks differ.

    Return 0, 1 if it has moved or error bars are too narrow, or `UNTOLD`.
    """
    check_outputs(output=options.output)
    reference = _reference(options.camera)
    before = reference.camera if isinstance(reference, Fit) else reference
    is_robot = options.mesh.lower().endswith(".urdf")
    data, fitted, halved = (_robot if is_robot else _mesh)(options, progress)
    whole = fitted(data, before)
    fit = whole if isinstance(whole, Fit) else whole.cameras["camera"]
    fit = fit._replace(status=whole.status)
    if fit.status == "non_finite":
        progress.done()
        print("cannot tell: NaN or infinity turned up")
        return UNTOLD
    if options.split:
        progress.say("fitting each half")
        finding = split_check(lambda half: fitted(half, fit.camera), halved(whole))
        is_told, is_fine = finding.is_conclusive, finding.agrees
    else:
        finding = drift(fit, reference)
        is_told, is_fine = fit.status == "converged", not finding.moved
    progress.done()
    print(finding)
    print(f"status     {fit.status}   ({STATUSES[fit.status]})")
    for weak in fit.weak:
        print(f"weak       {weak}")
    if options.output is not None:
        with say_written(options.output), named(path="output"):
            io.save_fit(options.output, fit)
    return int(not is_fine) if is_told else UNTOLD


def _reference(path: str) -> Camera | Fit:
    """Return the fit that a file holds, with its covariance; else its camera, taken as exact."""
    with named(path="camera"):
        camera = formats.read_one(path)
        try:
            return io.load_fit(path)
        except (ValueError, OSError):
            return camera


def _mesh(options: argparse.Namespace, progress: Ticker) -> CheckData:
    if len(options.files) != 1:
        raise ValueError("`MASK`: expected one image of MESH (of a robot: ROBOT.urdf JOINTS MASKs)")
    mask = read_mask(record_of(options, mask=options.files[0]))
    scene = read_scene(options.mesh)
    progress.say("fitting (the first time compiles, some seconds)")
    fitted = lambda weight, start: fit_camera(scene, mask, start, options.free, weight=weight)
    return None, fitted, lambda fit: outline_halves(mask, fit.mask_error)


def _robot(options: argparse.Namespace, progress: Ticker) -> CheckData:
    if len(options.files) < 2:
        raise ValueError("`MASK`: expected JOINTS, and an image for each of its rows, got none")
    options.robot, (options.joints, *options.masks) = options.mesh, options.files
    _, views = read_views(options)
    if options.split and len(views) < 2:
        raise ValueError("`split`: expected at least two views of a robot, got one")
    progress.say(f"fitting {len(views)} views (the first time compiles, some seconds)")
    fitted = lambda views, start: fit_joint(views, start, options.free)
    return views, fitted, lambda _: (views[::2], views[1::2])
