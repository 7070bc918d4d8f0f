"""Is what an accelerator makes right, and how fast is it there?

    python experiments/device.py OUT

The same programs on this machine's device and on its CPU, each in a process of its own: masks, a
depth map, derivatives, rays, fits. Errors are the largest entry's distance from what the CPU makes
in float64, as a share of the largest entry; times are medians of calls, after the first.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import camera_at, degrees, folder, orbited
from rough import balls, bumpy, soup
from scipy.spatial.transform import Rotation

import pinhole_jax as pj

LONG, MOST = 2.0, 30
#: Where programs run, the truth first, and whether in float64.
PLACES = {"cpu64": ("cpu", "1"), "cpu32": ("cpu", "0"), "here64": ("", "1"), "here32": ("", "0")}
#: A fit starts so many degrees off.
OFF = 8.0


def real(tree: Any) -> Any:
    """Return arrays in this process's precision."""
    to = np.float64 if jax.config.read("jax_enable_x64") else np.float32
    return jax.tree.map(lambda x: x.astype(to) if x.dtype.kind == "f" else x, tree)


def camera(size: int = 256) -> pj.Camera:
    return real(camera_at(np.eye(3), np.array([0.1, 0.05]), 5.0, 0.6, size))


def loss(camera, scene):
    return jnp.sum(pj.silhouette(camera, scene) ** 2)


def mask_of(scene: pj.Scene, size: int = 256) -> Callable[[], Any]:
    def made():
        return jax.jit(pj.silhouette), (camera(size), real(scene))

    return made


def gradient_of(scene: pj.Scene, *, lens: bool = False) -> Callable[[], Any]:
    def made():
        c = camera()
        if lens:
            model = real(pj.Lens([128.0, 128.0], 1.0, pj.BrownConrady(0.1, 0.0, 0.0, 0.0, 0.0)))
            c = pj.Camera(c.e, c.p, c.u, c.phi, c.d, c.W, c.H, model)
        of = lambda e, phi, s: loss(c.replace(e=e, phi=phi), s)
        return jax.jit(jax.value_and_grad(of, (0, 1))), (c.e, c.phi, real(scene))

    return made


def many():
    """64 masks at once, from places beside one another."""
    c, scene = camera(), real(bumpy(4, 0.0))
    places = c.e + 0.1 * np.random.default_rng(0).normal(size=(64, 3)).astype(c.e.dtype)
    one = lambda e: pj.silhouette(c.replace(e=e), scene)
    return jax.jit(jax.vmap(one)), (places,)


def gradient_of_vertices():
    mesh = real(bumpy(4, 0.0)).mesh
    of = lambda v: loss(camera(), pj.Scene(mesh=pj.Mesh(v, mesh.faces)))
    return jax.jit(jax.grad(of)), (mesh.vertices,)


def depth():
    return jax.jit(pj.depth), (camera(), real(bumpy(4, 0.0)))


def rays():
    def distances(camera, scene):
        hit = pj.trace(scene, pj.camera_rays(camera))
        return jnp.where(jnp.isfinite(hit.t), hit.t, 0)

    return jax.jit(distances), (camera(1024), real(bumpy(6, 0.0)))


PROGRAMS: dict[str, Callable] = {
    "mask, 5k faces, 256 px": mask_of(bumpy(4, 0.0)),
    "mask, 82k faces, 256 px": mask_of(bumpy(6, 0.0)),
    "mask, 82k faces, 1024 px": mask_of(bumpy(6, 0.0), 1024),
    "mask, scan of 82k, 256 px": mask_of(bumpy(6, 0.12)),
    "mask, soup of 10k": mask_of(soup(10_000)),
    "mask, 2000 spheres": mask_of(balls(2000)),
    "64 masks under vmap": many,
    "depth, 5k faces, 256 px": depth,
    "rays, 82k faces, 1024 px": rays,
    "camera's gradient": gradient_of(bumpy(4, 0.0)),
    "camera's gradient, lens": gradient_of(bumpy(4, 0.0), lens=True),
    "camera's gradient, 200 spheres": gradient_of(balls(200)),
    "vertices' gradient": gradient_of_vertices,
}


def program(name: str) -> tuple[dict, list[np.ndarray]]:
    """Return what a program's calls take, and its answer."""
    function, arguments = PROGRAMS[name]()
    clock = lambda: time.perf_counter()
    begin = clock()
    answer = jax.block_until_ready(function(*arguments))
    first, calls = clock() - begin, []
    begin = clock()
    while len(calls) < 3 or (len(calls) < MOST and clock() - begin < LONG):
        start = clock()
        jax.block_until_ready(function(*arguments))
        calls.append(clock() - start)
    leaves = [np.asarray(x, np.float64) for x in jax.tree.leaves(answer)]
    return {"first s": first, "ms": 1e3 * float(np.median(calls))}, leaves


def fit(hard: bool) -> tuple[dict, list[np.ndarray]]:
    """Return what fits to one mask take, and how they end."""
    truth, scene = camera(), real(bumpy(4, 0.0))
    mask = np.asarray(jax.jit(pj.silhouette)(truth, scene))
    turn = Rotation.from_rotvec(np.deg2rad(OFF) * np.array([0.6, 0.8, 0])).as_matrix()
    start, seconds = real(orbited(truth, turn, 1.05)), []
    for _ in range(4):
        begin = time.perf_counter()
        found = pj.fit_camera(scene, mask > 0.5 if hard else mask, start)
        seconds.append(time.perf_counter() - begin)
    of = {"status": found.status, "degrees off": degrees(found.camera, truth)}
    return {"first s": seconds[0], "ms": 1e3 * float(np.median(seconds[1:])), **of}, []


def child(place: str) -> None:
    """Print and save what one place makes."""
    kept, rows = {}, {}
    tasks = {name: lambda name=name: program(name) for name in PROGRAMS}
    tasks |= {"fit, exact mask": lambda: fit(False), "fit, hard mask": lambda: fit(True)}
    for name, task in tasks.items():
        try:
            rows[name], leaves = task()
        except Exception as error:  # (the others' rows are wanted, too)
            rows[name], leaves = {"error": f"{type(error).__name__}: {error}"[:500]}, []
        kept |= {f"{name}/{k}": leaf for k, leaf in enumerate(leaves)}
        print(place, name, rows[name], flush=True)
        np.savez_compressed(folder() / f"{place}.npz", **kept)
        answer = {"device": jax.devices()[0].device_kind, "jax": jax.__version__, "rows": rows}
        (folder() / f"{place}.json").write_text(json.dumps(answer, indent=1) + "\n")


def apart(name: str, ours: Any, truth: Any) -> float | None:
    """Return how far a program's answer is from the true one; infinite where only one of the two
    is finite."""
    names = [n for n in truth.files if n.startswith(f"{name}/") and n in ours.files]
    most = None
    for n in names:
        a, b = ours[n], truth[n]
        both = np.isfinite(a) & np.isfinite(b)
        off = np.abs(np.subtract(a, b, where=both, out=np.zeros_like(b)))
        off[(a != b) & ~both & ~(np.isnan(a) & np.isnan(b))] = np.inf
        most = max(most or 0.0, float(off.max() / np.abs(b[np.isfinite(b)]).max()))
    return most


def main() -> None:
    if len(sys.argv) > 2:
        child(sys.argv[2])
        return
    for place, (platform, x64) in PLACES.items():
        if (folder() / f"{place}.json").exists():  # (made on another machine, or before)
            continue
        environment = {**os.environ, "JAX_ENABLE_X64": x64, "JAX_PLATFORMS": platform}
        words = [sys.executable, __file__, str(folder()), place]
        subprocess.run(words, env=environment, check=True)
    made = {place: json.loads((folder() / f"{place}.json").read_text()) for place in PLACES}
    answers = {place: np.load(folder() / f"{place}.npz") for place in PLACES}
    for name in made["cpu64"]["rows"]:
        print(name)
        for place, of in made.items():
            row = of["rows"].get(name, {})
            row["apart"] = apart(name, answers[place], answers["cpu64"])
            print("   ", place, row)
    (folder() / "device.json").write_text(json.dumps(made, indent=1) + "\n")


if __name__ == "__main__":
    main()
