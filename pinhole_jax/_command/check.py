"""`pinhole-jax check`: is a mask still explained by a camera, or has it moved?"""

import argparse

from .. import Camera, Fit, drift, fit_camera, fit_joint, formats, io
from .._files.naming import named
from .._files.progress import Ticker
from ..names import STATUSES
from .hand_eye import robot_of, views_of
from .inputs import mask_of, scene_of
from .outputs import check_outputs, replaced

#: The exit status where the fit is not to be trusted.
UNTOLD = 3
#: What the command calls the arguments of the fits.
ASKED = {"target": "MASK", "free": "--free", "camera": "CAMERA", "cameras": "CAMERA"}


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Fit from the camera, print how far that leads; return 0, 1 where it has moved, or `UNTOLD`
    where the masks do not say."""
    check_outputs(output=options.output)
    reference = _reference(options.camera)
    before = reference.camera if isinstance(reference, Fit) else reference
    if options.mesh.lower().endswith(".urdf"):
        fit = _of_robot(options, before, progress)
    else:
        fit = _of_mesh(options, before, progress)
    progress.done()
    if fit.status == "non_finite":
        print("cannot tell: NaN or infinity turned up")
        return UNTOLD
    found = drift(fit, reference)
    print(found)
    print(f"status     {fit.status}: {STATUSES[fit.status]}")
    for words in fit.weak:
        print(f"weak       {words}")
    if options.output is not None:
        there = replaced([options.output])
        with named(path="--output"):
            io.save_fit(options.output, fit)
        print(f"written    {options.output}{there}")
    return UNTOLD if fit.status != "converged" else int(found.moved)


def _reference(path: str) -> Camera | Fit:
    """Return the fit that a file holds, with its covariance; else its camera, taken as exact."""
    with named(path="CAMERA"):
        camera = formats.read_one(path)
        try:
            return io.load_fit(path)
        except (ValueError, OSError):
            return camera


def _of_mesh(options: argparse.Namespace, camera: Camera, progress: Ticker) -> Fit:
    if options.joints is None or options.masks:
        raise ValueError("`MASK`: expected one image of MESH (of a robot: ROBOT.urdf JOINTS MASKs)")
    mask = mask_of(options.joints, options.mask_from, progress.tell)
    scene = scene_of(options.mesh, progress.tell)
    progress.say("fitting (the first time compiles, some seconds)")
    with named(**ASKED):
        return fit_camera(scene, mask, camera, options.free)


def _of_robot(options: argparse.Namespace, camera: Camera, progress: Ticker) -> Fit:
    if options.joints is None or not options.masks:
        raise ValueError("`MASK`: expected JOINTS, and an image for each of its rows, got none")
    options.robot = options.mesh
    views = views_of(robot_of(options), options, progress.tell)
    progress.say(f"fitting {len(views)} views (the first time compiles, some seconds)")
    with named(**ASKED):
        fit = fit_joint(views, camera, options.free)
    return fit.cameras["camera"]._replace(status=fit.status)
