"""How long does a user wait for a first call, and for that of another checkout?

    python experiments/first_calls.py OUT [FOLDER [CALL ...]]

Each first call in a process of its own with nothing kept; of this checkout and the one in FOLDER in
turn, since machines differ and are busy: seconds by the clock, and their ratio. Imports are not
counted, nor is what is given, but a mesh is a call of its own. Calls that are not named keep what
OUT tells of them.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

import pinhole_jax as pj

HERE = Path(__file__).resolve().parents[1]
TURNS = 3
#: What names a call in a process of its own, and a mask's file.
ONE, MASK = "PINHOLE_JAX_FIRST_CALL", "PINHOLE_JAX_FIRST_MASK"


# (Public names alone, which older versions have, too.)
def _camera(**more) -> pj.Camera:
    given = {"e": [0.3, 0.25, 5.0], "p": [0.1, 0.05, 0.0], "u": [0, 1, 0], "phi": 0.6}
    return pj.Camera(**given, W=256, H=256, **more)


def _loss(camera, scene):
    return jnp.sum(pj.silhouette(camera, scene) ** 2)


def mesh():
    jax.devices()  # (what JAX takes to begin with is not counted)
    sphere = trimesh.creation.icosphere(4)
    return pj.Mesh, (np.asarray(sphere.vertices), np.asarray(sphere.faces))


def mask():
    return pj.silhouette, (_camera(), pj.Scene(mesh=pj.shapes.bumpy(4)))


def mask_within_a_program():
    return jax.jit(pj.silhouette), (_camera(), pj.Scene(mesh=pj.shapes.bumpy(4)))


def gradient_of_camera():
    return jax.jit(jax.grad(_loss)), (_camera(), pj.Scene(mesh=pj.shapes.bumpy(4)))


def gradient_of_camera_and_vertices():
    mesh = pj.shapes.bumpy(4)
    loss = lambda c, v, f: _loss(c, pj.Scene(mesh=pj.Mesh(v, f)))
    faces = np.asarray(mesh.faces)
    return jax.jit(jax.grad(lambda c, v: loss(c, v, faces), (0, 1))), (_camera(), mesh.vertices)


def gradient_with_spheres_and_distortion():
    lens = pj.Lens([128.0, 128.0], 1.0, pj.BrownConrady(0.1))
    spheres = pj.Spheres(np.array([[0.9, 0, 0], [0, 1.0, 0.2]], np.float32), np.float32([0.3, 0.2]))
    scene = pj.Scene(mesh=pj.shapes.bumpy(4), spheres=spheres)
    return jax.jit(jax.grad(_loss)), (_camera(lens=lens), scene)


def fit_camera():
    start = pj.Camera([0.5, 0.1, 5.2], [0.1, 0, 0], [0, 1, 0], 0.6, W=256, H=256)
    return pj.fit_camera, (pj.Scene(mesh=pj.shapes.bumpy(4)), np.load(os.environ[MASK]), start)


CALLS: dict[str, Callable] = {
    f.__name__: f
    for f in (
        mesh,
        mask,
        mask_within_a_program,
        gradient_of_camera,
        gradient_of_camera_and_vertices,
        gradient_with_spheres_and_distortion,
        fit_camera,
    )
}


def one(name: str) -> float:
    """Return the seconds of a first call in this process."""
    function, arguments = CALLS[name]()
    begin = time.perf_counter()
    answer = function(*arguments)
    jax.block_until_ready([x for x in jax.tree.leaves(answer) if isinstance(x, jax.Array)])
    return time.perf_counter() - begin


def waited(name: str, checkout: Path, drawn: Path) -> float:
    """Return the seconds of a first call of a checkout, in a process of its own."""
    given = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    given |= {ONE: name, MASK: str(drawn), "PYTHONPATH": str(checkout)}
    words = [sys.executable, __file__]
    out = subprocess.run(words, env=given, capture_output=True, text=True, check=True)
    return float(out.stdout.split()[-1])


def main() -> None:
    folder, *others = map(Path, sys.argv[1:3])
    folder.mkdir(parents=True, exist_ok=True)
    drawn, kept = folder / "first_mask.npy", folder / "first_calls.json"
    named = sys.argv[3:] or [*CALLS]
    table = json.loads(kept.read_text()) if kept.exists() and sys.argv[3:] else {}
    np.save(drawn, pj.silhouette(_camera(), pj.Scene(mesh=pj.shapes.bumpy(4))))
    for name in named:
        seconds: list[list[float]] = [[], []]
        for _ in range(TURNS):
            for own, checkout in zip(seconds, (HERE, *others), strict=False):
                own.append(round(waited(name, checkout.resolve(), drawn.resolve()), 2))
        here, there = seconds
        table[name] = {"here": here, "there": there}
        said = f"{name.replace('_', ' ')}: {np.median(here):.1f} s"
        if others:
            ratio = table[name]["ratio"] = round(float(np.median(here) / np.median(there)), 2)
            said += f", {np.median(there):.1f} in {others[0].name}: {ratio:.2f} times"
        print(said, flush=True)
    drawn.unlink()
    kept.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    print(one(os.environ[ONE])) if ONE in os.environ else main()
