"""The documentation's pictures.

    python experiments/pictures.py gallery | fit [OUT]

- `gallery`: what a camera sees: mask, depth (near is light) and normals (x, y, z as R, G, B).
- `fit`: the README's moving picture: a cow's outline settles on its photo. A search would need no
  start; this fit begins 36 degrees off, so that there is something to see. Each step of the fit is
  a stop, between them the camera moves smoothly.
"""

from itertools import pairwise

import numpy as np
from _common import Options, axes_of, camera_at, degrees, main, mask_of, meshes, orbited
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

import pinhole_jax as pj

SIZE = 480
EYE = np.array([2.9, 1.4, -3.0])
#: Frames from one step of the fit to the next, ms of each, and how long the ends stay.
BETWEEN, EACH, STAYS = 4, 60, 1800


def grey(depth: np.ndarray) -> np.ndarray:
    """Return 1 (nearest) to 0.2 (farthest), and 0 where nothing is met."""
    met = np.isfinite(depth)
    near, far = depth[met].min(), depth[met].max()
    return np.where(met, 1 - 0.8 * (np.where(met, depth, near) - near) / (far - near), 0)


def gallery(asked: Options) -> dict:
    scene = pj.Scene(mesh=pj.shapes.bumpy(5), spheres=pj.Spheres([[0.75, -0.45, 1.1]], [0.35]))
    camera = pj.Camera([1.6, 1.2, 4.6], [0.05, -0.05, 0.1], [0, 1, 0], 0.66, W=256, H=256)
    mask, depth = mask_of(camera, scene), np.asarray(pj.depth(camera, scene), float)
    normals, met = np.asarray(pj.normals(camera, scene), float), np.isfinite(depth)[..., None]
    panels = [mask[..., None], grey(depth)[..., None], np.where(met, (normals + 1) / 2, 0)]
    row = [np.broadcast_to(x, (256, w, 3)) for p in panels for x, w in ((p, 256), (1.0, 8))][:-1]
    image = np.round(255 * np.concatenate(row, axis=1)).astype(np.uint8)
    pj.io.save_image(asked.out / "gallery.png", image)
    return {"verdict": f"{mask.sum():.0f} px covered, {met.sum()} pixel centres have a depth"}


def shaded(camera: pj.Camera, scene: pj.Scene) -> np.ndarray:
    """Return a picture of the scene, lit from the upper left, before a dark ground."""
    normals = np.nan_to_num(np.asarray(pj.normals(camera, scene), float))
    light = np.array([*map(np.asarray, pj.camera_basis(camera))]).T @ [-0.45, 0.6, -0.66]
    tone = np.clip(np.abs(normals @ light), 0, 1)[..., None]
    cover = np.asarray(pj.silhouette(camera, scene), float)[..., None]
    ground, body = np.array([26, 34, 44]), np.array([228, 208, 178])
    return np.uint8(ground * (1 - cover) + cover * (60 + 0.72 * body * tone).clip(0, 255))


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


def fit(asked: Options) -> dict:
    _, (name, scene) = meshes("spot.obj")
    axes = axes_of(pj.Camera(EYE, np.zeros(3), [0.0, 1, 0], 0.5, W=SIZE, H=SIZE))
    truth = camera_at(axes, np.zeros(2), np.linalg.norm(EYE), 0.43, SIZE)
    mask, picture = mask_of(truth, scene), shaded(truth, scene)
    start = orbited(truth, Rotation.from_rotvec(np.deg2rad([12, 32, -8])).as_matrix(), 1.25)
    fit = pj.fit_camera(scene, mask > 0.5, start, free=("pose", "phi"), record=True)
    frames = []
    for number, (a, b) in enumerate(pairwise(stop.camera for stop in fit.history), 1):
        if degrees(a, b) < 0.05:
            continue
        for share in np.arange(BETWEEN) / BETWEEN:
            way = {k: (1 - share) * getattr(a, k) + share * getattr(b, k) for k in ("e", "p", "u")}
            camera = a.replace(**way, phi=(1 - share) * a.phi + share * b.phi)
            words = f"step {number}: {degrees(camera, truth):.1f} degrees off"
            frames.append(frame(picture, camera, scene, words))
    sigma = float(np.rad2deg(np.linalg.norm(fit.std[:3])))
    words = f"{fit.status}: {degrees(fit.camera, truth):.2f} degrees off, sigma {sigma:.2f}"
    frames.append(frame(picture, fit.camera, scene, words))
    lasts = [STAYS // 2] + [EACH] * (len(frames) - 2) + [STAYS]
    more = {"save_all": True, "append_images": frames[1:], "duration": lasts, "loop": 0}
    frames[0].save(asked.out / "fit.webp", **more, quality=80, method=4)
    return {"verdict": f"{len(frames)} frames of a {name}: {words}"}


if __name__ == "__main__":
    main(__doc__, {"gallery": gallery, "fit": fit})
