"""Does a fit say so when its camera is wrong?

    python experiments/honesty.py near-symmetric | wrong-masks | occluders | tolerance | \
        unseen-exact | unseen-wrong | unseen-occluders [OUT]

- `near-symmetric`: closed shapes that look alike from several sides. They are a mug and a can
  whose handle or bump is out of the outline, an ellipsoid, a sphere with a dent, a plate and a box.
  Five kinds of mask of 128 x 128 pixels, starts 10 to 30 degrees off and none. A lie is a fit that
  says `converged` while it is more than one degree and more than 4 standard errors off.
- `wrong-masks`: masks as people and networks make them: grown or shrunk, wavy along stretches of
  the outline, cut off, bitten, kept as JPEG; objects of 40 to 230 px on films of 256 x 256 pixels.
- `occluders`: a half-plane, a board or a ball hides 10 to 40 % of the outline, and no weight image
  says so. `--quick` takes 48 trials.
- `unseen-...`: the first three with ten shapes that no constant was tuned on (`_shapes.py`).
- `tolerance`: the error against corrupted outline, blur and occluders, with a weight image and
  without, starts 5 degrees and 5 % off.
"""

import io
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import _shapes
import numpy as np
import trimesh
from _common import (
    Options,
    camera_at,
    curves,
    degrees,
    main,
    mask_of,
    meshes,
    orbited,
    percentiles,
    random_camera,
    show,
    start_from,
    trials,
    turn_by,
)
from PIL import Image
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial.transform import Rotation

import pinhole_jax as pj

SIZE = 128
Random = np.random.Generator
Made = tuple[pj.Mesh, np.ndarray]


def mug(random: Random) -> Made:
    """Return a mug, and axes that look at its handle from behind or from the front."""
    body = trimesh.creation.cylinder(radius=0.8, height=2, sections=64)
    handle = trimesh.creation.torus(0.35, 0.08, major_sections=24, minor_sections=12)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    handle.apply_translation([0.85, 0, 0])
    return float32_mesh(body + handle), beside(random)


def can(random: Random) -> Made:
    """Return a can with a bump, and axes that look at the bump from behind or from the front."""
    body = trimesh.creation.cylinder(radius=0.8, height=2, sections=64)
    bump = trimesh.creation.icosphere(subdivisions=2, radius=0.15)
    bump.apply_translation([0.8, 0, 0.3])
    return float32_mesh(body + bump), beside(random)


def ellipsoid(random: Random) -> Made:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    mesh.vertices *= [1.1, 0.8, 0.95]
    return float32_mesh(mesh), anywhere(random)


def dented(random: Random) -> Made:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    off = np.linalg.norm(mesh.vertices - [0.6, 0.64, 0.48], axis=1)
    depth = 0.3 * np.exp(-((off / 0.35) ** 2))
    return float32_mesh(mesh, mesh.vertices * (1 - depth)[:, None]), anywhere(random)


def plate(random: Random) -> Made:
    return float32_mesh(trimesh.creation.box([1.7, 1.2, 0.08])), anywhere(random)


def box(random: Random) -> Made:
    return float32_mesh(trimesh.creation.box([1.2, 1.32, 1.05])), anywhere(random)


def float32_mesh(mesh, vertices=None) -> pj.Mesh:
    points = mesh.vertices if vertices is None else vertices
    return pj.Mesh(np.asarray(points, np.float32), np.asarray(mesh.faces))


def beside(random: Random) -> np.ndarray:
    """Return axes that look along x, up to 15 degrees off it about z and 35 up or down."""
    turn = np.deg2rad(random.uniform(-15, 15)) + np.pi * random.integers(2)
    height = np.deg2rad(random.uniform(-35, 35))
    v = -np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
    b1 = np.cross(v, [0, 0, 1])
    b1 /= np.linalg.norm(b1)
    return np.stack([b1, np.cross(b1, v), v])


def anywhere(random: Random) -> np.ndarray:
    return Rotation.random(random_state=random).as_matrix()


def bracket(random: Random) -> Made:
    """Return three plates that meet at a corner."""
    parts = []
    for size, place in (
        ([1.6, 1.2, 0.15], [0, 0, 0]),
        ([0.15, 1.2, 0.9], [-0.72, 0, 0.5]),
        ([0.9, 0.15, 0.5], [-0.3, 0.52, 0.3]),
    ):
        part = trimesh.creation.box(size)
        part.apply_translation(place)
        parts.append(part)
    return float32_mesh(trimesh.util.concatenate(parts)), anywhere(random)


def bumpy(random: Random) -> Made:
    return float32_mesh(pj.shapes.bumpy(4)), anywhere(random)


SHAPES = {f.__name__: f for f in (mug, can, ellipsoid, dented, plate, box)}
DRAWN = {f.__name__: f for f in (bumpy, bracket, mug, dented)}


def made(shape: str, random: Random) -> tuple[pj.Scene, np.ndarray]:
    """A shape of `SHAPES`, `DRAWN` or the unseen ones, and axes that look at it."""
    if shape in _shapes.NAMES:
        return _shapes.scene(shape, random), anywhere(random)
    mesh, axes = (SHAPES | DRAWN)[shape](random)
    return pj.Scene(mesh=mesh), axes


# Masks: what a computed one becomes


KINDS: dict[str, Callable[[np.ndarray, Random], np.ndarray]] = {
    "exact": lambda image, random: image,
    "8 bits": lambda image, random: np.round(255 * image).astype(np.uint8),
    "one bit": lambda image, random: image > 0.5,
    "noisy": lambda image, random: image + 0.02 * random.normal(size=image.shape),
    "blurred": lambda image, random: gaussian_filter(image, 0.8),
}


def signed_distance(image: np.ndarray) -> np.ndarray:
    """Return the distance to the outline in px, positive inside."""
    inside = image > 0.5
    return distance_transform_edt(inside) - distance_transform_edt(~inside) - inside + 0.5


def waves(shape: tuple[int, ...], random: Random) -> np.ndarray:
    """Return by how many px the outline is off: 0.5 to 4 px, over 4 to 25 px."""
    field = gaussian_filter(random.normal(size=shape), random.uniform(4, 25))
    return random.uniform(0.5, 4) * field / field.std()


def soft(image: np.ndarray, random: Random) -> np.ndarray:
    """Return a network's mask: wavy, biased, and soft over some px."""
    off = signed_distance(image) + waves(image.shape, random) / 2 + random.uniform(-1, 1)
    return 1 / (1 + np.exp(-off / random.uniform(0.3, 1.5)))


def outline_of(mask: np.ndarray) -> np.ndarray:
    """Return the pixels (n, 2) of a hard mask that have a neighbour outside."""
    padded = np.pad(mask > 0.5, 1)
    core = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return np.argwhere(padded[1:-1, 1:-1] & ~core)


def beyond(image: np.ndarray, share: float, random: Random) -> np.ndarray:
    """Return the pixels of a half-plane over a share of the object."""
    rows, columns = np.indices(image.shape)
    direction = random.normal(size=2)
    depth = direction[0] * rows + direction[1] * columns
    return depth < np.quantile(depth[image > 0.5], share)


def bitten(image: np.ndarray, random: Random) -> np.ndarray:
    """Return a mask with three discs of a tenth of its size cut out of its outline."""
    inside, outline = image > 0.5, outline_of(image)
    rows, columns = np.indices(image.shape)
    radius = 0.1 * np.sqrt(inside.sum())
    for row, column in outline[random.integers(len(outline), size=3)]:
        inside &= np.hypot(rows - row, columns - column) > radius
    return inside


def jpeg(image: np.ndarray, quality: int) -> np.ndarray:
    file = io.BytesIO()
    grey = Image.fromarray(np.round(255 * image).astype(np.uint8))
    grey.save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))


WRONG: dict[str, Callable[[np.ndarray, Random], np.ndarray]] = {
    "hard": lambda image, random: image > 0.5,
    "grown": lambda image, random: signed_distance(image) > -random.uniform(0.5, 4),
    "shrunk": lambda image, random: signed_distance(image) > random.uniform(0.5, 3),
    "wavy": lambda image, random: signed_distance(image) > waves(image.shape, random),
    "soft": soft,
    "cut": lambda i, random: (i > 0.5) & ~beyond(i, random.uniform(0.05, 0.2), random),
    "bitten": bitten,
    "JPEG 30": lambda image, random: jpeg(image, 30),
    "JPEG 5": lambda image, random: jpeg(image, 5),
}


def hidden(image: np.ndarray, share: float, kind: str, random: Random) -> np.ndarray:
    """Return the pixels (H, W) of an occluder that hides a share of the outline."""
    outline = outline_of(image)
    place = outline[random.integers(len(outline))]
    angle = random.uniform(0, 2 * np.pi)
    aside = np.moveaxis(np.indices(image.shape), 0, -1) - place
    along = aside @ [np.cos(angle), np.sin(angle)]
    if kind == "board":
        along = np.maximum(np.abs(along), 3 * np.abs(aside @ [-np.sin(angle), np.cos(angle)]))
    elif kind == "ball":
        along = np.linalg.norm(aside, axis=-1)
    return along < np.quantile(along[tuple(outline.T)], share)


# Trials


def answer(
    scene: pj.Scene, target: np.ndarray, start: pj.Camera | None, truth: pj.Camera, phi: float
) -> tuple[pj.Fit, dict[str, Any]]:
    """Return a fit, and how far off it is, in degrees and standard errors, and what it says."""
    fit = pj.fit_camera(scene, target, start, phi=None if start else phi)
    off, *modes = (degrees(found.camera, truth) for found in (fit, *fit.modes))
    sigma = float(np.rad2deg(np.linalg.norm(fit.std[:3])))
    return fit, {
        "status": fit.status,
        "degrees": off,
        "sigma": sigma,
        "sigmas": off / sigma if sigma > 0 else float("inf"),
        "nearest": min([off, *modes]),
        "modes": len(modes),
        "rms": fit.rms,
        "iou": fit.iou,
        "start": start is not None,
    }


def trial(number: int, shape: str, kind: str) -> dict:
    """Return a fit of a shape that looks alike from several sides."""
    random = np.random.default_rng([number, *map(ord, shape)])
    scene, axes = made(shape, random)
    distance = random.uniform(1.2, 2.0) / np.sin(0.3)
    truth = camera_at(axes, random.uniform(-0.1, 0.1, 2), distance, 0.6, SIZE)
    target = KINDS[kind](mask_of(truth, scene), random)
    axis = random.normal(size=3)
    turn = turn_by(random.uniform(10, 30), axis)
    start = orbited(truth, turn, random.uniform(0.95, 1.05))
    if random.uniform() < 0.15:
        start = None
    return {"kind": kind, **answer(scene, target, start, truth, 0.6)[1]}


def is_lie(row: dict) -> bool:
    return row["status"] == "converged" and row["degrees"] > 1 and not row["sigmas"] <= 4


def exact(name: str, shapes: Iterable[str], asked: Options) -> dict:
    """Masks that programs make."""
    cases = [(shape, kind) for shape in asked.names(shapes) for kind in KINDS]
    rows = trials(asked, name, asked.number(1000, 35), cases, trial)
    sure = [r for r in rows if r["status"] == "converged"]
    found = {
        "trials": len(rows),
        "converged": len(sure),
        "lies": sum(map(is_lie, rows)),
        "right": sum(r["degrees"] < 1 or r["sigmas"] < 4 for r in rows),
        "worst converged, degrees": max((r["degrees"] for r in sure), default=0.0),
        "statuses": dict(Counter(r["status"] for r in rows)),
        "median seconds": float(np.median([r["seconds"] for r in rows])),
    }
    words = f"{found['lies']} of {len(rows)} fits say `converged` and are wrong"
    return {"verdict": f"{words}; {len(sure)} converged", **found}


PX, PHI = 256, 0.6
STARTS = (10, 20, 30, None)


def start_off(truth: pj.Camera, far: float, axis: np.ndarray, aside: np.ndarray) -> pj.Camera:
    """Return a camera this many degrees off about an axis, 5 % of the origin's distance aside."""
    near = orbited(truth, turn_by(far, axis), 1.0)
    distance = np.linalg.norm(np.asarray(truth.e - truth.p, float))
    shift = np.float32(0.05 * distance * aside / np.linalg.norm(aside))
    return near.replace(e=near.e + shift, p=near.p + shift)


def view(shape: str, random: Random, least: float, most: float) -> tuple[pj.Scene, pj.Camera]:
    """Return a shape before a camera in which it is this many px large."""
    scene, axes = made(shape, random)
    px = np.exp(random.uniform(np.log(least), np.log(most)))
    distance = PX / np.tan(PHI / 2) / px
    return scene, camera_at(axes, random.uniform(-0.1, 0.1, 2), distance, PHI, PX)


def wrong_trial(number: int, shape: str, kind: str) -> dict:
    random = np.random.default_rng([number, *map(ord, shape)])
    scene, truth = view(shape, random, 40, 230)
    image = mask_of(truth, scene)
    target = WRONG[kind](image, random)
    while np.max(target) < 0.5:  # (Wavering has left nothing of a thin part.)
        target = WRONG[kind](image, random)
    axis, aside = random.normal(size=(2, 3))
    far = STARTS[number % len(STARTS)]
    start = None if far is None else start_off(truth, far, axis, aside)
    fit, row = answer(scene, target, start, truth, PHI)
    best = pj.fit_camera(scene, target, truth) if row["degrees"] > 5 else fit
    # A camera near the truth leaves 5 % less squares than the answer.
    better = best.rms**2 < 0.95 * fit.rms**2 and degrees(best.camera, truth) < 5
    return {"kind": kind, **row, "a better one was to be had": bool(better)}


def hidden_trial(number: int, shape: str, kind: str) -> dict:
    random = np.random.default_rng([number, 11, *map(ord, shape)])
    scene, truth = view(shape, random, 60, 230)
    share, _, what = kind.split()
    image = mask_of(truth, scene)
    target = (image > 0.5) & ~hidden(image, int(share) / 100, what, random)
    start = start_off(truth, 10, *random.normal(size=(2, 3))) if number % 2 else None
    fit, row = answer(scene, target, start, truth, PHI)
    return {"kind": f"{share} %", **row, "told": fit.unbelieved is not None}


def summary(rows: list[dict]) -> dict[str, Any]:
    sure = [r for r in rows if r["status"] == "converged"]
    right = [r for r in rows if r["degrees"] < 5]
    ratio = [r["sigmas"] for r in right if 0 < r["sigma"] < np.inf] or [np.nan]
    known = [r["degrees"] for r in rows if np.isfinite(r["sigma"])] or [np.nan]
    return {
        "fits": len(rows),
        "converged": len(sure),
        "> 5 deg": sum(r["degrees"] > 5 for r in sure),
        "> 10 deg": sum(r["degrees"] > 10 for r in sure),
        "> 5 deg, 4 sigma": sum(r["degrees"] > max(5, 4 * r["sigma"]) for r in sure),
        "a better one was to be had": sum(r.get("a better one was to be had", 0) for r in rows),
        "told": sum(r.get("told", 0) for r in rows),
        "ambiguous of right": sum(r["status"] == "ambiguous" for r in right) / max(len(right), 1),
        "error / sigma": float(np.median(ratio)),
        "90 %": float(np.quantile(ratio, 0.9)),
        "median degrees": float(np.median([r["degrees"] for r in rows])),
        "... where determined": float(np.median(known)),
        "seconds": float(np.median([r["seconds"] for r in rows])),
    }


def by_kind(rows: list[dict]) -> dict:
    """Return the rows' summaries by kind of mask, and in all."""
    kinds = dict.fromkeys(r["kind"] for r in rows)
    table = {kind: summary([r for r in rows if r["kind"] == kind]) for kind in kinds}
    table["all"] = summary(rows)
    show({"kind": kind, **row} for kind, row in table.items())
    every = table["all"]
    words = f"of {every['converged']} `converged` {every['> 5 deg']} are more than 5 degrees off"
    return {"verdict": f"{len(rows)} fits: {words}", "table": table}


def wrong(name: str, shapes: Iterable[str], asked: Options) -> dict:
    """Masks that people and networks make."""
    cases = [(shape, kind) for shape in shapes for kind in asked.names(WRONG)]
    return by_kind(trials(asked, name, asked.number(1000, 36), cases, wrong_trial))


def occluded(name: str, shapes: Iterable[str], asked: Options) -> dict:
    """Masks of objects behind something."""
    kinds = [f"{s} % {what}" for s in (10, 20, 30, 40) for what in ("plane", "board", "ball")]
    cases = [(shape, kind) for shape in shapes for kind in kinds]
    return by_kind(trials(asked, name, asked.number(1000, 48), cases, hidden_trial))


# Where masks get worse and worse

SHARES, BLURS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4), (0.5, 1.0, 2.0, 4.0, 8.0)


def corrupted(mask: np.ndarray, share: float, random: Random) -> np.ndarray:
    """Return a hard mask with discs filled or cut out over a share of its outline."""
    outline, result = outline_of(mask), (mask > 0.5).copy()
    rows, columns = np.indices(mask.shape)
    spoilt = np.zeros(len(outline), bool)
    size = np.sqrt(np.sum(mask) / np.pi)
    while spoilt.mean() < share:
        row, column = outline[random.choice(np.flatnonzero(~spoilt))]
        radius = size * random.uniform(0.05, 0.15)
        result[np.hypot(rows - row, columns - column) < radius] = random.random() < 0.5
        spoilt |= np.hypot(*(outline - [row, column]).T) < radius
    return result


def tolerance(asked: Options) -> dict:
    errors: dict[str, dict[float, list[float]]] = {}
    for name, scene in meshes("spot.obj"):
        for number in range(asked.seed, asked.seed + asked.number(15)):
            random = np.random.default_rng(number)
            truth = random_camera(random)
            start, mask = start_from(truth, 5, 0.05, random), mask_of(truth, scene)
            jobs = []
            for share in SHARES:
                spoilt = corrupted(mask, share, random)
                jobs += [("corrupted outline", share, spoilt, {})]
                jobs += [("corrupted, plain least squares", share, spoilt, {"outlier_px": None})]
            jobs += [("blur, px", blur, gaussian_filter(mask, blur), {}) for blur in BLURS]
            for share in SHARES[2:]:
                covered = beyond(mask, share, random)
                target, weight = np.where(covered, 0, mask), ~covered * 1.0
                jobs += [("occluder", share, target, {})]
                jobs += [("occluder, weight image", share, target, {"weight": weight})]
            for kind, x, target, more in jobs:
                fit = pj.fit_camera(scene, target, start, **more)
                curve = errors.setdefault(f"{name}, {kind}", {})
                curve.setdefault(x, []).append(degrees(fit.camera, truth))
    table = {kind: {x: percentiles(y) for x, y in of.items()} for kind, of in errors.items()}
    show({"": kind, **{str(x): y["median"] for x, y in of.items()}} for kind, of in table.items())
    worst = [of[0.2]["median"] for kind, of in table.items() if "corrupted outline" in kind]
    words = f"20 % of the outline corrupted: {max(worst):.2f} degrees (median) at most"
    return {"verdict": words, "table": table}


def draw(found: dict, path: Path) -> None:
    panels = []
    for group in ("corrupted", "blur", "occluder"):
        lines = {k: of for k, of in found["table"].items() if group in k}
        medians = {k: ([*of], [y["median"] for y in of.values()]) for k, of in lines.items()}
        panels.append(("pose error, degrees", group, "semilogy", medians))
    curves(path, *panels)


if __name__ == "__main__":
    main(
        __doc__,
        {
            "near-symmetric": partial(exact, "near-symmetric", SHAPES),
            "wrong-masks": partial(wrong, "wrong-masks", DRAWN),
            "occluders": partial(occluded, "occluders", DRAWN),
            "unseen-exact": partial(exact, "unseen-exact", _shapes.NAMES),
            "unseen-wrong": partial(wrong, "unseen-wrong", _shapes.NAMES),
            "unseen-occluders": partial(occluded, "unseen-occluders", _shapes.NAMES),
            "tolerance": (tolerance, draw),
        },
    )
