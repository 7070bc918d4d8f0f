"""`pinhole-jax hand-eye`: the camera that sees a robot, from a URDF, joint angles and masks."""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .. import Camera, JointView, fit_joint, joint_observability, split_check
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


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Fit, print and write; return 0, or 1 for a fit not to trust."""
    check_outputs(output=Path(options.output) / "camera.json", report=options.report)
    robot, views = read_views(options)
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
    known = read_start(record_of(options), (W, H))
    camera = known.camera or poseless_camera(known.phi, W, H, known.lens)

    progress.say(f"fitting {len(views)} views (the first time compiles, some seconds)")
    free, zeros = options.free, _zeros(options)
    fitted = partial(fit_joint, free=free, joint_zeros=zeros)
    fit = fitted(views, camera, search=known.camera is None)
    more: dict[str, Any] = {}
    if options.holdout:
        refit = lambda half: fitted(half, fit.camera)
        more["halves"] = str(split_check(refit, (views[::2], views[1::2])))
    finite = fit.status != "non_finite"
    if proposed is not None and finite:
        more["proposed"] = best_postures(worths(views, fit.camera, free, proposed, zeros))

    progress.say("drawing")
    drawings = {
        f"overlay_{k}.png": overlay(picture, view.camera, view.scene)
        for k, (picture, view) in enumerate(zip(pictures, fit.views, strict=True))
        if finite
    }
    progress.done()
    print(fit)
    if finite:
        print(object_pose(fit.cameras["camera"], pixel_centres=options.pixel_centres))
    for name, words in more.items():
        print(f"{name:11}{words}")
    names = [Path(name).name for name in options.masks]
    more |= {"frame": options.in_hand or "the base", "pixel_centres": options.pixel_centres}
    page = lambda: robot_page(fit, masks, pictures, names, **more)
    write_results(options, fit.cameras["camera"]._replace(status=fit.status), drawings, page)
    return 0 if fit.status == "converged" else 1


def read_views(options: argparse.Namespace) -> tuple[Robot, list[JointView]]:
    """Return a file's robot (`robot`), without some links (`leave_out`), and its views: `masks` of
    the postures in a file (`joints`)."""
    with named(path="ROBOT"):
        robot = load_urdf(options.robot, options.leave_out)
    views = _views(robot, options, options.joints, "JOINTS")
    if len(views) != len(options.masks):
        raise ValueError(
            f"`MASK`: expected one for each of {len(views)} rows of {options.joints!r}, got"
            f" {len(options.masks)}"
        )
    masks = (read_mask(record_of(options, mask=x)) for x in options.masks)
    return robot, [view._replace(target=mask) for view, mask in zip(views, masks, strict=True)]


def _zeros(options: argparse.Namespace) -> float | None:
    """Return the sigma (rad) of the joints' zeros; None: they are exact."""
    if (degrees := options.joint_zeros) is None:
        return None
    if not 0 < degrees < np.inf:
        raise ValueError(f"`joint_zeros`: expected a positive number of degrees, got {degrees}")
    if options.in_hand is not None:
        raise ValueError("`joint_zeros`: expected none with `in_hand`, whose link they move")
    return float(np.deg2rad(degrees))


def _views(robot: Robot, options: argparse.Namespace, path: str, option: str) -> list[JointView]:
    """Return the views, without masks, of a robot in the postures of an option's file."""
    link, views = options.in_hand, []
    with named(path=option, angles=option):
        for angles in joint_angles(path, robot):
            poses = robot.poses(angles)
            if link not in (None, *poses):
                words = f"expected a link among {', '.join(poses)}, got {link!r}"
                raise ValueError(f"`in_hand`: {words}")
            scene, posture = robot.scene_at(poses), robot.posture(angles)
            views.append(JointView(scene, None, mount=poses.get(link or ""), posture=posture))
    return views


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


# Postures in which one more mask would help.


def worths(
    views: Sequence[JointView],
    camera: Camera,
    free: str,
    proposed: Sequence[JointView],
    joint_zeros: float | None = None,
) -> list[float]:
    """Return the factor by which one more mask of each proposed view would reduce the standard
    errors of the camera's pose (their geometric mean), by `joint_observability`.

    It is infinite if the masks of `views` do not determine the pose and one more would.
    """

    def size(views: Sequence[JointView]) -> float:
        found = joint_observability(views, camera, free, joint_zeros=joint_zeros)
        pose = [name.startswith(("camera rotation_", "camera e_")) for name in found.names]
        covariance = found.covariance[np.ix_(pose, pose)]
        if not np.all(np.isfinite(covariance)):
            return np.inf
        return abs(float(np.linalg.det(covariance))) ** (0.5 / len(covariance))

    before, after = size(views), [size([*views, view]) for view in proposed]
    return [before / x if x < before else 1.0 for x in after]


def best_postures(factors: Sequence[float]) -> str:
    """Return a sentence on the proposed postures that would help most, the best first."""
    best = sorted(range(len(factors)), key=lambda k: -factors[k])
    each = ", ".join(f"row {k + 1} {factors[k]:.2f}" for k in best[:5])
    return f"one more mask would divide the standard errors of the pose by: {each}"
