"""Is a robot's camera found from exact masks, with no start, as exactly as floats allow?

    python experiments/robots_exact.py OUT [FITS]

The KUKA LBR Med7 and the Franka Panda of `../shared/data/robots`, five random postures each time
before a random camera; computed masks, float32. Each fit has nothing but scenes, masks and K.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
from _common import camera_at, folder, percentiles, trials

import pinhole_jax as pj

DATA = Path(__file__).parents[2] / "shared" / "data" / "robots"
ROBOTS = ("lbr_med7", "panda")
POSTURES, SIZE, PHI = 5, 256, 0.7
#: How far joints turn (rad) and slide (m).
TURN, OPEN = 1.2, 0.04
#: Where the cameras look, above the base (m), and from how far.
AT, FAR = 0.45, (1.8, 2.8)
#: What was asked for.
DEGREES, METRES = 1e-5, 1e-5


def camera(random: np.random.Generator) -> pj.Camera:
    """Return a camera that looks at the arm from the front, above or a little below."""
    about, up = random.uniform(0, 2 * np.pi), np.deg2rad(random.uniform(-10, 50))
    back = np.array([np.cos(about) * np.cos(up), np.sin(about) * np.cos(up), np.sin(up)])
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    eye = [0, 0, AT] + random.uniform(-0.1, 0.1, 3) + random.uniform(*FAR) * back
    axes = np.stack([right, np.cross(back, right), -back])
    seen = camera_at(axes, np.zeros(2), 1.0, PHI, SIZE)
    shift = np.asarray(eye - np.asarray(seen.e), np.float32)
    return pj.Camera(seen.e + shift, seen.p + shift, seen.u, PHI, 1.0, SIZE, SIZE)


def posture(robot: pj.robots.Robot, random: np.random.Generator) -> dict[str, float]:
    """Return angles (rad), and how far a gripper's fingers are open (m)."""
    units = robot.posture(np.zeros(len(robot.joints))).units
    return {
        name: random.uniform(-TURN, TURN) if unit == "rad" else random.uniform(0, OPEN)
        for name, unit in zip(robot.joints, units, strict=True)
    }


def trial(robot: pj.robots.Robot, number: int) -> dict:
    """Return how far off the camera is that one fit finds."""
    random = np.random.default_rng([number, 5])
    truth = camera(random)
    views = []
    for _ in range(POSTURES):
        scene = robot.scene(posture(robot, random))
        views.append(pj.JointView(scene, np.asarray(pj.silhouette(truth, scene))))
    begin = time.perf_counter(), time.process_time()
    nowhere = camera_at(np.eye(3), np.zeros(2), 1.0, PHI, SIZE)
    found = pj.fit_joint(views, nowhere, search=True)
    angle, shift = (float(x) for x in pj.pose_error(found.camera, truth))
    return {
        "status": found.status,
        "degrees": float(np.rad2deg(angle)),
        "metres": shift,
        "wall": time.perf_counter() - begin[0],
        "cpu": time.process_time() - begin[1],
    }


def main() -> None:
    out = folder()
    if not DATA.exists():
        sys.exit(f"skipped: no robots at {DATA}")
    pj.cache()
    count = trials(60)
    rows: list[dict] = []
    for name in ROBOTS:
        robot = pj.robots.load_urdf(DATA / name / f"{name}.urdf")
        for number in range(count // len(ROBOTS)):
            rows.append({"robot": name, "number": number, **trial(robot, number)})
            print(rows[-1], flush=True)
            (out / "robots_exact.json").write_text(json.dumps(summary(rows), indent=1) + "\n")
    print(json.dumps(summary(rows)["table"], indent=1))


def summary(rows: list[dict]) -> dict:
    table = {}
    for name in ROBOTS:
        mine = [r for r in rows if r["robot"] == name]
        if not mine:
            continue
        table[name] = {
            "fits": len(mine),
            "as exact as asked": sum(
                r["degrees"] <= DEGREES and r["metres"] <= METRES for r in mine
            ),
            "converged": sum(r["status"] == "converged" for r in mine),
            "degrees": percentiles(r["degrees"] for r in mine),
            "metres": percentiles(r["metres"] for r in mine),
            "seconds": percentiles(r["wall"] for r in mine),
        }
    return {"table": table, "fits": rows}


if __name__ == "__main__":
    main()
