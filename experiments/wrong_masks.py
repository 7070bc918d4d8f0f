"""Where does a mask that is wrong lead, and does the fit say so?

Masks as people and networks make them: grown or shrunk, wavy along stretches of the outline, cut
off, bitten, kept as JPEG. Objects of 40 to 230 px on films of 256 x 256 pixels; starts 10, 20 and
30 degrees off and 5 % of the distance aside, and none. For each kind of mask: how often the fit
says `converged` and is off by more than 5 and 10 degrees, how often it is off by more than 5
degrees and 4 standard errors, how often a better camera was to be had (a fit from the truth leaves
less), what an error is in standard errors, and how many right cameras are called ambiguous.
"""

import io
import time
from collections import Counter

import numpy as np
from _common import camera_at, degrees, orbited, rows_of, run
from honesty import anywhere, dented, mug, of
from PIL import Image
from scipy.ndimage import distance_transform_edt, gaussian_filter
from tolerance import COLUMNS, ROWS, occluder, outline_of

import pinhole_jax as pj

SIZE, PHI = 256, 0.6
STARTS = (10, 20, 30, None)


def bracket(random: np.random.Generator) -> tuple[pj.Mesh, np.ndarray]:
    """Return three plates that meet at a corner."""
    import trimesh

    parts = []
    for size, place in (
        ([1.6, 1.2, 0.15], [0, 0, 0]),
        ([0.15, 1.2, 0.9], [-0.72, 0, 0.5]),
        ([0.9, 0.15, 0.5], [-0.3, 0.52, 0.3]),
    ):
        part = trimesh.creation.box(size)
        part.apply_translation(place)
        parts.append(part)
    return of(trimesh.util.concatenate(parts)), anywhere(random)


def bumpy(random: np.random.Generator) -> tuple[pj.Mesh, np.ndarray]:
    mesh = pj.shapes.bumpy(4)
    return pj.Mesh(np.asarray(mesh.vertices, np.float32), mesh.faces), anywhere(random)


SHAPES = {f.__name__: f for f in (bumpy, bracket, mug, dented)}


def signed_distance(image: np.ndarray) -> np.ndarray:
    """Return the distance to the outline in px, positive inside."""
    inside = image > 0.5
    return distance_transform_edt(inside) - distance_transform_edt(~inside) - inside + 0.5


def grown(image, random):
    return signed_distance(image) > -random.uniform(0.5, 4)


def shrunk(image, random):
    return signed_distance(image) > random.uniform(0.5, 3)


def waves(shape, random) -> np.ndarray:
    """Return by how many px the outline is off: 0.5 to 4 px, over 4 to 25 px."""
    field = gaussian_filter(random.normal(size=shape), random.uniform(4, 25))
    return random.uniform(0.5, 4) * field / field.std()


def wavy(image, random):
    return signed_distance(image) > waves(image.shape, random)


def soft(image, random):
    """Return what a network gives: wavy, biased, and soft over some px."""
    off = signed_distance(image) + waves(image.shape, random) / 2 + random.uniform(-1, 1)
    return 1 / (1 + np.exp(-off / random.uniform(0.3, 1.5)))


def cut(image, random):
    """Return a mask from which a straight cut takes 5 to 20 %."""
    return (image > 0.5) & ~occluder(image, random.uniform(0.05, 0.2), random)


def bitten(image, random):
    """Return a mask with three discs of a tenth of its size cut out of its outline."""
    inside, outline = image > 0.5, outline_of(image)
    radius = 0.1 * np.sqrt(inside.sum())
    for row, column in outline[random.integers(len(outline), size=3)]:
        inside &= np.hypot(ROWS - row, COLUMNS - column) > radius
    return inside


def jpeg(image, quality):
    file = io.BytesIO()
    grey = Image.fromarray(np.round(255 * image).astype(np.uint8))
    grey.save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))


KINDS = {
    "hard": lambda image, random: image > 0.5,
    **{f.__name__: f for f in (grown, shrunk, wavy, soft, cut, bitten)},
    "JPEG 30": lambda image, random: jpeg(image, 30),
    "JPEG 5": lambda image, random: jpeg(image, 5),
}


def start_off(truth: pj.Camera, far: float, axis: np.ndarray, aside: np.ndarray) -> pj.Camera:
    """Return a camera this many degrees off about an axis, 5 % of the origin's distance aside."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(np.deg2rad(far) * axis / np.linalg.norm(axis)).as_matrix()
    near = orbited(truth, turn, 1.0)
    distance = np.linalg.norm(np.asarray(truth.e - truth.p, float))
    shift = np.float32(0.05 * distance * aside / np.linalg.norm(aside))
    return pj.Camera(near.e + shift, near.p + shift, near.u, near.phi, 1.0, truth.W, truth.H)


def trial(number: int, shape: str, kind: str) -> dict:
    """Return one fit: how far off, in degrees and standard errors, and what it said."""
    random = np.random.default_rng([number, *map(ord, shape)])
    mesh, axes = SHAPES[shape](random)
    scene = pj.Scene(mesh=mesh)
    px = np.exp(random.uniform(np.log(40), np.log(230)))
    distance = SIZE / np.tan(PHI / 2) / px
    truth = camera_at(axes, random.uniform(-0.1, 0.1, 2), distance, PHI, SIZE)
    target = KINDS[kind](np.asarray(pj.silhouette(truth, scene)), random)
    axis = random.normal(size=3)
    aside = random.normal(size=3)
    far = STARTS[number % len(STARTS)]
    start = None if far is None else start_off(truth, far, axis, aside)
    begin = time.perf_counter()
    fit = pj.fit_camera(scene, target, start, phi=None if start else PHI)
    seconds = time.perf_counter() - begin
    off = degrees(fit.camera, truth)
    modes = [degrees(m.camera, truth) for m in fit.modes]
    sigma = float(np.rad2deg(np.linalg.norm(fit.std[:3])))
    best = pj.fit_camera(scene, target, truth) if off > 5 else fit
    return {
        "number": number,
        "shape": shape,
        "kind": kind,
        "start": far,
        "px": round(px),
        "status": fit.status,
        "degrees": off,
        "sigma": sigma,
        "nearest": min([off, *modes]),
        "modes": len(modes),
        "rms": fit.rms,
        "iou": fit.iou,
        "rms of the best": best.rms,
        "degrees of the best": degrees(best.camera, truth),
        "seconds": seconds,
    }


def thrown_away(row: dict) -> bool:
    """Return whether a camera that is near the truth leaves 5 % less squares than the answer."""
    better = row["rms of the best"] ** 2 < 0.95 * row["rms"] ** 2
    return bool(row["degrees"] > 5 > row["degrees of the best"] and better)


def summary(rows: list[dict]) -> dict:
    sure = [r for r in rows if r["status"] == "converged"]
    right = [r for r in rows if r["degrees"] < 5]
    ratio = [r["degrees"] / r["sigma"] for r in right if 0 < r["sigma"] < np.inf]
    return {
        "fits": len(rows),
        "median degrees": float(np.median([r["degrees"] for r in rows])),
        "converged": len(sure),
        "converged, > 5 deg": sum(r["degrees"] > 5 for r in sure),
        "converged, > 10 deg": sum(r["degrees"] > 10 for r in sure),
        "converged, > 5 deg and > 4 sigma": sum(
            r["degrees"] > max(5, 4 * r["sigma"]) for r in sure
        ),
        "a better camera was to be had": sum(map(thrown_away, rows)),
        "right, but ambiguous": sum(r["status"] == "ambiguous" for r in right) / max(len(right), 1),
        "error / sigma, median": float(np.median(ratio)) if ratio else None,
        "error / sigma, 90 %": float(np.quantile(ratio, 0.9)) if ratio else None,
        "statuses": dict(Counter(r["status"] for r in rows)),
        "seconds, median": float(np.median([r["seconds"] for r in rows])),
    }


def line(r: dict) -> str:
    return (
        f"{r['shape']:8} {r['kind']:8} {r['px']:4} px start {r['start']} {r['status']:14}"
        f" {r['degrees']:7.2f} deg (1 sigma: {r['sigma']:.3f}) modes {r['modes']}"
        f" iou {r['iou']:.3f} {r['seconds']:.2f} s{'  THROWN AWAY' if thrown_away(r) else ''}"
    )


def question() -> dict:
    rows = rows_of(SHAPES, KINDS, trial, line)
    kinds = dict.fromkeys(r["kind"] for r in rows)
    table = {kind: summary([r for r in rows if r["kind"] == kind]) for kind in kinds}
    table["all"] = summary(rows)
    for kind, found in table.items():
        print(f"{kind:8} {found}")
    return {"trials": len(rows), "table": table}


if __name__ == "__main__":
    run(question)
