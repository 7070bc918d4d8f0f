"""Does a photo put right what its mask has wrong?

Photos are traced: shading, self-shadows, the object's shadow on a wall, three textures, clutter
with edges of its own, blur, noise, JPEG. Masks are grown, shrunk or wavy by 1 to 3 px. Each is
fitted without and with the photo, from 3 degrees off; errors are of the camera and, in px, of the
mesh's vertices on the film.
"""

import io
import time
from pathlib import Path

import numpy as np
from _common import camera_at, degrees, meshes, percentiles, run, trials
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from wrong_masks import signed_distance

import pinhole_jax as pj

W, H, PHI = 640, 480, 0.6
#: Rays a pixel, each way.
FINE = 2
TEXTURES = ("plain", "mottled", "patches")
#: How a mask is wrong: by how many px a smooth field moves its edge.
MASKS = ("grown", "shrunk", "wavy")


def waves(points: np.ndarray, random: np.random.Generator, scale: float, count: int = 12):
    """Return a smooth random field of about unit variance at points (..., n)."""
    total = np.zeros(points.shape[:-1])
    for _ in range(count):
        wave = random.normal(size=points.shape[-1]) / scale
        total += np.sin(points @ wave + random.uniform(0, 2 * np.pi))
    return total * (2 / count) ** 0.5


def painted(points: np.ndarray, random: np.random.Generator, texture: str, base: np.ndarray):
    """Return the albedo (..., 3) of a surface: one colour, mottled, or patches of up to four."""
    albedo = np.broadcast_to(base, (*points.shape[:-1], 3)).copy()
    if texture == "patches":
        for _ in range(3):
            colour = np.clip(base + 0.35 * random.normal(size=3), 0.03, 0.95)
            albedo[waves(points, random, 0.3) > 0.7] = colour
    if texture in ("patches", "mottled"):
        albedo *= np.exp(0.12 * waves(points, random, 0.08) + 0.1 * waves(points, random, 0.03))[
            ..., None
        ]
    return albedo


def clutter(random: np.random.Generator, shape: tuple[int, int], base: np.ndarray) -> np.ndarray:
    """Return a backdrop (h, w, 3): boxes and discs of all colours on a mottled wall."""
    h, w = shape
    row, column = np.mgrid[:h, :w] / h
    image = painted(np.stack([row, column], -1), random, "mottled", base)
    for _ in range(random.integers(15, 50)):
        y, x = random.uniform(0, 1), random.uniform(0, w / h)
        a, b, turn = *random.uniform(0.03, 0.2, 2), random.uniform(0, np.pi)
        u = (row - y) * np.cos(turn) + (column - x) * np.sin(turn)
        v = (column - x) * np.cos(turn) - (row - y) * np.sin(turn)
        inside = (
            (abs(u) < a) & (abs(v) < b) if random.uniform() < 0.5 else np.hypot(u / a, v / b) < 1
        )
        image[inside] = random.uniform(0.03, 0.9, 3) * (1 + 0.3 * (u[inside, None] / a))
    return image


def photo_of(
    camera: pj.Camera, scene: pj.Scene, random: np.random.Generator, texture: str, cluttered: bool
):
    """Return a photo (H, W, 3), uint8: traced with shading and shadows, blurred, noisy, a JPEG."""
    fine = pj.Camera(camera.e, camera.p, camera.u, camera.phi, 1.0, W * FINE, H * FINE)
    rays = pj.camera_rays(fine)
    hit = pj.trace(scene, rays)
    eye, to = np.asarray(rays.origin, float), np.asarray(rays.direction, float)
    t = np.asarray(hit.t, float)
    met = np.isfinite(t)
    basis = np.stack([np.asarray(x, float) for x in pj.camera_basis(camera)])
    light = (
        np.array([random.uniform(-1, 1), random.uniform(0.3, 1.2), random.uniform(-1.2, -0.4)])
        @ basis
    )
    light /= np.linalg.norm(light)

    where = eye + np.where(met, t, 0)[..., None] * to
    normal = np.asarray(hit.normal, float)
    normal *= -np.sign(np.sum(normal * to, -1, keepdims=True))
    lit = np.clip(normal @ light, 0, 1)
    lit *= ~hidden(scene, where + 1e-3 * normal, light)
    paint = random.uniform(0.08, 0.8, 3)
    albedo = painted(where, random, texture, paint)
    half = light - to
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    shine = random.uniform(0, 0.25) * np.clip(np.sum(half * normal, -1), 0, 1) ** 30 * (lit > 0)
    ambient = random.uniform(0.2, 0.5)
    front = albedo * (ambient + (1 - ambient) * lit)[..., None] + shine[..., None]

    # A wall behind the object, which its shadow falls on.
    behind = 1.25 + random.uniform(0, 1)
    far = (np.linalg.norm(eye) + behind) / (to @ basis[2])
    wall = eye + far[..., None] * to
    dark = hidden(scene, wall, light)
    base = random.uniform(0.08, 0.8, 3)
    if np.linalg.norm(base - paint) < 0.3:  # an object is not the colour of the wall
        base = 1 - paint
    back = clutter(random, met.shape, base) if cluttered else painted(wall, random, "mottled", base)
    back = back * np.where(dark, ambient + 0.2, 1.0)[..., None]

    image = np.where(met[..., None], front, back)
    image = image.reshape(H, FINE, W, FINE, 3).mean(axis=(1, 3))
    image = gaussian_filter(image, (*[random.uniform(0.5, 1.2)] * 2, 0))
    image = np.clip(image, 0, 1) ** (1 / 2.2)
    image = image + random.uniform(2, 6) / 255 * random.normal(size=image.shape)
    file = io.BytesIO()
    Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(
        file, "JPEG", quality=92
    )
    return np.asarray(Image.open(file))


def hidden(scene: pj.Scene, points: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return whether the scene keeps the light from points."""
    origin = np.asarray(points, scene.mesh.vertices.dtype)
    towards = np.broadcast_to(light.astype(origin.dtype), origin.shape)
    return np.asarray(pj.occluded(scene, pj.Rays(origin, towards)))


def spoiled(image: np.ndarray, kind: str, px: float, random: np.random.Generator) -> np.ndarray:
    """Return a hard mask whose edge is wrong by some px."""
    distance = signed_distance(image)
    if kind != "wavy":
        return distance > (px if kind == "shrunk" else -px)
    field = gaussian_filter(random.normal(size=image.shape), random.uniform(6, 20))
    return distance > px * field / field.std()


def on_film(scene: pj.Scene, a: pj.Camera, b: pj.Camera) -> float:
    """Return by how many px (rms) two cameras show the vertices apart."""
    apart = np.asarray(pj.project(a, scene.mesh.vertices) - pj.project(b, scene.mesh.vertices))
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=-1))))


def trial(number: int, name: str, scene: pj.Scene) -> tuple[dict, np.ndarray]:
    """Return what a mask and its photo lead to, and the photo."""
    random = np.random.default_rng(10_000 + number)
    axes = Rotation.random(random_state=random).as_matrix()
    distance = random.uniform(1.1, 2.0) / np.sin(PHI / 2)
    truth = camera_at(axes, random.uniform(-0.1, 0.1, 2), distance, PHI)
    truth = pj.Camera(truth.e, truth.p, truth.u, truth.phi, 1.0, W, H)
    texture, cluttered = TEXTURES[number % 3], bool(random.integers(2))
    photo = photo_of(truth, scene, random, texture, cluttered)
    kind, px = MASKS[(number // 3) % 3], int(random.integers(1, 4))
    mask = spoiled(np.asarray(pj.silhouette(truth, scene)), kind, px, random)

    turn = Rotation.from_rotvec(np.deg2rad(3) * axes[number % 3]).as_matrix()
    e, p, u = (np.float32(turn @ np.asarray(x, float)) for x in (truth.e, truth.p, truth.u))
    start = pj.Camera(e, p, u, truth.phi, 1.0, W, H)
    fits = {"mask": pj.fit_camera(scene, mask, start)}
    begun = time.perf_counter()
    fits["photo"] = pj.fit_camera(scene, mask, start, photo=photo)
    row = {"shape": name, "texture": texture, "cluttered": cluttered, "mask": kind, "px": px}
    for what, fit in fits.items():
        row[f"{what}_degrees"] = degrees(fit.camera, truth)
        row[f"{what}_eye"] = float(pj.pose_error(fit.camera, truth)[1]) / distance
        row[f"{what}_px"] = on_film(scene, fit.camera, truth)
    row["seconds"] = time.perf_counter() - begun
    row["word"] = fits["photo"].weak[-1]
    return row, photo


def question() -> dict:
    """Return all rows, and how errors with a photo compare to those without."""
    scenes = dict(meshes("spot.obj", "bob.obj", "suzanne.ply"))
    total, rows = trials(36), []
    for number in range(total):
        # All trials of a shape follow one another: they share compiled programs.
        name = list(scenes)[number * len(scenes) // total]
        row, photo = trial(number, name, scenes[name])
        rows.append(row)
        if number < 4:
            PHOTOS.append(photo)
        print(row, flush=True)
    answer: dict = {"rows": rows}
    for measure in ("degrees", "eye", "px"):
        share = [row[f"photo_{measure}"] / row[f"mask_{measure}"] for row in rows]
        answer[measure] = {
            "mask": percentiles(row[f"mask_{measure}"] for row in rows),
            "photo": percentiles(row[f"photo_{measure}"] for row in rows),
            "median ratio": float(np.median(share)),
            "at most a third": float(np.mean(np.array(share) <= 1 / 3)),
        }
    px, angle = answer["px"], answer["degrees"]
    print(
        f"{total} photos: the median error is {px['photo']['median']:.2f} px on the film, by masks"
        f" alone {px['mask']['median']:.2f}; at most a third of the mask's in"
        f" {px['at most a third']:.0%} (on the film), {angle['at most a third']:.0%} (angle)"
    )
    return answer


PHOTOS: list[np.ndarray] = []


def draw(answer: dict, path: Path) -> None:
    """Draw error with the photo against error without, and some photos."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 4), width_ratios=(1, 1, 1.35))
    for axis, measure, unit in ((axes[0], "px", "px on the film"), (axes[1], "degrees", "degrees")):
        for kind in MASKS:
            rows = [row for row in answer["rows"] if row["mask"] == kind]
            x, y = ([row[f"{what}_{measure}"] for row in rows] for what in ("mask", "photo"))
            axis.loglog(x, y, "o", label=f"{kind} mask")
        ends = np.array([min(1e-1, *axis.get_xlim()), axis.get_xlim()[1]])
        axis.loglog(ends, ends, "k-", lw=0.8)
        axis.loglog(ends, ends / 3, "k--", lw=0.8, label="a third")
        axis.set(xlabel=f"error by the mask ({unit})", ylabel=f"with the photo ({unit})")
    axes[0].legend(fontsize=8)
    tiles = [np.concatenate(PHOTOS[k : k + 2], axis=1) for k in range(0, len(PHOTOS) - 1, 2)]
    axes[2].imshow(np.concatenate(tiles))
    axes[2].axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    run(question, draw)
