"""Where is a camera that sees a robot? Masks by a network, joint angles and a URDF, with no start.

    python experiments/robots.py OUT

The KUKA LBR Med7 of `../shared/data/robots`: five postures before a stereo camera. Each eye is
fitted by itself: that both are 120.09 mm apart, and parallel, no fit knows. Then halves of the
postures, and the peers' answers. The picture has the recovered outlines on the photos.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
from _common import folder
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax._camera.poses import at_pose, inverse, pose_of
from pinhole_jax._fit.drift import drift

DATA = Path(__file__).parents[2] / "shared" / "data" / "robots" / "lbr_med7"
K = [
    [534.6265258789062, 0, 478.0846252441406],
    [0, 534.6265258789062, 260.9943542480469],
    [0, 0, 1],
]
BASELINE = 120.09
HALVES = (((0, 2, 4), (1, 3)), ((0, 1), (2, 3, 4)))
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
    fits = {}
    unknown = pj.formats.from_opencv(K, np.eye(3), np.zeros(3), 960, 540, pixel_centres="integer")
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
            "excess": found.excess,
            "IoU": [view.iou for view in found.views],
            "from a start": apart(fit, again.cameras["camera"]),
            "halves": [
                apart(
                    *(
                        pj.fit_joint([seen[k] for k in half], found.camera).cameras["camera"]
                        for half in pair
                    )
                )
                for pair in HALVES
            ],
        }
        print(side, json.dumps(table[side], indent=1), flush=True)
        draw(out, side, found, seen)
    table["stereo"] = stereo(fits["left"], fits["right"])
    peers = json.loads((DATA / "peer_answers.json").read_text())
    left, right = (
        at_pose(unknown, np.array(peers[f"HT_{side}_dr"]) @ OPTICAL) for side in ("left", "right")
    )
    table["the peer's"] = stereo(*(fits["left"]._replace(camera=c) for c in (left, right)))
    print(json.dumps({k: table[k] for k in ("stereo", "the peer's")}, indent=1))
    (out / "robots.json").write_text(json.dumps(table, indent=1))


def stereo(left: pj.Fit, right: pj.Fit) -> dict:
    """How two eyes lie to one another, beside the truth, and how many sigmas off."""
    step = inverse(pose_of(left.camera)) @ pose_of(right.camera)
    turn = Rotation.from_matrix(step[:3, :3]).as_rotvec()
    sigma = np.hypot(left.std, right.std)
    shift = pose_of(left.camera)[:3, :3] @ (step[:3, 3] - [BASELINE / 1e3, 0, 0])
    return {
        "baseline, mm": float(1e3 * np.linalg.norm(step[:3, 3])),
        "degrees from parallel": float(np.rad2deg(np.linalg.norm(turn))),
        "most sigmas": float(np.max(np.abs(np.append(turn * [1, -1, 1], shift) / sigma))),
    }


def draw(out: Path, side: str, found: pj.JointFit, seen: list[pj.JointView]) -> None:
    tiles = []
    for k, (view, given) in enumerate(zip(found.views, seen, strict=True)):
        photo = pj.io.load_image(DATA / f"{side}_{k}.jpg")
        tiles.append(np.asarray(pj.plot.overlay(photo, view.camera, given.scene))[::2, ::2])
    pj.io.save_image(out / f"robots_{side}.jpg", np.concatenate(tiles[:4:2] + tiles[4:], axis=1))


if __name__ == "__main__":
    main()
