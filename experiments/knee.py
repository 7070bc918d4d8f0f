"""Where are a knee's implants, femur and tibia of one frame together and apart?

    python experiments/knee.py OUT

`../shared/data/knee`: three frames of fluoroscopy with an expert's poses, masks that are these
projected (labels) and masks by a network. The camera is known; both bones start 3 degrees, 3, 3
and 15 mm off. Apart, each is a joint fit of one mask; together, a frame's two are one fit of two
objects. They have no unknown in common, so the answers are to be the same. A `converged` is false
where it is more than 4 sigma and half a degree off. Errors are in the camera's frame.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
from _common import folder
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax._camera.poses import rigid

DATA = Path(__file__).parents[2] / "shared" / "data" / "knee"
BONES = {"femur": "fem.jts", "tibia": "tib.jts"}
STARTS, DEGREES, SHIFT = 3, 3.0, (3.0, 3.0, 15.0)
FALSE_SIGMAS, FALSE_DEGREES = 4.0, 0.5
WORST = ("degrees", "sideways, mm", "depth, mm", "most sigmas", "apart from alone")


def camera() -> pj.Camera:
    distance, _, _, pixel = map(float, (DATA / "calibration.txt").read_text().split()[1:5])
    K = np.array([[distance / pixel, 0, 512], [0, distance / pixel, 512], [0, 0, 1]])
    return pj.formats.from_opencv(K, np.eye(3), np.zeros(3), 1024, 1024, pixel_centres="half")


def poses(bone: str) -> list[np.ndarray]:
    """The expert's, in the camera's frame; the file's looks along -z with y up: R = Rz Rx Ry."""
    lines = (DATA / BONES[bone]).read_text().splitlines()[2:]
    result = []
    for line in (line for line in lines if line.strip()):
        x, y, z, *angles = map(float, line.split(","))
        turn = np.diag([1.0, -1, -1])
        rotation = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
        result.append(rigid(turn @ rotation, turn @ [x, y, z]))
    return result


def off(pose: np.ndarray, middle: np.ndarray, seed: int) -> np.ndarray:
    """The pose turned about the mesh's middle, and shifted."""
    random = np.random.default_rng(seed)
    axis, signs = random.normal(size=3), random.choice([-1, 1], 3)
    turn = Rotation.from_rotvec(np.deg2rad(DEGREES) * axis / np.linalg.norm(axis)).as_matrix()
    there = pose[:3, :3] @ middle + pose[:3, 3] + signs * SHIFT
    return rigid(turn @ pose[:3, :3], there - turn @ pose[:3, :3] @ middle)


def error(found, truth: np.ndarray, middle: np.ndarray) -> dict:
    """How far an object's pose is from the expert's."""
    turn = Rotation.from_matrix(found.pose[:3, :3].T @ truth[:3, :3]).as_rotvec()
    shift = (found.pose - truth)[:3] @ np.append(middle, 1)
    sigmas = np.append(turn, truth[:3, 3] - found.pose[:3, 3]) / found.std
    return {
        "degrees": float(np.rad2deg(np.linalg.norm(turn))),
        "sideways, mm": float(np.hypot(*shift[:2])),
        "depth, mm": float(abs(shift[2])),
        "sigma, degrees": float(np.rad2deg(np.max(found.std[:3]))),
        "most sigmas": float(np.max(np.abs(sigmas))),
    }


def rows() -> Iterator[dict]:
    scenes = {bone: pj.Scene(mesh=pj.load_mesh(DATA / f"{bone}.stl")) for bone in BONES}
    middles = {b: np.asarray(s.mesh.vertices, float).mean(axis=0) for b, s in scenes.items()}
    known, truth = camera(), {bone: poses(bone) for bone in BONES}
    for kind in ("label", "network"):
        for frame in range(3):
            views = {
                bone: pj.JointView(
                    scenes[bone], pj.io.load_mask(DATA / f"{bone}_{kind}_{frame}.png"), object=bone
                )
                for bone in BONES
            }
            for seed in range(STARTS):
                start = {b: off(truth[b][frame], middles[b], 10 * frame + seed) for b in BONES}
                both = pj.fit_joint([*views.values()], known, (), objects=start)
                for bone in BONES:
                    alone = pj.fit_joint([views[bone]], known, (), objects={bone: start[bone]})
                    told = both.objects[bone], truth[bone][frame], middles[bone]
                    apart = np.max(np.abs(both.objects[bone].pose - alone.objects[bone].pose))
                    yield {
                        "bone": bone,
                        "masks": kind,
                        "frame": frame,
                        "start": seed,
                        "status": alone.status,
                        "of both": both.status,
                        **error(*told),
                        "apart from alone": float(apart),
                    }


def verdict(found: list[dict]) -> dict:
    """The worst of each bone and kind of masks; how many are `converged`, and falsely."""
    result = {}
    for bone, kind in ((b, k) for k in ("label", "network") for b in BONES):
        of = [row for row in found if (row["bone"], row["masks"]) == (bone, kind)]
        wrong = lambda r: r["most sigmas"] > FALSE_SIGMAS and r["degrees"] > FALSE_DEGREES
        sure = [row for row in of if row["status"] == "converged"]
        result[f"{bone}, {kind}"] = {
            **{f"worst {name}": max(row[name] for row in of) for name in WORST},
            "converged": len(sure),
            "falsely": sum(map(wrong, sure)),
            "of": len(of),
        }
    return result


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    out = folder()
    if not DATA.exists():
        sys.exit(f"skipped: no real data at {DATA}")
    pj.cache()
    found = []
    for row in rows():
        found.append(row)
        print(row, flush=True)
    answer = {"verdict": verdict(found), "rows": found}
    print(json.dumps(answer["verdict"], indent=1))
    (out / "knee.json").write_text(json.dumps(answer, indent=1) + "\n")


if __name__ == "__main__":
    main()
