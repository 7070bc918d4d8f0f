"""What do many masks, views and fits cost, and what do they survive?

    python experiments/many.py batch | views | masks [OUT]

- `batch`: hard masks, starts some degrees off, by worker processes; then once more, with workers
  and the parent killed at random and resumed: the table is to be the same.
- `views`: cameras all round one mesh that share an unknown focal length: time and memory of a joint
  fit of 10, 100 and 1000 views, each in a process of its own.
- `masks`: five meshes by twenty sizes of image by kinds of mask in one loop: what is compiled, and
  how much memory is held.
"""

import json
import os
import random as chance
import resource
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import jax
import jax.monitoring
import numpy as np
import trimesh
from _common import (
    Options,
    apart,
    degrees,
    main,
    mask_of,
    meshes,
    percentiles,
    random_camera,
    resized,
    show,
    start_from,
)
from honesty import KINDS, jpeg

import pinhole_jax as pj


def records(folder: Path, count: int) -> list[dict]:
    """Write masks of 96 px and where to start, and return what `fit_many` takes."""
    mesh = pj.shapes.bumpy(2)
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(folder / "part.ply")
    items, scene = [], pj.Scene(mesh=pj.load_mesh(folder / "part.ply"))
    for k in range(count):
        random = np.random.default_rng(k)
        truth, name = random_camera(random, size=96), f"{folder / str(k)}"
        pj.io.save_image(f"{name}.png", mask_of(truth, scene) > 0.5)
        pj.io.save_camera(f"{name}.json", start_from(truth, 5, 0.02, random))
        paths = {"mask": f"{name}.png", "camera": f"{name}.json"}
        items.append({"id": f"{k}", "mesh": str(folder / "part.ply"), **paths})
    return items


def rows_of(folder: Path) -> dict[str, dict]:
    """Return a folder's rows by id, without their times."""
    return {row["id"]: {**row, "seconds": 0.0} for row in pj.batch.Results(folder)}


def children(pid: int) -> list[int]:
    """Return the worker processes of a process."""
    try:
        own = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return [int(n) for n in own if "spawn_main" in Path(f"/proc/{n}/cmdline").read_text()]
    except OSError:
        return []


def batch(asked: Options) -> dict:
    count, data = asked.number(1000, 8), asked.out / "batch"
    (asked.out / "batch.items").write_text(json.dumps(records(data, count)))
    run = [sys.executable, __file__, "--fit-many", str(asked.out / "batch.items")]
    begin = time.perf_counter()
    subprocess.run([*run, str(data / "whole")], check=True)
    seconds, killed, draw = time.perf_counter() - begin, Counter(), chance.Random(0)
    while True:
        process = subprocess.Popen([*run, str(data / "stopped")])
        until = time.perf_counter() + draw.uniform(0.3, 0.8) * seconds
        while process.poll() is None and time.perf_counter() < until:
            time.sleep(draw.uniform(0.05, 0.2) * seconds)
            if len(own := children(process.pid)) > 1 and draw.random() < 0.5:
                os.kill(draw.choice(own), signal.SIGKILL)
                killed["workers"] += 1
        if process.poll() is not None:
            break
        process.kill()
        process.wait()
        killed["parents"] += 1
    whole, stopped = rows_of(data / "whole"), rows_of(data / "stopped")
    same = repr(sorted(whole.items())) == repr(sorted(stopped.items()))
    words = f"{count} items in {seconds:.0f} s; killed {dict(killed)}, the same table: {same}"
    return {"verdict": words, "seconds": seconds, "killed": killed, "same": same}


def joint(number: int) -> dict:
    """Return the time and the error of a fit of this many views of 64 px."""
    scene, truth, given = pj.Scene(mesh=pj.shapes.bumpy(2)), {}, {}
    for k in range(number):
        random = np.random.default_rng(k)
        camera = truth[str(k)] = random_camera(random, size=64)
        given[str(k)] = start_from(camera, 2, 0.02, random).replace(phi=np.float32(0.62))
    views = [pj.JointView(scene, mask_of(c, scene), camera=k) for k, c in truth.items()]
    begin = time.process_time()
    fit = pj.fit_joint(views, given, shared="phi")
    found = {k: of.camera for k, of in fit.cameras.items()}
    return {
        "views": number,
        "status": fit.status,
        "s of the processor": time.process_time() - begin,
        "peak GB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "phi off": float(found["0"].phi) - 0.6,
        "worst degrees": max(degrees(camera, truth[k]) for k, camera in found.items()),
    }


def views(asked: Options) -> dict:
    numbers = (3, 6) if asked.quick else (10, 100, 1000)
    rows = [apart(__file__, "--views", str(number)) for number in numbers]
    show(rows)
    last = rows[-1]
    words = f"{last['views']} views: {last['s of the processor']:.0f} s of the processor"
    return {"verdict": f"{words}, {last['peak GB']:.1f} GB", "table": rows}


FIT = "jit(descended)"  # a fit's program, by JAX's name of it
WAYS = {**KINDS, "JPEG": lambda image, random: jpeg(image > 0.5, 85)}


def megabytes() -> float:
    """Return the process's resident memory (MB), 0 if the system does not report it."""
    path = Path("/proc/self/statm")
    pages = int(path.read_text().split()[1]) if path.exists() else 0
    return pages * resource.getpagesize() / 1e6


def masks(asked: Options) -> dict:
    compiled: list[float] = []

    def listen(event: str, duration_secs: float, **about: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration" and about.get("fun_name") == FIT:
            compiled.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    scenes = [pj.Scene(mesh=pj.shapes.bumpy(k)) for k in (2, 3, 4)]
    scenes += [scene for name, scene in meshes("spot.obj", "suzanne.ply") if name != "bumpy"]
    rows, kinds = [], [*WAYS]
    for number in range(asked.number(200, 4)):
        random = np.random.default_rng(number % 100)
        scene, kind = scenes[number % len(scenes)], kinds[number // len(scenes) % len(kinds)]
        truth = resized(random_camera(random), *map(int, random.integers(160, 900, 2)))
        start = start_from(truth, 5, 0.02, random)
        mask = WAYS[kind](mask_of(truth, scene), random)
        before, begin = len(compiled), time.perf_counter()
        fit = pj.fit_camera(scene, mask, start)
        row = {"W": truth.W, "H": truth.H, "kind": kind, "s": time.perf_counter() - begin}
        row |= {"MB": megabytes(), "degrees": degrees(fit.camera, truth)}
        rows.append({**row, "programs": len(compiled) - before})
        print(rows[-1], flush=True)
    programs = sum(row["programs"] for row in rows)
    held = [row["MB"] for row in rows]
    seconds = percentiles(row["s"] for row in rows if not row["programs"])
    words = f"{len(rows)} fits: {programs} programs of a fit"
    words += f", {held[len(held) // 2]:.0f} MB half-way, {held[-1]:.0f} at the end"
    return {"verdict": words, "s": seconds, "table": rows}


if __name__ == "__main__":
    if sys.argv[1] == "--fit-many":
        pj.fit_many(json.loads(Path(sys.argv[2]).read_text()), out=sys.argv[3], workers=2)
    elif sys.argv[1] == "--views":
        print(json.dumps(joint(int(sys.argv[2]))))
    else:
        main(__doc__, {"batch": batch, "views": views, "masks": masks}, x64=False)
