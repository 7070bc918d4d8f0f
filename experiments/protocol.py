"""The field's protocol for bad starts: a rotation and a share of the distance off.

The camera is turned about the object by 10, 15 or 30 degrees about a random axis, and is 5, 10 or
15 % too near or too far; exact masks of 256 x 256 pixels, the pose free. A success is an error
below 5 degrees; means are over all successes.
"""

import time

import numpy as np
from _common import degrees, meshes, orbited, random_camera, run, trials

import pinhole_jax as pj

STARTS = ((10, 0.05), (15, 0.10), (30, 0.15))


def start_from(truth: pj.Camera, angle: float, share: float, random) -> pj.Camera:
    """Return the camera turned about the origin by an angle (degrees), nearer or farther."""
    from scipy.spatial.transform import Rotation

    axis = random.normal(size=3)
    turn = Rotation.from_rotvec(np.deg2rad(angle) * axis / np.linalg.norm(axis)).as_matrix()
    return orbited(truth, turn, 1 + share * random.choice([-1, 1]))


def question() -> dict:
    answer = {}
    for name, scene in meshes("spot.obj", "suzanne.ply"):
        for angle, share in STARTS:
            errors, shifts, seconds, right = [], [], [], 0
            for trial in range(trials(200)):
                random = np.random.default_rng(trial)
                truth = random_camera(random)
                start = start_from(truth, angle, share, random)
                mask = np.asarray(pj.silhouette(truth, scene))
                begin = time.perf_counter()
                fit = pj.fit_camera(scene, mask, start)
                seconds.append(time.perf_counter() - begin)
                error, shift = degrees(fit.camera, truth), pj.pose_error(fit.camera, truth)[1]
                if error < 5:
                    errors.append(error)
                    shifts.append(float(shift) / float(np.linalg.norm(truth.e)))
                right += fit.status == "converged" and error < 0.01
            answer[f"{name}, {angle} degrees, {share:.0%}"] = {
                "success": len(errors) / trials(200),
                "within_0.01_degrees": right,
                "mean_degrees": float(np.mean(errors)),
                "mean_shift": float(np.mean(shifts)),
                "median_s": float(np.median(seconds)),
            }
            print(
                f"{name}, {angle} degrees and {share:.0%} off: {len(errors) / trials(200):.1%},"
                f" mean {np.mean(errors):.1e} degrees, {np.mean(shifts):.1e} of the distance;"
                f" median {np.median(seconds):.2f} s",
                flush=True,
            )
    return answer


if __name__ == "__main__":
    run(question)
