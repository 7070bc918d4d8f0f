"""What is found on real data that others made, how far off, and does sigma say so?

    python experiments/real.py PART [OUT], a PART of single | robots | knee | chessboards | split |
                                           photos | demos | command

- `single`: a bottle in two photos, a published render of a cow, knee implants under fluoroscopy:
  fits from 10 degrees and 5 % of the distance off, beside what a tracker, a renderer or an expert
  gives. The picture has the outlines.
- `robots`: a KUKA arm, five postures before a stereo camera: each eye is fitted by itself, with no
  start, then with the photos. That both are 120.09 mm apart, and parallel, no fit knows.
- `knee`: femur and tibia of a frame as two objects of one fit, from 3 degrees, 3, 3, 15 mm off.
- `chessboards`: does `fit_points` calibrate as OpenCV does? Thirteen photos.
- `split`: do halves of each of these differ by no more than their error bars say? Odd and even
  views or photos, alternate blocks of a lone outline, odd and even corners. (`--resume` goes on.)
- `photos`: what a photo adds where the mask is off by 1 to 3 px: traced, textured, lit, noisy.
- `demos`: four published pose demonstrations (PyTorch3D, nvdiffrast, Mitsuba, redner), redone from
  the outline alone, the whole pose free.
- `command`: how long does `pinhole-jax fit` take with no start: a bottle's mask by
  GrabCut, implants' masks by a network? Twice: with no programs kept, and with them.

`../shared/data` holds what is real; where it is not there, a part says so and is skipped. Errors
are of the object in the camera's frame. (A coffee cup: `coffee_cup.py`.)
"""

import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from _common import (
    DATA,
    NORMAL_95,
    SHARED,
    Options,
    axes_of,
    camera_at,
    degrees,
    main,
    mask_of,
    meshes,
    percentiles,
    resized,
    show,
    start_from,
    trials,
    turn_by,
)
from honesty import signed_distance, waves
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import pinhole_jax as pj

KNEE, LBR = DATA / "knee", DATA / "robots" / "lbr_med7"
TILE = (480, 360)


def pose_of(camera: pj.Camera) -> np.ndarray:
    """Return world_from_camera (4, 4): x right, y down, z forward."""
    right, up, forward = axes_of(camera)
    return rigid(np.stack([right, -up, forward], axis=1), np.asarray(camera.e, float))


def rigid(turn: np.ndarray, shift: Any) -> np.ndarray:
    return np.vstack([np.column_stack([turn, shift]), [0, 0, 0, 1]])


def at_pose(camera: pj.Camera, pose: np.ndarray) -> pj.Camera:
    _, down, forward = pose[:3, :3].T
    e, to = pose[:3, 3], np.asarray(camera.e).dtype
    return camera.replace(e=e.astype(to), p=(e + forward).astype(to), u=(-down).astype(to))


def given_camera(K: Any, R: Any, t: Any, W: int, H: int, centres: str = "integer") -> pj.Camera:
    return pj.formats.from_opencv(K, R, t, W, H, pixel_centres=centres)


def there(path: Path) -> bool:
    """True if data are there; prints a line if they are not."""
    if not path.exists():
        print(f"skipped: there is no {path}")
    return path.exists()


# Single fits

Item = tuple[str, pj.Scene, np.ndarray, pj.Camera, np.ndarray]


def bottle() -> Iterator[Item]:
    """Yield a shampoo bottle; what is given is a tracker's pose of photo 200."""
    here = DATA / "photos" / "m3t_shampoo"
    given = json.loads((here / "camera.json").read_text())
    pose = given["objects"]["shampoo"]
    truth = given_camera(given["K"], pose["R"], pose["t"], 960, 540)
    scene = pj.Scene(mesh=pj.load_mesh(here / "schauma.obj"))
    for number, path in pose["mask"].items():
        image = pj.io.load_image(here / f"color_camera_image_{number}.png")
        yield f"bottle {number}", scene, pj.io.load_mask(here / path), truth, image


def cow() -> Iterator[Item]:
    """Yield PyTorch3D's published render of a cow: its camera is known exactly."""
    here = DATA / "renders" / "pytorch3d_cow"
    given = json.loads((here / "camera.json").read_text())
    truth = given_camera(given["K"], given["R"], given["t"], 256, 256)
    image = pj.io.load_image(here / "cow.png")
    mask = image[..., :3].min(axis=2) < 255
    yield "cow", pj.Scene(mesh=pj.load_mesh(here / "cow.obj")), mask, truth, image


def implants() -> Iterator[Item]:
    """Yield implants: masks that are an expert's pose projected, and masks by a network."""
    for bone in BONES:
        scene = pj.Scene(mesh=pj.load_mesh(KNEE / f"{bone}.stl"))
        for kind in ("label", "network"):
            for frame, pose in enumerate(expert(bone)):
                mask = pj.io.load_mask(KNEE / f"{bone}_{kind}_{frame}.png")
                truth = at_pose(fluoroscope(), np.linalg.inv(pose))
                yield f"{bone} {frame}, {kind}", scene, mask, truth, mask


def error(fit: pj.Fit, truth: pj.Camera, scene: pj.Scene) -> dict[str, float]:
    """Return a fit's errors against the given pose: the object in the camera's frame."""
    apart = pj.drift(fit, truth)
    centre = np.append(np.asarray(scene.mesh.vertices, float).mean(axis=0), 1)
    here, right = (np.linalg.solve(pose_of(c), centre)[:3] for c in (fit.camera, truth))
    return {
        "degrees": float(np.rad2deg(apart.angle)),
        "sigma": float(np.rad2deg(np.max(fit.std[:3]))),
        "sideways": float(np.hypot(*(here - right)[:2])),
        "in depth": float(abs((here - right)[2])),
        "most sigmas": float(np.nanmax(np.abs(apart.by))),
    }


def off(truth: pj.Camera, scene: pj.Scene) -> pj.Camera:
    """Return the camera turned by 10 degrees about the scene's middle, and 5 % farther away."""
    centre = np.asarray(scene.mesh.vertices, float).mean(axis=0)
    turn, pose = turn_by(10, np.random.default_rng(0).normal(size=3)), pose_of(truth)
    away = centre + 1.05 * turn @ (pose[:3, 3] - centre)
    return at_pose(truth, rigid(turn @ pose[:3, :3], away))


def single(asked: Options) -> dict:
    if not there(DATA):
        return {"verdict": "skipped: no real data", "table": []}
    rows, tiles = [], []
    for name, items in {"bottle": bottle, "cow": cow, "knee": implants}.items():
        for item in items() if name in asked.names([name]) else ():
            title, scene, mask, truth, image = item
            free = ("pose", "phi") if name == "cow" else ("pose",)
            fit = pj.fit_camera(scene, mask, off(truth, scene), free)
            rows.append({"": title, "status": fit.status, **error(fit, truth, scene)})
            rows[-1]["IoU"] = fit.iou
            print(rows[-1], flush=True)
            if "label" not in title:
                tiles.append(tile(image, fit.camera, scene, mask))
            if asked.quick:
                break
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % 4)
    lines = [np.concatenate(tiles[k : k + 4], axis=1) for k in range(0, len(tiles), 4)]
    pj.io.save_image(asked.out / "real_single.jpg", np.concatenate(lines))
    show(rows)
    return verdict(rows)


def verdict(rows: list[dict]) -> dict:
    """Return the number of trusted fits, and of those that are wrong."""
    sure = [row for row in rows if row["status"] == "converged"]
    false = [row for row in sure if row["most sigmas"] > 4 and row["degrees"] > 0.5]
    worst = max((row["most sigmas"] for row in sure), default=0)
    words = (
        f"{len(sure)} of {len(rows)} `converged`, {len(false)} falsely, {worst:.1f} sigma at most"
    )
    return {"verdict": words, "table": rows}


def tile(image: np.ndarray, camera: pj.Camera, scene: pj.Scene, mask: np.ndarray) -> np.ndarray:
    """Draw the outline on the part of a picture about the mask."""
    row, column = np.nonzero(mask)
    H, W = mask.shape
    height = 1.3 * max(np.ptp(row), np.ptp(column) * TILE[1] / TILE[0])
    height = int(min(height, H, W * TILE[1] / TILE[0]))
    width = height * TILE[0] // TILE[1]
    left = int(np.clip(column.mean() - width / 2, 0, W - width))
    top = int(np.clip(row.mean() - height / 2, 0, H - height))
    window = (left, top, left + width, top + height)
    drawn = Image.fromarray(np.asarray(pj.plot.overlay(image, camera, scene, window=window)))
    return np.asarray(drawn.convert("RGB").resize(TILE, Image.Resampling.LANCZOS))


# A robot

K = [[534.6265258789062, 0, 478.0846252441406], [0, 534.6265258789062, 260.9943542480469],
     [0, 0, 1]]  # fmt: skip
BASELINE = 120.09
HALVES = ((0, 2, 4), (1, 3)), ((0, 1), (2, 3, 4))


def postures(side: str) -> list[pj.JointView]:
    robot = pj.robots.load_urdf(LBR / "lbr_med7.urdf")
    angles = json.loads((LBR / "joints.json").read_text())["postures"]
    masks = [pj.io.load_mask(LBR / f"{side}_mask_{k}.png") for k in range(len(angles))]
    return [pj.JointView(robot.scene(q), mask) for q, mask in zip(angles, masks, strict=True)]


def stereo(fits: dict[str, pj.Fit]) -> dict:
    """Return the right eye's pose from the left one: turns and shifts, also in sigmas."""
    left, right = (pose_of(fits[side].camera) for side in ("left", "right"))
    step = np.linalg.solve(left, right)
    turn = Rotation.from_matrix(step[:3, :3]).as_rotvec()
    shift = left[:3, :3] @ (step[:3, 3] - [BASELINE / 1e3, 0, 0])
    sigma = np.hypot(*(fits[side].std for side in ("left", "right")))
    by = np.abs(np.append(turn * [1, -1, 1], shift) / sigma)
    return {
        "baseline, mm": float(1e3 * np.linalg.norm(step[:3, 3])),
        "degrees from parallel": float(np.rad2deg(np.linalg.norm(turn))),
        "most sigmas": float(np.max(by)),
        "intervals that hold": int(np.sum(by < NORMAL_95)),
    }


def robots(asked: Options) -> dict:
    if not there(LBR):
        return {"verdict": "skipped: no robot", "table": {}}
    unknown, ways = given_camera(K, np.eye(3), np.zeros(3), 960, 540), {}
    for side in ("left", "right"):
        seen = postures(side)
        found = {"masks": pj.fit_joint(seen, unknown, search=True)}
        if not asked.quick:
            photos = [pj.io.load_image(LBR / f"{side}_{k}.jpg") for k in range(len(seen))]
            both = [v._replace(photo=x) for v, x in zip(seen, photos, strict=True)]
            found["photos"] = pj.fit_joint(both, found["masks"].camera)
            views = [found["photos"].views[k].camera for k in (0, 2, 4)]
            drawn = [pj.plot.overlay(photos[k], c, seen[k].scene)[60:, 320:800]
                     for k, c in zip((0, 2, 4), views, strict=True)]  # fmt: skip
            pj.io.save_image(asked.out / f"robots_{side}.jpg", np.concatenate(drawn, axis=1))
        for way, fit in found.items():
            row = {"status": fit.status, "IoU": float(np.mean([v.iou for v in fit.views]))}
            if way == "masks" and not asked.quick:
                half = lambda some, s=seen, f=fit: pj.fit_joint([s[k] for k in some], f.camera)
                pairs = [[half(some).cameras["camera"] for some in pair] for pair in HALVES]
                row["halves, degrees"] = [degrees(a.camera, b.camera) for a, b in pairs]
            ways.setdefault(way, {})[side] = fit.cameras["camera"]
            print(side, way, row, flush=True)
    table = {way: stereo(fits) for way, fits in ways.items()}
    show({"": way, **row} for way, row in table.items())
    said = [
        f"{way}: {row['baseline, mm']:.1f} mm apart (truth {BASELINE}),"
        f" {row['degrees from parallel']:.2f} degrees from parallel"
        for way, row in table.items()
    ]
    return {"verdict": "; ".join(said), "table": table}


# A knee

BONES = {"femur": "fem.jts", "tibia": "tib.jts"}


def fluoroscope() -> pj.Camera:
    distance, _, _, pixel = map(float, (KNEE / "calibration.txt").read_text().split()[1:5])
    K = np.array([[distance / pixel, 0, 512], [0, distance / pixel, 512], [0, 0, 1]])
    return given_camera(K, np.eye(3), np.zeros(3), 1024, 1024, "half")


def expert(bone: str) -> list[np.ndarray]:
    """Return poses in the camera's frame; the file's looks along -z with y up: R = Rz Rx Ry."""
    poses, turn = [], np.diag([1.0, -1, -1])
    for line in (KNEE / BONES[bone]).read_text().splitlines()[2:]:
        if line.strip():
            *place, a, b, c = map(float, line.split(","))
            rotation = Rotation.from_euler("ZXY", [a, b, c], degrees=True).as_matrix()
            poses.append(rigid(turn @ rotation, turn @ place))
    return poses


def knee(asked: Options) -> dict:
    if not there(KNEE):
        return {"verdict": "skipped: no knee", "table": []}
    scenes = {bone: pj.Scene(mesh=pj.load_mesh(KNEE / f"{bone}.stl")) for bone in BONES}
    rows, frames = [], range(1 if asked.quick else 3)
    for kind, frame in itertools.product(("label", "network"), frames):
        random, views, start = np.random.default_rng(frame), [], {}
        for bone, scene in scenes.items():
            mask = pj.io.load_mask(KNEE / f"{bone}_{kind}_{frame}.png")
            views.append(pj.JointView(scene, mask, object=bone))
            pose = expert(bone)[frame]
            middle = np.asarray(scene.mesh.vertices, float).mean(axis=0)
            turn = turn_by(3, random.normal(size=3)) @ pose[:3, :3]
            place = (pose @ np.append(middle, 1))[:3] + random.choice([-1, 1], 3) * [3, 3, 15]
            start[bone] = rigid(turn, place - turn @ middle)
        both = pj.fit_joint(views, fluoroscope(), (), objects=start)
        for bone, found in both.objects.items():
            truth = expert(bone)[frame]
            turn = Rotation.from_matrix(found.pose[:3, :3].T @ truth[:3, :3]).as_rotvec()
            by = np.append(turn, truth[:3, 3] - found.pose[:3, 3]) / found.std
            row = {"": f"{bone} {frame}, {kind}", "status": both.status}
            row["degrees"] = float(np.rad2deg(np.linalg.norm(turn)))
            row["sigma"] = float(np.rad2deg(np.max(found.std[:3])))
            rows.append({**row, "most sigmas": float(np.max(np.abs(by)))})
    show(rows)
    return verdict(rows)


# Chessboards

BOARDS = DATA / "calib" / "opencv_chessboard"
INNER, SQUARE_M = (9, 6), 0.025
NAMES = ("k1", "k2", "p1", "p2", "k3")


def corners(folder: Path) -> tuple[np.ndarray, tuple[int, int]]:
    """Return inner corners by photo (V, N, 2) as OpenCV counts pixels, and (W, H)."""
    import cv2

    found, size = [], (0, 0)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
    for file in sorted(folder.glob("*.jpg")):
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        at = cv2.findChessboardCorners(grey, INNER)[1]
        found.append(cv2.cornerSubPix(grey, at, (11, 11), (-1, -1), stop).reshape(-1, 2))
        size = grey.shape[::-1]
    return np.array(found, float), size


def board() -> np.ndarray:
    """Return the corners on the board (N, 3), metres."""
    i, j = np.meshgrid(np.arange(INNER[0]), np.arange(INNER[1]))
    return SQUARE_M * np.stack([i.ravel(), j.ravel(), 0 * i.ravel()], axis=-1)


def by_opencv(points: np.ndarray, seen_at: np.ndarray, size: tuple[int, int]) -> dict:
    """Return OpenCV's calibration with one focal length, as `fit_points` has it here."""
    import cv2

    start = np.array([[500.0, 0, size[0] / 2], [0, 500.0, size[1] / 2], [0, 0, 1]])
    given = [points.astype(np.float32)] * len(seen_at), [*seen_at.astype(np.float32)], size, start
    rms, K, k, *_ = cv2.calibrateCamera(*given, None, flags=cv2.CALIB_FIX_ASPECT_RATIO)
    return {"rms_px": rms, "focal_px": K[0, 0], **dict(zip(NAMES, k.ravel(), strict=True))}


def by_fit(points: np.ndarray, seen_at: np.ndarray, size: tuple[int, int]) -> tuple[dict, tuple]:
    """Return the same by `fit_points`, from a field of view of 60 degrees and no pose."""
    W, H = size
    start = pj.Camera([0, 0, 1], [0, 0, 0], [0, 1, 0], np.deg2rad(60), W=W, H=H)
    fits = pj.fit_points(points, film_of(seen_at, H), start)
    camera = fits[0].camera
    rms = float(np.sqrt(np.mean([f.rms_px**2 for f in fits])))
    numbers = {"rms_px": rms, "focal_px": float(H / (2 * np.tan(float(camera.phi) / 2)))}
    return {**numbers, **{k: float(getattr(camera.lens.distortion, k)) for k in NAMES}}, fits


def film_of(seen_at: np.ndarray, H: int) -> np.ndarray:
    """Return OpenCV's pixels (..., 2) on the film."""
    return np.stack([seen_at[..., 0] + 0.5, H - 0.5 - seen_at[..., 1]], axis=-1)


def chessboards(asked: Options) -> dict:
    if not there(BOARDS):
        return {"verdict": "skipped: no chessboards", "table": []}
    given = board(), *corners(BOARDS)
    ours, theirs = by_fit(*given)[0], by_opencv(*given)
    show([{"": "fit_points", **ours}, {"": "OpenCV", **theirs}])
    apart = abs(ours["focal_px"] / theirs["focal_px"] - 1)
    words = f"{ours['rms_px']:.4f} px (OpenCV {theirs['rms_px']:.4f}), focal length {apart:.1e} off"
    return {"verdict": words, "ours": ours, "theirs": theirs}


# Halves

PANDA = DATA / "robots" / "panda"
HAND = ["panda_hand", "panda_leftfinger", "panda_rightfinger"]
#: Halves are to differ by at most this many sigmas (rms).
WIDE = 1.3
#: What fits a half, and the halves.
Split = tuple[Callable[[Any], Any], tuple[Any, Any]]


def views_split(views: list[pj.JointView], unknown: pj.Camera) -> Split:
    """Return odd and even views of a robot; each half starts from the fit to all views."""
    whole = pj.fit_joint(views, unknown, search=True)
    return lambda half: pj.fit_joint(half, whole.camera), (views[::2], views[1::2])


def kuka(side: str) -> Iterator[Split]:
    yield views_split(postures(side), given_camera(K, np.eye(3), np.zeros(3), 960, 540))


def panda() -> Iterator[Split]:
    K = np.loadtxt(PANDA / "K.txt").reshape(3, 3)
    robot = pj.robots.load_urdf(PANDA / "panda.urdf", HAND)
    given = json.loads((PANDA / "joints.json").read_text())
    angles = [dict(zip(given["names"], row, strict=True)) for row in given["postures"]]
    masks = [pj.io.load_mask(PANDA / f"mask_{k}.png") for k in range(len(angles))]
    views = [pj.JointView(robot.scene(q), mask) for q, mask in zip(angles, masks, strict=True)]
    yield views_split(views, given_camera(K, np.eye(3), np.zeros(3), 640, 480))


def outlines(items: Iterable[Item], free: tuple[str, ...] = ("pose",)) -> Iterator[Split]:
    """Yield alternate blocks of each lone outline, but for misfits: they claim no error bars."""
    for name, scene, mask, truth, _ in items:
        whole = pj.fit_camera(scene, mask, off(truth, scene), free)
        if whole.status == "misfit":
            print(f"{name}: a misfit", flush=True)
            continue
        refit = lambda w, s=scene, m=mask, c=whole.camera: pj.fit_camera(s, m, c, free, weight=w)
        yield refit, pj.outline_halves(mask, whole.mask_error)


def implants_of(name: str) -> Iterator[Split]:
    """Yield the splits of a bone's frames, by its name and that of the masks."""
    bone, kind = name.split(" by ")
    yield from outlines(x for x in implants() if x[0].startswith(bone) and kind in x[0])


def board_photos() -> Iterator[Split]:
    """Yield odd and even photos of a chessboard: what they share is the lens."""
    points, (seen_at, size) = board(), corners(BOARDS)
    film, lens = film_of(seen_at, size[1]), by_fit(points, seen_at, size)[1][0].camera
    yield lambda x: pj.fit_points(points, x, lens), (film[::2], film[1::2])


def board_corners() -> Iterator[Split]:
    """Yield odd and even corners of each photo, with the lens that all photos show."""
    points, (seen_at, size) = board(), corners(BOARDS)
    odd = np.arange(len(points)) % 2
    seen = zip(film_of(seen_at, size[1]), by_fit(points, seen_at, size)[1], strict=True)
    for film, fit in seen:
        yield lambda w, x=film, c=fit.camera: pj.fit_points(points, x, c, weights=w), (odd, 1 - odd)


#: Sets of real data: the splits, and how many mm a unit has (None: it has no size).
SPLITS: dict[str, tuple[Callable[[], Iterator[Split]], float | None]] = {
    "KUKA left": (lambda: kuka("left"), 1e3),
    "KUKA right": (lambda: kuka("right"), 1e3),
    "Panda": (panda, 1e3),
    "femur by label": (lambda: implants_of("femur by label"), 1.0),
    "tibia by label": (lambda: implants_of("tibia by label"), 1.0),
    "femur by network": (lambda: implants_of("femur by network"), 1.0),
    "tibia by network": (lambda: implants_of("tibia by network"), 1.0),
    "bottle": (lambda: outlines(bottle()), 1e3),
    "cow": (lambda: outlines(cow(), ("pose", "phi")), None),
    "chessboards": (board_photos, 1e3),
    "corners": (board_corners, 1e3),
}


def number_of(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def halved(number: int, name: str) -> dict:
    """Return the checks of a set's splits, and their rms over all parameters."""
    del number
    (splits, mm), checks = SPLITS[name], []
    for refit, halves in splits():
        check = pj.split_check(refit, halves)
        print(f"{name}: {check}", flush=True)
        part, row = check.parts[0], {"statuses": [*check.statuses], "rms": check.rms}
        row |= {"chance": check.chance, "count": check.parameters * check.is_conclusive}
        row |= {
            "degrees": number_of(np.rad2deg(part.angle)),
            "mm": mm and number_of(mm * part.shift),
        }
        checks.append(row)
    told = [row for row in checks if row["count"]]
    squares = [row["count"] * row["rms"] ** 2 for row in told]
    most = lambda key: max((row[key] for row in told if row[key] is not None), default=None)
    return {
        "rms": float((sum(squares) / sum(x["count"] for x in told)) ** 0.5) if told else None,
        "splits": len(told),
        "degrees": most("degrees"),
        "mm": most("mm"),
        "checks": checks,
    }


def split(asked: Options) -> dict:
    if not there(DATA):
        return {"verdict": "skipped: no real data", "sets": {}}
    names = asked.names(SPLITS)
    place = lambda name: f"real-split-{name.replace(' ', '-')}"
    sets = {name: trials(asked, place(name), 1, [(name,)], halved)[0] for name in names}
    show({"": name, **{k: row[k] for k in [*row][:4]}} for name, row in sets.items())
    known = {name: row["rms"] for name, row in sets.items() if row["splits"]}
    wide = [f"{name} {rms:.2f}" for name, rms in known.items() if rms > WIDE]
    words = f"{len(known) - len(wide)} of {len(known)} sets within {WIDE} sigma (rms)"
    wide += [f"{name}: cannot tell" for name in sets if name not in known]
    return {"verdict": "; ".join([words, *wide]), "sets": sets}


# Photos


def pattern(points: np.ndarray, random: np.random.Generator, scale: float) -> np.ndarray:
    """Return a smooth random field of about unit variance at points (..., n), on a last axis."""
    turns = random.normal(size=(points.shape[-1], 12)) / scale
    field = np.sin(points @ turns + random.uniform(0, 2 * np.pi, 12)).sum(axis=-1, keepdims=True)
    return field / 6**0.5


def photo_of(camera: pj.Camera, scene: pj.Scene, random: np.random.Generator) -> np.ndarray:
    """Return a photo (H, W, 3), uint8: mottled, lit, before coloured discs, blurred, noisy."""
    rays = pj.camera_rays(camera, samples=2)
    hit = pj.trace(scene, rays)
    shape = (camera.H, camera.W, -1, 1)
    t, normal = np.asarray(hit.t, float)[..., None], np.asarray(hit.normal, float)
    to = np.asarray(rays.direction, float)
    where = np.asarray(rays.origin, float) + np.where(np.isfinite(t), t, 6) * to
    light = np.array([random.uniform(-1, 1), 0.8, random.uniform(-1.2, -0.4)]) @ axes_of(camera)
    lit = 0.35 + 0.65 * np.abs(normal @ (light / np.linalg.norm(light)))[..., None]
    paint = random.uniform(0.1, 0.8, 3)
    front = paint * lit * np.exp(0.12 * pattern(where, random, 0.08))
    back = (0.9 - paint) * np.exp(0.15 * pattern(where, random, 0.3))
    for _ in range(20):
        inside = np.linalg.norm(where - random.uniform(-2, 2, 3), axis=-1) < 0.6
        back[inside] = random.uniform(0.03, 0.9, 3)
    image = np.where(np.isfinite(t), front, back).reshape(*shape[:3], 3).mean(axis=2)
    image = gaussian_filter(image, (0.8, 0.8, 0)).clip(0, 1) ** (1 / 2.2)
    noise = random.uniform(2, 6) / 255 * random.normal(size=image.shape)
    return np.round(255 * np.clip(image + noise, 0, 1)).astype(np.uint8)


def photos(asked: Options) -> dict:
    rows, scenes = [], [*meshes("spot.obj", "suzanne.ply")]
    for number in range(asked.seed, asked.seed + asked.number(12)):
        name, scene = scenes[number % len(scenes)]
        random = np.random.default_rng(10_000 + number)
        axes = Rotation.random(random_state=random).as_matrix()
        distance = random.uniform(1.1, 2.0) / np.sin(0.3)
        truth = resized(camera_at(axes, random.uniform(-0.1, 0.1, 2), distance, 0.6), 640, 480)
        image, inside = photo_of(truth, scene, random), signed_distance(mask_of(truth, scene))
        by = random.choice([-1, 1]) * random.uniform(1, 3)
        mask = inside > (waves(inside.shape, random) if number % 3 else by)
        start, row = start_from(truth, 3, 0.0, random), {"": name}
        points = scene.mesh.vertices
        for kind, more in (("mask", {}), ("photo", {"photo": image})):
            fit = pj.fit_camera(scene, mask, start, **more)
            apart = np.asarray(pj.project(fit.camera, points) - pj.project(truth, points))
            row[f"{kind}, px"] = float(np.sqrt(np.mean(np.sum(apart**2, axis=-1))))
            row[f"{kind}, degrees"] = degrees(fit.camera, truth)
        rows.append(row)
    show(rows)
    medians = {k: percentiles(row[k] for row in rows)["median"] for k in rows[0] if k}
    words = f"{medians['mask, px']:.2f} px by the mask, {medians['photo, px']:.2f} with the photo"
    return {"verdict": f"{words} (medians)", "medians": medians, "table": rows}


# Published demonstrations


def look_at(eye: Any, target: Any, fov: float, size: int) -> pj.Camera:
    return pj.Camera(eye, target, [0.0, 1, 0], np.deg2rad(fov), 1.0, size, size)


def as_if_moved(camera: pj.Camera, turn: np.ndarray, shift: Any, centre: Any = 0.0) -> pj.Camera:
    """Return the camera that sees the object at rest as `camera` sees it moved: first turned about
    a centre, then shifted."""
    axes = axes_of(camera) @ turn
    eye = turn.T @ (np.asarray(camera.e) - centre - np.asarray(shift)) + centre
    return camera.replace(e=eye, p=eye + axes[2], u=axes[1])


def cases() -> Iterator[tuple[str, pj.Mesh, pj.Camera, pj.Camera | None, bool]]:
    """Yield each demonstration: its mesh, camera and start, and whether its mask is hard."""
    pot, spot = (pj.load_mesh(SHARED / name) for name in ("teapot.obj", "spot.obj"))
    scaled = lambda mesh, by: pj.Mesh(by * np.asarray(mesh.vertices), mesh.faces)
    a = np.deg2rad(50)
    truth = look_at([0, 3 * np.sin(a), 3 * np.cos(a)], [0, 0, 0], 60, 256)
    start = look_at([3, 6.9, 2.5], [0, 0, 0], 60, 256)
    yield "PyTorch3D", scaled(pot, 0.319064), truth, start, True
    truth, mesh = look_at([0, 30, 200], [0, 30, 0], 45, 256), scaled(pot, 25.0)
    turn = Rotation.from_euler("xyz", [0.1, -0.1, 0.1]).as_matrix()
    middle = np.asarray(mesh.vertices).mean(axis=0)
    yield "redner", mesh, truth, as_if_moved(truth, turn, [10, -10, 10], middle), False
    truth = look_at([0, 0, 2], [0, 0, 0], 60, 64)
    turn = Rotation.from_euler("y", 25, degrees=True).as_matrix()
    points = np.asarray(spot.vertices)
    low, high = points.min(axis=0), points.max(axis=0)
    mesh = pj.Mesh((points - (low + high) / 2) / (high - low)[1], spot.faces)
    yield (
        "Mitsuba (a cow for its bunny)",
        mesh,
        truth,
        as_if_moved(truth, turn, [0.1, -0.25, 0]),
        False,
    )
    front = look_at([0, 0, 3.5], [0, 0, 0], np.rad2deg(2 * np.arctan(0.4)), 256)
    import trimesh

    cube = trimesh.creation.box()
    turn = Rotation.random(random_state=0).as_matrix()
    yield (
        "nvdiffrast",
        pj.Mesh(cube.vertices, cube.faces),
        as_if_moved(front, turn, 0.0),
        None,
        False,
    )


def demos(asked: Options) -> dict:
    if not there(SHARED):
        return {"verdict": "skipped: no meshes", "table": []}
    rows, cube = [], Rotation.create_group("O").as_matrix()
    for name, mesh, truth, start, hard in cases():
        scene = pj.Scene(mesh=mesh)
        mask = mask_of(truth, scene)
        phi = truth.phi if start is None else None
        fit = pj.fit_camera(scene, mask > 0.5 if hard else mask, start, phi=phi)
        # What a cube's turns onto itself show is the same.
        same = [truth] if start else [as_if_moved(truth, turn, 0.0) for turn in cube]
        off = min(degrees(fit.camera, c) for c in same)
        rows.append({"": name, "status": fit.status, "degrees": off, "modes": len(fit.modes)})
    show(rows)
    worst = max(row["degrees"] for row in rows)
    return {"verdict": f"All four are found, the worst {worst:.2g} degrees off", "table": rows}


# The command

#: A mesh, a mask, and what is known of the camera.
COMMANDS = {
    "bottle": "photos/m3t_shampoo/schauma.obj photos/m3t_shampoo/shampoo_mask_200.png"
    " --K 698.128 698.617 478.459 274.426",
    "femur": "knee/femur.stl knee/femur_network_0.png --K 3211.8 3211.8 511.5 511.5",
    "tibia": "knee/tibia.stl knee/tibia_network_0.png --K 3211.8 3211.8 511.5 511.5",
}


def command(asked: Options) -> dict:
    rows = []
    for name, words in COMMANDS.items() if there(DATA) else ():
        with tempfile.TemporaryDirectory() as out:
            fit = [sys.executable, "-m", "pinhole_jax", "fit", *words.split(), "-o", out]
            first, again = (processor_seconds(fit, XDG_CACHE_HOME=out) for _ in range(2))
            status = pj.io.load_json(f"{out}/camera.json")["fit"]["status"]
        rows.append({"": name, "status": status, "first s": first, "again s": again})
    show(rows)
    return {"verdict": "Seconds, first and again: see the table", "table": rows}


def processor_seconds(line: list[str], **environment: str) -> float:
    """The processor's seconds that a command line takes in the data's folder."""
    spent = lambda: sum(os.times()[2:4])  # by children
    begin = spent()
    subprocess.run(line, cwd=DATA, env=os.environ | environment, stdout=-1, check=False)
    return spent() - begin


if __name__ == "__main__":
    parts = (single, robots, knee, chessboards, split, photos, demos, command)
    main(__doc__, {f.__name__: f for f in parts})
