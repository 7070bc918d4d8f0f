"""Does a fit say so when its camera is wrong?

Closed shapes that look alike from several sides (a mug and a can whose handle or bump is out of
the outline, an ellipsoid, a sphere with a dent, a plate, a box; a knee's implants, where these are
there), five kinds of mask of 128 x 128 pixels, starts 10 to 30 degrees off and none. A lie is a fit
that says `converged` while it is more than one degree and more than 4 standard errors off. The
command line may name the number of trials and the first seed; `checks` after the folder asks what
the looks after convergence, by which a fit knows, add to one of an ordinary shape.
"""

import sys
import time
from collections import Counter
from unittest import mock

import numpy as np
from _common import SHARED, camera_at, meshes, orbited, percentiles, random_camera, rows_of, run

import pinhole_jax as pj
from pinhole_jax._fit import strategy
from pinhole_jax._fit.places import Places

SIZE = 128
KNEE = SHARED.with_name("knee")


def mug(random: np.random.Generator) -> tuple[pj.Mesh, np.ndarray]:
    """Return a mug, and axes that look at its handle from behind or from the front."""
    import trimesh

    body = trimesh.creation.cylinder(radius=0.8, height=2, sections=64)
    handle = trimesh.creation.torus(0.35, 0.08, major_sections=24, minor_sections=12)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    handle.apply_translation([0.85, 0, 0])
    return of(body + handle), beside(random)


def can(random: np.random.Generator) -> tuple[pj.Mesh, np.ndarray]:
    """Return a can with a bump, and axes that look at the bump from behind or from the front."""
    import trimesh

    body = trimesh.creation.cylinder(radius=0.8, height=2, sections=64)
    bump = trimesh.creation.icosphere(subdivisions=2, radius=0.15)
    bump.apply_translation([0.8, 0, 0.3])
    return of(body + bump), beside(random)


def ellipsoid(random: np.random.Generator) -> tuple[pj.Mesh, np.ndarray]:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=4)
    mesh.vertices *= [1.1, 0.8, 0.95]
    return of(mesh), anywhere(random)


def dented(random: np.random.Generator) -> tuple[pj.Mesh, np.ndarray]:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=4)
    off = np.linalg.norm(mesh.vertices - [0.6, 0.64, 0.48], axis=1)
    depth = 0.3 * np.exp(-((off / 0.35) ** 2))
    return of(mesh, mesh.vertices * (1 - depth)[:, None]), anywhere(random)


def plate(random: np.random.Generator) -> tuple[pj.Mesh, np.ndarray]:
    import trimesh

    return of(trimesh.creation.box([1.7, 1.2, 0.08])), anywhere(random)


def box(random: np.random.Generator) -> tuple[pj.Mesh, np.ndarray]:
    import trimesh

    return of(trimesh.creation.box([1.2, 1.32, 1.05])), anywhere(random)


def implant(random: np.random.Generator) -> tuple[pj.Mesh, np.ndarray]:
    """Return a knee's implant of radius 1, and axes: a tibia's tray is nearly its mirror image."""
    mesh = pj.load_mesh(KNEE / f"{random.choice(['tibia', 'femur'])}.stl")
    vertices = np.asarray(mesh.vertices, float)
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return of(mesh, vertices / np.linalg.norm(vertices, axis=1).max()), anywhere(random)


def of(mesh, vertices=None) -> pj.Mesh:
    points = mesh.vertices if vertices is None else vertices
    return pj.Mesh(np.asarray(points, np.float32), np.asarray(mesh.faces))


def beside(random: np.random.Generator) -> np.ndarray:
    """Return axes that look along x, up to 15 degrees off it about z and 35 up or down."""
    turn = np.deg2rad(random.uniform(-15, 15)) + np.pi * random.integers(2)
    height = np.deg2rad(random.uniform(-35, 35))
    v = -np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
    b1 = np.cross(v, [0, 0, 1])
    b1 /= np.linalg.norm(b1)
    return np.stack([b1, np.cross(b1, v), v])


def anywhere(random: np.random.Generator) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.random(random_state=random).as_matrix()


SHAPES = {f.__name__: f for f in (mug, can, ellipsoid, dented, plate, box)}
if KNEE.exists():
    SHAPES[implant.__name__] = implant


def eight_bits(image, random):
    return np.round(255 * image).astype(np.uint8)


def one_bit(image, random):
    return image > 0.5


def noisy(image, random):
    return image + 0.02 * random.normal(size=image.shape)


def blurred(image, random):
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(image, 0.8)


KINDS = {
    "exact": lambda image, random: image,
    "8 bits": eight_bits,
    "one bit": one_bit,
    "noisy": noisy,
    "blurred": blurred,
}


def turn_by(degrees: float, axis: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)).as_matrix()


def trial(number: int, shape: str, kind: str) -> dict:
    """Return one fit: how far off, in degrees and standard errors, its status and seconds."""
    random = np.random.default_rng([number, *map(ord, shape)])
    mesh, axes = SHAPES[shape](random)
    scene = pj.Scene(mesh=mesh)
    distance = random.uniform(1.2, 2.0) / np.sin(0.3)
    truth = camera_at(axes, random.uniform(-0.1, 0.1, 2), distance, 0.6, SIZE)
    target = KINDS[kind](np.asarray(pj.silhouette(truth, scene)), random)
    axis = random.normal(size=3)
    angle = random.uniform(10, 30)
    start = orbited(truth, turn_by(angle, axis), random.uniform(0.95, 1.05))
    if random.uniform() < 0.15:
        start = None
    begin = time.perf_counter()
    fit = pj.fit_camera(scene, target, start, phi=None if start else 0.6)
    seconds = time.perf_counter() - begin
    off = float(np.rad2deg(pj.pose_error(fit.camera, truth)[0]))
    known = np.linalg.norm(fit.std[:3])
    modes = [float(np.rad2deg(pj.pose_error(m.camera, truth)[0])) for m in fit.modes]
    return {
        "number": number,
        "shape": shape,
        "kind": kind,
        "start": None if start is None else angle,
        "status": fit.status,
        "degrees": off,
        "sigmas": float(np.deg2rad(off) / known) if known > 0 else float("inf"),
        "sigma": float(np.rad2deg(known)),
        "nearest_mode": min(modes, default=None),
        "modes": len(modes),
        "rms": fit.rms,
        "iou": fit.iou,
        "weak": fit.weak,
        "seconds": seconds,
    }


def is_lie(row: dict) -> bool:
    return row["status"] == "converged" and row["degrees"] > 1 and not row["sigmas"] <= 4


def line(r: dict) -> str:
    return (
        f"{r['shape']:10} {r['kind']:8} {r['status']:14} {r['degrees']:8.3f} deg"
        f" {r['sigmas']:9.1f} sigma (1: {r['sigma']:.1e} deg) rms {r['rms']:.1e}"
        f" iou {r['iou']:.4f} modes {r['modes']} start {r['start'] and round(r['start'])}"
        f" {r['seconds']:.2f} s{'  LIE' if is_lie(r) else ''}"
    )


def question() -> dict:
    rows = rows_of(SHAPES, KINDS, trial, line)
    lies = [r for r in rows if is_lie(r)]
    print(f"{len(lies)} of {len(rows)} fits say `converged` and are wrong")
    table = {}
    for shape in SHAPES:
        mine = [r for r in rows if r["shape"] == shape]
        right = [r for r in mine if r["degrees"] < 1 or r["sigmas"] < 4]
        table[shape] = {
            "lies": sum(map(is_lie, mine)),
            "trials": len(mine),
            "statuses": dict(Counter(r["status"] for r in mine)),
            "right": len(right),
            "right and converged": sum(r["status"] == "converged" for r in right),
            "seconds": percentiles([r["seconds"] for r in mine]) if mine else None,
        }
        print(f"{shape:10} {table[shape]}")
    return {"trials": len(rows), "lies": lies, "table": table}


#: How often a fit is timed with and without its looks round, in turn.
REPEATS = 5


def cost() -> dict:
    """Return what looks round add to fits of ordinary shapes, compiled, in processor time."""
    rows = []
    for name, scene in meshes("spot.obj", "bob.obj", "teapot.obj"):
        random = np.random.default_rng([5, *map(ord, name)])
        for _ in range(2):
            truth, axis = random_camera(random), random.normal(size=3)
            image = np.asarray(pj.silhouette(truth, scene))
            start = orbited(truth, turn_by(15, axis), 1.05)
            for kind in ("exact", "8 bits", "one bit"):
                rows.append({"shape": name, **looks(scene, KINDS[kind](image, random), start)})
                rows[-1]["kind"] = kind
                print(rows[-1], flush=True)
    return {"rows": rows}


def looks(scene: pj.Scene, target: np.ndarray, start: pj.Camera) -> dict:
    """Return a fit's seconds of the processor (medians) with its looks round and without them."""
    nowhere = lambda solver, mask, found, *_: Places(found, [], [])
    seconds: dict[str, list[float]] = {"without": [], "with": []}
    fit = pj.fit_camera(scene, target, start)
    for _ in range(REPEATS):
        for name, look in (("without", nowhere), ("with", strategy.looked_round)):
            with mock.patch.object(strategy, "looked_round", look):
                begin = time.process_time()
                pj.fit_camera(scene, target, start)
                seconds[name].append(time.process_time() - begin)
    without, whole = (float(np.median(x)) for x in seconds.values())
    return {"status": fit.status, "without": without, "with": whole, "more": whole / without - 1}


if __name__ == "__main__":
    run(cost if "checks" in sys.argv else question)
