"""How far are a mask, its Jacobian and a fit's step from what the machine can do?

The yardstick is a plain compiled loop that does the least work (`_plain_loop.py`). Spheres of more
and more faces at 512 px, and of 328k faces at more and more pixels; on one thread and on two, each
in a process of its own. Both sides take float32 and what is worked out once per mesh; medians of
calls that are compiled already, ours and the loop's in turn, so that a busy machine slows both.
A fit's step is what it does at one camera on its finest level: residuals, their derivatives by pose
and phi, and where to go. Then an object of 64 px on a small film and on a large one. Last, memory,
each figure in a process of its own: what is resident while a program runs for the first time (it is
compiled already), with the scene and what is returned, over these two; and of 1000 views at once.
(Linux alone tells.)

`python experiments/limit_of_speed.py out` takes some 13 minutes, with `--quick` 3.
"""

import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

FACES = (1e2, 1e3, 1e4, 1e5, 3.28e5, 1e6, 4e6)
PIXELS = (64, 128, 256, 512, 1024, 2048, 4096)
QUICK = ((1e2, 1e5), (64, 512))
AT_PX, AT_FACES = 512, 3.28e5
#: Of these a Jacobian and a fit's step are measured: their programs take 12 s each to compile.
SLOW = ((1e2, 1e4, 3.28e5, 4e6), (64, 256, 1024, 4096))
MOST_PX = 1024  # of a Jacobian: at 4096 px it is 470 MB
SMALL_PX, FILMS = 64, (256, 4096)
LARGE = 9e4  # faces, from which on a mask is held against the loop
SECONDS = 1.0  # for the calls of one figure
#: Faces and px of which memory is measured, and how many masks of 64 px are made at once.
MEMORY = [(n, px) for n in (1e5, 1e6, 4e6) for px in (512, 4096)]
VIEWS, VIEWS_PX, VIEWS_FACES = 1000, 64, 1e5
NAMES = ("mask", "jacobian", "step")
THREADS = (1, 2)
PARAMETERS = (0.4, 1.1, 4.8, 0.05, -0.02, 0.03, 0.55)  # e, p, phi
UP = (0.1, 1.0, 0.05)


def sphere(faces: float):
    """Return a sphere of about this many faces, in rings of twice as many as there are rings."""
    import pinhole_jax as pj

    rings = max(4, round((faces / 4) ** 0.5))
    angle = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    profile = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    profile[[0, -1], 0] = 0
    mesh = pj.shapes.revolved(profile, 2 * rings)
    return pj.Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces))


def in_turn(jobs: dict) -> dict:
    """Return the median seconds of each job; all have run before."""
    import jax

    times: dict = {name: [] for name in jobs}
    begin = time.perf_counter()
    while len(times[next(iter(jobs))]) < 5 or time.perf_counter() - begin < SECONDS:
        for name, job in jobs.items():
            start = time.perf_counter()
            jax.block_until_ready(job())
            times[name].append(time.perf_counter() - start)
        if len(times[name]) == 200:
            break
    return {name: float(np.median(x)) for name, x in times.items()}


def library(scene, px: int):
    """Return our mask, and our mask with its Jacobian, as functions of the parameters."""
    import jax
    import jax.numpy as jnp

    import pinhole_jax as pj

    def mask(x, scene):
        up, d = jnp.asarray(UP, jnp.float32), jnp.float32(1)
        return pj.silhouette(pj.Camera(x[:3], x[3:6], up, x[6], d, px, px), scene)

    def both(x, scene):
        twice = lambda x: (lambda image: (image, image))(mask(x, scene))
        jacobian, image = jax.jacfwd(twice, has_aux=True)(x)
        return image, jacobian

    x = jnp.asarray(PARAMETERS, jnp.float32)
    compiled = (jax.jit(mask), jax.jit(both))
    return [lambda f=f: f(x, scene) for f in compiled]


def fit_step(mesh, px: int, target: np.ndarray):
    """Return a step of a fit to a target as a function, which returns the squares there."""
    import pinhole_jax as pj
    from pinhole_jax._solver.levenberg_marquardt import descended
    from pinhole_jax._solver.moves import canonical
    from pinhole_jax._solver.solver import Solver

    scene, weights = pj.Scene(mesh=mesh), np.broadcast_to(1.0, target.shape)
    solver = Solver.of(scene, target, weights, np.float32, ("pose", "phi"), 64)
    e, p, u, phi = (np.float32(x) for x in (PARAMETERS[:3], PARAMETERS[3:6], UP, PARAMETERS[6]))
    camera = canonical(pj.Camera(e, p, u, phi, 1.0, px, px))
    solver.look(camera, solver.finest)  # its buffers grow
    ends = np.float32(1e-3), np.int32(1)
    given = solver.problem, solver.levels[solver.finest], *ends, solver.freed, solver.capacity
    return lambda: descended(camera, *given)[-1].sums.squares


def measured(mesh, px: int, slow: bool) -> dict:
    """Return times of the library and of the loop, and how far apart their answers are."""
    import _plain_loop as loop

    import pinhole_jax as pj

    shape = loop.shape_of(mesh)
    film = loop.film_of(np.array(PARAMETERS), np.array(UP), px, px)
    our_mask, our_both = library(pj.Scene(mesh=mesh), px)
    jobs = {"mask": our_mask, "mask, loop": lambda: loop.mask(shape, film)}
    apart = {"mask": float(np.abs(np.asarray(our_mask()) - loop.mask(shape, film)).max())}
    if slow and px <= MOST_PX:
        plain = lambda: loop.mask_and_jacobian(shape, film)
        jobs |= {"jacobian": our_both, "jacobian, loop": plain}
        ours, theirs = np.asarray(our_both()[1]), plain()[1]
        apart["jacobian"] = float(np.abs(ours - theirs).max() / np.abs(theirs).max())
    if slow:
        moved = np.add(PARAMETERS, (0, 0, 0, 0.01, 0.01, 0, 0.002))
        target = loop.mask(shape, loop.film_of(moved, np.array(UP), px, px))
        step = fit_step(mesh, px, target)
        jobs |= {"step": step, "step, loop": lambda: loop.step(shape, film, target)}
        apart["step"] = abs(float(step()) / loop.step(shape, film, target)[0] - 1)
    if apart["mask"] > 1e-3 or max(apart.get("jacobian", 0), apart.get("step", 0)) > 1e-2:
        raise SystemExit(f"loop and library differ: {apart}")
    return {"faces": len(mesh.faces), "px": px, "apart": apart, "seconds": in_turn(jobs)}


def small(mesh) -> dict:
    """Return seconds of a small object on films of several sizes, and of writing these."""
    import jax
    import jax.numpy as jnp

    import pinhole_jax as pj

    scene, jobs = pj.Scene(mesh=mesh), {}
    size = SMALL_PX / 2 / np.tan(np.arcsin(1 / np.linalg.norm(PARAMETERS[:3])))
    for px in FILMS:
        e, p, u = (jnp.asarray(x, jnp.float32) for x in (PARAMETERS[:3], PARAMETERS[3:6], UP))
        phi, d = jnp.float32(2 * np.arctan(px / 2 / size)), jnp.float32(1)
        camera = pj.Camera(e, p, u, phi, d, px, px)
        jobs[f"{px} px"] = lambda camera=camera: pj.silhouette(camera, scene)
        write = jax.jit(lambda x, px=px: jnp.full((px, px), x))
        jobs[f"{px} px, written"] = lambda write=write: write(jnp.float32(0))
    for job in jobs.values():
        job()
    return in_turn(jobs)


def resident(field: str) -> int:
    """Return bytes of a field of the process's memory: `VmRSS`, now, `VmHWM`, at most."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(x for x in lines if x.startswith(field)).split()[1])


def memory(faces: float, px: int, views: int) -> dict:
    """Return bytes of the scene, of what is returned, and by how many more are resident while masks
    are made: of one view, or of as many under `vmap`."""
    import ctypes

    import jax
    import jax.numpy as jnp

    import pinhole_jax as pj

    def mask(x, scene):
        up, d = jnp.asarray(UP, jnp.float32), jnp.float32(1)
        return pj.silhouette(pj.Camera(x[:3], x[3:6], up, x[6], d, px, px), scene)

    scene = pj.Scene(mesh=sphere(faces))
    x = jnp.asarray(PARAMETERS, jnp.float32)
    if views > 1:
        mask, x = jax.vmap(mask, (0, None)), jnp.broadcast_to(x, (views, 7))
    compiled = jax.jit(mask).lower(x, scene).compile()
    jax.block_until_ready(jax.tree.leaves(scene))
    ctypes.CDLL(None).malloc_trim(0)  # what compiling took is given back
    Path("/proc/self/clear_refs").write_text("5")  # at most, from now on
    before = resident("VmRSS")
    image = jax.block_until_ready(compiled(x, scene))
    beyond = resident("VmHWM") - before
    size = sum(x.nbytes for x in jax.tree.leaves(scene) if isinstance(x, jax.Array))
    return {"scene": size, "image": image.nbytes, "beyond": beyond}


def all_memory(quick: bool) -> list[dict]:
    """Return the figures of `memory`, each from a process of its own."""
    if not Path("/proc/self/clear_refs").exists():
        return []
    some = [(n, px, 1) for n, px in (MEMORY[:2] if quick else MEMORY)]
    rows = []
    for faces, px, views in (*some, (VIEWS_FACES, VIEWS_PX, VIEWS)):
        command = [sys.executable, __file__, "--memory", str(faces), str(px), str(views)]
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
        row = {"faces": faces, "px": px, "views": views, **json.loads(done.stdout)}
        rows.append(row)
        scene, image, beyond = (row[k] / 1e6 for k in ("scene", "image", "beyond"))
        print(
            f"memory, {faces:.0f} faces, {px} px, {views} views: scene {scene:.0f} MB, masks"
            f" {image:.0f}, beyond the scene {beyond:.0f}: {(scene + beyond) / (scene + image):.2f}"
            " times both (asked: 4)",
            flush=True,
        )
    return rows


def child(threads: int, quick: bool) -> dict:
    """Return both sweeps on this many threads."""
    sweeps = QUICK if quick else (FACES, PIXELS)
    result: dict = {"faces": [], "pixels": []}
    mesh = sphere(AT_FACES)
    for name, sizes, slow in zip(result, sweeps, SLOW, strict=True):
        for n in sizes:
            shape, px = (sphere(n), AT_PX) if name == "faces" else (mesh, n)
            same = [r for r in result["faces"] if (r["faces"], r["px"]) == (len(shape.faces), px)]
            result[name].append(same[0] if same else measured(shape, px, n in slow))
            print(threads, line(result[name][-1]), file=sys.stderr, flush=True)
    result["small"] = small(mesh)
    return result


def line(row: dict) -> str:
    cells = [f"{row['faces']:8d} faces {row['px']:5d} px"]
    for name in NAMES:
        if name in row["seconds"]:
            ours, plain = row["seconds"][name], row["seconds"][f"{name}, loop"]
            figures = f"{1e3 * ours:.2f} ms, loop {1e3 * plain:.2f}, {ours / plain:.1f} times"
            cells.append(f"{name} {figures} (apart {row['apart'][name]:.0e})")
    return "; ".join(cells)


def on_threads(threads: int, quick: bool) -> dict:
    """Return what a process of its own measures, which has this many processors."""
    settings = {"NUMBA_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "PASSIVE"}
    command = [sys.executable, __file__, "--threads", str(threads), *["--quick"] * quick]
    pin = None
    if hasattr(os, "sched_setaffinity"):
        some = sorted(os.sched_getaffinity(0))[:threads]
        pin = lambda: os.sched_setaffinity(0, some)  # XLA takes as many threads as it may run on
    done = subprocess.run(
        command, env={**os.environ, **settings}, stdout=subprocess.PIPE, check=True, preexec_fn=pin
    )
    return json.loads(done.stdout)


def slope(rows: list[dict], by: str, name: str) -> float:
    """Return the power of the upper half of a sweep, by which time grows."""
    rows = [r for r in rows if name in r["seconds"]]
    rows = rows[len(rows) // 2 - (len(rows) < 4) :]
    x, y = (np.log([f(r) for r in rows]) for f in (lambda r: r[by], lambda r: r["seconds"][name]))
    return float(np.polyfit(x, y, 1)[0])


def plot(results: dict, path: Path) -> None:
    try:
        import matplotlib
    except ImportError:
        print("no plot: matplotlib is not installed")
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True)
    for axis, (sweep, by) in zip(axes, (("faces", "faces"), ("pixels", "px")), strict=True):
        for threads, style in zip(results["threads"], ("-", "--"), strict=False):
            rows = results["threads"][threads][sweep]
            for color, name in enumerate(x + loop for x in NAMES for loop in ("", ", loop")):
                some = [r for r in rows if name in r["seconds"]]
                if len(some) < 2:
                    continue
                power = slope(rows, by, name)
                axis.loglog(
                    [r[by] for r in some],
                    [1e3 * r["seconds"][name] for r in some],
                    style,
                    marker="x" if "loop" in name else "o",
                    color=f"C{color}",
                    label=f"{name}, {threads} thread{'s' * (threads != '1')}: power {power:.2f}",
                )
        where = f"{AT_PX} px" if sweep == "faces" else f"{AT_FACES:.0f} faces"
        axis.set(xlabel=f"{sweep if by == 'faces' else 'px a side'} ({where})")
        axis.legend(fontsize=6)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("ms")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def table(results: dict) -> str:
    """Return the figures as a table of README's kind."""
    cells = ["threads", "faces", "px"]
    for words in ("mask, ms", "+ Jacobian, ms", "fit's step, ms"):
        cells += [words, "loop", "ratio"]
    lines = ["| " + " | ".join(cells) + " |", "|---" * len(cells) + "|"]
    for threads, sweeps in results["threads"].items():
        for row in (*sweeps["faces"], *sweeps["pixels"]):
            cells = [threads, str(row["faces"]), str(row["px"])]
            for name in NAMES:
                if name not in row["seconds"]:
                    cells += ["–"] * 3
                    continue
                ours, plain = row["seconds"][name], row["seconds"][f"{name}, loop"]
                cells += [f"{1e3 * ours:.2f}", f"{1e3 * plain:.2f}", f"{ours / plain:.1f}"]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    quick = "--quick" in sys.argv
    if "--threads" in sys.argv:
        print(json.dumps(child(int(sys.argv[sys.argv.index("--threads") + 1]), quick)))
        return
    if "--memory" in sys.argv:
        faces, px, views = map(float, sys.argv[sys.argv.index("--memory") + 1 :])
        print(json.dumps(memory(faces, int(px), int(views))))
        return
    named = [x for x in sys.argv[1:] if not x.startswith("-")]
    folder = Path(named[0] if named else "out")
    folder.mkdir(parents=True, exist_ok=True)
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = [n for n in THREADS if n <= (count or 1)]
    results: dict = {"threads": {str(n): on_threads(n, quick) for n in threads}}
    sweeps = results["threads"].values()
    large = [r for s in sweeps for rows in (s["faces"], s["pixels"]) for r in rows]
    large = [r["seconds"] for r in large if r["faces"] >= LARGE]
    worst = max(seconds["mask"] / seconds["mask, loop"] for seconds in large)
    print(f"a mask takes at most {worst:.1f} times the loop from 100k faces on (asked: 4)")
    for threads, sweeps in results["threads"].items():
        less, more, *written = (
            sweeps["small"][f"{px} px{w}"] for w in ("", ", written") for px in FILMS
        )
        beyond = 1e3 * (more - written[1] - less + written[0])
        print(
            f"{threads} threads: {SMALL_PX} px of {FILMS[0]} take {1e3 * less:.2f} ms,"
            f" of {FILMS[1]} {1e3 * more:.2f}, of which writing takes {1e3 * written[1]:.2f}:"
            f" {beyond:.2f} more"
        )
    print(table(results))
    results["memory"] = all_memory(quick)
    import jax
    import numba

    versions = {"jax": jax.__version__, "numba": numba.__version__}
    results["versions"] = {**versions, "python": platform.python_version()}
    results["machine"] = f"{platform.machine()}, {count} processors"
    (folder / "limit_of_speed.json").write_text(json.dumps(results, indent=1) + "\n")
    plot(results, folder / "limit_of_speed.png")


if __name__ == "__main__":
    main()
