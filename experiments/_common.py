"""What the experiments share: the command line, trials that go on where they stopped, tables and
curves, meshes, cameras, starts that are off.

    python experiments/... PART [OUT] [--trials N] [--seed N] [--quick] [--only A,B]

A part answers one question: it prints its verdict, and writes `OUT/SCRIPT_PART.json` and, where it
has a picture, `OUT/SCRIPT_PART.png`.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import pinhole_jax as pj

DATA = Path(__file__).parents[2] / "shared" / "data"
SHARED = DATA / "meshes"
NORMAL_95 = 1.96


class Options(NamedTuple):
    """What the command line asks for.

    - `trials`: how many, None for the part's own number. `seed`: the first trial's.
    - `quick`: the smallest size that still says something. `only`: names, all if there are none.
    - `resume`: trials that `out` holds are not done again. `flags`: a script's own that are given.
    """

    out: Path
    trials: int | None = None
    seed: int = 0
    quick: bool = False
    only: tuple[str, ...] = ()
    resume: bool = False
    flags: tuple[str, ...] = ()

    def number(self, usual: int, quick: int = 1) -> int:
        return self.trials or (quick if self.quick else usual)

    def names(self, known: Iterable[str]) -> list[str]:
        return [name for name in known if not self.only or name in self.only]


Part = Callable[[Options], dict]
Picture = Callable[[dict, Path], None]


def main(
    about: str | None,
    parts: Mapping[str, Part | tuple[Part, Picture]],
    x64: bool = True,
    flags: tuple[str, ...] = (),
) -> None:
    """Answer a part's question; write the answer's JSON, and its picture, to a folder."""
    words = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=about, formatter_class=words)
    parser.add_argument("part", choices=parts)
    parser.add_argument("out", nargs="?", type=Path, default=Path("out"))
    parser.add_argument("--trials", type=int, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="of the first trial")
    parser.add_argument("--quick", action="store_true", help="the smallest size")
    parser.add_argument("--only", type=lambda x: tuple(x.split(",")), default=(), help="A,B")
    parser.add_argument("--resume", action="store_true", help="go on with what OUT holds")
    for flag in flags:
        parser.add_argument(
            f"--{flag}", dest="flags", action="append_const", const=flag, default=[]
        )
    given = vars(parser.parse_args())
    name = given.pop("part")
    answer, *draw = parts[name] if isinstance(parts[name], tuple) else (parts[name],)
    given["out"].mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", x64)
    pj.cache()
    found = answer(Options(**given))
    print(found["verdict"])
    path = given["out"] / f"{Path(sys.argv[0]).stem}_{name}"
    for picture in draw:
        picture(found, path.with_suffix(".png"))
    found["versions"] = {"jax": jax.__version__, "python": platform.python_version()}
    path.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n")


def trials(
    asked: Options, name: str, total: int, cases: Sequence[tuple], trial: Callable[..., dict]
) -> list[dict]:
    """Return the rows of `trial(number, *case)`, the cases one after the other in equal shares.

    Each row is a line of `OUT/NAME.jsonl` as soon as it is there: with `resume` it is read, not
    done again. All trials of a case follow one another: they share compiled programs.
    """
    path, kept = asked.out / f"{name}.jsonl", {}
    if asked.resume and path.exists():
        kept = {tuple(key): row for key, row in map(json.loads, path.read_text().splitlines())}
    else:
        path.unlink(missing_ok=True)
    rows = []
    for k in range(total):
        key = (asked.seed + k, *cases[k * len(cases) // total])
        if key not in kept:
            begin = time.perf_counter()
            kept[key] = trial(*key)
            kept[key]["seconds"] = time.perf_counter() - begin
            with path.open("a") as file:
                file.write(json.dumps([key, kept[key]]) + "\n")
            print(*key, json.dumps(kept[key]), flush=True)
        rows.append(kept[key])
    return rows


def apart(script: str, *words: str, **environment: str) -> dict:
    """Return the JSON that a script prints last, run in a process of its own."""
    given = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    given |= environment
    done = subprocess.run([sys.executable, script, *words], env=given, stdout=-1, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def show(rows: Iterable[dict]) -> None:
    """Print rows as a table."""
    short = lambda x: f"{x:.3g}" if isinstance(x, float) else str(x)
    table = [{k: short(v) for k, v in row.items()} for row in rows]
    keys = dict.fromkeys(k for row in table for k in row)
    wide = {k: max(len(k), *(len(row.get(k, "")) for row in table)) for k in keys}
    for row in [{k: k for k in keys}, *table]:
        print("  ".join(row.get(k, "").ljust(wide[k]) for k in keys))


def curves(path: Path, *panels: tuple[str, str, str, dict[str, tuple]]) -> None:
    """Draw panels: title, label of x, scale ("loglog", "semilogy", "plot"), curves by name: x, y
    and Matplotlib's format, if any. The legends stand below, where they hide no curve."""
    try:
        import matplotlib
    except ImportError:
        print("no picture: matplotlib is not installed")
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = 3
    size = (4.6 * len(panels), 3.6 + 0.17 * max(len(x[-1]) // columns for x in panels))
    figure, axes = plt.subplots(1, len(panels), figsize=size, squeeze=False, layout="constrained")
    for axis, (title, label, scale, lines) in zip(axes[0], panels, strict=True):
        for name, (x, y, *style) in lines.items():
            getattr(axis, scale)(x, y, *(style or ["o-"]), label=name, markersize=4)
        axis.set(title=title, xlabel=label)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=columns)
    figure.savefig(path, dpi=100)


def meshes(*names: str) -> Iterator[tuple[str, pj.Scene]]:
    """Yield the bumpy shape and the named files, each of radius 1 about the origin, float32."""
    for name in ("bumpy", *names):
        if name == "bumpy":
            mesh = pj.shapes.bumpy(4)
        elif (SHARED / name).exists():
            mesh = pj.load_mesh(SHARED / name)
        else:
            print(f"{name}: skipped, there is no {SHARED / name}")
            continue
        yield name.split(".")[0], scene_of(np.asarray(mesh.vertices), mesh.faces)


def scene_of(vertices: np.ndarray, faces: Any) -> pj.Scene:
    """Return a mesh of radius 1 about the origin, float32."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scaled = (vertices - (low + high) / 2) / (np.linalg.norm(high - low) / 2)
    return pj.Scene(mesh=pj.Mesh(scaled.astype(np.float32), faces))


def noisy(vertices: np.ndarray, faces: np.ndarray, noise: float) -> np.ndarray:
    """Return vertices (V, 3) that are off by a number of mean edges (one standard deviation)."""
    edge = np.mean(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1))
    return vertices + np.random.default_rng(0).normal(0, noise * edge, vertices.shape)


def camera_at(
    axes: np.ndarray, aside: np.ndarray, distance: float, phi: float, size: int = 256
) -> pj.Camera:
    """Return a float32 camera with axes (rows right, up, forward), beside the origin's line."""
    e = -distance * axes[2] + aside @ axes[:2]
    e, p, u = (x.astype(np.float32) for x in (e, e + distance * axes[2], axes[1]))
    return pj.Camera(e, p, u, np.float32(phi), 1.0, size, size)


def random_camera(random: np.random.Generator, phi: float = 0.6, size: int = 256) -> pj.Camera:
    """Return a camera turned at random, the unit sphere across 40 to 90 % of the film."""
    axes = Rotation.random(random_state=random).as_matrix()
    distance = random.uniform(1.1, 2.4) / np.sin(phi / 2)
    return camera_at(axes, random.uniform(-0.1, 0.1, 2), distance, phi, size)


def resized(camera: pj.Camera, W: int, H: int) -> pj.Camera:
    return pj.Camera(camera.e, camera.p, camera.u, camera.phi, 1.0, W, H)


def axes_of(camera: pj.Camera) -> np.ndarray:
    return np.stack([np.asarray(a, float) for a in pj.camera_basis(camera)])


def orbited(truth: pj.Camera, turn: np.ndarray, far: float) -> pj.Camera:
    """Return the camera turned about the origin by a rotation (3, 3), `far` times as far away."""
    axes = axes_of(truth) @ turn.T
    e = far * (turn @ np.asarray(truth.e, float))
    near = camera_at(axes, axes[:2] @ e, -e @ axes[2], float(truth.phi))
    return resized(near, truth.W, truth.H)


def turn_by(degrees: float, axis: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)).as_matrix()


def start_from(
    truth: pj.Camera, angle: float, share: float, random: np.random.Generator
) -> pj.Camera:
    """Return the camera turned about the origin (degrees), nearer or farther by a share."""
    axis = random.normal(size=3)
    return orbited(truth, turn_by(angle, axis), 1 + share * random.choice([-1, 1]))


def mask_of(camera: pj.Camera, scene: pj.Scene) -> np.ndarray:
    return np.asarray(pj.silhouette(camera, scene))


def degrees(camera: pj.Camera, truth: pj.Camera) -> float:
    """Return the angle between two cameras."""
    return float(np.rad2deg(pj.pose_error(camera, truth)[0]))


def percentiles(values: Iterable[float]) -> dict[str, float]:
    """Return median, mean and largest."""
    array = np.array([*values])
    kinds = {"median": np.median, "mean": np.mean, "max": np.max}
    return {name: float(kind(array)) for name, kind in kinds.items()}


def median_s(call: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the median seconds of a call that is compiled, of few if they take long."""
    return in_turn({"": call}, clock)[""]


def in_turn(
    jobs: dict[str, Callable[[], Any]], clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Return the median seconds of each job; all take turns, so a busy machine slows all.

    Of the processor's time the least is what a call takes: others' calls only add to it.
    """
    times: dict[str, list[float]] = {name: [] for name in jobs}
    begin = time.perf_counter()
    for turn in range(-1, 200):
        for name, job in jobs.items():
            start = clock()
            jax.block_until_ready(job())
            times[name] += [clock() - start] if turn >= 0 else []
        if turn > 3 and time.perf_counter() - begin > len(jobs):
            break
    typical = np.min if clock is time.process_time else np.median
    return {name: float(typical(x)) for name, x in times.items()}
