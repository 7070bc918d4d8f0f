"""What is found on real data, how far is it off, and does the stated sigma say so?

    python experiments/real.py OUT [bottle cow knee lbr]

`../shared/data` holds photos, masks and cameras that others made: a bottle in two photos, a
published render, a robot arm, knee implants under fluoroscopy with an expert's poses. Single
fits start 10 degrees and 5 % of the distance off what is given, the arm from nothing. Errors are
of the object in the camera's frame: turn, sideways, in depth. Answers of others
(`peer_answers.json`) stand beside, and are no truth. The picture has the outlines on the photos.
Times are of what is compiled, but for the arm's; a busy machine makes them longer.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import robots
from _common import folder
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax._camera.poses import at_pose, inverse, pose_of

DATA = Path(__file__).parents[2] / "shared" / "data"
DEGREES, FARTHER = 10.0, 1.05
TILE = (480, 360)


class Drawn(NamedTuple):
    """What the picture shows: a photo (or mask) and the outline that was found on it."""

    title: str
    photo: np.ndarray
    mask: np.ndarray
    camera: pj.Camera
    scene: pj.Scene


class Item(NamedTuple):
    """One fit's line of the table, and its tile of the picture (None: it has no tile)."""

    row: dict[str, Any]
    tile: Drawn | None = None


def off(truth: pj.Camera, scene: pj.Scene, seed: int = 0) -> pj.Camera:
    """Return the camera turned about the scene's middle, about a random axis, and farther away."""
    centre = middle(scene)
    axis = np.random.default_rng(seed).normal(size=3)
    turn = Rotation.from_rotvec(np.deg2rad(DEGREES) * axis / np.linalg.norm(axis)).as_matrix()
    pose = pose_of(truth)
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] = centre + FARTHER * turn @ (pose[:3, 3] - centre)
    return at_pose(truth, pose)


def middle(scene: pj.Scene) -> np.ndarray:
    return np.asarray(scene.mesh.vertices, float).mean(axis=0)


def error(fit: pj.Fit, truth: pj.Camera, scene: pj.Scene) -> dict[str, float]:
    """Return how far a fit is from what is given: the object in the camera's frame."""
    apart = pj.drift(fit, truth)
    centre = np.append(middle(scene), 1)
    there, here = ((inverse(pose_of(c)) @ centre)[:3] for c in (truth, fit.camera))
    shift = here - there
    return {
        "degrees": float(np.rad2deg(apart.angle)),
        "sideways": float(np.hypot(*shift[:2])),
        "depth": float(abs(shift[2])),
        "distance": float(there[2]),
        "most sigmas": float(np.nanmax(np.abs(apart.by))),
    }


def single(
    name: str,
    scene: pj.Scene,
    mask: np.ndarray,
    truth: pj.Camera,
    unit: str,
    free: tuple[str, ...] = ("pose",),
    photo: np.ndarray | None = None,
) -> Item:
    """Return a fit from 10 degrees off; the time is that of the second call, all compiled."""
    start = off(truth, scene)
    pj.fit_camera(scene, mask, start, free=free)
    begin = time.perf_counter()
    fit = pj.fit_camera(scene, mask, start, free=free)
    seconds = time.perf_counter() - begin
    row = {
        "name": name,
        "free": free,
        "unit": unit,
        "status": fit.status,
        **error(fit, truth, scene),
        "sigma degrees": float(np.rad2deg(np.max(fit.std[:3]))),
        "IoU": fit.iou,
        "IoU of what is given": shown_iou(truth, scene, mask),
        "seconds": seconds,
        "weak": fit.weak,
        "modes, degrees off": [error(mode, truth, scene)["degrees"] for mode in fit.modes],
    }
    if "phi" in free:
        k = fit.names.index("phi")
        row["phi, sigmas off"] = float(abs(fit.camera.phi - truth.phi) / fit.std[k])
        row["focal length, % off"] = 100 * float(
            abs(np.tan(truth.phi / 2) / np.tan(fit.camera.phi / 2) - 1)
        )
    shown = photo if photo is not None else np.where(mask, 200, 40).astype(np.uint8)
    return Item(row, Drawn(name, shown, mask, fit.camera, scene))


def bottle() -> Iterator[Item]:
    """Yield the shampoo bottle; what is given is a tracker's pose of photo 200."""
    here = DATA / "photos" / "m3t_shampoo"
    given = json.loads((here / "camera.json").read_text())
    pose = given["objects"]["shampoo"]
    truth = pj.formats.from_opencv(
        given["K"], pose["R"], pose["t"], 960, 540, pixel_centres="integer"
    )
    scene = pj.Scene(mesh=pj.load_mesh(here / "schauma.obj"))
    for photo in ("200", "201"):
        mask = pj.io.load_mask(here / pose["mask"][photo])
        image = pj.io.load_image(here / f"color_camera_image_{photo}.png")
        yield single(f"bottle, photo {photo}", scene, mask, truth, "m", photo=image)


def cow() -> Iterator[Item]:
    """Yield PyTorch3D's published render of a cow: its camera is known exactly."""
    here = DATA / "renders" / "pytorch3d_cow"
    given = json.loads((here / "camera.json").read_text())
    truth = pj.formats.from_opencv(
        given["K"], given["R"], given["t"], 256, 256, pixel_centres="integer"
    )
    scene = pj.Scene(mesh=pj.load_mesh(here / "cow.obj"))
    photo = pj.io.load_image(here / "cow.png")
    mask = photo[..., :3].min(axis=2) < 255
    yield single("cow, a render", scene, mask, truth, "units", ("pose", "phi"), photo)


def knee() -> Iterator[Item]:
    """Yield the implants: masks that are the expert's pose projected, and masks by a network."""
    here = DATA / "knee"
    distance, _, _, pixel = map(float, (here / "calibration.txt").read_text().split()[1:5])
    focal = distance / pixel
    K = np.array([[focal, 0, 512], [0, focal, 512], [0, 0, 1]])
    for bone, file in (("femur", "fem.jts"), ("tibia", "tib.jts")):
        scene = pj.Scene(mesh=pj.load_mesh(here / f"{bone}.stl"))
        lines = (here / file).read_text().splitlines()[2:]
        poses = [[float(x) for x in line.split(",")] for line in lines if line.strip()]
        for kind in ("label", "network"):
            for frame, (x, y, z, *angles) in enumerate(poses):
                # The file's camera looks along -z with y up: R = Rz Rx Ry.
                R = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
                turn = np.diag([1.0, -1, -1])
                truth = pj.formats.from_opencv(
                    K, turn @ R, turn @ [x, y, z], 1024, 1024, pixel_centres="half"
                )
                mask = pj.io.load_mask(here / f"{bone}_{kind}_{frame}.png")
                item = single(f"{bone} {frame}, {kind}", scene, mask, truth, "mm")
                yield item if frame == 0 and kind == "network" else Item(item.row)


def lbr() -> Iterator[Item]:
    """Yield both eyes of the stereo camera, each by itself, then what lies between them."""
    peers = json.loads((robots.DATA / "peer_answers.json").read_text())
    unknown = pj.formats.from_opencv(
        robots.K, np.eye(3), np.zeros(3), 960, 540, pixel_centres="integer"
    )
    fits = {}
    for side in ("left", "right"):
        seen = robots.views(side)
        found, seconds = joint(seen, unknown)
        fit = fits[side] = found.cameras["camera"]
        peer = at_pose(unknown, np.array(peers[f"HT_{side}_dr"]) @ robots.OPTICAL)
        apart = robots.apart(fit, fit._replace(camera=peer, std=np.zeros(6)))
        row = {
            **joint_row(f"LBR, {side} eye, 5 masks", found, seconds),
            "the peer's IoU": [shown_iou(peer, v.scene, v.target) for v in seen],
            "from the peer": apart,
        }
        photo = pj.io.load_image(robots.DATA / f"{side}_3.jpg")
        tile = (photo, np.asarray(seen[3].target), found.views[3].camera, seen[3].scene)
        yield Item(row, Drawn(row["name"], *tile))
    yield Item({"name": "LBR, between the eyes", **robots.stereo(fits["left"], fits["right"])})


def joint(views: list[pj.JointView], camera: pj.Camera) -> tuple[pj.JointFit, float]:
    begin = time.perf_counter()
    found = pj.fit_joint(views, camera, search=True)
    return found, time.perf_counter() - begin


def joint_row(name: str, found: pj.JointFit, seconds: float) -> dict[str, Any]:
    fit = found.cameras["camera"]
    return {
        "name": name,
        "status": found.status,
        "sigma degrees": float(np.rad2deg(np.max(fit.std[:3]))),
        "sigma eye, mm": float(1e3 * np.max(fit.std[3:6])),
        "IoU": [view.iou for view in found.views],
        "seconds, with compilation": seconds,
        "weak": found.weak,
    }


def shown_iou(camera: pj.Camera, scene: pj.Scene, mask: np.ndarray) -> float:
    share = np.asarray(mask, float) / (255 if mask.dtype == np.uint8 else 1)
    return float(pj.iou(pj.silhouette(camera, scene), share))


QUESTIONS: dict[str, Callable[[], Iterator[Item]]] = {
    "bottle": bottle,
    "cow": cow,
    "knee": knee,
    "lbr": lbr,
}


def line(row: dict[str, Any]) -> str:
    """Return a row of the printed table."""
    if "baseline, mm" in row:
        return (
            f"{row['name']:<26}{row['baseline, mm']:.1f} mm apart (truth {robots.BASELINE}),"
            f" {row['degrees from parallel']:.2f} degrees from parallel,"
            f" {row['most sigmas']:.1f} sigma"
        )
    start = f"{row['name']:<26}{row['status']:<16}IoU {np.mean(row['IoU']):.3f}"
    sigma = f"  sigma {row['sigma degrees']:.2f} deg"
    if "degrees" not in row:
        return f"{start}{sigma}, {row['sigma eye, mm']:.1f} mm"
    away = f"  {row['degrees']:.2f} deg, {row['sideways']:.3g} {row['unit']} sideways,"
    depth = f" {row['depth']:.3g} in depth ({row['most sigmas']:.1f} sigma)"
    return f"{start}{sigma}{away}{depth}  {row['seconds']:.2f} s"


def window(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return the part of a picture about a mask, 4:3, some room around."""
    row, column = np.nonzero(mask)
    height = 1.3 * max(np.ptp(row), np.ptp(column) * TILE[1] / TILE[0])
    H, W = mask.shape
    height = int(min(height, H, W * TILE[1] / TILE[0]))
    width = height * TILE[0] // TILE[1]
    left = int(np.clip(column.mean() - width / 2, 0, W - width))
    top = int(np.clip(row.mean() - height / 2, 0, H - height))
    return left, top, left + width, top + height


def draw(tile: Drawn, path: Path) -> None:
    """Draw the outline on the photo."""
    image = pj.plot.overlay(tile.photo, tile.camera, tile.scene, window=window(tile.mask))
    small = Image.fromarray(np.asarray(image)).resize(TILE, Image.Resampling.LANCZOS)
    ImageDraw.Draw(small).text((8, 6), tile.title, fill="white", stroke_width=2, stroke_fill=0)
    path.parent.mkdir(exist_ok=True)
    small.save(path)


def join(tiles: Path, path: Path) -> None:
    """Join the tiles that there are, four in a row."""
    found = [x for name in QUESTIONS for x in sorted(tiles.glob(f"{name}_*.png"))]
    drawn = [np.asarray(Image.open(x)) for x in found]
    drawn += [np.full_like(drawn[0], 255)] * (-len(drawn) % 4)
    rows = [np.concatenate(drawn[k : k + 4], axis=1) for k in range(0, len(drawn), 4)]
    Image.fromarray(np.concatenate(rows)).save(path, quality=80)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    out = folder()
    if not DATA.exists():
        sys.exit(f"skipped: no real data at {DATA}")
    pj.cache()
    path, tiles = out / "real.json", out / "real_tiles"
    # What is not asked for stays as an earlier run has left it.
    answer = json.loads(path.read_text()) if path.exists() else {}
    for name in sys.argv[2:] or QUESTIONS:
        rows = answer[name] = []
        for k, item in enumerate(QUESTIONS[name]()):
            rows.append({**item.row, "load of the machine": round(os.getloadavg()[0], 1)})
            print(line(item.row), flush=True)
            if item.tile is not None:
                draw(item.tile, tiles / f"{name}_{k}.png")
        path.write_text(json.dumps(answer, indent=1) + "\n")
    if tiles.exists():
        join(tiles, out / "real.jpg")


if __name__ == "__main__":
    main()
