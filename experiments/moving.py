"""What does a fit look like? The README's moving picture: a cow's outline settles on its photo.

A search would need no start; this fit begins 35 degrees off, so that there is something to see. Each
step of the fit is a frame, between them the camera moves smoothly; the last ones show one
sigma as a band.
"""

import numpy as np
from _common import degrees, folder, meshes, orbited, random_camera, run
from PIL import Image, ImageDraw, ImageFont

import pinhole_jax as pj

SIZE = 480
#: Frames from one step of the fit to the next, ms of each, and how long the ends stay.
BETWEEN, EACH, STAYS = 4, 60, 1800


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


def frame(
    picture: np.ndarray, camera: pj.Camera, scene: pj.Scene, words: str, band: np.ndarray | None
) -> Image.Image:
    """Return the picture with the camera's outline and words on it."""
    drawn = Image.fromarray(pj.plot.overlay(picture, camera, scene, band_px=band))
    drawn = drawn.resize((SIZE, SIZE), Image.Resampling.LANCZOS)
    font = ImageFont.load_default(size=18)
    ImageDraw.Draw(drawn).text((16, SIZE - 34), words, fill=(235, 240, 245), font=font)
    return drawn


def question() -> dict:
    from scipy.spatial.transform import Rotation

    (_, _), (name, scene) = meshes("spot.obj")
    truth = random_camera(np.random.default_rng(5), size=SIZE)
    mask = np.asarray(pj.silhouette(truth, scene))
    picture = shaded(truth, scene)
    turn = Rotation.from_rotvec(np.deg2rad([12, 32, -8])).as_matrix()
    start = orbited(truth, turn, 1.25)
    fit = pj.fit_camera(scene, mask > 0.5, start, free=("pose", "phi"), record=True)
    stops = [stop.camera for stop in fit.history]

    frames = []
    for number, (a, b) in enumerate(zip(stops, stops[1:], strict=False), 1):
        if degrees(a, b) < 0.05:
            continue
        for share in np.arange(BETWEEN) / BETWEEN:
            camera = between(a, b, share)
            off = degrees(camera, truth)
            words = f"step {number}: {off:.1f} degrees off"
            frames.append(frame(picture, camera, scene, words, None))
    sigma = float(np.rad2deg(np.max(fit.std[:3])))
    off = degrees(fit.camera, truth)
    words = f"{fit.status}: {off:.2f} degrees off, sigma {sigma:.2f}"
    band = 20 * pj.plot.outline_sigma(fit, scene)
    frames.append(frame(picture, fit.camera, scene, words, band))
    lasts = [STAYS // 2] + [EACH] * (len(frames) - 2) + [STAYS]
    path = folder() / "fit.webp"
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=lasts, loop=0, quality=80, method=4
    )
    print(f"{len(frames)} frames of a {name}, {path.stat().st_size / 1e6:.2f} MB: {words}")
    return {"frames": len(frames), "status": fit.status, "degrees": off, "sigma_degrees": sigma}


if __name__ == "__main__":
    run(question)
