"""Does `fit_points` calibrate a camera as OpenCV does? Thirteen photos of a chessboard."""

import time
from pathlib import Path

import cv2
import numpy as np
from _common import SHARED, run

import pinhole_jax as pj

FOLDER = SHARED.parent / "calib" / "opencv_chessboard"
INNER, SQUARE_M = (9, 6), 0.025
NAMES = ("k1", "k2", "p1", "p2", "k3")


def corners(folder: Path) -> tuple[list[str], np.ndarray, tuple[int, int]]:
    """Return photos by name, their inner corners (V, N, 2) as OpenCV counts pixels, and (W, H)."""
    names, found, size = [], [], (0, 0)
    for file in sorted(folder.glob("*.jpg")):
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        seen, at = cv2.findChessboardCorners(grey, INNER)
        if not seen:
            raise RuntimeError(f"no chessboard in {file.name}")
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
        names.append(file.name)
        found.append(cv2.cornerSubPix(grey, at, (11, 11), (-1, -1), stop).reshape(-1, 2))
        size = grey.shape[::-1]
    return names, np.array(found, float), size


def board() -> np.ndarray:
    """Return the corners on the board (N, 3), metres."""
    i, j = np.meshgrid(np.arange(INNER[0]), np.arange(INNER[1]))
    return SQUARE_M * np.stack([i.ravel(), j.ravel(), 0 * i.ravel()], axis=-1)


def by_opencv(points: np.ndarray, seen_at: np.ndarray, size: tuple[int, int]) -> dict:
    """Return OpenCV's calibration with one focal length, as `fit_points` has it here."""
    start = np.array([[500.0, 0, size[0] / 2], [0, 500.0, size[1] / 2], [0, 0, 1]])
    began = time.perf_counter()
    rms, K, k, _, _ = cv2.calibrateCamera(
        [points.astype(np.float32)] * len(seen_at),
        list(seen_at.astype(np.float32)),
        size,
        start,
        None,
        flags=cv2.CALIB_FIX_ASPECT_RATIO,
    )
    took = time.perf_counter() - began
    numbers = {"rms_px": rms, "focal_px": K[0, 0], "cx": K[0, 2], "cy": K[1, 2]}
    return {**numbers, **dict(zip(NAMES, k.ravel(), strict=True)), "seconds": took}


def by_fit(points: np.ndarray, seen_at: np.ndarray, size: tuple[int, int]) -> tuple[dict, tuple]:
    """Return the same by `fit_points`, from a field of view of 60 degrees and no pose."""
    W, H = size
    start = pj.Camera([0, 0, 1], [0, 0, 0], [0, 1, 0], np.deg2rad(60), W=W, H=H)
    film = np.stack([seen_at[..., 0] + 0.5, H - 0.5 - seen_at[..., 1]], axis=-1)
    pj.fit_points(points, film, start)  # compiles
    began = time.perf_counter()
    fits = pj.fit_points(points, film, start)
    took = time.perf_counter() - began
    camera, lens = fits[0].camera, fits[0].camera.lens
    x, y = (float(z) for z in lens.principal_point)
    coefficients = {name: float(getattr(lens.distortion, name)) for name in NAMES}
    numbers = {
        "rms_px": float(np.sqrt(np.mean([f.rms_px**2 for f in fits]))),
        "focal_px": float(H / (2 * np.tan(float(camera.phi) / 2))),
        "cx": x - 0.5,
        "cy": H - 0.5 - y,
    }
    return {**numbers, **coefficients, "seconds": took}, fits


def question() -> dict:
    names, seen_at, size = corners(FOLDER)
    theirs = by_opencv(board(), seen_at, size)
    ours, fits = by_fit(board(), seen_at, size)
    std = dict(zip(fits[0].names, fits[0].std.tolist(), strict=True))
    off = abs(ours["focal_px"] / theirs["focal_px"] - 1)
    print(
        f"{len(names)} photos: reprojection error {ours['rms_px']:.4f} px (OpenCV"
        f" {theirs['rms_px']:.4f}), focal length {off:.4%} off OpenCV's, k1 by"
        f" {abs(ours['k1'] - theirs['k1']):.5f}; {', '.join(sorted({f.status for f in fits}))}"
    )
    for key in theirs:
        print(f"{key:<9} {ours[key]:12.6f} {theirs[key]:12.6f}  {std.get(key, np.nan):.2g}")
    views = {n: {"rms_px": f.rms_px, "status": f.status} for n, f in zip(names, fits, strict=True)}
    kept = {key: std[key] for key in NAMES}
    return {"fit_points": ours, "opencv": theirs, "std": kept, "views": views}


if __name__ == "__main__":
    run(question)
