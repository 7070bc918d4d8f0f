"""One fit as a small animation, and the basin of convergence about the true camera.

The animation shows the outline after 0, 1, 2, ... steps a level. The map tells for starts up to 60
degrees off about two axes and with distances 0.6 to 1.6 times the true one whether a single
descent, with no search behind it, ends at the camera.
"""

from pathlib import Path

import numpy as np
from _common import degrees, folder, meshes, orbited, random_camera, run, trials
from PIL import Image, ImageDraw

import pinhole_jax as pj
from pinhole_jax._solver.moves import canonical
from pinhole_jax._solver.solver import Solver

FAR = 60


def turned(truth: pj.Camera, right: float, up: float, far: float) -> pj.Camera:
    """Return the camera moved about the origin by angles (degrees) about its own axes."""
    from scipy.spatial.transform import Rotation

    axes = np.stack([np.asarray(a, float) for a in pj.camera_basis(truth)])
    turn = Rotation.from_rotvec(np.deg2rad([right, up, 0]) @ axes).as_matrix()
    return orbited(truth, turn, far)


def animation(scene: pj.Scene, truth: pj.Camera, path: Path) -> int:
    """Write the fit's way as a GIF; return its number of pictures."""
    mask = np.asarray(pj.silhouette(truth, scene))
    start, frames = turned(truth, 18, -14, 1.15), []
    for steps in range(9):
        camera = start
        if steps:
            fit = pj.fit_camera(scene, mask, start, max_steps=steps)
            camera = fit.camera
        picture = (90 + 100 * mask).astype(np.uint8)
        frame = Image.fromarray(pj.plot.overlay(picture, camera, scene))
        words = f"{steps} steps a level: {degrees(camera, truth):.2g} degrees off"
        ImageDraw.Draw(frame).text((10, 10), words, fill=(255, 255, 255))
        frames.append(frame.resize((512, 512)))
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=700, loop=0)
    return len(frames)


def question() -> dict:
    n = trials(13)
    angles, answer = np.linspace(-FAR, FAR, n), {}
    for name, scene in meshes("spot.obj"):
        truth = random_camera(np.random.default_rng(1))
        mask = np.asarray(pj.silhouette(truth, scene))
        weights = np.ones(mask.shape)
        solver = Solver.of(scene, mask, weights, np.float32, ("pose",), 64)

        def ends_right(start: pj.Camera, solver=solver, truth=truth) -> bool:
            return degrees(solver.solve(canonical(start), solver.levels).camera, truth) < 0.1

        turns = [[ends_right(turned(truth, a, b, 1)) for b in angles] for a in angles]
        reach = np.geomspace(0.6, 1.6, n)
        nearer = [[ends_right(turned(truth, a, 0, r)) for r in reach] for a in angles]
        answer[name] = {"turns": turns, "distances": nearer, "angles": [*angles], "reach": [*reach]}
        answer[name]["pictures"] = animation(scene, truth, folder() / f"{name}_fit.gif")
        within = np.hypot(*np.meshgrid(angles, angles)) < 31
        print(
            f"{name}: {np.mean(np.array(turns)[within]):.0%} of turns up to 30 degrees end at the"
            f" camera, {np.mean(turns):.0%} of all; {np.mean(nearer):.0%} of turns with distances"
        )
    return answer


def draw(answer: dict, path: Path) -> None:
    import matplotlib.pyplot as plt

    names = [name for name in answer if name != "versions"]
    figure, panels = plt.subplots(len(names), 2, figsize=(8, 3.6 * len(names)), squeeze=False)
    for row, name in zip(panels, names, strict=True):
        found = answer[name]
        for panel, key in zip(row, ("turns", "distances"), strict=True):
            x = found["angles"] if key == "turns" else found["reach"]
            panel.pcolormesh(
                x, found["angles"], np.array(found[key]) * 1.0, cmap="Greens", vmax=1.5
            )
            panel.set_ylabel(f"{name}: about b1, degrees")
            panel.set_xlabel("about b2, degrees" if key == "turns" else "times the distance")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    run(question, draw)
