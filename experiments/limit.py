"""Is the fit as exact as the data allow, and are its error bars right?

Gaussian noise in every pixel of an exact 256 x 256 mask, 200 refits: root-mean-square error over
the Cramer-Rao bound of the exact Jacobian, how often 95 % intervals hold the truth. Then one-bit
masks from 32 to 1024 pixels: the error's slope. Last, many views: the error against their number.
"""

import numpy as np
from _common import degrees, meshes, random_camera, run, trials
from protocol import start_from

import pinhole_jax as pj

NOISE = 0.02


def values(camera: pj.Camera, truth: pj.Camera) -> np.ndarray:
    """Return small rotations about the true camera's axes, eye and phi, as a fit reports them."""
    a, b = (np.stack([np.asarray(x, float) for x in pj.camera_basis(c)]) for c in (truth, camera))
    turn = a @ (np.cross(a, b).sum(axis=0) / 2)
    return np.array([*turn, *np.asarray(camera.e, float), float(camera.phi)])


def noise_limit(scene: pj.Scene) -> dict:
    from scipy.stats import norm

    truth = random_camera(np.random.default_rng(5))
    free = ("pose", "phi")
    bound = pj.observability(truth, scene, free, noise=NOISE).std
    mask, exact = np.asarray(pj.silhouette(truth, scene), float), values(truth, truth)
    errors, held, inside = [], [], norm.ppf(0.975)
    for trial in range(trials(200)):
        random = np.random.default_rng(trial)
        start = start_from(truth, 3, 0.02, random)
        fit = pj.fit_camera(scene, mask + NOISE * random.normal(size=mask.shape), start, free)
        errors.append(values(fit.camera, truth) - exact)
        held.append(np.abs(errors[-1]) < inside * fit.std)
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
    share = np.mean(held, axis=0)
    print(f"  rms error over the Cramer-Rao bound: {ratio.min():.3f} to {ratio.max():.3f}")
    spread = f"{share.min():.1%} to {share.max():.1%}"
    print(f"  95 % intervals hold the truth in {share.mean():.1%} ({spread})")

    return {"names": fit.names, "rms_over_bound": [*ratio], "intervals_hold": [*share]}


def one_bit(scene: pj.Scene) -> dict:
    sizes, result = (32, 64, 128, 256, 512, 1024), {}
    for size in sizes:
        errors = []
        for trial in range(trials(200) // 10):
            random = np.random.default_rng(trial)
            truth = random_camera(random, size=size)
            start = start_from(truth, 3, 0.02, random)
            mask = np.asarray(pj.silhouette(truth, scene)) > 0.5
            errors.append(degrees(pj.fit_camera(scene, mask, start).camera, truth))
        result[str(size)] = float(np.median(errors))
    slope = np.polyfit(np.log([*sizes]), np.log([*result.values()]), 1)[0]
    listed = ", ".join(f"{k}: {v:.1e}" for k, v in result.items())
    print(f"  one-bit masks, median degrees: {listed}")
    print(f"  slope {slope:.2f}")
    return {"median_degrees": result, "slope": float(slope)}


def many_views(scene: pj.Scene) -> dict:
    result = {}
    for views in (1, 4, 16):
        errors = []
        for trial in range(trials(200) // 10):
            random = np.random.default_rng(1000 + trial)
            truths = [random_camera(random) for _ in range(views)]
            starts = [start_from(c, 3, 0.02, random) for c in truths]
            noise = lambda random=random: 0.005 * random.normal(size=(256, 256))
            masks = [np.asarray(pj.silhouette(c, scene)) + noise() for c in truths]
            fits = pj.fit_cameras(scene, masks, starts)
            focal = [np.tan(0.3) / np.tan(float(f.camera.phi) / 2) - 1 for f in fits]
            errors.append(focal[0])
        result[str(views)] = float(np.sqrt(np.mean(np.square(errors))))
    listed = ", ".join(f"{k}: {v:.3%}" for k, v in result.items())
    print(f"  focal length, rms error by views: {listed}")
    return result


def question() -> dict:
    answer = {}
    for name, scene in meshes("spot.obj"):
        print(name)
        answer[name] = {
            "noise": noise_limit(scene),
            "one_bit": one_bit(scene),
            "views": many_views(scene),
        }
    return answer


if __name__ == "__main__":
    run(question)
