"""How fast is the tracer beside Embree?

Rays of a camera (an image) and rays from anywhere to anywhere against spheres of triangles. Of an
image's rays what they meet is drawn (`trace` of a camera, `depth`) or, as of all others, searched
for in a tree (`trace` of its rays). Embree runs through `embreex`, on one core; ours uses what XLA
uses. Times are medians of calls that are compiled already, ours and Embree's in turn, so a busy
machine slows all.
"""

import json
import platform
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh

import pinhole_jax as pj

IMAGES = (32, 128, 512, 1024)  # px, squares
SUBDIVISIONS = (3, 5, 7)  # 1280, 20480 and 327680 faces
CALLS = 5


def timed(jobs: dict) -> dict[str, tuple[float, float]]:
    """Return seconds of each job's first call, and the median of its later ones; job by job."""
    times: dict = {name: [] for name in jobs}
    for _ in range(CALLS + 1):
        for name, job in jobs.items():
            begin = time.perf_counter()
            jax.block_until_ready(job())
            times[name].append(time.perf_counter() - begin)
    return {name: (x[0], float(np.median(x[1:]))) for name, x in times.items()}


def camera(width: int) -> pj.Camera:
    e, p, u = np.float32([0.3, 1, 5]), np.zeros(3, np.float32), np.float32([0, 1, 0])
    return pj.Camera(e, p, u, np.float32(0.45), np.float32(1), width, width)


def random_rays(width: int) -> pj.Rays:
    random = np.random.default_rng(0)
    origin = random.normal(size=(width * width, 3))
    origin *= 3 / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = random.uniform(-1, 1, size=origin.shape) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return pj.Rays(jnp.asarray(origin, jnp.float32), jnp.asarray(direction, jnp.float32))


def embree(shape: trimesh.Trimesh):
    """Return Embree's first hits of rays as a function, or None where embreex is not installed."""
    try:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh
    except ImportError:
        return None
    scene = rtcore_scene.EmbreeScene()
    mesh = TriangleMesh(scene, shape.vertices[shape.faces].astype(np.float32))

    return lambda origin, direction, keep=mesh: scene.run(origin, direction)


def temporary_bytes(function, *arguments) -> int:
    """Return how much memory a call needs beside its arguments and its result."""
    compiled = eqx.filter_jit(function).lower(*arguments).compile().compiled
    return int(compiled.memory_analysis().temp_size_in_bytes)


def run(shape: trimesh.Trimesh, scene: pj.Scene, rays: pj.Rays, film: pj.Camera | None) -> dict:
    """Return times and shares of equal hits; of an image, if `film` says whose rays these are."""
    jobs = {"trace": lambda: pj.trace(scene, rays), "occluded": lambda: pj.occluded(scene, rays)}
    if film is not None:
        jobs["depth"] = lambda: pj.depth(film, scene)
        jobs["drawn"] = lambda: pj.trace(scene, film)
    direction = np.asarray(rays.direction).reshape(-1, 3)
    origin = np.ascontiguousarray(np.broadcast_to(rays.origin, rays.direction.shape).reshape(-1, 3))
    peer = embree(shape)
    if peer is not None:
        jobs["trace_by_embree"] = lambda: pj.trace(scene, rays, search="embree")
        jobs["embree"] = lambda: peer(origin, direction)
    seconds = timed(jobs)
    result = {"faces": len(shape.faces), "rays": len(direction)}
    result |= {f"{name}_s": median for name, (_, median) in seconds.items()}
    result |= {f"{name}_first_call_s": first for name, (first, _) in seconds.items()}
    ours = np.asarray(pj.trace(scene, rays).primitive).reshape(-1)
    if film is not None:
        drawn = np.asarray(pj.trace(scene, film).primitive).reshape(-1)
        result["drawn_as_searched"] = float(np.mean(drawn == ours))
    if peer is not None:
        theirs = peer(origin, direction)
        for name in jobs:
            result[f"{name}_ratio"] = result[f"{name}_s"] / result["embree_s"]
        by_embree = np.asarray(pj.trace(scene, rays, search="embree").primitive).reshape(-1)
        result["by_embree_as_searched"] = float(np.mean(by_embree == ours))
        result["same_face"] = float(np.mean(ours == theirs))
        result["same_hit"] = float(np.mean((ours >= 0) == (theirs >= 0)))
    return result


def plot(results: dict, path: Path) -> None:
    try:
        import matplotlib
    except ImportError:
        print("no plot: matplotlib is not installed")
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    for axis, kind in zip(axes, ("image", "random"), strict=True):
        for color, subdivisions in enumerate(SUBDIVISIONS):
            rows = [r for r in results[kind] if r["faces"] == 20 * 4**subdivisions]
            rays = [r["rays"] for r in rows]
            kinds = (("trace_s", "-o", ", tree"), ("depth_s", "--s", ", drawn"))
            for key, line, what in (*kinds, ("embree_s", ":x", ", Embree")):
                if key in rows[0]:
                    label = f"{rows[0]['faces']} faces{what}"
                    axis.loglog(rays, [r[key] for r in rows], line, color=f"C{color}", label=label)
        axis.set(title=f"{kind} rays", xlabel="rays")
    axes[0].set_ylabel("seconds")
    axes[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def say(last: dict) -> None:
    """Print the verdict on the largest image."""
    print(
        f"{last['rays']} rays of an image, {last['faces']} faces; drawn as searched for:", end=" "
    )
    print(f"{last['drawn_as_searched']:.6f} of them")
    for name in ("depth", "drawn", "trace"):
        text = f"{name}: {1e3 * last[f'{name}_s']:.0f} ms"
        text += f" (first call {last[f'{name}_first_call_s']:.1f} s)"
        if "embree_s" in last:
            text += f", {last[f'{name}_ratio']:.1f} times Embree's on one core"
        print(text)
    if "embree_s" not in last:
        print("Embree was not asked: embreex is not installed")
    drawn, searched = last["temporary_bytes"] / 1e6, last["tree_temporary_bytes"] / 1e6
    given = last["arguments_bytes"] / 1e6
    print(f"{drawn:.0f} MB beside the {given:.0f} MB of the mesh; the tree's {searched:.0f}")


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    folder.mkdir(parents=True, exist_ok=True)
    results: dict = {"image": [], "random": []}
    for subdivisions in SUBDIVISIONS:
        shape = trimesh.creation.icosphere(subdivisions=subdivisions)
        mesh = pj.Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces))
        scene = pj.Scene(mesh=mesh)
        films = [camera(width) for width in IMAGES]
        results["image"] += [run(shape, scene, pj.camera_rays(film), film) for film in films]
        results["random"] += [run(shape, scene, random_rays(n), None) for n in IMAGES[:3]]
    last, film = results["image"][-1], camera(IMAGES[-1])
    leaves = [x for x in jax.tree.leaves((scene, film)) if hasattr(x, "nbytes")]
    last["arguments_bytes"] = int(sum(x.nbytes for x in leaves))
    last["temporary_bytes"] = temporary_bytes(pj.depth, film, scene)
    last["tree_temporary_bytes"] = temporary_bytes(pj.trace, scene, pj.camera_rays(film))
    say(last)
    for kind in ("image", "random"):
        for r in results[kind]:
            print(
                kind,
                r["faces"],
                r["rays"],
                *(f"{k} {r[k]:.4g}" for k in r if k.endswith("_s") and "first" not in k),
            )
    results["versions"] = {"jax": jax.__version__, "python": platform.python_version()}
    results["machine"] = (
        f"{platform.machine()}, {len(jax.devices())} {jax.default_backend()} device"
    )
    (folder / "tracer.json").write_text(json.dumps(results, indent=1) + "\n")
    plot(results, folder / "tracer.png")


if __name__ == "__main__":
    main()
