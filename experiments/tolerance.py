"""How wrong may a mask be? Pose error against corrupted outline, blur, one bit, an occluder.

Masks of 256 x 256 pixels, pose free, starts 5 degrees and 5 % off. Corruption: discs centred on
the outline are filled or cut out until a share of it is gone. Occluder: a half-plane over a part of
the object, with a weight image that says so, and without.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from _common import degrees, meshes, percentiles, random_camera, run, trials
from protocol import start_from

import pinhole_jax as pj

SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4)
BLURS = (0.5, 1.0, 2.0, 4.0, 8.0)
ROWS, COLUMNS = np.mgrid[:256, :256]


def outline_of(mask: np.ndarray) -> np.ndarray:
    """Return the pixels (n, 2) of a hard mask that have a neighbour outside."""
    inside = mask > 0.5
    padded = np.pad(inside, 1)
    core = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return np.argwhere(inside & ~core)


def corrupted(mask: np.ndarray, share: float, random: np.random.Generator) -> np.ndarray:
    """Return a hard mask with discs filled or cut out over a share of its outline."""
    outline, result = outline_of(mask), (mask > 0.5).copy()
    spoilt = np.zeros(len(outline), bool)
    size = np.sqrt(np.sum(mask) / np.pi)
    while spoilt.mean() < share:
        row, column = outline[random.choice(np.flatnonzero(~spoilt))]
        radius = size * random.uniform(0.05, 0.15)
        result[np.hypot(ROWS - row, COLUMNS - column) < radius] = random.random() < 0.5
        spoilt |= np.hypot(*(outline - [row, column]).T) < radius
    return result


def occluder(mask: np.ndarray, share: float, random: np.random.Generator) -> np.ndarray:
    """Return the pixels of a half-plane over a share of the object."""
    direction = random.normal(size=2)
    depth = direction[0] * ROWS + direction[1] * COLUMNS
    return depth < np.quantile(depth[mask > 0.5], share)


def targets(
    mask: np.ndarray, random: np.random.Generator
) -> Iterator[tuple[str, float, Any, dict]]:
    """Yield kinds of wrong masks, how wrong, the mask, and options of the fit."""
    from scipy.ndimage import gaussian_filter

    for share in SHARES:
        spoilt = corrupted(mask, share, random)
        yield "corrupted outline", share, spoilt, {}
        yield "corrupted outline, plain least squares", share, spoilt, {"outlier_px": None}
    for blur in BLURS:
        yield "blur (px)", blur, gaussian_filter(mask, blur), {}
    for share in SHARES[2:]:
        hidden = occluder(mask, share, random)
        target = np.where(hidden, 0, mask)
        yield "occluder", share, target, {}
        yield "occluder, weight image", share, target, {"weight": ~hidden * 1.0}


def question() -> dict:
    answer: dict = {}
    for name, scene in meshes("spot.obj"):
        errors: dict[str, dict[str, list[float]]] = {}
        for trial in range(trials(15)):
            random = np.random.default_rng(trial)
            truth = random_camera(random)
            start = start_from(truth, 5, 0.05, random)
            mask = np.asarray(pj.silhouette(truth, scene))
            for kind, x, target, options in targets(mask, random):
                fit = pj.fit_camera(scene, target, start, **options)
                curve = errors.setdefault(kind, {}).setdefault(str(x), [])
                curve.append(degrees(fit.camera, truth))
        answer[name] = {
            kind: {x: percentiles(values) for x, values in curve.items()}
            for kind, curve in errors.items()
        }
        for kind, curve in answer[name].items():
            line = ", ".join(f"{x}: {v['median']:.3f} ({v['max']:.2g})" for x, v in curve.items())
            print(f"{name}, {kind}: median (max) degrees {line}", flush=True)
    return answer


def draw(answer: dict, path: Path) -> None:
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 3, figsize=(12, 3.6), sharey=True)
    for panel, group in zip(panels, ("corrupted outline", "blur", "occluder"), strict=True):
        for name, kind in ((n, k) for n in answer if n != "versions" for k in answer[n]):
            if kind.startswith(group):
                curve, plain = (
                    answer[name][kind],
                    kind.removeprefix(group).removeprefix(" (px)").strip(", "),
                )
                medians = [v["median"] for v in curve.values()]
                style = "--" if plain else "-"
                x = [float(k) for k in curve]
                panel.plot(x, medians, style, marker="o", label=f"{name} {plain}")
        panel.set_yscale("log")
        panel.set_xlabel("blur, px" if group == "blur" else f"{group}, share")
        panel.axhline(0.5, color="0.7", lw=1)
        panel.legend(fontsize=7)
    panels[0].set_ylabel("pose error, degrees (median)")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    run(question, draw)
