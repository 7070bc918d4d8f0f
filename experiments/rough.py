"""What do rough meshes and large photos cost, beside smooth shapes and small masks?

    python experiments/rough.py OUT [masks] [fits] [slopes] [photos] [tolerance]

Bumpy spheres with noise on their vertices (as a share of the mean edge: a scan has 0.12, a
hedgehog 1.2), loose triangles, interlocked boxes, overlapping spheres, and real meshes where
`../shared` has them; masks beside a smooth mesh of about as many faces and Embree's one sample a
pixel, fits to hard and soft masks, and how the time of a mask grows with noise, faces and pixels.
Then fits to photos of 500 to 4000 pixels' width. Everything is compiled when it is timed; medians
of calls, float32. Last, what masks cost that may err (`silhouette(..., tolerance=)`), in
milliseconds of the processor, the least of some calls, and by how much the worst pixel errs.
"""

import json
import platform
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import trimesh
from _common import SHARED, camera_at, degrees, folder, noisy, orbited
from scipy.spatial.transform import Rotation
from tracer import embree

import pinhole_jax as pj

CALLS, LONG = 7, 3.0
SMOOTH, SCAN, HEDGEHOG = 0.0, 0.12, 1.2
WIDTHS = (500, 1000, 2000, 4000)
TOLERANCES = (1 / 4, 1 / 16, 1 / 64, 1 / 128)
CROWDED = ("scan, 82k", "hedgehog 1.2, 82k", "soup, 10k", "2000 spheres", "20000 spheres")
REAL = ("counter.stl", "cycloidal.ply", "suzanne.ply")


def bumpy(subdivisions: int, noise: float) -> pj.Scene:
    """Return a bumpy sphere whose vertices are off by this many edges (one standard deviation)."""
    mesh = pj.shapes.bumpy(subdivisions)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return scene_of(noisy(vertices, faces, noise), faces)


def scene_of(vertices: np.ndarray, faces: np.ndarray) -> pj.Scene:
    """Return a mesh of radius 1 about the origin."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scaled = (vertices - (low + high) / 2) / (np.linalg.norm(high - low) / 2)
    return pj.Scene(mesh=pj.Mesh(scaled.astype(np.float32), faces))


def soup(number: int) -> pj.Scene:
    """Return loose triangles, a tenth of the whole across."""
    random = np.random.default_rng(0)
    corners = random.normal(0, 0.5, (number, 1, 3)) + random.normal(0, 0.1, (number, 3, 3))
    return scene_of(corners.reshape(-1, 3), np.arange(3 * number).reshape(-1, 3))


def boxes(number: int) -> pj.Scene:
    """Return boxes that run through one another."""
    random, box = np.random.default_rng(0), trimesh.creation.box()
    turns = Rotation.random(number, random_state=0).as_matrix()
    sizes = random.uniform(0.05, 0.2, (number, 1, 3))
    places = random.normal(0, 0.4, (number, 1, 3))
    vertices = (box.vertices[None] * sizes) @ turns.transpose(0, 2, 1) + places
    faces = box.faces[None] + 8 * np.arange(number)[:, None, None]
    return scene_of(vertices.reshape(-1, 3), faces.reshape(-1, 3))


def balls(number: int) -> pj.Scene:
    """Return spheres that overlap."""
    random = np.random.default_rng(0)
    centers = random.normal(0, 0.3, (number, 3)).astype(np.float32)
    radii = random.uniform(0.3, 1, number) * 0.35 / number ** (1 / 3)
    return pj.Scene(spheres=pj.Spheres(centers, radii.astype(np.float32)))


def real(name: str) -> pj.Scene:
    mesh = pj.load_mesh(SHARED / name)
    return scene_of(np.asarray(mesh.vertices, float), np.asarray(mesh.faces))


def view(number: int = 0, size: int = 256) -> pj.Camera:
    """Return one of three cameras that see the unit sphere whole."""
    axes = Rotation.from_rotvec([(0.4, 0.3, 0.1), (0.1, 1.5, 0), (1.6, 0.2, 0.1)][number])
    return camera_at(axes.as_matrix(), np.zeros(2), 4.0, 0.6, size)


def median_ms(call: Callable[[], Any]) -> float:
    """Return the median of a call that is compiled, of few if they take long."""
    jax.block_until_ready(call())
    times: list[float] = []
    while len(times) < CALLS and sum(times) < LONG:
        begin = time.perf_counter()
        jax.block_until_ready(call())
        times.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(times))


def mask_ms(scene: pj.Scene, number: int = 0, size: int = 256) -> float:
    camera = view(number, size)
    return median_ms(lambda: pj.silhouette(camera, scene))


def embree_ms(scene: pj.Scene, number: int = 0, size: int = 256) -> float | None:
    """Return what Embree needs for one sample a pixel, None where it is not there."""
    if scene.mesh is None:
        return None
    shape = trimesh.Trimesh(
        np.asarray(scene.mesh.vertices), np.asarray(scene.mesh.faces), process=False
    )
    peer = embree(shape)
    rays = pj.camera_rays(view(number, size))
    direction = np.asarray(rays.direction).reshape(-1, 3)
    origin = np.ascontiguousarray(np.broadcast_to(rays.origin, rays.direction.shape).reshape(-1, 3))
    return None if peer is None else median_ms(lambda: peer(origin, direction))


def cases() -> dict[str, tuple[Callable[[], pj.Scene], int]]:
    """Return scenes, and the subdivisions of a smooth mesh with about as many faces."""
    few = {
        "smooth, 82k": (lambda: bumpy(6, SMOOTH), 6),
        "scan, 82k": (lambda: bumpy(6, SCAN), 6),
        "smooth, 328k": (lambda: bumpy(7, SMOOTH), 7),
        "scan, 328k": (lambda: bumpy(7, SCAN), 7),
        "hedgehog 0.6, 20k": (lambda: bumpy(5, HEDGEHOG / 2), 5),
        "hedgehog 1.2, 82k": (lambda: bumpy(6, HEDGEHOG), 6),
        "soup, 1k": (lambda: soup(1000), 3),
        "soup, 10k": (lambda: soup(10_000), 4),
        "2000 boxes, 24k": (lambda: boxes(2000), 5),
        "100 spheres": (lambda: balls(100), 0),
        "2000 spheres": (lambda: balls(2000), 0),
        "20000 spheres": (lambda: balls(20_000), 0),
    }
    for name, subdivisions in zip(REAL, (6, 5, 2), strict=True):
        if (SHARED / name).exists():
            few[name] = (lambda name=name: real(name), subdivisions)
        else:
            print(f"{name}: skipped, there is no {SHARED / name}")
    return few


def masks() -> dict[str, Any]:
    """Return ms of masks, of a smooth mesh's of as many faces, and of Embree."""
    smooth = {k: mask_ms(bumpy(k, SMOOTH)) for k in (2, 3, 4, 5, 6, 7)}
    found: dict[str, Any] = {}
    for name, (make, like) in cases().items():
        scene = make()
        row = {
            "faces": 0 if scene.mesh is None else len(scene.mesh.faces),
            "ms": [mask_ms(scene, k) for k in range(3 if "." in name[-5:] else 1)],
            "ms at 1024 px": mask_ms(scene, 0, 1024),
            "embree_ms": embree_ms(scene),
            "smooth_ms": smooth.get(like),
        }
        found[name] = row
        of = f", smooth {row['smooth_ms']:.1f}" if row["smooth_ms"] else ""
        times = ", ".join(f"{x:.1f}" for x in row["ms"])
        print(f"{name:18s} {times} ms (1024 px: {row['ms at 1024 px']:.0f}){of}", flush=True)
    return found


def off(truth: pj.Camera) -> pj.Camera:
    """Return where fits start: 8 degrees and 5 % of the distance off."""
    start = orbited(truth, Rotation.from_rotvec(np.deg2rad([4, -6, 3])).as_matrix(), 1.05)
    return pj.Camera(start.e, start.p, start.u, start.phi, 1.0, truth.W, truth.H)


def fit_s(scene: pj.Scene, mask: np.ndarray, truth: pj.Camera) -> dict[str, Any]:
    """Return seconds of a fit that is compiled, its status, and how far off it ends (degrees)."""
    fit = lambda: pj.fit_camera(scene, mask, off(truth), free=("pose", "phi"))
    once = fit()
    times = []
    for _ in range(3):
        begin = time.process_time()
        fit()
        times.append(time.process_time() - begin)
    found = {"s": min(times), "status": once.status}
    return {**found, "degrees": degrees(once.camera, truth)}


def hard_and_soft(scene: pj.Scene, truth: pj.Camera) -> dict[str, Any]:
    soft = np.asarray(pj.silhouette(truth, scene))
    return {
        "hard": fit_s(scene, soft > 0.5, truth),
        "soft": fit_s(scene, np.round(255 * soft).astype(np.uint8), truth),
    }


def fits() -> dict[str, Any]:
    """Return seconds of fits to hard and soft masks of 256 px."""
    found = {}
    for name, (make, _) in cases().items():
        if "spheres" in name:
            continue
        found[name] = hard_and_soft(make(), view())
        told = [f"{k} {v['s']:.2f} s ({v['status']})" for k, v in found[name].items()]
        print(f"fit, {name:18s} {', '.join(told)}", flush=True)
    return found


def slopes() -> dict[str, dict[str, float]]:
    """Return ms of a mask over noise (20k faces), faces (a scan), and pixels (a scan of 82k)."""
    return {
        "noise": {str(x): mask_ms(bumpy(5, x)) for x in (0, 0.03, 0.06, 0.12, 0.25, 0.5, 1, 2)},
        "faces": {str(20 * 4**k): mask_ms(bumpy(k, SCAN)) for k in (2, 3, 4, 5, 6, 7)},
        "smooth faces": {str(20 * 4**k): mask_ms(bumpy(k, SMOOTH)) for k in (2, 3, 4, 5, 6, 7)},
        "pixels": {str(x): mask_ms(bumpy(6, SCAN), 0, x) for x in (64, 128, 256, 512, 1024, 2048)},
    }


def photos() -> dict[str, Any]:
    """Return seconds and peak memory of fits to photos, 4:3, half of whose height is an object."""
    scene, found = bumpy(2, SMOOTH), {}
    for width in WIDTHS:
        truth = view(0, width)
        truth = pj.Camera(truth.e, truth.p, truth.u, truth.phi, 1.0, width, 3 * width // 4)
        found[str(width)] = hard_and_soft(scene, truth)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        found[str(width)]["peak_gb"] = peak
        row = found[str(width)]
        told = ", ".join(f"{k} {row[k]['s']:.2f} s" for k in ("hard", "soft"))
        print(f"photo, {width} px wide: {told}, {peak:.1f} GB so far", flush=True)
    return found


def processor_ms(call: Callable[[], Any]) -> float:
    """Return the least of a call's times on the processor, of few if they take long."""
    jax.block_until_ready(call())
    times: list[float] = []
    while len(times) < CALLS and sum(times) < 1e3 * LONG:
        begin = time.process_time()
        jax.block_until_ready(call())
        times.append(1e3 * (time.process_time() - begin))
    return min(times)


def tolerances() -> dict[str, Any]:
    """Return ms of masks of crowded scenes by their tolerance (0: exact; "clamped": layers are
    summed), and by how much the worst pixel errs."""
    found: dict[str, Any] = {}
    for name in CROWDED:
        scene = cases()[name][0]()
        exact = np.asarray(pj.silhouette(view(), scene))
        ways = {"clamped": {"overlaps": False}, "0": {}}
        ways |= {f"1/{round(1 / x)}": {"tolerance": x} for x in TOLERANCES}
        found[name] = {key: ms_and_error(scene, exact, **way) for key, way in ways.items()}
        told = [f"{k}: {v['ms']:.1f} ms ({v['worst']:.1e})" for k, v in found[name].items()]
        print(f"{name:18s} {', '.join(told)}", flush=True)
    return found


def ms_and_error(scene: pj.Scene, exact: np.ndarray, **way: Any) -> dict[str, float]:
    """Return what a mask costs, and by how much its worst pixel errs."""
    call = lambda: pj.silhouette(view(), scene, **way)
    worst = float(np.max(np.abs(np.asarray(call()) - exact)))
    return {"ms": processor_ms(call), "worst": worst}


def draw_tolerances(found: dict[str, Any], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(5, 3.6))
    for name, row in found.items():
        few = [row[f"1/{round(1 / t)}"] for t in TOLERANCES]
        (line,) = axis.loglog([x["worst"] for x in few], [x["ms"] for x in few], "-o", label=name)
        axis.axhline(row["0"]["ms"], color=line.get_color(), linestyle=":")
    axis.set(xlabel="worst error of a pixel", ylabel="ms of the processor (dotted: exact)")
    axis.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def slope(row: dict[str, float], least: float = 0) -> float:
    """Return the log-log slope of a row's upper half."""
    x, y = np.array([(float(k), v) for k, v in row.items() if float(k) > least]).T
    half = len(x) // 2
    return float(np.polyfit(np.log(x[half:]), np.log(y[half:]), 1)[0])


def draw(found: dict[str, Any], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 4, figsize=(14, 3.4))
    words = {"noise": "noise / edge", "faces": "faces", "pixels": "px"}
    for axis, (name, label) in zip(axes, words.items(), strict=False):
        for key in (k for k in found["slopes"] if k.endswith(name)):
            row = {k: v for k, v in found["slopes"][key].items() if float(k) > 0}
            told = f"{key}: slope {slope(row):.2f}"
            axis.loglog([float(k) for k in row], [*row.values()], "-o", label=told)
        axis.set(title=f"mask over {name}", xlabel=label)
        axis.legend(fontsize=7)
    axes[0].set_ylabel("ms")
    for kind in ("hard", "soft"):
        row = {k: v[kind]["s"] for k, v in found["photos"].items()}
        told = f"{kind}: slope {slope(row):.2f}"
        axes[3].loglog([float(k) for k in row], [*row.values()], "-o", label=told)
    axes[3].set(title="fit to a photo", xlabel="px wide", ylabel="s of the processor")
    axes[3].set_xticks(WIDTHS, [str(width) for width in WIDTHS])
    axes[3].minorticks_off()
    axes[3].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main() -> None:
    parts = {"masks": masks, "fits": fits, "slopes": slopes, "photos": photos}
    parts["tolerance"] = tolerances
    asked = [name for name in sys.argv[2:] if name in parts] or [*parts]
    path = folder() / "rough.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    found |= {name: parts[name]() for name in asked}
    found["versions"] = {"jax": jax.__version__, "python": platform.python_version()}
    path.write_text(json.dumps(found, indent=1) + "\n")
    if {"slopes", "photos"} <= found.keys():
        draw(found, folder() / "rough.png")
    if "tolerance" in found:
        draw_tolerances(found["tolerance"], folder() / "rough_tolerance.png")


if __name__ == "__main__":
    main()
