"""Does it work on a real photo? The camera over a coffee cup, from the cup's outline.

The photo comes with scikit-image (Rachel Michetti, CC0). The cup's mesh is a surface of revolution
with the proportions of an espresso cup on its saucer (saucer radius 1), the mask colour
thresholds.
A mesh that is round about its axis cannot tell where the camera stands around it, so that is given:
the eye is where x = 0. Without the prior the status is `rank_deficient`, and a note names the axis.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
import scipy.ndimage
import skimage.color
import skimage.data
import skimage.morphology
import trimesh

import pinhole_jax as pj
from pinhole_jax import io, plot, shapes

PHI = 0.35  # rad: no EXIF in the photo; that of a 70 mm lens on full frame


def cup(rim: float = 0.54, height: float = 0.95) -> pj.Mesh:
    saucer = [(0, 0), (0.55, 0), (1, 0.17), (0.985, 0.19), (0.42, 0.06)]
    outside = [(0.8 * rim, 0.35 * height), (rim, height)]
    inside = [(rim - 0.07, height), (rim - 0.12, 0.45 * height), (0, 0.4 * height)]
    return shapes.revolved(np.array(saucer + outside + inside), sections=96)


def segment(photo: np.ndarray) -> np.ndarray:
    """Return the mask of red glaze and white china; what sticks out (the spoon) is opened away."""
    lightness, a, b = np.moveaxis(skimage.color.rgb2lab(photo), -1, 0)
    red = (a > b + 1) & (a > 27)
    white = (lightness > 75) & (np.hypot(a, b) < 25)
    mask = skimage.morphology.isotropic_closing(red | white, 5)
    mask = scipy.ndimage.binary_fill_holes(mask)
    mask = skimage.morphology.isotropic_opening(mask, 40)
    label, count = scipy.ndimage.label(mask)
    return label == 1 + np.argmax(scipy.ndimage.sum(mask, label, range(1, count + 1)))


def main() -> None:
    kept = pj.cache()
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    photo = skimage.data.coffee()
    H, W = photo.shape[:2]
    scene = pj.Scene(mesh=cup())
    distance = 1.25 / np.tan(PHI / 2)
    tilt = np.deg2rad(50)
    eye = distance * np.array([0, -np.cos(tilt), np.sin(tilt)])
    start = pj.Camera(eye, [0, 0, 0.3], [0, 0, 1], PHI, 1.0, W, H)
    begin = time.perf_counter()
    mask = segment(photo)
    print(f"Fitting; what is compiled for it the first time is kept in {kept}.", flush=True)
    round_about_z = {"e_x": (0.0, 1e-3)}
    fit = pj.fit_camera(scene, mask, start, free=("pose",), prior=round_about_z)
    seconds = time.perf_counter() - begin

    x, y, z = np.asarray(fit.camera.e)
    print(
        f"The camera stood {np.linalg.norm([x, y, z]):.1f} saucer radii from the cup,"
        f" {np.rad2deg(np.arctan2(z, np.hypot(x, y))):.0f} degrees above the table"
        f" (IoU {fit.iou:.3f}, {seconds:.0f} s)."
    )
    print(fit)
    io.save_image(folder / "coffee_cup.jpg", plot.overlay(photo, fit.camera, scene))
    io.save_camera(folder / "coffee_cup.json", fit.camera)
    for name, image in (("photo.png", photo), ("mask.png", mask)):  # what a user brings
        io.save_image(folder / name, image)
    trimesh.Trimesh(scene.mesh.vertices, scene.mesh.faces).export(folder / "cup.ply")
    record = {"status": fit.status, "iou": fit.iou, "rms": fit.rms, "weak": list(fit.weak)}
    (folder / "coffee_cup_fit.json").write_text(json.dumps(record, indent=1) + "\n")
    print(f"Picture: {folder / 'coffee_cup.jpg'}")


if __name__ == "__main__":
    main()
