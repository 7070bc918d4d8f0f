"""What several experiments share: meshes, random cameras, starts that are off."""

import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path

import jax
import numpy as np

import pinhole_jax as pj
from pinhole_jax._solver.moves import canonical
from pinhole_jax._solver.solver import Solver

SHARED = Path(__file__).parents[2] / "shared" / "data" / "meshes"


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
        vertices = np.asarray(mesh.vertices)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        scaled = (vertices - (low + high) / 2) / (np.linalg.norm(high - low) / 2)
        yield name.split(".")[0], pj.Scene(mesh=pj.Mesh(scaled.astype(np.float32), mesh.faces))


def camera_at(
    axes: np.ndarray, aside: np.ndarray, distance: float, phi: float, size: int = 256
) -> pj.Camera:
    """Return a float32 camera with axes (rows right, up, forward), beside the origin's line."""
    e = -distance * axes[2] + aside @ axes[:2]
    e, p, u = (x.astype(np.float32) for x in (e, e + distance * axes[2], axes[1]))
    return pj.Camera(e, p, u, np.float32(phi), 1.0, size, size)


def random_camera(random: np.random.Generator, phi: float = 0.6, size: int = 256) -> pj.Camera:
    """Return a camera turned at random, the unit sphere across 40 to 90 % of the film."""
    from scipy.spatial.transform import Rotation

    axes = Rotation.random(random_state=random).as_matrix()
    distance = random.uniform(1.1, 2.4) / np.sin(phi / 2)
    return camera_at(axes, random.uniform(-0.1, 0.1, 2), distance, phi, size)


def orbited(truth: pj.Camera, turn: np.ndarray, far: float) -> pj.Camera:
    """Return the camera turned about the origin by a rotation (3, 3), `far` times as far away."""
    axes = np.stack([np.asarray(a, float) for a in pj.camera_basis(truth)]) @ turn.T
    e = far * (turn @ np.asarray(truth.e, float))
    return camera_at(axes, axes[:2] @ e, -e @ axes[2], float(truth.phi), truth.W)


def one_step(solver: Solver, camera: pj.Camera) -> tuple:
    """Return the arguments with which `descended` takes one step on the finest level."""
    level, ends = solver.levels[solver.finest], (np.float32(1e-3), np.int32(1))
    return canonical(camera), solver.problem, level, *ends, solver.freed, solver.capacity


def degrees(camera: pj.Camera, truth: pj.Camera) -> float:
    """Return the angle between two cameras."""
    return float(np.rad2deg(pj.pose_error(camera, truth)[0]))


def run(question: Callable[[], dict], draw: Callable[[dict, Path], None] | None = None) -> None:
    """Answer a question in float64 mode; write the answer's JSON, and its picture, to a folder."""
    jax.config.update("jax_enable_x64", True)
    name = Path(sys.argv[0]).stem
    answer = question()
    answer["versions"] = {"jax": jax.__version__, "python": platform.python_version()}
    (folder() / f"{name}.json").write_text(json.dumps(answer, indent=1) + "\n")
    if draw is None:
        return
    try:
        import matplotlib
    except ImportError:
        print("no plot: matplotlib is not installed")
    else:
        matplotlib.use("Agg")
        draw(answer, folder() / f"{name}.png")


def one_by_one(names: Iterable[str], answer: Callable[[str], dict]) -> None:
    """Answer for each name in a process of its own, with nothing kept; write the table's JSON."""
    if len(sys.argv) > 2:
        print(json.dumps(answer(sys.argv[2])))
        return
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    table: dict[str, dict] = {}
    for name in names:
        words = [sys.executable, sys.argv[0], str(folder()), name]
        out = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
        table[name] = json.loads(out.stdout)
        print(name.replace("_", " "), table[name], flush=True)
    table["versions"] = {"jax": jax.__version__}
    (folder() / f"{Path(sys.argv[0]).stem}.json").write_text(json.dumps(table, indent=1) + "\n")


def folder() -> Path:
    """Return the folder that the command line names, for results."""
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    path.mkdir(parents=True, exist_ok=True)
    return path


def trials(default: int) -> int:
    """Return how many trials the command line asks for."""
    return int(sys.argv[2]) if len(sys.argv) > 2 else default


def first() -> int:
    """Return the number of the first trial, from which its seed is made: after that of trials."""
    return int(sys.argv[3]) if len(sys.argv) > 3 and sys.argv[3].isdigit() else 0


def rows_of(
    shapes: Iterable[str],
    kinds: Collection[str],
    trial: Callable[[int, str, str], dict],
    line: Callable[[dict], str],
) -> list[dict]:
    """Return the rows of 1000 trials, or as many as the command line asks for, from the seed on
    that it names after that; `-v` prints each."""
    cases = [(shape, kind) for shape in shapes for kind in kinds]
    total, rows = trials(1000), []
    for number in range(total):
        # All kinds of a shape follow one another: they share compiled programs.
        rows.append(trial(first() + number, *cases[(number * len(cases)) // total]))
        if "-v" in sys.argv:
            print(line(rows[-1]), flush=True)
    return rows


def percentiles(values: Iterable[float]) -> dict[str, float]:
    """Return median, mean and largest."""
    array = np.array([*values])
    kinds = {"median": np.median, "mean": np.mean, "max": np.max}
    return {name: float(kind(array)) for name, kind in kinds.items()}


def noisy(vertices: np.ndarray, faces: np.ndarray, noise: float) -> np.ndarray:
    """Return vertices (V, 3) that are off by so many mean edges (one standard deviation)."""
    edge = np.mean(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1))
    return vertices + np.random.default_rng(0).normal(0, noise * edge, vertices.shape)
