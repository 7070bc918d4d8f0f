"""Do 95 % intervals hold?

    python experiments/intervals.py one-view | few-views [OUT]

- `one-view`: masks of 256 x 256 pixels whose outline wavers by 0.3 to 2 px over 2 to 30 px, with a
  bias of -1 to 1 px: of one bit, of 8 bits, with wide edges, and noisy; others that are grown or
  shrunk by up to 2 px, and computed ones. Each fit starts at the truth, every other one is in
  float64. The picture: how often intervals hold, against the length over which outlines err.
- `few-views`: where 2, 3 or 5 views say how far views differ. Masks of 64 x 64 pixels whose pixels
  err independently (3 %): cameras that share an unknown focal length, and one object before cameras
  at known places. In half of the fits nothing but masks errs, in the others each focal length, or
  each camera's place, that is taken as known.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np
from _common import (
    NORMAL_95,
    Options,
    axes_of,
    camera_at,
    curves,
    main,
    mask_of,
    show,
    trials,
    turn_by,
)
from honesty import DRAWN, PHI, Random, signed_distance, view
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import pinhole_jax as pj

WAVERING = ("one bit", "8 bits", "wide edges", "noisy")
KINDS = (*WAVERING, "grown", "computed")
#: Ends of the classes of lengths (px).
LENGTHS = (2, 4, 8, 16, 30.01)


def error(found: pj.Camera, truth: pj.Camera) -> np.ndarray:
    """Return by how much a camera is off: turns about its own axes (rad), and its eye (6,)."""
    axes = axes_of(found)
    turn = Rotation.from_matrix(axes_of(truth).T @ axes).as_rotvec()
    return np.concatenate([axes @ turn, np.asarray(truth.e, float) - np.asarray(found.e, float)])


def spoilt(image: np.ndarray, kind: str, length: float, random: Random) -> Any:
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


def trial(number: int, shape: str, kind: str) -> dict:
    """Return one fit: its errors in standard errors, and what it said."""
    random = np.random.default_rng([number, 7, *map(ord, shape)])
    scene, truth = view(shape, random, 60, 220)
    length = float(np.exp(random.uniform(np.log(2), np.log(30))))
    mask = spoilt(mask_of(truth, scene), kind, length, random)
    if number % 2:
        wide = lambda x: np.asarray(x, float)
        truth = jax.tree.map(wide, truth)
        scene = pj.Scene(mesh=pj.Mesh(wide(scene.mesh.vertices), scene.mesh.faces))
    fit = pj.fit_camera(scene, mask, truth)
    off, known = np.abs(error(fit.camera, truth)), np.isfinite(fit.std)
    alone = np.sqrt(np.diag(fit.independent_covariance))
    return {
        "kind": kind,
        "float": "float64" if number % 2 else "float32",
        "length": length,
        "status": fit.status,
        "errors": (off / fit.std)[known].tolist(),
        "if independent": (off / alone)[known].tolist(),
    }


def summary(rows: list[dict]) -> dict:
    errors, alone = (np.concatenate([r[k] for r in rows]) for k in ("errors", "if independent"))
    return {
        "fits": len(rows),
        "intervals": len(errors),
        "hold": float(np.mean(errors < NORMAL_95)),
        "if independent": float(np.mean(alone < NORMAL_95)),
        "error / sigma": float(np.median(errors)),
        "90 %": float(np.quantile(errors, 0.9)),
        "converged": sum(r["status"] == "converged" for r in rows),
    }


def one_view(asked: Options) -> dict:
    cases = [(shape, kind) for shape in asked.names(DRAWN) for kind in KINDS]
    rows = trials(asked, "one-view", asked.number(400, 24), cases, trial)
    told = [r for r in rows if r["errors"]]
    wavering = [r for r in told if r["kind"] in WAVERING]
    groups = {kind: [r for r in told if r["kind"] == kind] for kind in KINDS}
    for name in ("float32", "float64"):
        groups[name] = [r for r in wavering if r["float"] == name]
    for low, high in pairwise(LENGTHS):
        groups[f"{low:.0f} to {high:.0f} px"] = [r for r in wavering if low <= r["length"] < high]
    groups |= {"wavering": wavering, "all": told}
    table = {name: summary(some) for name, some in groups.items() if some}
    show({"": name, **row} for name, row in table.items())
    held = table.get("wavering", table["all"])
    words = f"of {held['intervals']} intervals of masks that waver {held['hold']:.1%} hold"
    return {"verdict": f"{words} (asked 93 to 97 %)", "table": table}


def draw(found: dict, path: Path) -> None:
    table = found["table"]
    ways = {"hold": "as stated", "if independent": "if pixels were independent"}
    groups = ([x for x in table if " to " in x], [x for x in KINDS if x in table])
    lines = [{label: (of, [table[x][k] for x in of]) for k, label in ways.items()} for of in groups]
    words = ("length over which the outline errs", "kind of mask")
    curves(path, *(("share that hold", w, "plot", x) for w, x in zip(words, lines, strict=True)))


SMALL, NOISE = 64, 0.03
#: What is taken as known errs by: focal lengths (a share of it), and cameras (rad and world units).
WRONG = {"phi": 2e-3, "object": 1e-3}


def moved(camera: pj.Camera, by: np.ndarray) -> pj.Camera:
    """Return a camera turned by a vector (rad) and shifted in its own frame: halves of `by`."""
    axes = axes_of(camera)
    turn = turn_by(np.rad2deg(np.linalg.norm(by[:3])), by[:3] @ axes)
    e = np.asarray(camera.e, float) + by[3:] @ axes
    e, p, u = (np.float32(x) for x in (e, e + turn @ axes[2], turn @ axes[1]))
    return camera.replace(e=e, p=p, u=u)


def joint(seed: int, kind: str, number: int, wrong: bool) -> dict:
    """Return the errors of a joint fit's unknowns in standard errors."""
    random = np.random.default_rng(seed)
    scene, given, views = pj.Scene(mesh=pj.shapes.bumpy(2)), {}, []
    for k in range(number):
        axes = Rotation.random(random_state=random).as_matrix()
        camera = there = given[str(k)] = camera_at(axes, np.zeros(2), 4.5, PHI, SMALL)
        if wrong and kind == "phi":
            there = camera.replace(phi=np.float32(PHI * (1 + WRONG[kind] * random.normal())))
        elif wrong:
            there = moved(camera, WRONG[kind] * random.normal(size=6))
        mask = mask_of(there, scene) + NOISE * random.normal(size=(SMALL, SMALL))
        views.append(pj.JointView(scene, mask, camera=str(k)))
    if kind == "phi":
        fit = pj.fit_joint(views, given, shared="phi").cameras["0"]
        return {"errors": [float((fit.camera.phi - PHI) / fit.std[-1])]}
    views = [v._replace(object="part") for v in views]
    found = pj.fit_joint(views, given, (), objects={"part": np.eye(4)}).objects["part"]
    turn = Rotation.from_matrix(found.pose[:3, :3]).as_rotvec()
    return {"errors": (np.append(turn, found.pose[:3, 3]) / found.std).tolist()}


def few_views(asked: Options) -> dict:
    table = []
    for case in [(kind, n, wrong) for kind in WRONG for n in (2, 3, 5) for wrong in (False, True)]:
        name = "few-views-" + "-".join(map(str, case))
        rows = trials(asked, name, asked.number(16), [case], joint)
        off = np.abs(np.concatenate([r["errors"] for r in rows]))
        row = dict(zip(("unknown", "views", "what is known errs"), case, strict=True))
        table.append({**row, "hold": float(np.mean(off < NORMAL_95)), "of": off.size})
    show(table)
    least = min(table, key=lambda row: row["hold"])
    words = f"{least['hold']:.0%} hold at worst: {least['views']} views, {least['unknown']} unknown"
    return {"verdict": words, "table": table}


if __name__ == "__main__":
    main(__doc__, {"one-view": (one_view, draw), "few-views": few_views})
