"""Is the camera found with no start at all?

Exact masks of 256 x 256 pixels, rotations uniformly random; the focal length known, or 0.4 to
0.9 rad of field of view and 0.6 as a first guess. Found: right to 0.01 degrees.
"""

import time

import numpy as np
from _common import degrees, meshes, percentiles, random_camera, run, trials

import pinhole_jax as pj


def question() -> dict:
    answer = {}
    for name, scene in meshes("spot.obj", "bob.obj", "suzanne.ply", "teapot.obj"):
        for free in (("pose",), ("pose", "phi")):
            found, seconds, lost = [], [], []
            for trial in range(trials(100)):
                random = np.random.default_rng(trial)
                truth = random_camera(random, random.uniform(0.4, 0.9) if len(free) > 1 else 0.6)
                mask = np.asarray(pj.silhouette(truth, scene))
                begin = time.perf_counter()
                fit = pj.fit_camera(scene, mask, None, free, phi=0.6)
                seconds.append(time.perf_counter() - begin)
                error = degrees(fit.camera, truth)
                found.append(error < 0.01 and fit.status == "converged")
                if not found[-1]:
                    lost.append((trial, round(error, 3), fit.status, fit.rms))
            answer[f"{name}, {'+'.join(free)}"] = {
                "found": sum(found),
                "of": len(found),
                "lost": lost,
                "first_s": seconds[0],
                "seconds": percentiles(seconds[1:]),
            }
            print(
                f"{name}, {' and '.join(free)} free: {sum(found)} of {len(found)},"
                f" median {np.median(seconds[1:]):.2f} s, lost {lost}",
                flush=True,
            )
    return answer


if __name__ == "__main__":
    run(question)
