"""`pinhole-jax hand-eye`: the camera that sees a robot, from a URDF, joint angles and masks."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import Camera, JointFit, JointView, drift, fit_joint, io
from .._files.naming import named
from .._files.pictures import three_channels
from .._files.progress import Clock, Ticker
from ..formats import object_pose
from ..plot import overlay
from ..robots import Robot, load_urdf
from ..show.robot_page import robot_page
from .inputs import mask_of, photo_beside
from .joints import joint_angles
from .known import known, names_of, unplaced
from .outputs import check_outputs, replaced
from .proposals import Sight, in_words, worths

#: What the command calls the arguments of `fit_joint`.
ASKED = {"target": "MASK", "free": "--free", "camera": "--camera", "cameras": "--camera"}


def run(options: argparse.Namespace, progress: Ticker) -> int:
    """Fit, print and write; return 0, or 1 for a fit that is not to be trusted."""
    progress.clock = Clock()
    check_outputs(output=Path(options.output) / "camera.json", report=options.report)
    robot = robot_of(options)
    views = views_of(robot, options, progress.tell)
    masks = [np.asarray(view.target) for view in views]
    pictures = _pictures(options, masks)
    if options.refine:
        photos = map(three_channels, pictures)
        views = [v._replace(photo=p) for v, p in zip(views, photos, strict=True)]
    proposed = None if options.propose is None else _proposed(robot, options)
    camera, search = _start(options, masks[0], progress.tell)
    progress.say(f"fitting {len(views)} views (the first time compiles, some seconds)")
    with named(**ASKED):
        fit = fit_joint(
            views,
            camera,
            names_of(options.free),
            search=search,
            joint_zeros=zeros_of(options),
        )
    apart = _halves(fit, views, options) if options.holdout else None
    usable = fit.status != "non_finite"
    more = None if proposed is None or not usable else _worths(fit, views, options, proposed)
    progress.done()
    print(fit)
    if usable:
        print(object_pose(fit.cameras["camera"], pixel_centres=options.pixel_centres))
    if apart is not None:
        print(f"halves     {apart}")
    if more is not None:
        print(f"recorded   {_worth_most(fit)}")
        print(f"proposed   {more}")
    folder = Path(options.output)
    written = [folder / "camera.json"]
    written += [folder / f"overlay_{k}.png" for k in range(len(masks) * usable)]
    written += [Path(options.report)] if options.report is not None and usable else []
    there = replaced(written)
    _write(written, options, fit, pictures)
    if options.report is not None and usable:
        text = robot_page(
            fit,
            masks,
            pictures,
            [Path(path).name for path in options.masks],
            frame=options.in_hand or "the base",
            halves=apart,
            proposed=more,
            pixel_centres=options.pixel_centres,
        )
        with named(path="--report"):
            io.save_text(options.report, text)
    print(f"written    {', '.join(map(str, written))}{there}")
    return 0 if fit.status == "converged" else 1


def views_of(
    robot: Robot, options: argparse.Namespace, tell: Callable[[str], Any]
) -> list[JointView]:
    """Return the views of a robot in the postures of a file (`joints`), with `masks`."""
    with named(path="JOINTS"):
        postures = joint_angles(options.joints, robot)
    if len(postures) != len(options.masks):
        raise ValueError(
            f"`MASK`: expected one of each of {len(postures)} rows of {options.joints!r}, got"
            f" {len(options.masks)}"
        )
    masks = [mask_of(path, options.mask_from, tell) for path in options.masks]
    views = []
    for angles, mask in zip(postures, masks, strict=True):
        scene, mount = _posed(robot, angles, options.in_hand, "JOINTS")
        posture = robot.posture(angles) if zeros_of(options) else None
        views.append(JointView(scene, mask, mount=mount, posture=posture))
    return views


def robot_of(options: argparse.Namespace) -> Robot:
    """Return the robot of a file (`robot`), but for some links (`leave_out`)."""
    with named(path="ROBOT", leave_out="--leave-out"):
        return load_urdf(options.robot, _names(options.leave_out))


def _posed(robot: Robot, angles: dict[str, float], link: str | None, file: str) -> Sight:
    """Return a robot in a posture of a file, and where the link is that carries the camera."""
    with named(angles=file):
        poses = robot.poses(angles)
    if link is not None and link not in poses:
        words = f"expected a link among {', '.join(poses)}, got {link!r}"
        raise ValueError(f"`--in-hand`: {words}")
    return robot.at(poses), None if link is None else poses[link]


def _proposed(robot: Robot, options: argparse.Namespace) -> list[Sight]:
    """Return a robot in the postures of `--propose`."""
    if "pose" not in names_of(options.free):
        raise ValueError(f"`--propose`: expected `pose` in --free, got {options.free!r}")
    with named(path="--propose"):
        postures = joint_angles(options.propose, robot)
    return [_posed(robot, angles, options.in_hand, "--propose") for angles in postures]


def _worths(
    fit: JointFit, views: list[JointView], options: argparse.Namespace, proposed: list[Sight]
) -> str:
    """Return a sentence that says what a mask of each proposed posture would tell."""
    found = fit.cameras["camera"]
    mounts = [None if v.mount is None else np.asarray(v.mount) for v in views]
    seen = [(view.scene, mount) for view, mount in zip(fit.views, mounts, strict=True)]
    return in_words(worths(found.camera, found.covariance, names_of(options.free), seen, proposed))


def zeros_of(options: argparse.Namespace) -> float | None:
    """Return how surely the joints' zeros are known (rad), None: exactly."""
    degrees = getattr(options, "joint_zeros", None)
    if degrees is None:
        return None
    if not 0 < degrees < np.inf:
        raise ValueError(f"`--joint-zeros`: expected a positive number of degrees, got {degrees}")
    if options.in_hand is not None:
        raise ValueError("`--joint-zeros`: expected none beside `--in-hand`, whose link they move")
    return float(np.deg2rad(degrees))


def _names(text: str | None) -> Sequence[str]:
    return [] if text is None else names_of(text)


def _start(
    options: argparse.Namespace, mask: np.ndarray, tell: Callable[[str], Any]
) -> tuple[Camera, bool]:
    """Return the camera to start from, and whether of it the lens alone is known."""
    unused = dict.fromkeys(("crop", "resize", "fov", "image"))
    asked = argparse.Namespace(**{**unused, **vars(options)}, mask=options.masks[0])
    H, W = mask.shape
    camera, phi, lens = known(asked, names_of(options.free), (W, H), tell)
    if camera is not None:
        return camera, False
    return unplaced(phi, W, H, lens), True


def _halves(fit: JointFit, views: list[JointView], options: argparse.Namespace) -> str:
    """Return a sentence that says how far apart the fits to each half of the views are."""
    if len(views) < 2:
        return "expected two views at least"
    start, free = fit.camera, names_of(options.free)
    known = zeros_of(options)
    one, other = (
        fit_joint(half, start, free, joint_zeros=known).cameras["camera"]
        for half in (views[::2], views[1::2])
    )
    apart = drift(one, other)
    degrees = np.rad2deg(apart.angle)
    words = f"{degrees:.2g} degrees, {apart.distance:.2g} (unit of the URDF) apart, {apart.size}"
    verdict = "they do not agree" if apart.moved else "they agree"
    return f"each half of the views by itself: {words}: {verdict}"


def _worth_most(fit: JointFit) -> str:
    """Return a sentence that says which mask tells most."""
    best = max(range(len(fit.views)), key=lambda k: fit.views[k].worth)
    worth = fit.views[best].worth
    if not np.isfinite(worth):
        return f"without view {best} the pose were not determined"
    return f"without view {best} the standard errors of the pose were {worth:.2f} times as large"


def _pictures(options: argparse.Namespace, masks: list[np.ndarray]) -> list[np.ndarray]:
    """Return what outlines are drawn on: the photos of `--images`, the masks without."""
    if options.images is None:
        if options.refine:
            raise ValueError("`--refine`: expected photos, --images PHOTO ...")
        return masks
    if len(options.images) != len(masks):
        raise ValueError(
            f"`--images`: expected one of each of {len(masks)} masks, got {len(options.images)}"
        )
    pairs = zip(options.images, masks, strict=True)
    return [photo_beside(path, mask, "--images") for path, mask in pairs]


def _write(
    paths: list[Path], options: argparse.Namespace, fit: JointFit, pictures: list[np.ndarray]
) -> None:
    """Write the camera, and each picture with the outline on it."""
    with named(path="--output"):
        found = fit.cameras["camera"]._replace(status=fit.status)
        io.save_fit(paths[0], found, pixel_centres=options.pixel_centres)
        if fit.status != "non_finite":
            for path, view, picture in zip(paths[1:], fit.views, pictures, strict=False):
                io.save_image(path, overlay(picture, view.camera, view.scene))
