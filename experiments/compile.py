"""What does a first call wait for? Kernels, loops and seconds of each program that is compiled.

    python experiments/compile.py OUT

Each program in a process of its own with nothing kept: tracing, lowering, compiling, one run. Equal
kernels are compiled once, but for loops that are one kernel, which are compiled wherever they stand
(`distinct`): what a program takes follows these. (The command with an empty and a filled cache is
in `hotspots.py`.)
"""

import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import camera_at, one_by_one, one_step
from _kernels import kernels

import pinhole_jax as pj
from pinhole_jax._solver.levenberg_marquardt import descended
from pinhole_jax._solver.solver import Solver

RUNS = 30


def _camera(size: int = 256) -> pj.Camera:
    return camera_at(np.eye(3), np.array([0.1, 0.05]), 5.0, 0.6, size)


def _scene() -> pj.Scene:
    return pj.Scene(mesh=pj.shapes.bumpy(4))


def _loss(camera, scene):
    return jnp.sum(pj.silhouette(camera, scene) ** 2)


def mask():
    return jax.jit(pj.silhouette), (_camera(), _scene())


def mask_without_overlaps():
    return jax.jit(lambda c, s: pj.silhouette(c, s, overlaps=False)), (_camera(), _scene())


def depth():
    return jax.jit(pj.depth), (_camera(), _scene())


def gradient_of_camera():
    return jax.jit(jax.grad(_loss)), (_camera(), _scene())


def gradient_of_camera_and_vertices():
    def loss(camera, vertices, scene):
        return _loss(camera, eqx.tree_at(lambda s: s.mesh.vertices, scene, vertices))

    scene = _scene()
    return jax.jit(jax.grad(loss, (0, 1))), (_camera(), scene.mesh.vertices, scene)


def gradient_with_spheres_and_distortion():
    lens = pj.Lens([128.0, 128.0], 1.0, pj.BrownConrady(0.1, 0.0, 0.0, 0.0, 0.0))
    c = _camera()
    camera = pj.Camera(c.e, c.p, c.u, c.phi, c.d, c.W, c.H, lens)
    spheres = pj.Spheres(np.array([[0.9, 0, 0], [0, 1.0, 0.2]], np.float32), np.float32([0.3, 0.2]))
    return jax.jit(jax.grad(_loss)), (camera, pj.Scene(mesh=_scene().mesh, spheres=spheres))


def fit():
    """The one program that looks and steps, with the arguments that a fit gives it."""
    truth, scene = _camera(), _scene()
    mask = np.isfinite(np.asarray(pj.trace(scene, pj.camera_rays(truth)).t))
    weights = np.broadcast_to(1.0, mask.shape)
    return descended, one_step(
        Solver.of(scene, mask, weights, np.float32, ("pose", "phi"), 64), truth
    )


PROGRAMS: dict[str, Callable] = {
    f.__name__: f
    for f in (
        mask,
        mask_without_overlaps,
        depth,
        gradient_of_camera,
        gradient_of_camera_and_vertices,
        gradient_with_spheres_and_distortion,
        fit,
    )
}


def program(name: str) -> dict:
    """Return the counts and times of a program, compiled in this process."""
    function, arguments = PROGRAMS[name]()
    clock = [time.perf_counter()]
    lowered = function.lower(*arguments)
    clock.append(time.perf_counter())
    compiled = lowered.compile()
    clock.append(time.perf_counter())
    inner = getattr(compiled, "compiled", compiled)
    run = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        run.append(time.perf_counter() - begin)
    seconds = dict(zip(("trace and lower", "compile"), np.diff(clock).round(2), strict=True))
    return {**kernels(inner.as_text())._asdict(), **seconds, "run ms": 1e3 * float(np.median(run))}


if __name__ == "__main__":
    one_by_one(PROGRAMS, program)
