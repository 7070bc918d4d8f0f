"""What is lost in float32, function by function?

Bumpy shape of 5120 faces and a sphere, 64 x 64 pixels, random cameras. What is rounded to float32
is taken as exact: the same numbers in float64 are the answer, which errs 5e8 times less
(`stress.py` holds float64 against 60 digits). Mean, 99 % and worst over pixels, rays or points.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _common import random_camera, run, trials

import pinhole_jax as pj

SIZE = 64
WEIGHT = np.random.default_rng(0).normal(size=(SIZE, SIZE))


def as_double(tree):
    single = lambda x: eqx.is_array(x) and x.dtype == jnp.float32
    return jax.tree.map(lambda x: x.astype(jnp.float64) if single(x) else x, tree)


def scenes() -> tuple[pj.Scene, pj.Scene]:
    """Return the scene in float32, and of the same numbers in float64."""
    bumpy = pj.shapes.bumpy(4)
    vertices = np.asarray(bumpy.vertices, np.float32)
    center, radius = np.array([[0.7, 0.4, 0.6]], np.float32), np.array([0.3], np.float32)

    def scene(dtype):
        mesh = pj.Mesh(vertices.astype(dtype), bumpy.faces)
        return pj.Scene(mesh=mesh, spheres=pj.Spheres(center.astype(dtype), radius.astype(dtype)))

    return scene(np.float32), scene(np.float64)


@eqx.filter_jit
def slope(camera: pj.Camera, scene: pj.Scene):
    """Return the derivative of a weighted sum of the image, by the camera's parameters."""
    loss = lambda c: jnp.sum(jnp.asarray(WEIGHT, c.e.dtype) * pj.silhouette(c, scene))
    return eqx.filter_grad(loss)(camera)


def length(x: np.ndarray) -> np.ndarray:
    return np.linalg.norm(x, axis=-1).ravel()


def relative(x, y) -> np.ndarray:
    x, y = (np.asarray(z, float).ravel() for z in (x, y))
    return np.abs(x - y) / np.abs(y)


def differences(camera: pj.Camera, scene: pj.Scene, exact: pj.Scene) -> dict[str, np.ndarray]:
    """Return what each function's results in float32 differ from those in float64."""
    view = as_double(camera)
    rays, right_rays = pj.camera_rays(camera), pj.camera_rays(view)
    points = scene.mesh.vertices
    hit, right = pj.trace(scene, rays), pj.trace(exact, as_double(rays))
    same = (hit.primitive == right.primitive) & (right.primitive >= 0)
    on = lambda x: np.asarray(x, float)[np.asarray(same)]
    d, right_d = (slope(c, s) for c, s in ((camera, scene), (view, exact)))
    parts = lambda c: np.concatenate([np.ravel(x) for x in (c.e, c.p, c.u, c.phi)])
    return {
        "rays (rad)": length(np.asarray(rays.direction, float) - right_rays.direction),
        "project (px)": length(
            np.asarray(pj.project(camera, points), float) - pj.project(view, as_double(points))
        ),
        "trace: t (relative)": relative(on(hit.t), on(right.t)),
        "trace: barycentric": length(on(hit.barycentric) - on(right.barycentric)),
        "trace: normal (rad)": length(on(hit.normal) - on(right.normal)),
        "trace: another primitive (of 1 ray)": 1.0 * np.ravel(hit.primitive != right.primitive),
        "silhouette (px^2)": np.abs(
            np.ravel(np.asarray(pj.silhouette(camera, scene), float) - pj.silhouette(view, exact))
        ),
        "derivative of a sum over the image (relative)": np.abs(parts(d) - parts(right_d))
        / np.abs(parts(right_d)).max(),
    }


def question() -> dict:
    scene, exact = scenes()
    found: dict[str, list[np.ndarray]] = {}
    for trial in range(trials(50)):
        random = np.random.default_rng(trial)
        camera = random_camera(random, size=SIZE)
        for name, error in differences(camera, scene, exact).items():
            found.setdefault(name, []).append(error)
    answer = {}
    for name, errors in found.items():
        every = np.concatenate(errors)
        figures = {"mean": every.mean(), "99 %": np.quantile(every, 0.99), "worst": every.max()}
        answer[name] = {kind: float(f"{x:.3g}") for kind, x in figures.items()}
    worst = answer["silhouette (px^2)"]["worst"]
    print(f"float32 errs by {worst:.1e} px^2 at worst; in all:")
    for name, figures in answer.items():
        print(f"{name:48s}" + "".join(f"{k} {v:8.1e}  " for k, v in figures.items()))
    return {"trials": trials(50), "errors": answer}


if __name__ == "__main__":
    run(question)
