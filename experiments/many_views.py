"""How do time and memory of a joint fit grow with the number of views?

Cameras all round one mesh, masks of 64 x 64 pixels, each with a pose of its own, all with the same
unknown focal length (`fit_joint(shared="phi")`); starts 2 degrees and 2 % off. Each number of views
runs in a process of its own; times are of the processor, with what is compiled.
"""

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
from _common import run

import pinhole_jax as pj
from pinhole_jax._camera.poses import at_pose, exponential, pose_of

SIZE, PHI, START = 64, 0.6, 0.62
NUMBERS = (10, 100, 1000)


def views(number: int) -> tuple[pj.Scene, list[pj.Camera], list[pj.Camera]]:
    """Return the scene, the cameras, and where to start."""
    random = np.random.default_rng(0)
    truth, starts = [], []
    for _ in range(number):
        eye = random.normal(size=3)
        eye, up = (
            x.astype(np.float32) for x in (5 * eye / np.linalg.norm(eye), random.normal(size=3))
        )
        camera = pj.Camera(eye, np.zeros(3, np.float32), up, np.float32(PHI), 1.0, SIZE, SIZE)
        off = np.append(random.uniform(-0.04, 0.04, 3), random.uniform(-0.08, 0.08, 3))
        near = at_pose(camera, pose_of(camera) @ exponential(off))
        truth.append(camera)
        starts.append(near.replace(phi=np.float32(START)))
    return pj.Scene(mesh=pj.shapes.bumpy(2)), truth, starts


def one(number: int) -> dict:
    """Return what a fit of this many views takes, and how far off it is."""
    scene, truth, starts = views(number)
    masks = [np.asarray(pj.silhouette(camera, scene)) for camera in truth]
    before, held = processor(), memory()
    given = [pj.JointView(scene, mask, camera=str(k)) for k, mask in enumerate(masks)]
    fit = pj.fit_joint(given, {str(k): start for k, start in enumerate(starts)}, shared="phi")
    found = [fit.cameras[str(k)] for k in range(number)]
    pairs = zip(found, truth, strict=True)
    off = [np.rad2deg(float(pj.pose_error(one.camera, camera)[0])) for one, camera in pairs]
    return {
        "views": number,
        "status": fit.status,
        "seconds of the processor": processor() - before,
        "MB more": memory() - held,
        "peak, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        "phi off": float(found[0].camera.phi) - PHI,
        "its std": float(found[0].std[-1]),
        "worst camera, degrees": float(max(off)),
    }


def processor() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def memory() -> float:
    """Return what the process holds, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def question() -> dict:
    rows = []
    for number in map(int, sys.argv[2:] or NUMBERS):
        done = subprocess.run(
            [sys.executable, __file__, "--one", str(number)], check=True, stdout=subprocess.PIPE
        )
        rows.append(json.loads(done.stdout))
        print(rows[-1], flush=True)
    return {"rows": rows}


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(one(int(sys.argv[2]))))
    else:
        run(question)
