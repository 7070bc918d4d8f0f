"""Do 95 % intervals hold, where a mask's outline errs by stretches?

Masks of 256 x 256 pixels whose outline wavers by 0.3 to 2 px over 2 to 30 px, with a bias of -1 to
1 px: of one bit, of 8 bits, with wide edges, and noisy; others that are grown or shrunk by up to
2 px, and computed ones. Each fit starts at the truth, every other one is in float64. For each kind
and float type: how many of the parameters' 95 % intervals hold it, errors in standard errors, and
the same if pixels were independent. The picture: how often intervals hold, against the length over
which outlines err.
"""

import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
from _common import camera_at, first, run, trials
from scipy.ndimage import gaussian_filter
from wrong_masks import PHI, SHAPES, SIZE, signed_distance

import pinhole_jax as pj

WAVERING = ("one bit", "8 bits", "wide edges", "noisy")
KINDS = (*WAVERING, "grown", "computed")
DTYPES = (np.dtype(np.float32), np.dtype(np.float64))
NORMAL_95 = 1.96
#: Ends of the classes of lengths (px).
LENGTHS = np.array([2, 4, 8, 16, 30.01])


def error(found: pj.Camera, truth: pj.Camera) -> np.ndarray:
    """Return by how much a camera is off: turns about its own axes (rad), and its eye (6,)."""
    from scipy.spatial.transform import Rotation

    axes, wanted = (
        np.stack([np.asarray(b, float) for b in pj.camera_basis(c)]) for c in (found, truth)
    )
    turn = Rotation.from_matrix(wanted.T @ axes).as_rotvec()
    return np.concatenate([axes @ turn, np.asarray(truth.e, float) - np.asarray(found.e, float)])


def spoilt(image: np.ndarray, kind: str, length: float, random: np.random.Generator) -> Any:
    """Return a mask whose outline errs over a length (px)."""
    if kind == "computed":
        return image > 0.5
    if kind == "grown":
        return signed_distance(image) > random.uniform(-2, 2)
    field = gaussian_filter(random.normal(size=image.shape), length / 2**0.5)
    px = np.exp(random.uniform(np.log(0.3), np.log(2)))
    off = signed_distance(image) + px * field / field.std() + random.uniform(-1, 1)
    if kind == "one bit":
        return off > 0
    if kind == "wide edges":
        return 1 / (1 + np.exp(-off / random.uniform(0.3, 1)))
    share = np.clip(off + 0.5, 0, 1)
    if kind == "noisy":
        return share + 0.02 * random.normal(size=image.shape)
    return np.round(255 * share).astype(np.uint8)


def trial(number: int, shape: str, kind: str, dtype: np.dtype) -> dict:
    """Return one fit: its errors in standard errors, and what it said."""
    random = np.random.default_rng([number, 7, *map(ord, shape)])
    mesh, axes = SHAPES[shape](random)
    scene = pj.Scene(mesh=mesh)
    px = np.exp(random.uniform(np.log(60), np.log(220)))
    distance = SIZE / np.tan(PHI / 2) / px
    truth = camera_at(axes, random.uniform(-0.1, 0.1, 2), distance, PHI, SIZE)
    length = float(np.exp(random.uniform(np.log(2), np.log(30))))
    mask = spoilt(np.asarray(pj.silhouette(truth, scene)), kind, length, random)
    scene = pj.Scene(mesh=pj.Mesh(np.asarray(mesh.vertices, dtype), mesh.faces))
    truth = jax.tree.map(lambda x: np.asarray(x, dtype), truth)
    begin = time.perf_counter()
    fit = pj.fit_camera(scene, mask, truth)
    seconds = time.perf_counter() - begin
    off, alone = np.abs(error(fit.camera, truth)), fit.independent_covariance
    known = np.isfinite(fit.std)
    return {
        "shape": shape,
        "kind": kind,
        "float": dtype.name,
        "length": length,
        "status": fit.status,
        "seconds": seconds,
        "errors": (off / fit.std)[known].tolist(),
        "if independent": (off / np.sqrt(np.diag(alone)))[known].tolist(),
        "turn": float(np.linalg.norm(off[:3]) / np.linalg.norm(fit.std[:3])),
    }


def summary(rows: list[dict]) -> dict:
    errors, alone = (np.concatenate([r[k] for r in rows]) for k in ("errors", "if independent"))
    turn = np.array([r["turn"] for r in rows])
    return {
        "fits": len(rows),
        "95 % intervals that hold": float(np.mean(errors < NORMAL_95)),
        "... if pixels were independent": float(np.mean(alone < NORMAL_95)),
        "error / sigma, median": float(np.median(errors)),
        "error / sigma, 90 %": float(np.quantile(errors, 0.9)),
        "turn / sigma, median": float(np.median(turn)),
        "turn / sigma, 90 %": float(np.quantile(turn, 0.9)),
        "converged": sum(r["status"] == "converged" for r in rows),
    }


def question() -> dict:
    count, rows = trials(400), []
    cases = [(shape, kind) for shape in SHAPES for kind in KINDS]
    for number in range(count):
        case = cases[number * len(cases) // count]
        rows.append(trial(first() + number, *case, DTYPES[number % 2]))
        if "-v" in sys.argv:
            print(rows[-1], flush=True)
    told = [r for r in rows if r["errors"]]
    table = {kind: [r for r in told if r["kind"] == kind] for kind in KINDS}
    wavering = [r for r in told if r["kind"] in WAVERING]
    table |= {dtype.name: [r for r in wavering if r["float"] == dtype.name] for dtype in DTYPES}
    by_length = {
        f"{low:.0f} to {high:.0f} px": [r for r in wavering if low <= r["length"] < high]
        for low, high in pairwise(LENGTHS)
    }
    table |= {"wavering": wavering, "all": told}
    answer = {
        name: {key: summary(some) for key, some in of.items() if some}
        for name, of in (("by kind", table), ("by length", by_length))
    }
    for name, found in (answer["by kind"] | answer["by length"]).items():
        print(f"{name:14} {found}")
    return {"trials": count, **answer}


def draw(answer: dict, path: Path) -> None:
    import matplotlib.pyplot as plt

    panels: Any = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", sharey=True)
    figure, axes = panels
    of = (answer["by length"], {k: answer["by kind"][k] for k in KINDS if k in answer["by kind"]})
    for axis, rows, style in zip(axes, of, ("o-", "o"), strict=True):
        for key, label in (
            ("95 % intervals that hold", "as stated"),
            ("... if pixels were independent", "if pixels were independent"),
        ):
            names = [name.removesuffix(" px") for name in rows]
            axis.plot(names, [row[key] for row in rows.values()], style, label=label)
        axis.tick_params(labelsize=8)
        axis.axhspan(0.93, 0.97, color="0.85", label="93 to 97 %")
    axes[0].set(
        ylim=(0, 1.02),
        xlabel="length over which the outline errs (px)",
        ylabel="share of 95 % intervals that hold",
    )
    axes[1].set_xlabel("kind of mask")
    axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    run(question, draw)
