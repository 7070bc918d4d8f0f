"""What does a loop over many masks compile, and how much memory does it hold?

Five meshes (80 to 5120 faces and those that there are) by twenty sizes of image (160 to 900 px),
hard masks, a start 5 degrees off. Asked: programs of a fit are shared, so that a few serve all, and
memory stays.
"""

import time
from pathlib import Path

import jax
import jax.monitoring
import numpy as np
from _common import degrees, meshes, orbited, percentiles, random_camera, run, trials
from scipy.spatial.transform import Rotation
from skimage.draw import polygon

import pinhole_jax as pj

#: Compilations that take so many seconds are counted: a fit's program, not what fills an array.
LARGE = 1.0
SIZES = 20


def shapes() -> list[pj.Scene]:
    """Return five scenes of meshes with different numbers of faces."""
    own = [pj.Scene(mesh=pj.shapes.bumpy(k)) for k in (2, 3, 4)]
    found = [scene for name, scene in meshes("spot.obj", "suzanne.ply") if name != "bumpy"]
    more = [pj.Scene(mesh=pj.shapes.bumpy(k, seed)) for k, seed in ((1, 1), (4, 2))]
    return [*own, *found, *more][:5]


def hard_mask(camera: pj.Camera, scene: pj.Scene) -> np.ndarray:
    """Return which pixels' centres faces cover: drawn one by one, nothing is compiled for it."""
    assert scene.mesh is not None
    film = np.asarray(pj.project(camera, scene.mesh.vertices))
    mask = np.zeros((camera.H, camera.W), bool)
    for face in film[np.asarray(scene.mesh.faces)]:
        mask[polygon(camera.H - 0.5 - face[:, 1], face[:, 0] - 0.5, mask.shape)] = True
    return mask


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
    compiled: list[float] = []

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration" and duration_secs > LARGE:
            compiled.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    scenes, rows = shapes(), []
    for number in range(trials(200)):
        random = np.random.default_rng(number % (len(scenes) * SIZES))
        scene = scenes[number % len(scenes)]
        W, H = (int(x) for x in random.integers(160, 900, 2))
        truth = resized(random_camera(random), W, H)
        axis = random.normal(size=3)
        turn = Rotation.from_rotvec(np.deg2rad(5) * axis / np.linalg.norm(axis)).as_matrix()
        start = resized(orbited(truth, turn, 1.02), W, H)
        mask = hard_mask(truth, scene)
        before, begin = len(compiled), time.perf_counter()
        fit = pj.fit_camera(scene, mask, start)
        rows.append(
            {
                "W": W,
                "H": H,
                "seconds": time.perf_counter() - begin,
                "programs": len(compiled) - before,
                "degrees": degrees(fit.camera, truth),
                "status": fit.status,
                "MB": megabytes(),
            }
        )
        r = rows[-1]
        print(
            f"{number:3} {W:3} x {H:3} {fit.status:14} {r['degrees']:7.3f} deg"
            f" {r['seconds']:6.2f} s, {r['programs']} programs, {r['MB'] or 0:.0f} MB",
            flush=True,
        )
    warm = [r["seconds"] for r in rows if not r["programs"]]
    answer = {
        "fits": len(rows),
        "programs": sum(r["programs"] for r in rows),
        "fits that compiled": sum(r["programs"] > 0 for r in rows),
        "seconds of the others": percentiles(warm) if warm else None,
        "MB after 10 fits": rows[min(9, len(rows) - 1)]["MB"],
        "MB at the end": rows[-1]["MB"],
        "off by more than a degree": sum(r["degrees"] > 1 for r in rows),
    }
    print(answer)
    return answer


if __name__ == "__main__":
    run(question)
