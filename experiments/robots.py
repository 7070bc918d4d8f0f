"""Where is a camera that sees a robot? Masks by a network, joint angles and a URDF, with no start.

    python experiments/robots.py OUT

The KUKA LBR Med7 of `../shared/data/robots`: five postures before a stereo camera. Each eye is
fitted by itself: that both are 120.09 mm apart, and parallel, no fit knows. Then halves of the
postures, all of it once more with the photos, both eyes as one rig, and the peers' answers. The
picture has the recovered outlines on the photos, above the peers'.
"""

import json
import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from _common import folder
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax._camera.poses import at_pose, inverse, pose_of, skew
from pinhole_jax._fit.drift import drift

DATA = Path(__file__).parents[2] / "shared" / "data" / "robots" / "lbr_med7"
K = [
    [534.6265258789062, 0, 478.0846252441406],
    [0, 534.6265258789062, 260.9943542480469],
    [0, 0, 1],
]
BASELINE = 120.09
HALVES = (((0, 2, 4), (1, 3)), ((0, 1), (2, 3, 4)))
#: A start that far off (a camera's own frame: degrees and m), and how many standard deviations an
#: interval of 95 % reaches.
OFF, WITHIN = np.eye(4), 1.96
OFF[:3, :3] = Rotation.from_euler("xyz", [3, -2, 5], degrees=True).as_matrix()
OFF[:3, 3] = [0.02, -0.02, 0.05]
#: ROS has x forward, y left, z up where a camera's frame has z, -x, -y.
OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


def views(side: str) -> list[pj.JointView]:
    robot = pj.robots.load_urdf(DATA / "lbr_med7.urdf")
    angles = json.loads((DATA / "joints.json").read_text())["postures"]
    masks = [pj.io.load_mask(DATA / f"{side}_mask_{k}.png") for k in range(len(angles))]
    return [pj.JointView(robot.scene(q), mask) for q, mask in zip(angles, masks, strict=True)]


def apart(one: pj.Fit, other: pj.Fit) -> dict:
    """How far apart two cameras are, and in standard deviations."""
    found = drift(other, one)
    return {
        "degrees": float(np.rad2deg(found.angle)),
        "mm": 1e3 * found.distance,
        "most sigmas": float(np.max(np.abs(found.by))),
    }


def main() -> None:
    out = folder()
    if not DATA.exists():
        sys.exit(f"no robot at {DATA}")
    pj.cache()
    table: dict = {}
    fits, refined = {}, {}
    unknown = pj.formats.from_opencv(K, np.eye(3), np.zeros(3), 960, 540, pixel_centres="integer")
    answers = json.loads((DATA / "peer_answers.json").read_text())
    peers = {
        side: at_pose(unknown, np.array(answers[f"HT_{side}_dr"]) @ OPTICAL)
        for side in ("left", "right")
    }
    for side in ("left", "right"):
        seen = views(side)
        begin = time.perf_counter()
        found = pj.fit_joint(seen, unknown, search=True)
        first = time.perf_counter() - begin
        begin = time.perf_counter()
        pj.fit_joint(seen, unknown, search=True)
        searched = time.perf_counter() - begin
        begin = time.perf_counter()
        again = pj.fit_joint(seen, found.camera)
        seconds = [first, searched, time.perf_counter() - begin]
        fit = fits[side] = found.cameras["camera"]
        table[side] = {
            "status": found.status,
            "seconds (first, compiled, from a start)": seconds,
            "std": fit.std.tolist(),
            "peak of the process so far, MB": peak(),
            "excess": found.excess,
            "IoU": [view.iou for view in found.views],
            "from a start": apart(fit, again.cameras["camera"]),
            "halves": halves(seen, found.camera),
            "with the photos": (photos := with_photos(side, seen, found.camera)).row,
        }
        refined[side] = photos.fit.cameras["camera"]
        print(side, json.dumps(table[side], indent=1), flush=True)
        draw(out, side, photos.fit, seen, peers[side])
    table["stereo"] = stereo(fits["left"], fits["right"])
    table["stereo, with the photos"] = stereo(refined["left"], refined["right"])
    table["postures one by one"] = one_by_one({s: fits[s].camera for s in fits})
    table["both eyes as one rig"] = as_one_rig(fits)
    theirs = (fits["left"]._replace(camera=peers[side]) for side in ("left", "right"))
    table["the peer's"] = stereo(*theirs)
    print(json.dumps({k: table[k] for k in table if k not in fits}, indent=1))
    (out / "robots.json").write_text(json.dumps(table, indent=1))


def peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def halves(seen: list[pj.JointView], start: pj.Camera) -> list[dict]:
    """How far apart the cameras are that halves of the postures lead to."""
    fit = lambda half: pj.fit_joint([seen[k] for k in half], start).cameras["camera"]
    return [apart(*map(fit, pair)) for pair in HALVES]


def as_one_rig(fits: dict[str, pj.Fit]) -> dict:
    """What both eyes say of the left one where their rig's transform is known: its sigmas by the
    left eye's masks, by both, and what both should say by theory (information adds up), the sigmas'
    geometric mean over these, and how far apart halves of the postures are."""
    step = np.eye(4)
    step[0, 3] = BASELINE / 1e3
    rig, start = {"left": np.eye(4), "right": step}, fits["left"].camera
    cameras = {side: at_pose(start, pose_of(start) @ rig[side]) for side in rig}
    of = {side: [v._replace(camera=side) for v in views(side)] for side in rig}

    def fit(half: Sequence[int]) -> pj.JointFit:
        return pj.fit_joint([of[side][k] for k in half for side in rig], cameras, rig=rig)

    both = fit(range(len(of["left"])))
    told = both.cameras["left"]
    # The right eye's turn is the left one's, its place follows that.
    turned = pose_of(told.camera)[:3, :3]
    follows = np.eye(6)
    follows[3:, :3] = -skew(turned @ step[:3, 3]) @ turned @ np.diag([1, -1, 1])
    right = follows.T @ np.linalg.inv(fits["right"].covariance) @ follows
    theory = np.linalg.inv(np.linalg.inv(fits["left"].covariance) + right)
    size = lambda covariance: float(np.exp(np.linalg.slogdet(covariance)[1] / 12))
    alone = size(fits["left"].covariance)
    return {
        "status": both.status,
        "excess": both.excess,
        "std of the left eye alone": fits["left"].std.tolist(),
        "std": told.std.tolist(),
        "std by theory": np.sqrt(np.diag(theory)).tolist(),
        "left eye alone over both": alone / size(told.covariance),
        "by theory": alone / size(theory),
        "from the left eye alone": apart(told, fits["left"]),
        "halves": [apart(*(fit(half).cameras["left"] for half in pair)) for pair in HALVES],
    }


class WithPhotos(NamedTuple):
    """A fit refined on photos, and what the table says of it."""

    fit: pj.JointFit
    row: dict


def with_photos(side: str, seen: list[pj.JointView], start: pj.Camera) -> WithPhotos:
    photos = [pj.io.load_image(DATA / f"{side}_{k}.jpg") for k in range(len(seen))]
    views = [v._replace(photo=photo) for v, photo in zip(seen, photos, strict=True)]
    begin = time.perf_counter()
    found = pj.fit_joint(views, start)
    row = {
        "status": found.status,
        "seconds": time.perf_counter() - begin,
        "std": found.cameras["camera"].std.tolist(),
        "weak": found.weak,
        "halves": halves(views, found.camera),
    }
    return WithPhotos(found, row)


def stereo(left: pj.Fit, right: pj.Fit) -> dict:
    """How two eyes lie to one another, beside the truth, and how many sigmas off, number by number:
    three turns, three shifts."""
    step = inverse(pose_of(left.camera)) @ pose_of(right.camera)
    turn = Rotation.from_matrix(step[:3, :3]).as_rotvec()
    sigma = np.hypot(left.std, right.std)
    shift = pose_of(left.camera)[:3, :3] @ (step[:3, 3] - [BASELINE / 1e3, 0, 0])
    off = np.abs(np.append(turn * [1, -1, 1], shift) / sigma)
    return {
        "baseline, mm": float(1e3 * np.linalg.norm(step[:3, 3])),
        "degrees from parallel": float(np.rad2deg(np.linalg.norm(turn))),
        "most sigmas": float(np.max(off)),
        "sigmas": off.tolist(),
    }


def one_by_one(cameras: dict[str, pj.Camera]) -> dict:
    """What each posture's two masks say alone, from a start some degrees off, and how many of the
    95 % intervals between the eyes hold."""
    fits = {}
    for side, camera in cameras.items():
        start = at_pose(camera, pose_of(camera) @ OFF)
        fits[side] = [pj.fit_joint([v], start).cameras["camera"] for v in views(side)]
    pairs = [stereo(*pair) for pair in zip(*fits.values(), strict=True)]
    off = np.array([pair["sigmas"] for pair in pairs])
    return {
        "statuses": {side: [fit.status for fit in fits[side]] for side in fits},
        "std": {side: [fit.std.tolist() for fit in fits[side]] for side in fits},
        "pairs": pairs,
        "intervals that hold": f"{np.sum(off < WITHIN)} of {off.size}",
    }


def draw(
    out: Path, side: str, found: pj.JointFit, seen: list[pj.JointView], peer: pj.Camera
) -> None:
    """Draw our outlines on three of the photos, and below them the peer's."""
    rows = []
    for cameras in ([view.camera for view in found.views], [peer] * len(seen)):
        tiles = []
        for k in (0, 2, 4):
            photo = pj.io.load_image(DATA / f"{side}_{k}.jpg")
            drawn = np.asarray(pj.plot.overlay(photo, cameras[k], seen[k].scene))
            tiles.append(drawn[60:, 320:800])
        rows.append(np.concatenate(tiles, axis=1))
    pj.io.save_image(out / f"robots_{side}.jpg", np.concatenate(rows))


if __name__ == "__main__":
    main()
