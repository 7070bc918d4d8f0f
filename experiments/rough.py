"""What do rough meshes and large photos cost, and how hard is a mask to break?

    python experiments/rough.py masks | fits | growth | photos | stress [OUT]

- `masks`: bumpy spheres with noise on their vertices (as a share of the mean edge: a scan has 0.12,
  a tangle 1.2), loose triangles, overlapping spheres, and real meshes where
  `../shared` has them; beside a smooth mesh of about as many faces.
- `fits`: to hard and soft masks of some of these, seconds of the processor.
- `growth`: how the time of a mask grows with noise, faces and pixels.
- `photos`: fits to photos of 500 to 4000 pixels' width, and the process's memory.
- `stress`: each case of `tests/stress.py` draws scenes and cameras at some extreme (sizes, places,
  poses, slivers), rounds them to float32 and to float64, and takes what is rounded as exact; the
  answer is projected in 60 digits. A case holds where the worst pixel is below 256 epsilons off.

Everything is compiled when it is timed, in ms and s of the processor; float32.
"""

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from _common import (
    SHARED,
    Options,
    camera_at,
    curves,
    degrees,
    main,
    mask_of,
    median_s,
    noisy,
    orbited,
    resized,
    scene_of,
    show,
    trials,
)
from scipy.spatial.transform import Rotation

import pinhole_jax as pj

SCAN, TANGLE = 0.12, 1.2
WIDTHS = (500, 1000, 2000, 4000)
REAL = ("counter.stl", "cycloidal.ply", "suzanne.ply")


def bumpy(subdivisions: int, noise: float = 0.0) -> pj.Scene:
    """Return a bumpy sphere whose vertices are off by this many edges (one standard deviation)."""
    mesh = pj.shapes.bumpy(subdivisions)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return scene_of(noisy(vertices, faces, noise), faces)


def soup(number: int) -> pj.Scene:
    """Return loose triangles, a tenth of the whole across."""
    random = np.random.default_rng(0)
    corners = random.normal(0, 0.5, (number, 1, 3)) + random.normal(0, 0.1, (number, 3, 3))
    return scene_of(corners.reshape(-1, 3), np.arange(3 * number).reshape(-1, 3))


def balls(number: int) -> pj.Scene:
    """Return spheres that overlap."""
    random = np.random.default_rng(0)
    centers = random.normal(0, 0.3, (number, 3)).astype(np.float32)
    radii = random.uniform(0.3, 1, number) * 0.35 / number ** (1 / 3)
    return pj.Scene(spheres=pj.Spheres(centers, radii.astype(np.float32)))


def real(name: str) -> pj.Scene:
    mesh = pj.load_mesh(SHARED / name)
    return scene_of(np.asarray(mesh.vertices, float), np.asarray(mesh.faces))


#: Scenes, and the subdivisions of a smooth mesh with about as many faces.
CASES: dict[str, tuple[Callable[[], pj.Scene], int]] = {
    "smooth, 82k": (lambda: bumpy(6), 6),
    "scan, 82k": (lambda: bumpy(6, SCAN), 6),
    "scan, 328k": (lambda: bumpy(7, SCAN), 7),
    "tangle, 82k": (lambda: bumpy(6, TANGLE), 6),
    "soup, 10k": (lambda: soup(10_000), 4),
    "2000 spheres": (lambda: balls(2000), 0),
    "20000 spheres": (lambda: balls(20_000), 0),
}
CASES |= {
    name: (lambda name=name: real(name), level)
    for name, level in zip(REAL, (6, 5, 2), strict=True)
    if (SHARED / name).exists()
}


def asked_cases(asked: Options) -> list[str]:
    return asked.names([*CASES][:2] if asked.quick else CASES)


def view(size: int = 256) -> pj.Camera:
    """Return a camera that sees the unit sphere whole."""
    axes = Rotation.from_rotvec((0.4, 0.3, 0.1)).as_matrix()
    return camera_at(axes, np.zeros(2), 4.0, 0.6, size)


def mask_ms(scene: pj.Scene, size: int = 256, **more: Any) -> float:
    camera = view(size)
    return 1e3 * median_s(lambda: pj.silhouette(camera, scene, **more), time.process_time)


def masks(asked: Options) -> dict:
    rows = []
    for name in asked_cases(asked):
        make, like = CASES[name]
        scene, row = make(), {"": name}
        row |= {f"{px} px": mask_ms(scene, px) for px in (64, 256, 1024)}
        row["times smooth"] = row["256 px"] / mask_ms(bumpy(like)) if like else None
        rows.append(row)
        print(row, flush=True)
    show(rows)
    worst = max(rows, key=lambda row: row["256 px"])
    return {"verdict": f"The slowest, {worst['']}: {worst['256 px']:.0f} ms", "table": rows}


def hard_and_soft(scene: pj.Scene, truth: pj.Camera) -> dict[str, Any]:
    """Return seconds of the processor of fits to a hard and a soft mask, 8 degrees and 5 % off."""
    soft, row = mask_of(truth, scene), {}
    start = orbited(truth, Rotation.from_rotvec(np.deg2rad([4, -6, 3])).as_matrix(), 1.05)
    for kind, mask in (("hard", soft > 0.5), ("soft", np.round(255 * soft).astype(np.uint8))):
        fit = lambda mask=mask: pj.fit_camera(scene, mask, start, free=("pose", "phi"))
        row[f"{kind}, degrees"] = degrees(fit().camera, truth)
        row[f"{kind}, s"] = median_s(lambda f=fit: f().camera, time.process_time)
    return row


def fits(asked: Options) -> dict:
    rows = []
    for name in asked_cases(asked):
        if "spheres" not in name:
            rows.append({"": name, **hard_and_soft(CASES[name][0](), view())})
            print(rows[-1], flush=True)
    show(rows)
    worst = max(row["hard, s"] for row in rows)
    return {"verdict": f"Seconds of a fit to a hard mask: {worst:.2f} at most", "table": rows}


def growth(asked: Options) -> dict:
    levels = range(2, 5 if asked.quick else 8)
    noise, sizes = (0.03, 0.06, 0.12, 0.25, 0.5, 1, 2), (64, 128, 256, 512, 1024, 2048)
    table = {
        "noise / edge": {x: mask_ms(bumpy(levels[-1] - 2, x)) for x in noise},
        "faces of a scan": {20 * 4**k: mask_ms(bumpy(k, SCAN)) for k in levels},
        "smooth faces": {20 * 4**k: mask_ms(bumpy(k)) for k in levels},
        "px of a scan": {x: mask_ms(bumpy(levels[-1] - 1, SCAN), x) for x in sizes},
    }
    power = {k: np.polyfit(*np.log([[*x], [*x.values()]])[:, -3:], 1)[0] for k, x in table.items()}
    said = ", ".join(f"{name} {x:.2f}" for name, x in power.items())
    return {"verdict": f"A mask's time grows with these powers: {said}", "table": table}


def draw(found: dict, path: Path) -> None:
    lines = {k: {k: ([*x], [*x.values()])} for k, x in found["table"].items()}
    curves(path, *(("ms of a mask", k, "loglog", line) for k, line in lines.items()))


def photos(asked: Options) -> dict:
    rows = []
    for width in WIDTHS[: 1 if asked.quick else None]:
        row = hard_and_soft(bumpy(2), resized(view(), width, 3 * width // 4))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        rows.append({"px wide": width, **row, "peak GB": peak})
    show(rows)
    last = rows[-1]
    words = f"{last['px wide']} px: {last['hard, s']:.2f} s hard, {last['soft, s']:.2f} soft"
    return {"verdict": words, "table": rows}


def stress(asked: Options) -> dict:
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    import stress

    def worst(number: int, name: str, kind: str) -> dict:
        dtype, random = stress.TYPES[kind], np.random.default_rng([number, 5])
        view = stress.CASES[name](random)
        try:
            error = stress.worst(view, dtype)
        except ValueError:  # what a float type rounds to no camera is refused
            return {"name": name, "kind": kind, "epsilons": 0.0}
        unit = view.unit * float(np.finfo(dtype).eps)
        return {"name": name, "kind": kind, "epsilons": error / unit}

    cases = [(name, kind) for name in asked.names(stress.CASES) for kind in stress.TYPES]
    rows = trials(asked, "stress", asked.number(100) * len(cases), cases, worst)
    most: dict[str, dict] = {}
    for row in rows:
        kinds = most.setdefault(row["name"], dict.fromkeys(stress.TYPES, 0.0))
        kinds[row["kind"]] = max(kinds[row["kind"]], row["epsilons"])
    show({"": name, **row} for name, row in most.items())
    held = sum(max(row.values()) <= stress.LIMIT for row in most.values())
    words = f"{held} of {len(most)} cases hold {stress.LIMIT:g} epsilons"
    return {"verdict": words, "held": held, "table": most}


if __name__ == "__main__":
    parts = {"masks": masks, "fits": fits, "growth": (growth, draw), "photos": photos}
    main(__doc__, {**parts, "stress": stress}, x64="stress" in sys.argv[1:2])
