"""Do a joint fit's 95 % intervals hold where few views say how far views differ?

    python experiments/few_views.py OUT [FITS]

Cameras all round a bumpy mesh, masks of 64 x 64 pixels whose pixels err independently (3 %). Two
problems of 2, 3 and 5 views: cameras that share an unknown focal length (the views' disagreement is
the mean of 1, 2 and 4 numbers), and one object before cameras at known places (of 6, 12 and 24).
In half of the fits nothing but masks errs, in the others what is taken as known is wrong as well:
each focal length, or each camera's place. First the rule by itself, on normal numbers.
"""

import numpy as np
from _common import camera_at, run, trials
from scipy.spatial.transform import Rotation
from scipy.stats import t

import pinhole_jax as pj
from pinhole_jax._camera.poses import at_pose, exponential, pose_of
from pinhole_jax._joint.agreement import NORMAL_95

SIZE, PHI, NOISE = 64, 0.6, 0.03
NUMBERS, FITS, DRAWN = (2, 3, 5), 16, 200_000
#: What is taken as known errs by: focal lengths (a share of it), and cameras (rad and world units).
WRONG = {"phi": 2e-3, "object": 1e-3}


def by_itself() -> list[dict]:
    """How many intervals hold of a normal number that errs `times` as much as masks say."""
    random, rows = np.random.default_rng(0), []
    for freedom in (1, 2, 4, 6, 12, 24):
        for times in (1.0, 1.5, 2.0, 3.0):
            told = times**2 * random.chisquare(freedom, DRAWN) / freedom
            off = np.abs(times * random.normal(size=DRAWN))
            wide = (t.ppf(0.975, freedom) / NORMAL_95) ** 2
            smooth = 1 + np.maximum(told - 1, 0) * wide
            hold = lambda variance, off=off: float(np.mean(off < NORMAL_95 * variance**0.5))
            row = {"numbers": freedom, "times": times}
            row["Student's from 1 on (taken)"] = hold(np.where(told > 1, told * wide, 1.0))
            row["of what is beyond 1 alone"] = hold(smooth)
            row["Birge's"] = hold(np.maximum(told, 1))
            rows.append(row)
    return rows


def cameras(number: int, random: np.random.Generator) -> list[pj.Camera]:
    axes = (Rotation.random(random_state=random).as_matrix() for _ in range(number))
    return [camera_at(a, np.zeros(2), 4.5, PHI, SIZE) for a in axes]


def one(kind: str, number: int, wrong: bool, seed: int) -> list[float]:
    """How many standard errors the unknowns are off."""
    random = np.random.default_rng(seed)
    scene, right = pj.Scene(mesh=pj.shapes.bumpy(2)), cameras(number, random)
    share, seen = WRONG[kind] * wrong, []
    for camera in right:
        off = exponential(share * random.normal(size=6)) if kind == "object" else np.eye(4)
        phi = PHI * (1 + share * random.normal()) if kind == "phi" else PHI
        there = at_pose(camera, pose_of(camera) @ off).replace(phi=np.float32(phi))
        noise = NOISE * random.normal(size=(SIZE, SIZE))
        seen.append(np.asarray(pj.silhouette(there, scene)) + noise)
    given = {f"{k}": camera for k, camera in enumerate(right)}
    views = [pj.JointView(scene, mask, camera=f"{k}") for k, mask in enumerate(seen)]
    if kind == "phi":
        fit = pj.fit_joint(views, given, shared="phi").cameras["0"]
        return [float((fit.camera.phi - PHI) / fit.std[-1])]
    views = [view._replace(object="part") for view in views]
    found = pj.fit_joint(views, given, (), objects={"part": np.eye(4)}).objects["part"]
    turn = Rotation.from_matrix(found.pose[:3, :3]).as_rotvec()
    return (np.append(turn, found.pose[:3, 3]) / found.std).tolist()


def question() -> dict:
    rows = []
    for kind in WRONG:
        for number in NUMBERS:
            for wrong in (False, True):
                off = np.abs([one(kind, number, wrong, seed) for seed in range(trials(FITS))])
                rows.append(
                    {
                        "unknown": kind,
                        "views": number,
                        "what is known errs": wrong,
                        "hold": float(np.mean(off < NORMAL_95)),
                        "of": off.size,
                        "sigmas, rms": float(np.mean(off**2) ** 0.5),
                    }
                )
                print(rows[-1], flush=True)
    return {"fits": rows, "the rule by itself": by_itself()}


if __name__ == "__main__":
    run(question)
