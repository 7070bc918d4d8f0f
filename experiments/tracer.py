"""How fast is the tracer beside Embree?

Rays of a camera (an image) and rays from anywhere to anywhere against spheres of triangles. Embree
runs through `embreex`, on one core; ours uses what XLA uses. Times are medians of calls that are
compiled already; each of Embree's stands beside ours, so a busy machine slows both.
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


def timed(function) -> tuple[float, float]:
    """Return seconds of the first call, and the median of later ones."""
    times = []
    for _ in range(CALLS + 1):
        begin = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - begin)
    return times[0], float(np.median(times[1:]))


def image_rays(width: int) -> pj.Rays:
    e, p, u = np.float32([0.3, 1, 5]), np.zeros(3, np.float32), np.float32([0, 1, 0])
    return pj.camera_rays(pj.Camera(e, p, u, np.float32(0.45), np.float32(1), width, width))


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


def temporary_bytes(scene: pj.Scene, rays: pj.Rays) -> int:
    """Return how much memory a call needs beside its arguments and its result."""
    compiled = eqx.filter_jit(pj.trace).lower(scene, rays).compile().compiled
    return int(compiled.memory_analysis().temp_size_in_bytes)


def run(shape: trimesh.Trimesh, scene: pj.Scene, rays: pj.Rays) -> dict:
    first, median = timed(lambda: pj.trace(scene, rays))
    _, any_hit = timed(lambda: pj.occluded(scene, rays))
    direction = np.asarray(rays.direction).reshape(-1, 3)
    origin = np.ascontiguousarray(np.broadcast_to(rays.origin, rays.direction.shape).reshape(-1, 3))
    result = {
        "faces": len(shape.faces),
        "rays": len(direction),
        "first_call_s": first,
        "trace_s": median,
        "occluded_s": any_hit,
    }
    peer = embree(shape)
    if peer is not None:
        theirs = peer(origin, direction)
        ours = np.asarray(pj.trace(scene, rays).primitive).reshape(-1)
        result["embree_s"] = timed(lambda: peer(origin, direction))[1]
        result["ratio"] = median / result["embree_s"]
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
            for key, line in (("trace_s", "-o"), ("embree_s", ":x")):
                if key in rows[0]:
                    label = f"{rows[0]['faces']} faces" + (", Embree" if "emb" in key else "")
                    axis.loglog(rays, [r[key] for r in rows], line, color=f"C{color}", label=label)
        axis.set(title=f"{kind} rays", xlabel="rays")
    axes[0].set_ylabel("seconds")
    axes[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    folder.mkdir(parents=True, exist_ok=True)
    results: dict = {"image": [], "random": []}
    kinds = (("image", image_rays, IMAGES), ("random", random_rays, IMAGES[:3]))
    for subdivisions in SUBDIVISIONS:
        shape = trimesh.creation.icosphere(subdivisions=subdivisions)
        mesh = pj.Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces))
        scene = pj.Scene(mesh=mesh)
        for kind, make, widths in kinds:
            results[kind] += [run(shape, scene, make(width)) for width in widths]
    last, rays = results["image"][-1], image_rays(IMAGES[-1])
    leaves = [x for x in jax.tree.leaves((scene, rays)) if hasattr(x, "nbytes")]
    last["arguments_bytes"] = int(sum(x.nbytes for x in leaves))
    last["temporary_bytes"] = temporary_bytes(scene, rays)
    print(
        f"{last['rays']} rays of an image, {last['faces']} faces: {last['trace_s']:.2f} s"
        f" (first call {last['first_call_s']:.1f} s), "
        + (
            f"{last['ratio']:.1f} times Embree's on one core"
            if "ratio" in last
            else "Embree was not asked: embreex is not installed"
        )
        + f"; {last['temporary_bytes'] / 1e6:.0f} MB beside the {last['arguments_bytes'] / 1e6:.0f}"
        " MB of mesh and rays"
    )
    for kind in ("image", "random"):
        for r in results[kind]:
            print(
                kind,
                r["faces"],
                r["rays"],
                *(f"{k} {r[k]:.4g}" for k in ("trace_s", "occluded_s", "embree_s") if k in r),
            )
    results["versions"] = {"jax": jax.__version__, "python": platform.python_version()}
    results["machine"] = (
        f"{platform.machine()}, {len(jax.devices())} {jax.default_backend()} device"
    )
    (folder / "tracer.json").write_text(json.dumps(results, indent=1) + "\n")
    plot(results, folder / "tracer.png")


if __name__ == "__main__":
    main()
