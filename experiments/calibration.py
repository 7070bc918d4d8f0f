"""Do error bars hold at every level?

    python experiments/calibration.py ranks | matrix [OUT] [--resume] [--only exact,one-bit,drawn]

- `ranks`: simulation-based calibration, by kind of mask. Shape, camera, occluder and errors are
  drawn from the prior below, and the fit starts near the truth. If error bars are right, the rank
  (normal quantile) of the truth under the fit's Gaussian is uniform. So it must be for each
  parameter, for distance, px at the film's corner and the place of the object's farthest point.
  The picture: the ranks' distribution less the uniform one, and how often 95 % intervals hold by
  difficulty.
- `matrix`: the covariance of 200 refits beside the predicted one: eigenvalues, worst direction.

The prior: any rotation; size log-uniform, 40 to 220 px on films of 256 x 256; phi uniform, 0.35 to
0.9, free in every other fit; a start 3 degrees and 3 % off (one sigma). In three fits of four a
weight image hides up to 40 % of the outline. Errors by kind of mask:

- exact coverage, each pixel off by a normal error (log-uniform, 0.003 to 0.05);
- coverage above one half: one bit, off by nothing else;
- an outline that wavers by 0.2 to 2 px over 6 to 60 px (log-uniform), with covariance
  exp(-distance / length) or as smooth as networks draw. All of it is moved outwards by a normal
  bias of once that and 0.5 px (of five masks one: twice that and 2.5 px). It is one bit, or 8 bits
  with edges as wide as networks leave.
"""

from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import _shapes
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
    meshes,
    orbited,
    resized,
    scene_of,
    show,
    trials,
    turn_by,
)
from honesty import DRAWN, Random, anywhere, hidden
from intervals import error
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.special import expit
from scipy.stats import binom, chi2, norm

import pinhole_jax as pj

PX, FINER = 256, 4
REAL = ("spot.obj", "bob.obj", "teapot.obj", "suzanne.ply")
#: Bands hold the ECDFs of right ranks at all of these at once, 99 of 100 times.
GRID = np.arange(1, 40) / 40
SIMULATED = 2000
DIFFICULTIES = ("size, px", "share hidden", "near-symmetry", "mask error")


class Draw(NamedTuple):
    """What the prior gives: a view, a start, and how hard it is."""

    scene: pj.Scene
    truth: pj.Camera
    start: pj.Camera
    free: tuple[str, ...]
    weight: np.ndarray
    size: float
    hidden: float


def log_uniform(random: Random, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def wide(tree: Any) -> Any:
    """Return cameras or scenes in float64."""
    number = lambda x: np.asarray(x, float) if x.dtype.kind == "f" else x
    return jax.tree.map(number, tree)


def shapes() -> dict[str, Callable[[Random], pj.Scene]]:
    """Return makers of scenes of radius about 1 by name; ten that no constant was tuned on."""
    unit = lambda make, random: scene_of(np.asarray((mesh := make(random)[0]).vertices), mesh.faces)
    found = {name: partial(unit, make) for name, make in DRAWN.items()}
    found |= {name: partial(_shapes.scene, name) for name in _shapes.NAMES}
    return found | {name: lambda _, scene=scene: scene for name, scene in meshes(*REAL)}


def drawn_view(random: Random, make: Callable[[Random], pj.Scene]) -> Draw:
    """Return a draw from the prior, before any mask."""
    scene, size, phi = make(random), log_uniform(random, 40, 220), random.uniform(0.35, 0.9)
    distance = PX / np.tan(phi / 2) / size
    truth = camera_at(anywhere(random), random.uniform(-0.1, 0.1, 2), distance, phi, PX)
    turn = turn_by(3 * random.normal(), random.normal(size=3))
    start = orbited(truth, turn, np.exp(0.03 * random.normal()))
    free = ("pose",)
    if random.random() < 0.5:
        free, start = ("pose", "phi"), start.replace(phi=phi * np.exp(0.03 * random.normal()))
    share = max(random.uniform(-0.4 / 3, 0.4), 0.0)
    covered = np.zeros((PX, PX), bool)
    if share:
        kind = random.choice(["plane", "board", "ball"])
        covered = hidden(mask_of(truth, scene), share, kind, random)
    return Draw(*map(wide, (scene, truth, start)), free, ~covered * 1.0, size, share)


# Masks, and by how much each is off


def exact(draw: Draw, random: Random) -> tuple[np.ndarray, dict]:
    noise = log_uniform(random, 0.003, 0.05)
    mask = mask_of(draw.truth, draw.scene)
    return mask + noise * random.normal(size=mask.shape), {"mask error": noise}


def one_bit(draw: Draw, random: Random) -> tuple[np.ndarray, dict]:
    return mask_of(draw.truth, draw.scene) > 0.5, {"mask error": 0.0}


def drawn(draw: Draw, random: Random) -> tuple[np.ndarray, dict]:
    """Return a mask whose outline is off along its normals, from samples finer than pixels."""
    inside = mask_of(resized(draw.truth, FINER * PX, FINER * PX), draw.scene) > 0.5
    size, length = log_uniform(random, 0.2, 2), log_uniform(random, 6, 60)
    law, of_one_bit, biased = (bool(random.random() < share) for share in (0.5, 0.5, 0.2))
    field = (rough if law else smooth)(random.normal(size=inside.shape), FINER * length)
    bias = random.normal() * (np.hypot(2 * size, 2.5) if biased else np.hypot(size, 0.5))
    outwards = size * field / field.std() + bias
    off = displaced(inside, outwards)
    samples = off > 0 if of_one_bit else expit(off / random.uniform(0.3, 1))
    share = samples.reshape(PX, FINER, PX, FINER).mean(axis=(1, 3))
    mask = share > 0.5 if of_one_bit else np.round(255 * share).astype(np.uint8)
    edge = inside & (distance_transform_edt(inside) < 2)
    facts = {"wavers by": size, "over": length, "bias": float(bias), "as the fit assumes": law}
    facts["one bit"] = of_one_bit
    return mask, {"mask error": float(np.sqrt(np.mean(outwards[edge] ** 2))), **facts}


def rough(white: np.ndarray, length: float) -> np.ndarray:
    """Return a field whose covariance is exp(-distance / length), up to a factor."""
    across, down = np.meshgrid(*(np.fft.fftfreq(n) for n in white.shape), indexing="ij")
    power = (1 + (2 * np.pi * length) ** 2 * (across**2 + down**2)) ** -1.5
    return np.fft.ifft2(np.fft.fft2(white) * np.sqrt(power)).real


def smooth(white: np.ndarray, length: float) -> np.ndarray:
    """Return a field whose covariance is exp(-(distance / length)^2), up to a factor."""
    return gaussian_filter(white, length / 2, mode="wrap")


def displaced(inside: np.ndarray, outwards: np.ndarray) -> np.ndarray:
    """Return the distance (px) of samples inside an edge that is moved outwards by what its nearest
    point says."""
    (far, there), (near, here) = (
        distance_transform_edt(x, return_indices=True) for x in (inside, ~inside)
    )
    signed = np.where(inside, far - 0.5, 0.5 - near) / FINER
    return signed + outwards[tuple(np.where(inside, there, here))]


KINDS = {"exact": exact, "one-bit": one_bit, "drawn": drawn}


# What is measured of a camera

NUMBERS = {"phi": lambda camera: camera.phi, "k1": lambda camera: camera.lens.distortion.k1}
USED = ("distance", "px at the corner", "farthest point")
Values = Callable[[pj.Camera], np.ndarray]


def used(scene: pj.Scene, truth: pj.Camera, random: Random) -> Values:
    """Return a function from a camera to the `USED` values: the distance's logarithm, then px and
    place along a random direction."""
    points = scene.spheres.centers if scene.mesh is None else scene.mesh.vertices
    farthest = max(np.asarray(points), key=np.linalg.norm)
    b1, b2, v = axes_of(truth)
    distance = np.linalg.norm(truth.e)
    corner = np.asarray(truth.e) + distance * (v + np.tan(truth.phi / 2) * (b1 + b2))
    on_film, in_space = (x / np.linalg.norm(x) for x in (random.normal(size=n) for n in (2, 3)))

    def values(camera: pj.Camera) -> np.ndarray:
        place = axes_of(camera) @ (farthest - np.asarray(camera.e))
        seen = np.asarray(pj.project(camera, corner))
        return np.array([np.log(np.linalg.norm(camera.e)), seen @ on_film, place @ in_space])

    return values


def as_seen(about: pj.Camera, number: int) -> Values:
    """Return a function that gives a camera's six or seven coordinates about another in which a
    view is nearly linear: rotation, the object's place on the film and size, the focal length. (Of
    the reported ones, products of two small errors pass the sigma of the best-seen one.)"""

    def values(camera: pj.Camera) -> np.ndarray:
        spread = np.log(np.tan(float(camera.phi) / 2))
        place, size = pj.project(camera, np.zeros(3)), np.log(np.linalg.norm(camera.e)) + spread
        return np.array([*error(about, camera)[:3], *np.asarray(place), size, spread])[:number]

    return values


def carried(fit: pj.Fit, values: Values) -> np.ndarray:
    """Return the covariance of values by the fit's, to first order."""
    steps = 1e-3 * np.diag(fit.std)
    slopes = [(values(fit.displaced(x)) - values(fit.displaced(-x))) / 2e-3 for x in steps]
    slope = np.stack(slopes, axis=1) / fit.std
    return slope @ fit.covariance @ slope.T


def off_by(fit: pj.Fit, truth: pj.Camera) -> np.ndarray:
    """Return by how much the truth is off a fit, in the order of its names."""
    beside = [float(NUMBERS[x](truth) - NUMBERS[x](fit.camera)) for x in fit.names[6:]]
    return np.array([*error(fit.camera, truth), *beside])


def ranks(fit: pj.Fit, truth: pj.Camera, values: Values) -> dict[str, Any]:
    """Return the truth's distance in sigmas, by quantity and as it is seen, and Mahalanobis's
    square."""
    off = np.append(off_by(fit, truth), values(truth) - values(fit.camera))
    sigmas = off / np.append(fit.std, np.sqrt(np.diag(carried(fit, values))))
    seen = as_seen(fit.camera, len(fit.names))
    away, covariance = seen(truth) - seen(fit.camera), carried(fit, seen)
    return {
        "sigmas": dict(zip((*fit.names, *USED), sigmas.tolist(), strict=True)),
        "as seen": (away / np.sqrt(np.diag(covariance))).tolist(),
        "squared": float(away @ np.linalg.solve(covariance, away)),
    }


def near_symmetry(fit: pj.Fit) -> float:
    """Return the ratio of the standard errors of the worst-seen turn and the best-seen one."""
    values = np.linalg.eigvalsh(fit.independent_covariance[:3, :3])
    return float(np.sqrt(values[-1] / values[0]))


def trial(number: int, kind: str, makers: dict[str, Callable]) -> dict:
    random = np.random.default_rng([number, 69, *map(ord, kind)])
    shape = random.choice([*makers])
    draw = drawn_view(random, makers[shape])
    mask, facts = KINDS[kind](draw, random)
    fit = pj.fit_camera(draw.scene, mask, draw.start, draw.free, weight=draw.weight)
    row = {"shape": str(shape), "status": fit.status, "share hidden": draw.hidden}
    row |= {"size, px": draw.size, "phi is free": "phi" in draw.free, **facts}
    if fit.status != "converged" or not np.all(np.isfinite(fit.std)):
        return row  # (Only `converged` fits count: `calibrated`.)
    row |= {"near-symmetry": near_symmetry(fit), "read": fit.mask_error and [*fit.mask_error]}
    return {**row, **ranks(fit, draw.truth, used(draw.scene, draw.truth, random))}


# Answers


def least_tail(uniform: np.ndarray) -> float:
    """Return the smallest two-sided probability of an ECDF's values at the grid."""
    counts = np.searchsorted(np.sort(uniform), GRID)
    tails = binom.cdf(counts, len(uniform), GRID), binom.sf(counts - 1, len(uniform), GRID)
    return float(2 * np.min(tails))


def chance(count: int) -> float:
    """Return the tail below which one of 100 ECDFs of uniform numbers falls somewhere (Säilynoja,
    Bürkner and Vehtari 2022, by simulation)."""
    random = np.random.default_rng(0)
    tails = [least_tail(random.random(count)) for _ in range(SIMULATED)]
    return float(np.quantile(tails, 0.01))


def by_quantity(rows: list[dict]) -> dict[str, dict]:
    """Return the spread of each quantity's ranks, and of Mahalanobis's square."""
    uniform = {name: [] for row in rows for name in row["sigmas"]} | {"Mahalanobis": []}
    for row in rows:
        for name, sigmas in row["sigmas"].items():
            uniform[name].append(norm.cdf(sigmas))
        uniform["Mahalanobis"].append(chi2.cdf(row["squared"], len(row["sigmas"]) - len(USED)))
    least = {count: chance(count) for count in {*map(len, uniform.values())}}
    table = {}
    for name, values in uniform.items():
        x, count = np.array(values), len(values)
        beyond = 2 * np.abs(x - 0.5) if name != "Mahalanobis" else x
        table[name] = {
            "fits": count,
            "within": bool(least_tail(x) >= least[count]),
            "95 % hold": float(np.mean(beyond < 0.95)),
            "50 % hold": float(np.mean(beyond < 0.5)),
            "ECDF - x": (np.searchsorted(np.sort(x), GRID) / count - GRID).tolist(),
            "band": [
                (end(least[count] / 2, count, GRID) / count - GRID).tolist()
                for end in (binom.ppf, binom.isf)
            ],
        }
    return table


def by_difficulty(rows: list[dict]) -> dict[str, list[float]]:
    """Return the share of 95 % intervals that hold in quarters of the fits, easy or not."""
    table = {}
    for name in DIFFICULTIES:
        order = np.argsort([row[name] for row in rows], kind="stable")
        quarters = [[rows[k] for k in part] for part in np.array_split(order, 4)]
        held = [[abs(x) < NORMAL_95 for r in q for x in r["sigmas"].values()] for q in quarters]
        if len({row[name] for row in rows}) > 1 and all(held):
            table[name] = [float(np.mean(x)) for x in held]
    return table


def calibrated(rows: list[dict]) -> dict[str, Any]:
    """Return the spread of the ranks of `converged` fits, and the number of the others."""
    sure = [r for r in rows if r["status"] == "converged" and "sigmas" in r]
    quantities, quarters = by_quantity(sure), by_difficulty(sure)
    show({"": name, **{k: row[k] for k in [*row][:4]}} for name, row in quantities.items())
    quarter = lambda x: {str(k): part for k, part in enumerate(x, 1)}
    show({"": name, **quarter(x)} for name, x in quarters.items())
    return {
        "fits": len(rows),
        "statuses": dict(Counter(row["status"] for row in rows)),
        "within": sum(row["within"] for row in quantities.values()),
        "worst quarter": min(map(min, quarters.values()), default=float("nan")),
        "quantities": quantities,
        "quarters": quarters,
    }


def ranked(asked: Options) -> dict:
    makers, table = shapes(), {}
    for kind in asked.names(KINDS):
        one = partial(trial, makers=makers)
        rows = trials(asked, f"calibration-{kind}", asked.number(1000, 8), [(kind,)], one)
        table[kind] = calibrated(rows)
    words = [
        f"{kind}: {x['within']} of {len(x['quantities'])} quantities within 99 % bands, worst"
        f" quarter {x['worst quarter']:.0%}, {x['statuses'].get('converged', 0)} of {x['fits']}"
        " fits `converged`, the others left out"
        for kind, x in table.items()
    ]
    asked_for = "(asked 95 % of the quantities, 88 % in the worst quarter)"
    return {"verdict": f"{'; '.join(words)} {asked_for}", "table": table}


PARAMETERS = ("rotation_b1", "rotation_b2", "rotation_v", "e_x", "e_y", "e_z", "phi")
#: Each quantity's line in the picture.
COLOURS = {
    **{name: f"C{k}-" for k, name in enumerate(PARAMETERS)},
    **{name: f"C{k}--" for k, name in enumerate(USED)},
    "Mahalanobis": "k-",
}


def draw_ranks(found: dict, path: Path) -> None:
    panels, quarters = [], {}
    for (kind, row), dash in zip(found["table"].items(), ("-", "--", ":"), strict=False):
        known, lines = row["quantities"], {}
        for name, colour in COLOURS.items():
            if name in known:
                lines[name] = (GRID, known[name]["ECDF - x"], colour)
        for end, y in zip(("99 % band", "_"), known["Mahalanobis"]["band"], strict=True):
            lines[end] = (GRID, y, "k:")
        panels.append((f"{kind}: ECDF of ranks - uniform", "rank", "plot", lines))
        for k, name in enumerate(DIFFICULTIES):
            if name in row["quarters"]:
                quarter = row["quarters"][name]
                quarters[f"{kind}: {name}"] = (["1", "2", "3", "4"], quarter, f"C{k}o{dash}")
    words = "quarter of fits, from least to most of it"
    curves(path, *panels, ("95 % intervals that hold", words, "plot", quarters))


# Covariance as a matrix: refits under the noise that it assumes

SMALL, NOISE, NOISE_PX, REFITS = 96, 0.02, 0.3, 200
Refit = Callable[[Random], Any]


def noisy(mask: np.ndarray, random: Random) -> np.ndarray:
    return mask + NOISE * random.normal(size=mask.shape)


def small_camera(turn: float = 0.0, lens: pj.Lens | None = None) -> pj.Camera:
    """Return a camera before the unit sphere, turned about it (degrees)."""
    axes = turn_by(35, np.array([1, 2, 0.5])) @ turn_by(turn, np.array([0.2, 1, 0.1]))
    near = wide(camera_at(axes, np.array([0.05, -0.03]), 4.5, 0.6, SMALL))
    return pj.Camera(near.e, near.p, near.u, near.phi, 1.0, SMALL, SMALL, lens)


def ring(lens: pj.Lens | None = None) -> dict[str, pj.Camera]:
    return {str(k): small_camera(55.0 * k, lens) for k in range(3)}


def solid() -> pj.Scene:
    return pj.Scene(mesh=pj.shapes.bumpy(2))


def refits_of_one_view() -> tuple[pj.Camera, Refit]:
    scene, truth = solid(), small_camera()
    mask = mask_of(truth, scene)
    return truth, lambda random: pj.fit_camera(scene, noisy(mask, random), truth, ("pose", "phi"))


def refits_of_many(scenes: list[pj.Scene], cameras: dict[str, pj.Camera], **how: Any) -> Refit:
    """Return a function that fits noisy masks of scenes, each seen by the next camera, in one
    problem, and gives the first camera's fit."""
    names = [[*cameras][k % len(cameras)] for k in range(len(scenes))]
    pairs = [*zip(names, scenes, strict=True)]
    masks = [mask_of(cameras[name], scene) for name, scene in pairs]

    def refit(random: Random) -> pj.Fit:
        views = [
            pj.JointView(scene, noisy(mask, random), camera=name)
            for (name, scene), mask in zip(pairs, masks, strict=True)
        ]
        return pj.fit_joint(views, cameras, **how).cameras[names[0]]

    return refit


def refits_of_three_cameras() -> tuple[pj.Camera, Refit]:
    cameras = ring()
    return cameras["0"], refits_of_many([solid()] * 3, cameras, shared="phi")


def refits_of_a_robot() -> tuple[pj.Camera, Refit]:
    """Two links in four postures before one camera."""
    parts = [pj.shapes.bumpy(2), pj.shapes.revolved(np.array([(0, -1), (0.4, 0), (0, 1)]), 24)]
    arm, truth, scenes = pj.Assembly(parts), small_camera().replace(e=[0.4, -0.9, 6.0]), []
    for k in range(4):
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = turn_by(50 * k, np.ones(3)), [0.4 * k - 0.6, 0.2, 0.9]
        scenes.append(arm.scene_at([np.eye(4), place]))
    return truth, refits_of_many(scenes, {"camera": truth})


def refits_of_a_lens() -> tuple[pj.Camera, Refit]:
    cameras = ring(pj.Lens([SMALL / 2, SMALL / 2], 1.0, pj.BrownConrady(-0.1)))
    return cameras["0"], refits_of_many([solid()] * 3, cameras, shared="phi,k1")


def refits_of_points() -> tuple[pj.Camera, Refit]:
    truth = small_camera(0.0, pj.Lens([SMALL / 2, SMALL / 2], 1.0, pj.BrownConrady(-0.1)))
    points = np.random.default_rng(0).uniform(-1, 1, (60, 3))
    seen, free = np.asarray(pj.project(truth, points)), ("pose", "phi", "k1")
    return truth, lambda random: pj.fit_points(
        points, seen + NOISE_PX * random.normal(size=seen.shape), truth, free
    )


SETUPS = {
    "one view": refits_of_one_view,
    "three cameras": refits_of_three_cameras,
    "robot": refits_of_a_robot,
    "lens": refits_of_a_lens,
    "points": refits_of_points,
}


def compared(sampled: np.ndarray, predicted: np.ndarray) -> tuple[float, float, float]:
    """Return the least and the most of the eigenvalues' ratios, in order of size, and the angle
    (degrees) between the worst directions."""
    (of_sampled, where), (of_predicted, there) = map(np.linalg.eigh, (sampled, predicted))
    ratio, cosine = of_sampled / of_predicted, abs(where[:, -1] @ there[:, -1])
    return float(ratio.min()), float(ratio.max()), float(np.rad2deg(np.arccos(min(cosine, 1.0))))


def by_luck(predicted: np.ndarray, count: int) -> tuple[float, float, float]:
    """Return the limits that hold 99 of 100 samples of a right covariance."""
    random, n = np.random.default_rng(0), len(predicted)
    draws = random.normal(size=(SIMULATED, count, n)) @ np.linalg.cholesky(predicted).T
    found = np.array([compared(x.T @ x / count, predicted) for x in draws])
    least, most, angle = found.T
    return tuple(float(np.quantile(x, q)) for x, q in ((least, 0.01), (most, 0.99), (angle, 0.99)))


def refit_trial(number: int, name: str, setup: tuple[pj.Camera, Refit]) -> dict:
    truth, refit = setup
    fit = refit(np.random.default_rng([number, 17, *map(ord, name)]))
    # (That of several views is widened by what few views say of how they differ.)
    alone = getattr(fit, "independent_covariance", None)
    covariance = fit.covariance if alone is None else alone
    row = {"status": fit.status, "off": off_by(fit, truth).tolist()}
    return {**row, "covariance": covariance.tolist(), "std": fit.std.tolist()}


def matrix(asked: Options) -> dict:
    table = {}
    for name in asked.names(SETUPS):
        one = partial(refit_trial, setup=SETUPS[name]())
        part = f"calibration-matrix-{name.replace(' ', '-')}"
        rows = trials(asked, part, asked.number(REFITS, 30), [(name,)], one)
        off, covariance, std = (
            np.array([r[k] for r in rows]) for k in ("off", "covariance", "std")
        )
        sampled, predicted = off.T @ off / len(off), covariance.mean(axis=0)
        found, luck = compared(sampled, predicted), by_luck(predicted, len(off))
        table[name] = {
            "unknowns": off.shape[1],
            "refits": len(off),
            "converged": sum(r["status"] == "converged" for r in rows),
            "least eigenvalue": found[0],
            "most": found[1],
            "worst direction, degrees": found[2],
            "by chance": luck,
            "std / sampled": float(np.mean(std.mean(axis=0) / np.sqrt(np.diag(sampled)))),
        }
    show({"": name, **row} for name, row in table.items())
    least, most, turned = (
        [row[k] for row in table.values()]
        for k in ("least eigenvalue", "most", "worst direction, degrees")
    )
    words = f"eigenvalues of sampled over predicted covariance {min(least):.2f} to {max(most):.2f}"
    asked_for = "(asked 0.8 to 1.2, 18 degrees)"
    angle = f"worst directions up to {max(turned):.0f} degrees apart {asked_for}"
    return {"verdict": f"{len(table)} problems: {words}; {angle}", "table": table}


if __name__ == "__main__":
    main(__doc__, {"ranks": (ranked, draw_ranks), "matrix": matrix})
