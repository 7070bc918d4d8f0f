"""How exactly is a camera found, from how far off, and is that as exact as the data allow?

    python experiments/accuracy.py starts | search | noise | one-bit | views | basin | precision

- `starts`: exact masks of 256 x 256 pixels; starts 5 to 30 degrees and 5 to 15 % of the distance
  off, pose free (the field's protocol) and pose and focal length free; float32 and float64.
- `search`: the same masks and no start; the focal length known, or free with a first guess.
- `noise`: Gaussian noise in every pixel: the error over the Cramer-Rao bound of the exact Jacobian,
  and how often 95 % intervals hold the truth.
- `one-bit`: masks from 32 to 1024 pixels: the error's slope.
- `views`: the focal length that 1, 4 and 16 views share: its error.
- `basin`: which starts up to 60 degrees off about two axes end at the camera.
- `precision`: what is rounded to float32 is taken as exact, float64 answers: function by function.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import (
    NORMAL_95,
    Options,
    axes_of,
    degrees,
    main,
    mask_of,
    meshes,
    orbited,
    percentiles,
    random_camera,
    show,
    start_from,
    turn_by,
)

import pinhole_jax as pj

STARTS = ((5, 0.05), (10, 0.05), (15, 0.1), (20, 0.05), (30, 0.15))
FREE = (("pose",), ("pose", "phi"))
#: Found, degrees.
RIGHT = 0.01


def wide(tree):
    single = lambda x: eqx.is_array(x) and x.dtype == np.float32
    return jax.tree.map(lambda x: np.asarray(x, float) if single(x) else x, tree)


def zoomed(camera: pj.Camera, times: float) -> pj.Camera:
    """Return the camera with a focal length this many times as long."""
    phi = 2 * np.arctan(np.tan(camera.phi / 2) / times)
    return camera.replace(phi=np.asarray(phi, camera.phi.dtype))


def row_of(name: str, fits: list[tuple[pj.Fit, pj.Camera, float]]) -> dict:
    """Return a table's row: the number of right fits, their errors and their time."""
    off = [degrees(fit.camera, truth) for fit, truth, _ in fits]
    right = [x < RIGHT and f.status == "converged" for x, (f, *_) in zip(off, fits, strict=True)]
    seconds = float(np.median([s for *_, s in fits[1:]] or [np.nan]))
    of = {"found": sum(right), "of": len(fits), "median s": seconds}
    return {"": name, **of, **{f"{k} degrees": x for k, x in percentiles(off).items()}}


def fitted(scene: pj.Scene, truth: pj.Camera, start: pj.Camera | None, free: tuple[str, ...]):
    mask = mask_of(truth, scene)
    begin = time.perf_counter()
    fit = pj.fit_camera(scene, mask, start, free, phi=0.6 if start is None else None)
    return fit, truth, time.perf_counter() - begin


def starts(asked: Options) -> dict:
    table = []
    for name, scene in meshes("spot.obj", "suzanne.ply"):
        for kind, cast in (("float32", lambda x: x), ("float64", wide)):
            for free in FREE:
                for angle, share in STARTS:
                    fits = []
                    for number in range(asked.seed, asked.seed + asked.number(40)):
                        random = np.random.default_rng(number)
                        truth = cast(random_camera(random))
                        start = cast(start_from(truth, angle, share, random))
                        start = zoomed(start, 1 - share) if len(free) > 1 else start
                        fits.append(fitted(cast(scene), truth, start, free))
                    words = f"{name}, {kind}, {'+'.join(free)}, {angle} degrees, {share:.0%}"
                    table.append(row_of(words, fits))
                    print(table[-1], flush=True)
    return said(table)


def search(asked: Options) -> dict:
    table = []
    for name, scene in meshes("spot.obj", "bob.obj", "suzanne.ply", "teapot.obj"):
        for free in FREE:
            fits = []
            for number in range(asked.seed, asked.seed + asked.number(20)):
                random = np.random.default_rng(number)
                truth = random_camera(random, random.uniform(0.4, 0.9) if len(free) > 1 else 0.6)
                fits.append(fitted(scene, truth, None, free))
            table.append(row_of(f"{name}, {'+'.join(free)}", fits))
            print(table[-1], flush=True)
    return said(table)


def said(table: list[dict]) -> dict:
    show(table)
    found, of = (sum(row[k] for row in table) for k in ("found", "of"))
    worst = max(row["max degrees"] for row in table)
    return {"verdict": f"{found} of {of} found; the worst {worst:.1e} degrees off", "table": table}


def values(camera: pj.Camera, truth: pj.Camera) -> np.ndarray:
    """Return small rotations about the true camera's axes, eye and phi, as a fit reports them."""
    a = axes_of(truth)
    turn = a @ (np.cross(a, axes_of(camera)).sum(axis=0) / 2)
    return np.array([*turn, *np.asarray(camera.e, float), float(camera.phi)])


NOISE = 0.02


def noise(asked: Options) -> dict:
    table = []
    for name, scene in meshes("spot.obj"):
        truth, free = random_camera(np.random.default_rng(5)), FREE[1]
        bound = pj.observability(truth, scene, free, noise=NOISE).std
        mask, exact, errors, held = mask_of(truth, scene), values(truth, truth), [], []
        for number in range(asked.seed, asked.seed + asked.number(200, 2)):
            random = np.random.default_rng(number)
            start = start_from(truth, 3, 0.02, random)
            fit = pj.fit_camera(scene, mask + NOISE * random.normal(size=mask.shape), start, free)
            errors.append(values(fit.camera, truth) - exact)
            held.append(np.abs(errors[-1]) < NORMAL_95 * fit.std)
        ratios = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
        hold = np.mean(held, axis=0)
        for row in zip(fit.names, ratios.tolist(), hold.tolist(), strict=True):
            table.append({"": name, **dict(zip(("", "over the bound", "hold"), row, strict=True))})
            table[-1][""] = f"{name}, {row[0]}"
    show(table)
    least, most = (f(row["over the bound"] for row in table) for f in (min, max))
    hold = np.mean([row["hold"] for row in table])
    words = f"rms error {least:.2f} to {most:.2f} times the bound, {hold:.1%} of intervals hold"
    return {"verdict": words, "table": table}


def one_bit(asked: Options) -> dict:
    sizes, table = (32, 64, 128, 256, 512, 1024), {}
    for name, scene in meshes("spot.obj"):
        found: dict[int, float] = {}
        for size in sizes:
            errors = []
            for number in range(asked.seed, asked.seed + asked.number(20)):
                random = np.random.default_rng(number)
                truth = random_camera(random, size=size)
                start = start_from(truth, 3, 0.02, random)
                fit = pj.fit_camera(scene, mask_of(truth, scene) > 0.5, start)
                errors.append(degrees(fit.camera, truth))
            found[size] = float(np.median(errors))
        slope = np.polyfit(np.log([*found]), np.log([*found.values()]), 1)[0]
        table[f"{name}: slope {slope:.2f}"] = found
    show({"": name, **{str(k): x for k, x in row.items()}} for name, row in table.items())
    return {"verdict": f"median degrees over pixels: {', '.join(table)}", "table": table}


def views(asked: Options) -> dict:
    table = []
    for name, scene in meshes("spot.obj"):
        for number in (1, 4, 16):
            errors = []
            for k in range(asked.seed, asked.seed + asked.number(20)):
                random = np.random.default_rng(1000 + k)
                truths = [random_camera(random) for _ in range(number)]
                starts = [start_from(c, 3, 0.02, random) for c in truths]
                noisy = lambda c, r=random, s=scene: (
                    mask_of(c, s) + 0.005 * r.normal(size=(256,) * 2)
                )
                fits = pj.fit_cameras(scene, [noisy(c) for c in truths], starts)
                errors.append(np.tan(0.3) / np.tan(float(fits[0].camera.phi) / 2) - 1)
            off = float(np.sqrt(np.mean(np.square(errors))))
            table.append({"": name, "views": number, "focal length, rms share": off})
    show(table)
    return {"verdict": f"16 views: focal length {off:.2%} off (rms)", "table": table}


def basin(asked: Options) -> dict:
    angles, table = np.linspace(-60, 60, asked.number(13, 3)), {}
    for name, scene in meshes("spot.obj"):
        truth = random_camera(np.random.default_rng(1))
        axes, mask = axes_of(truth), mask_of(truth, scene)

        def ends_right(a: float, b: float, axes=axes, mask=mask, truth=truth, scene=scene) -> bool:
            start = orbited(truth, turn_by(np.hypot(a, b) + 1e-9, [a, b, 1e-9] @ axes), 1.0)
            return degrees(pj.fit_camera(scene, mask, start).camera, truth) < 0.1

        table[name] = [[ends_right(a, b) for b in angles] for a in angles]
    within = np.hypot(*np.meshgrid(angles, angles)) < 31
    shares = {k: (float(np.mean(np.array(x)[within])), float(np.mean(x))) for k, x in table.items()}
    words = [f"{k}: {a:.0%} up to 30 degrees, {b:.0%} of all" for k, (a, b) in shares.items()]
    return {"verdict": "; ".join(words), "angles": angles.tolist(), "table": table}


WEIGHT = np.random.default_rng(0).normal(size=(64, 64))


@eqx.filter_jit
def slope(camera: pj.Camera, scene: pj.Scene):
    """Return the derivative of a weighted sum of the image, by the camera's parameters."""
    loss = lambda c: jnp.sum(jnp.asarray(WEIGHT, c.e.dtype) * pj.silhouette(c, scene))
    return eqx.filter_grad(loss)(camera)


def differences(camera: pj.Camera, scene: pj.Scene) -> dict[str, np.ndarray]:
    """Return by what each function's results in float32 differ from those in float64."""
    eye, exact = wide(camera), wide(scene)
    rays, right = pj.camera_rays(camera), pj.camera_rays(eye)
    hit, met = pj.trace(scene, rays), pj.trace(exact, wide(rays))
    same = np.asarray((hit.primitive == met.primitive) & (met.primitive >= 0))
    away = lambda x, y: np.linalg.norm(np.asarray(x, float) - y, axis=-1)
    points = scene.mesh.vertices
    slopes = (np.concatenate(jax.tree.leaves(jax.tree.map(np.ravel, slope(c, s))))
              for c, s in ((camera, scene), (eye, exact)))  # fmt: skip
    ours, theirs = slopes
    return {
        "rays (rad)": away(rays.direction, right.direction),
        "project (px)": away(pj.project(camera, points), pj.project(eye, wide(points))),
        "trace: t (relative)": np.abs(hit.t / met.t - 1)[same],
        "trace: barycentric": away(hit.barycentric, met.barycentric)[same],
        "trace: normal (rad)": away(hit.normal, met.normal)[same],
        "silhouette (px^2)": np.abs(mask_of(camera, scene) - mask_of(eye, exact)),
        "derivative (of the largest)": np.abs(ours - theirs) / np.abs(theirs).max(),
    }


def precision(asked: Options) -> dict:
    ball = pj.Spheres(np.float32([[0.7, 0.4, 0.6]]), np.float32([0.3]))
    (_, shape), *_ = meshes()
    scene, found = pj.Scene(mesh=shape.mesh, spheres=ball), {}
    for number in range(asked.seed, asked.seed + asked.number(50)):
        camera = random_camera(np.random.default_rng(number), size=64)
        for name, error in differences(camera, scene).items():
            found.setdefault(name, []).append(np.ravel(error))
    every = {name: np.concatenate(errors) for name, errors in found.items()}
    figures = {"mean": np.mean, "99 %": lambda x: np.quantile(x, 0.99), "worst": np.max}
    table = {k: {name: float(f(x)) for name, f in figures.items()} for k, x in every.items()}
    show({"": name, **row} for name, row in table.items())
    words = f"float32 errs by {table['silhouette (px^2)']['worst']:.1e} px^2 at worst"
    return {"verdict": words, "table": table}


if __name__ == "__main__":
    parts = {f.__name__.replace("_", "-"): f for f in (starts, search, noise, one_bit, views)}
    main(__doc__, {**parts, "basin": basin, "precision": precision})
