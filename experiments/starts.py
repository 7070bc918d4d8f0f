"""From how far off is the camera found, and how exactly?

Bumpy closed meshes of 5120 faces, exact masks of 256 x 256 pixels, random cameras; starts 5, 10 and
20 degrees, 5 % of the distance and 5 % of the focal length off; pose and focal length free.
"""

import time

import numpy as np
from _common import run, trials

import pinhole_jax as pj

DEGREES = (5, 10, 20)


def turned(camera: pj.Camera, axis: np.ndarray, degrees: float, sign: int) -> pj.Camera:
    """Return the camera orbited about the origin, and 5 % off in distance and focal length."""
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    e, p, u = (np.asarray(x, float) for x in (camera.e, camera.p, camera.u))
    eye = R @ e * (1 + 0.05 * sign)
    phi = 2 * np.arctan(np.tan(float(camera.phi) / 2) / (1 - 0.05 * sign))
    dtype = np.asarray(camera.e).dtype.type
    moved = (x.astype(dtype) for x in (eye, eye + R @ (p - e), R @ u))
    return pj.Camera(*moved, dtype(phi), camera.d, camera.W, camera.H)


def fits(dtype: type) -> dict:
    errors: dict[int, list[float]] = {degrees: [] for degrees in DEGREES}
    times, statuses = [], []
    for trial in range(trials(67)):
        random = np.random.default_rng(trial)
        eye = random.normal(size=3)
        eye *= 5 / np.linalg.norm(eye)
        arrays = (
            x.astype(dtype) for x in (eye, 0.1 * random.normal(size=3), random.normal(size=3))
        )
        truth = pj.Camera(*arrays, dtype(0.6), dtype(1), 256, 256)
        scene = pj.Scene(mesh=pj.shapes.bumpy(4, seed=trial % 4))
        mask = np.asarray(pj.silhouette(truth, scene))
        for degrees in DEGREES:
            start = turned(truth, random.normal(size=3), degrees, int(random.choice([-1, 1])))
            begin = time.perf_counter()
            fit = pj.fit_camera(scene, mask, start, ("pose", "phi"))
            times.append(time.perf_counter() - begin)
            errors[degrees].append(float(np.rad2deg(pj.pose_error(fit.camera, truth)[0])))
            statuses.append(fit.status)
    found = [x for of in errors.values() for x in of]
    return {
        "within_0.005_degrees": sum(x <= 0.005 for x in found),
        "converged": statuses.count("converged"),
        "fits": len(statuses),
        "worst_degrees": {str(k): max(v) for k, v in errors.items()},
        "first_call_s": times[0],
        "median_s": float(np.median(times)),
    }


def question() -> dict:
    results = {np.dtype(t).name: fits(t) for t in (np.float32, np.float64)}
    for name, result in results.items():
        worst = max(result["worst_degrees"].values())
        print(
            f"{name}: {result['within_0.005_degrees']} of {result['fits']} within 0.005 degrees,"
            f" worst {worst:.1e}, {result['converged']} say converged,"
            f" median {1000 * result['median_s']:.0f} ms"
            f" (first call {result['first_call_s']:.1f} s)"
        )
    return results


if __name__ == "__main__":
    run(question)
