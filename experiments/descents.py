"""What do views cost in either Levenberg-Marquardt? How many wrong points does a fit bear?

One view's descent on the finest level by the compiled program (optimistix), and by the loop that
many views have, from the same start: seconds of the processor, least of 7 in turn. Then
`fit_points` of 30 points, a fifth to a half of which are anywhere on the film (the others err by
0.3 px), with `outlier_px=1.5`, no start: in how many draws the right ones decide.
"""

import time

import jax
import numpy as np
from _common import run
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax._joint.descent import descend
from pinhole_jax._joint.problem import JointProblem
from pinhole_jax._solver.problem import FINE_PX

DRAWS, POINTS = 12, 30
SHARES = (0.2, 0.4, 0.5)


def descents(number: int) -> dict:
    """Return what this many views take in either loop."""
    scene = pj.Scene(mesh=pj.shapes.bumpy(4))
    truth = pj.Camera([0.3, 1, 5], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, W=256, H=256)
    mask = np.asarray(pj.silhouette(truth, scene))
    start = truth.replace(e=[0.5, 1.2, 5], phi=0.63)
    views = [pj.JointView(scene, mask, camera=str(k)) for k in range(number)]
    cameras = {view.camera: start for view in views}
    problem = JointProblem.of(views, cameras, ("pose", "phi"), None, None, None, 64)
    px, eyes = FINE_PX[np.dtype(start.e.dtype)], problem.layout.eyes

    def compiled() -> int:
        begin = [(eye.solver, eye.canonical(problem.start)) for eye in eyes]
        ends = [next(solver.descents([camera], 64)) for solver, camera in begin]
        return jax.block_until_ready(ends[0]).steps[0]

    def many() -> int:
        ones = np.ones(number)
        return descend(problem.layout, problem.start, 1, ones, 64, px).steps

    seconds = {compiled: [], many: []}
    for _ in range(8):
        for loop, taken in seconds.items():
            begin = time.process_time()
            loop()
            taken.append(time.process_time() - begin)
    ms = {loop.__name__: round(1e3 * min(taken[1:]), 1) for loop, taken in seconds.items()}
    return {"views": number, **ms, "steps": [compiled(), many()]}


def wrong_points(flat: bool, share: float) -> dict:
    """Return in how many draws the right points decide, and how many say `ambiguous`."""
    right, ambiguous = 0, 0
    for seed in range(DRAWS):
        random = np.random.default_rng(seed)
        points = random.uniform(-1, 1, (POINTS, 3)) * [1, 1, 0 if flat else 1]
        axes = Rotation.from_euler("xyz", random.uniform(-0.9, 0.9, 3)).as_matrix()
        e = 5 * axes[2]
        truth = pj.Camera(e, np.zeros(3), axes[1], 0.6, W=640, H=480)
        seen_at = np.asarray(pj.project(truth, points)) + random.normal(0, 0.3, (POINTS, 2))
        wrong = np.arange(POINTS) < round(share * POINTS)
        there = np.where(wrong[:, None], random.uniform(0, [640, 480], (POINTS, 2)), seen_at)
        start = truth.replace(e=[0.0, 0, 1], u=[0.0, 1, 0])
        fit = pj.fit_points(points, there, start, outlier_px=1.5)
        alone = pj.fit_points(points[~wrong], seen_at[~wrong], start)
        right += bool(pj.pose_error(fit.camera, alone.camera)[0] < 1e-2)
        ambiguous += fit.status == "ambiguous"
    return {"flat": flat, "share": share, "right": right, "of": DRAWS, "ambiguous": ambiguous}


def question() -> dict:
    answer = {"descents": [descents(n) for n in (1, 4)], "points": []}
    for row in answer["descents"]:
        print(
            f"{row['views']} views: {row['compiled']} ms compiled, {row['many']} ms in the other",
            flush=True,
        )
    for flat in (False, True):
        for share in SHARES:
            answer["points"].append(wrong_points(flat, share))
            print(answer["points"][-1], flush=True)
    return answer


if __name__ == "__main__":
    run(question)
