"""`pinhole-jax check`: has a camera moved since its fit?"""

import argparse

from .. import Camera, Fit, drift, fit_camera, fit_joint, formats, io
from .._files.naming import named
from .._files.progress import Ticker
from ..batch.inputs import read_mask, read_scene
from ..names import STATUSES
from .hand_eye import read_robot, read_views
from .options import record_of
from .outputs import check_outputs, replacement_words

#: The exit status when the masks cannot tell.
UNTOLD = 3


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Fit from the camera and print its motion; return 0, 1 if it has moved, or `UNTOLD`."""
    check_outputs(output=options.output)
    reference = _reference(options.camera)
    before = reference.camera if isinstance(reference, Fit) else reference
    of_robot = options.mesh.lower().endswith(".urdf")
    fit = (_robot_fit if of_robot else _mesh_fit)(options, before, progress)
    progress.done()
    if fit.status == "non_finite":
        print("cannot tell: NaN or infinity turned up")
        return UNTOLD
    motion = drift(fit, reference)
    print(motion)
    print(f"status     {fit.status}   ({STATUSES[fit.status]})")
    for words in fit.weak:
        print(f"weak       {words}")
    if options.output is not None:
        there = replacement_words([options.output])
        with named(path="output"):
            io.save_fit(options.output, fit)
        print(f"written    {options.output}{there}")
    return UNTOLD if fit.status != "converged" else int(motion.moved)


def _reference(path: str) -> Camera | Fit:
    """Return the fit that a file holds, with its covariance; else its camera, taken as exact."""
    with named(path="camera"):
        camera = formats.read_one(path)
        try:
            return io.load_fit(path)
        except (ValueError, OSError):
            return camera


def _mesh_fit(options: argparse.Namespace, camera: Camera, progress: Ticker) -> Fit:
    if len(options.files) != 1:
        raise ValueError("`MASK`: expected one image of MESH (of a robot: ROBOT.urdf JOINTS MASKs)")
    mask = read_mask(record_of(options, mask=options.files[0]), progress.tell)
    scene = read_scene(options.mesh, progress.tell)
    progress.say("fitting (the first time compiles, some seconds)")
    return fit_camera(scene, mask, camera, options.free)


def _robot_fit(options: argparse.Namespace, camera: Camera, progress: Ticker) -> Fit:
    if len(options.files) < 2:
        raise ValueError("`MASK`: expected JOINTS, and an image for each of its rows, got none")
    options.robot, (options.joints, *options.masks) = options.mesh, options.files
    views = read_views(read_robot(options), options, progress.tell)
    progress.say(f"fitting {len(views)} views (the first time compiles, some seconds)")
    fit = fit_joint(views, camera, options.free)
    return fit.cameras["camera"]._replace(status=fit.status)
