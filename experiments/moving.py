"""What does a fit look like? The README's moving picture: a cow's outline settles on its photo.

A search would need no start; this fit begins 36 degrees off, so that there is something to see.
Each step of the fit is a stop, between them the camera moves smoothly.
"""

from itertools import pairwise

import numpy as np
from _common import camera_at, degrees, folder, meshes, orbited, run
from PIL import Image, ImageDraw, ImageFont

import pinhole_jax as pj

SIZE = 480
EYE = np.array([2.9, 1.4, -3.0])
#: Frames from one step of the fit to the next, ms of each, and how long the ends stay.
BETWEEN, EACH, STAYS = 4, 60, 1800


def looking(eye: np.ndarray) -> np.ndarray:
    """Return the axes (rows right, up, forward) of a camera that looks at the origin, y upwards."""
    camera = pj.Camera(eye, np.zeros(3), [0.0, 1, 0], 0.5, W=SIZE, H=SIZE)
    return np.stack([np.asarray(a, float) for a in pj.camera_basis(camera)])


def shaded(camera: pj.Camera, scene: pj.Scene) -> np.ndarray:
    """Return a picture of the scene, lit from the upper left, before a dark ground."""
    normals = np.nan_to_num(np.asarray(pj.normals(camera, scene), float))
    light = np.array([*map(np.asarray, pj.camera_basis(camera))]).T @ [-0.45, 0.6, -0.66]
    tone = np.clip(np.abs(normals @ light), 0, 1)[..., None]
    cover = np.asarray(pj.silhouette(camera, scene), float)[..., None]
    ground, body = np.array([26, 34, 44]), np.array([228, 208, 178])
    return np.uint8(ground * (1 - cover) + cover * (60 + 0.72 * body * tone).clip(0, 255))


def between(a: pj.Camera, b: pj.Camera, share: float) -> pj.Camera:
    """Return a camera on the way from one to another."""
    mixed = {
        name: (1 - share) * np.asarray(getattr(a, name)) + share * np.asarray(getattr(b, name))
        for name in ("e", "p", "u", "phi")
    }
    return a.replace(**mixed)


def frame(picture: np.ndarray, camera: pj.Camera, scene: pj.Scene, words: str) -> Image.Image:
    """Return the picture with the camera's outline and words on it."""
    drawn = Image.fromarray(picture).resize((2 * SIZE, 2 * SIZE), Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(drawn)
    corners = 2 * (pj.plot.outline(camera, scene) * [1, -1] + [0, SIZE])
    for colour, width in (((0, 30, 60), 9), ((0, 240, 255), 5)):
        for a, b in corners:
            draw.line([tuple(a), tuple(b)], fill=colour, width=width)
    font = ImageFont.load_default(size=34)
    draw.text((32, 2 * SIZE - 66), words, fill=(235, 240, 245), font=font)
    return drawn.resize((SIZE, SIZE), Image.Resampling.BOX)


def question() -> dict:
    from scipy.spatial.transform import Rotation

    (_, _), (name, scene) = meshes("spot.obj")
    truth = camera_at(looking(EYE), np.zeros(2), np.linalg.norm(EYE), 0.43, SIZE)
    mask = np.asarray(pj.silhouette(truth, scene))
    picture = shaded(truth, scene)
    turn = Rotation.from_rotvec(np.deg2rad([12, 32, -8])).as_matrix()
    start = orbited(truth, turn, 1.25)
    fit = pj.fit_camera(scene, mask > 0.5, start, free=("pose", "phi"), record=True)
    stops = [stop.camera for stop in fit.history]

    frames = []
    for number, (a, b) in enumerate(pairwise(stops), 1):
        if degrees(a, b) < 0.05:
            continue
        for share in np.arange(BETWEEN) / BETWEEN:
            camera = between(a, b, share)
            off = degrees(camera, truth)
            words = f"step {number}: {off:.1f} degrees off"
            frames.append(frame(picture, camera, scene, words))
    sigma = float(np.rad2deg(np.linalg.norm(fit.std[:3])))
    off = degrees(fit.camera, truth)
    words = f"{fit.status}: {off:.2f} degrees off, sigma {sigma:.2f}"
    frames.append(frame(picture, fit.camera, scene, words))
    lasts = [STAYS // 2] + [EACH] * (len(frames) - 2) + [STAYS]
    path = folder() / "fit.webp"
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=lasts, loop=0, quality=80, method=4
    )
    print(f"{len(frames)} frames of a {name}, {path.stat().st_size / 1e6:.2f} MB: {words}")
    return {"frames": len(frames), "status": fit.status, "degrees": off, "sigma_degrees": sigma}


if __name__ == "__main__":
    run(question)
