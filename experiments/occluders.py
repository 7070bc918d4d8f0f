"""Something covers the object, and nobody said so: is the camera found, and does the fit say?

Masks of 256 x 256 pixels, objects of 60 to 230 px. Before each stands a half-plane, a board or a
ball that hides a share of its outline; no weight image tells. Starts 10 degrees off and 5 % of the
distance aside, and none. For each share: the median error, how often the fit says `converged`, and
how often it does and is off by more than 5 degrees. `--quick` takes 48 trials, a number after the
folder so many.
"""

import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
from _common import camera_at, degrees, rows_of, run
from tolerance import COLUMNS, ROWS, outline_of
from wrong_masks import PHI, SHAPES, SIZE, start_off

import pinhole_jax as pj

KINDS = tuple(
    f"{share} % {kind}" for share in (10, 20, 30, 40) for kind in ("plane", "board", "ball")
)


def hidden(image: np.ndarray, share: float, kind: str, random: np.random.Generator) -> np.ndarray:
    """Return what (H, W) an occluder covers, so large that it hides a share of the outline."""
    outline = outline_of(image)
    place = outline[random.integers(len(outline))]
    angle = random.uniform(0, 2 * np.pi)
    along = np.cos(angle) * (ROWS - place[0]) + np.sin(angle) * (COLUMNS - place[1])
    across = np.cos(angle) * (COLUMNS - place[1]) - np.sin(angle) * (ROWS - place[0])
    if kind == "plane":
        size = along
    elif kind == "board":
        size = np.maximum(np.abs(along), 3 * np.abs(across))
    else:
        size = np.hypot(along, across)
    return size < np.quantile(size[tuple(outline.T)], share)


def trial(number: int, shape: str, kind: str) -> dict:
    """Return one fit: how far off, in degrees and standard errors, and what it said."""
    random = np.random.default_rng([number, 11, *map(ord, shape)])
    mesh, axes = SHAPES[shape](random)
    scene = pj.Scene(mesh=mesh)
    distance = SIZE / np.tan(PHI / 2) / np.exp(random.uniform(np.log(60), np.log(230)))
    truth = camera_at(axes, random.uniform(-0.1, 0.1, 2), distance, PHI, SIZE)
    image = np.asarray(pj.silhouette(truth, scene))
    share, _, what = kind.split()
    target = (image > 0.5) & ~hidden(image, int(share) / 100, what, random)
    start = start_off(truth, 10, *random.normal(size=(2, 3))) if number % 2 else None
    begin = time.perf_counter()
    fit = pj.fit_camera(scene, target, start, phi=None if start else PHI)
    off, *modes = (degrees(found.camera, truth) for found in (fit, *fit.modes))
    return {
        "shape": shape,
        "kind": kind,
        "share": int(share),
        "start": start is not None,
        "status": fit.status,
        "degrees": off,
        "nearest": min([off, *modes]),
        "told": fit.unbelieved is not None,
        "sigma": float(np.rad2deg(np.linalg.norm(fit.std[:3]))),
        "iou": fit.iou,
        "seconds": time.perf_counter() - begin,
    }


def line(r: dict) -> str:
    return (
        f"{r['shape']:8} {r['kind']:12} {'start' if r['start'] else 'none ':5} {r['status']:14}"
        f" {r['degrees']:7.2f} deg (1 sigma: {r['sigma']:.2f}; nearest mode {r['nearest']:.2f})"
        f" iou {r['iou']:.3f} {r['seconds']:.2f} s"
    )


def summary(rows: list[dict]) -> dict:
    sure = [r for r in rows if r["status"] == "converged"]
    return {
        "fits": len(rows),
        "median degrees": float(np.median([r["degrees"] for r in rows])),
        "median degrees with a start": float(np.median([r["degrees"] for r in rows if r["start"]])),
        "median degrees with none": float(
            np.median([r["degrees"] for r in rows if not r["start"]])
        ),
        "median degrees where determined": float(
            np.median([r["degrees"] for r in rows if np.isfinite(r["sigma"])])
        ),
        "an occluder told": sum(r["told"] for r in rows),
        "converged": len(sure),
        "converged, > 5 deg": sum(r["degrees"] > 5 for r in sure),
        "statuses": dict(Counter(r["status"] for r in rows)),
        "seconds, median": float(np.median([r["seconds"] for r in rows])),
    }


def question() -> dict:
    rows = rows_of(SHAPES, KINDS, trial, line)
    shares = sorted({r["share"] for r in rows})
    table = {str(share): summary([r for r in rows if r["share"] == share]) for share in shares}
    for share, found in table.items():
        print(f"{share} % {found}")
    return {"trials": len(rows), "table": table}


def draw(answer: dict, path: Path) -> None:
    import matplotlib.pyplot as plt

    table = answer["table"]
    shares = [int(share) for share in table]
    figure, (errors, counts) = plt.subplots(1, 2, figsize=(8, 3.4))
    for name in ("median degrees", "median degrees where determined"):
        errors.semilogy(shares, [row[name] for row in table.values()], "o-", label=name)
    errors.axhline(1, color="0.7", lw=1)
    for name in ("converged", "converged, > 5 deg"):
        counts.plot(shares, [row[name] / row["fits"] for row in table.values()], "o-", label=name)
    counts.set_ylabel("share of the fits")
    for panel in (errors, counts):
        panel.set_xlabel("hidden, % of the outline")
        panel.legend(fontsize=8)
    errors.set_ylabel("degrees")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    if "--quick" in sys.argv:
        sys.argv[sys.argv.index("--quick")] = "48"
    run(question, draw)
