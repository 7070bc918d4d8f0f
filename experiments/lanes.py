"""How many fits a second, side by side, on this machine's device: 1 to 4096 lanes.

Exact masks of 64 px of a shape of 320 faces, starts 8 degrees off; the same script on a CPU and on
a GPU. Says what of it goes into the descents (the device's part), and what one fit alone takes.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax._fit import fit_lanes as lanes

SIZE, SUBDIVISIONS, OFF_DEGREES = 64, 2, 8.0
NUMBERS = (1, 4, 16, 64, 256, 1024, 4096)
#: Up to this many lanes are fitted several times, the first not counted; on a device that takes
#: more at a time, `--warm` says how many.
WARM = 16
#: So many are fitted alone, too: for what that takes, and to compare the cameras.
ALONE = 16


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--most", type=int, default=NUMBERS[-1])
    parser.add_argument("--hard", action="store_true", help="masks of zeros and ones")
    parser.add_argument("--warm", type=int, default=WARM)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)
    pj.cache(options.out / "cache")
    numbers = [n for n in NUMBERS if n <= options.most]
    scene, masks, starts = made(numbers[-1], options.hard)
    answer = {
        "device": jax.devices()[0].device_kind,
        "masks": "hard" if options.hard else "exact",
        "alone": alone(scene, masks, starts),
        "curve": [],
    }
    path = options.out / ("lanes_hard.json" if options.hard else "lanes.json")
    for number in numbers:
        answer["curve"].append(row(scene, masks[:number], starts[:number], options.warm))
        print(json.dumps(answer["curve"][-1]), flush=True)
        path.write_text(json.dumps(answer, indent=1) + "\n")
    print(json.dumps(answer["alone"]))


def made(count: int, hard: bool) -> tuple[pj.Scene, np.ndarray, list[pj.Camera]]:
    """Return a scene, masks of it from all sides, and where to start."""
    seed = np.random.default_rng(0)
    scene = pj.Scene(mesh=pj.shapes.bumpy(SUBDIVISIONS))
    draw = jax.jit(pj.silhouette)
    masks, starts = [], []
    for _ in range(count):
        eye, up, axis = seed.normal(size=(3, 3))
        eye *= seed.uniform(5, 6) / np.linalg.norm(eye)
        camera = pj.Camera(eye, 0.08 * seed.normal(size=3), up, 0.6, 1.0, SIZE, SIZE)
        mask = np.asarray(draw(camera, scene))
        masks.append(mask > 0.5 if hard else mask)
        turn = Rotation.from_rotvec(np.deg2rad(OFF_DEGREES) * axis / np.linalg.norm(axis))
        starts.append(camera.replace(e=turn.apply(eye), u=turn.apply(up)))
    return scene, np.stack(masks), starts


def timed(call: Callable[[], Any]) -> tuple[float, float, Any]:
    """Return the seconds that a call takes, those of the processor, and its result."""
    begin, used = time.perf_counter(), time.process_time()
    result = call()
    return time.perf_counter() - begin, time.process_time() - used, result


def row(scene: pj.Scene, masks: np.ndarray, starts: list[pj.Camera], warm: int) -> dict:
    """Return what this many lanes take, once all is compiled, and what becomes of them."""
    count, spent = len(starts), []
    descend = lanes.descend

    def counted(*arguments, **named):
        seconds, used, result = timed(lambda: descend(*arguments, **named))
        spent.append((seconds, used))
        return result

    fit = lambda: lanes.fit_lanes(scene, masks, starts)
    first = timed(fit)[0] if count <= warm else None  # compiles; on a CPU more are the same again
    lanes.descend = counted
    try:
        runs = []
        for _ in range(3 if count <= warm else 1):
            spent.clear()
            runs.append((*timed(fit), np.sum(spent, axis=0)))
    finally:
        lanes.descend = descend
    seconds, used, found, down = min(runs, key=lambda r: r[1])
    return {
        "lanes": count,
        "lanes a second": count / seconds,
        "processor ms a lane": 1e3 * used / count,
        "of it in descents": 1e3 * down[1] / count,
        "seconds in descents": down[0],
        "seconds the first time": first,
        "statuses": Counter(fit.status for fit in found.fits),
        "alone": sum(map(bool, found.alone)),
    }


def alone(scene: pj.Scene, masks: np.ndarray, starts: list[pj.Camera]) -> dict:
    """Return what fits one after the other take, and how far lanes' cameras are from theirs."""
    count = min(ALONE, len(starts))
    pairs = [*zip(masks[:count], starts[:count], strict=True)]
    fit = lambda: [pj.fit_camera(scene, mask, start) for mask, start in pairs]
    fit()
    seconds, used, fits = min((timed(fit) for _ in range(3)), key=lambda r: r[1])
    found = lanes.fit_lanes(scene, masks[:count], starts[:count]).fits
    apart = [pj.pose_error(a.camera, b.camera)[0] for a, b in zip(found, fits, strict=True)]
    return {
        "fits a second": count / seconds,
        "processor ms a fit": 1e3 * used / count,
        "farthest from a lane's camera (degrees)": float(np.rad2deg(np.max(apart))),
        "other statuses": sum(a.status != b.status for a, b in zip(found, fits, strict=True)),
    }


if __name__ == "__main__":
    main()
