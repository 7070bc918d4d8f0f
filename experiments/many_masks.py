"""What does a loop over many masks compile, and how much memory does it hold?

Five meshes (320 to some 8000 faces) by twenty sizes of image (160 to 900 px) by five kinds of mask
(hard, soft, 8 bits, JPEG, noisy), a start 5 degrees off, all in one loop. Asked: at most 4 programs
of more than 3 seconds of compilation, and less than 1.5 GB that does not grow. Further arguments
are the kinds of mask to take (`out 100 hard JPEG`).
"""

import io
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import jax.monitoring
import numpy as np
from _common import degrees, meshes, orbited, percentiles, random_camera, run, trials
from PIL import Image
from scipy.spatial.transform import Rotation
from skimage.draw import polygon

import pinhole_jax as pj

#: Compilations that take this many seconds are counted: a fit's program, not what fills an array.
LARGE = 3.0
SIZES = 20
#: Samples along a pixel's side that soft masks are made of.
SAMPLES = 4
KINDS = ("hard", "soft", "8 bits", "JPEG", "noisy")


def shapes() -> list[pj.Scene]:
    """Return five scenes of meshes with different numbers of faces."""
    own = [pj.Scene(mesh=pj.shapes.bumpy(k)) for k in (2, 3, 4)]
    found = [scene for name, scene in meshes("spot.obj", "suzanne.ply") if name != "bumpy"]
    more = [pj.Scene(mesh=pj.shapes.bumpy(k, seed)) for k, seed in ((1, 1), (4, 2))]
    return [*own, *found, *more][:5]


def mask_of(camera: pj.Camera, scene: pj.Scene, kind: str, random: np.random.Generator) -> Any:
    """Return a mask of a kind. Faces are drawn one by one, so that nothing is compiled for it."""
    if kind in ("hard", "JPEG"):
        hard = drawn(camera, scene, 1)
        return hard if kind == "hard" else compressed(hard)

    fine = drawn(camera, scene, SAMPLES)
    soft = fine.reshape(camera.H, SAMPLES, camera.W, SAMPLES).mean(axis=(1, 3))
    if kind == "soft":
        return soft
    if kind == "8 bits":
        return np.uint8(np.round(255 * soft))
    return soft + random.normal(scale=0.02, size=soft.shape)


def drawn(camera: pj.Camera, scene: pj.Scene, fine: int) -> np.ndarray:
    """Return which pixels' centres faces cover, on a film of `fine` times as many rows and
    columns."""
    assert scene.mesh is not None
    film = fine * np.asarray(pj.project(camera, scene.mesh.vertices))
    mask = np.zeros((fine * camera.H, fine * camera.W), bool)
    for face in film[np.asarray(scene.mesh.faces)]:
        mask[polygon(len(mask) - 0.5 - face[:, 1], face[:, 0] - 0.5, mask.shape)] = True
    return mask


def compressed(mask: np.ndarray) -> np.ndarray:
    """Return a mask as JPEG of quality 85 gives it back, as uint8."""
    file = io.BytesIO()
    Image.fromarray(np.uint8(255 * mask)).save(file, "JPEG", quality=85)
    return np.asarray(Image.open(file))


def resized(camera: pj.Camera, W: int, H: int) -> pj.Camera:
    return pj.Camera(camera.e, camera.p, camera.u, camera.phi, 1.0, W, H)


def megabytes() -> float | None:
    """Return the process's resident memory, where the system tells."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    line = next(x for x in status.read_text().splitlines() if x.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


def question() -> dict:
    jax.config.update("jax_enable_x64", False)  # as a library's user has it
    compiled: list[str] = []

    def listen(event: str, duration_secs: float, **about: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration" and duration_secs > LARGE:
            compiled.append(str(about.get("fun_name", "?")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    scenes, rows, kinds = shapes(), [], sys.argv[3:] or KINDS
    for number in range(trials(200)):
        random = np.random.default_rng(number % (len(scenes) * SIZES))
        scene = scenes[number % len(scenes)]
        kind = kinds[number // len(scenes) % len(kinds)]
        W, H = (int(x) for x in random.integers(160, 900, 2))
        truth = resized(random_camera(random), W, H)
        axis = random.normal(size=3)
        turn = Rotation.from_rotvec(np.deg2rad(5) * axis / np.linalg.norm(axis)).as_matrix()
        start = resized(orbited(truth, turn, 1.02), W, H)
        mask = mask_of(truth, scene, kind, random)
        before, begin = len(compiled), time.perf_counter()
        fit = pj.fit_camera(scene, mask, start)
        rows.append(
            {
                "W": W,
                "H": H,
                "faces": len(scene.mesh.faces),
                "kind": kind,
                "seconds": time.perf_counter() - begin,
                "programs": compiled[before:],
                "degrees": degrees(fit.camera, truth),
                "status": fit.status,
                "MB": megabytes(),
            }
        )
        r = rows[-1]
        print(
            f"{number:3} {r['faces']:5} faces {W:3} x {H:3} {kind:7} {fit.status:14}"
            f" {r['degrees']:7.3f} deg {r['seconds']:6.2f} s, {r['MB'] or 0:.0f} MB"
            f" {' '.join(r['programs'])}",
            flush=True,
        )
    warm = [r["seconds"] for r in rows if not r["programs"]]
    answer = {
        "fits": len(rows),
        "kinds": [*kinds],
        "programs": len(compiled),
        "of which": dict(Counter(compiled)),
        "fits that compiled": [number for number, r in enumerate(rows) if r["programs"]],
        "seconds of the others": percentiles(warm) if warm else None,
        "MB after 10 fits": rows[min(9, len(rows) - 1)]["MB"],
        "MB after half": rows[len(rows) // 2]["MB"],
        "MB at the end": rows[-1]["MB"],
        "off by more than a degree": sum(r["degrees"] > 1 for r in rows),
    }
    print(answer)
    return answer


if __name__ == "__main__":
    run(question)
