"""`pinhole-jax hand-eye`: the camera that sees a robot, from a URDF, joint angles and masks."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .. import JointFit, JointView, fit_joint, split_check
from .._files.naming import named
from .._files.progress import Ticker
from ..batch.inputs import poseless_camera, read_mask, read_photo, read_start
from ..formats import object_pose
from ..plot import overlay
from ..robots import Robot, load_urdf
from ..show.robot_page import robot_page
from .joints import joint_angles
from .options import record_of
from .outputs import check_outputs, write_results
from .proposals import best_postures, worths


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Fit, print and write; return 0, or 1 for a fit not to trust."""
    check_outputs(output=Path(options.output) / "camera.json", report=options.report)
    robot = read_robot(options)
    views = read_views(robot, options, progress.tell)
    masks = [np.asarray(view.target) for view in views]
    pictures = _pictures(options, masks)
    if options.holdout and len(views) < 2:
        raise ValueError("`holdout`: expected at least two postures, got one")
    if options.refine:
        views = [v._replace(photo=p) for v, p in zip(views, pictures, strict=True)]
    proposed = None
    if options.propose is not None:
        if "pose" not in options.free.split(","):
            raise ValueError(f"`propose`: expected `pose` in --free, got {options.free!r}")
        proposed = _views(robot, options, options.propose, "propose")
    H, W = masks[0].shape
    known = read_start(record_of(options), (W, H), progress.tell)
    camera = known.camera or poseless_camera(known.phi, W, H, known.lens)

    progress.say(f"fitting {len(views)} views (the first time compiles, some seconds)")
    search, zeros = known.camera is None, joint_zeros(options)
    fit = fit_joint(views, camera, options.free, search=search, joint_zeros=zeros)
    halves = None
    if options.holdout:
        refit = lambda half: fit_joint(half, fit.camera, options.free, joint_zeros=zeros)
        halves = str(split_check(refit, (views[::2], views[1::2])))
    finite = fit.status != "non_finite"
    helpful = None
    if proposed is not None and finite:
        best = fit.cameras["camera"].camera
        helpful = best_postures(worths(views, best, options.free, proposed, zeros))

    progress.done()
    print(fit)
    if finite:
        print(object_pose(fit.cameras["camera"], pixel_centres=options.pixel_centres))
    if halves is not None:
        print(f"halves     {halves}")
    if helpful is not None:
        print(f"proposed   {helpful}")
    _write(options, fit, masks, pictures, halves, helpful)
    return 0 if fit.status == "converged" else 1


def read_robot(options: argparse.Namespace) -> Robot:
    """Return the robot of a file (`robot`), without some links (`leave_out`)."""
    with named(path="ROBOT"):
        return load_urdf(options.robot, options.leave_out)


def read_views(
    robot: Robot, options: argparse.Namespace, say: Callable[[str], Any]
) -> list[JointView]:
    """Return the views of a robot in the postures of a file (`joints`), with `masks`."""
    views = _views(robot, options, options.joints, "JOINTS")
    if len(views) != len(options.masks):
        raise ValueError(
            f"`MASK`: expected one for each of {len(views)} rows of {options.joints!r}, got"
            f" {len(options.masks)}"
        )
    masks = (read_mask(record_of(options, mask=x), say) for x in options.masks)
    return [view._replace(target=mask) for view, mask in zip(views, masks, strict=True)]


def joint_zeros(options: argparse.Namespace) -> float | None:
    """Return the sigma (rad) of the joints' zeros; None: they are exact."""
    degrees = getattr(options, "joint_zeros", None)
    if degrees is None:
        return None
    if not 0 < degrees < np.inf:
        raise ValueError(f"`joint_zeros`: expected a positive number of degrees, got {degrees}")
    if options.in_hand is not None:
        raise ValueError("`joint_zeros`: expected none with `in_hand`, whose link they move")
    return float(np.deg2rad(degrees))


def _views(robot: Robot, options: argparse.Namespace, path: str, option: str) -> list[JointView]:
    """Return the views, without masks, of a robot in the postures of an option's file."""
    with named(path=option, angles=option):
        return [_view(robot, angles, options) for angles in joint_angles(path, robot)]


def _view(robot: Robot, angles: dict[str, float], options: argparse.Namespace) -> JointView:
    link, poses = options.in_hand, robot.poses(angles)
    if link is not None and link not in poses:
        raise ValueError(f"`in_hand`: expected a link among {', '.join(poses)}, got {link!r}")
    mount = None if link is None else poses[link]
    posture = None if joint_zeros(options) is None else robot.posture(angles)
    return JointView(robot.scene_at(poses), None, mount=mount, posture=posture)


def _pictures(options: argparse.Namespace, masks: list[np.ndarray]) -> list[np.ndarray]:
    """Return the pictures to draw outlines on: the photos of `--images`, or else the masks."""
    if options.images is None:
        if options.refine:
            raise ValueError("`refine`: expected photos, --images PHOTO ..., got none")
        return masks
    if len(options.images) != len(masks):
        raise ValueError(
            f"`images`: expected one for each of {len(masks)} masks, got {len(options.images)}"
        )
    return [read_photo(path, mask) for path, mask in zip(options.images, masks, strict=True)]


def _write(
    options: argparse.Namespace,
    fit: JointFit,
    masks: list[np.ndarray],
    pictures: list[np.ndarray],
    halves: str | None,
    proposed: str | None,
) -> None:
    """Write the camera, each picture with the outline on it, and the page."""
    finite = fit.status != "non_finite"
    with Ticker("drawing"):
        drawings = {
            f"overlay_{k}.png": overlay(picture, view.camera, view.scene)
            for k, (picture, view) in enumerate(zip(pictures, fit.views, strict=True))
            if finite
        }
    names, frame = [Path(name).name for name in options.masks], options.in_hand or "the base"
    known = {"halves": halves, "proposed": proposed, "pixel_centres": options.pixel_centres}
    page = lambda: robot_page(fit, masks, pictures, names, frame=frame, **known)
    write_results(options, fit.cameras["camera"]._replace(status=fit.status), drawings, page)
