"""The files that a record names, read: for `fit_one` and for every command."""

import contextlib
import functools
import math
import os
import threading
from typing import Any, NamedTuple

import numpy as np

import pinhole_jax as pj

from .._files.naming import named
from .._files.progress import tell
from .records import PICTURES, Record, files_of, setting

Size = tuple[int, int]
#: A field of view (degrees) below `LEAST_FOV` is a mistake. A principal point farther from the
#: middle than this share of the picture's width is unusual.
LEAST_FOV, MOST_OFF = 1.0, 0.1
#: Fields that are arguments of `fit_camera`.
AS_THEY_ARE = ("outlier_px", "max_steps", "prior", "bounds")
#: This many meshes are kept.
MESHES = 8
#: Threads read one mesh after another: the mesh is kept.
_reading = threading.Lock()


class Start(NamedTuple):
    """A camera to start from, or else the field of view (rad) and the lens where they are known."""

    camera: pj.Camera | None = None
    phi: Any = None
    lens: pj.Lens | None = None


def read_inputs(record: Record) -> dict[str, Any]:
    """Return the arguments of `fit_camera` that a record has, the mesh read last; `photo` is for
    refinement or for drawing.

    Raises ValueError naming the wrong field.
    """
    if str(record["mesh"]).lower().endswith(PICTURES):
        words = f"expected triangles, got the picture {record['mesh']!r}"
        raise ValueError(f"`mesh`: {words}: are `mesh` and `mask` exchanged?")
    mask = read_mask(record)
    known = read_start(record, (mask.shape[1], mask.shape[0]))._asdict()
    known |= {"target": mask, "free": setting(record, "free")}
    if "weight" in record:
        with named(path="weight"):
            known["weight"] = pj.io.load_mask(record["weight"], "luminance") / 255.0
    if "photo" in record:
        known["photo"] = read_photo(record["photo"], mask)
    known |= {name: record[name] for name in AS_THEY_ARE if name in record}
    return {**known, "scene": read_scene(record["mesh"])}


def read_mask(record: Record) -> np.ndarray:
    """Return the mask (H, W), uint8, without the crumbs and pinholes that `tidy` removes."""
    mask, invert = record["mask"], setting(record, "invert")
    with named(path="mask", rle="mask"):
        if isinstance(mask, str):
            image = pj.io.load_mask(mask, record.get("mask_from"), tell, invert=invert)
        else:
            image = pj.io.mask_of_rle(mask)
            image = 255 - image if invert else image
    if speck := setting(record, "tidy"):
        image, notes = pj.io.tidy_mask(image, *([] if speck is True else [speck]))
        changes = [note for note in notes if note.endswith(("dropped", "filled"))]
        if shown := notes if speck is True else changes:
            hint = "turn this off with `tidy` (on the command line: --no-tidy)"
            tell(f"mask: {'; '.join(shown)}; {hint}")
    return image


def read_photo(path: str, mask: np.ndarray) -> np.ndarray:
    """Return a photo (H, W, 3) of the mask's size."""
    with named(path="photo"):
        picture = pj.io.load_image(path, rgb=True)
    if picture.shape[:2] != mask.shape:
        (h, w), (H, W) = picture.shape[:2], mask.shape
        raise ValueError(f"`photo`: expected the mask's size {W} x {H}, got {w} x {h} ({path})")
    return picture


def read_scene(path: str) -> pj.Scene:
    """Return the mesh of a file, which is kept as long as the file stays the same."""
    changed = 0.0
    with contextlib.suppress(OSError, TypeError, ValueError):  # its reader says why
        changed = os.stat(path).st_mtime
    with named(path="mesh", vertices="mesh"), _reading:
        scene, notes = _scene(path, changed)
    for note in notes:
        tell(note)
    return scene


@functools.lru_cache(MESHES)
def _scene(path: str, changed: float) -> tuple[pj.Scene, list[str]]:
    """Return a mesh's scene, and notes on it."""
    del changed
    notes: list[str] = []
    scene = pj.Scene(mesh=pj.load_mesh(path, say=notes.append))
    return scene, [note.replace("`path`", "`mesh`") for note in notes]


# The camera.


def read_start(record: Record, size: Size) -> Start:
    """Return the camera, or its field of view and lens, for a mask of this size (W, H).

    Raises ValueError for fields that do not go together, and for sizes that differ.
    """
    ways = [name for name in ("camera", "K", "fov") if name in record]
    if len(ways) > 1:
        raise ValueError(f"`{ways[1]}`: expected none with `{ways[0]}`")
    for name, needed in (("start", ["K"]), ("dist", ["K"]), ("crop", ["camera", "K"])):
        if name in record and not {*ways} & {*needed}:
            words = f"expected `{'` or `'.join(needed)}` with it, got none"
            raise ValueError(f"`{name}`: {words}")
    left, top, W, H = window = _window(record, size)
    picture = math.ceil(max(left, 0)) + W, math.ceil(max(top, 0)) + H
    if ways == ["camera"]:
        with named(path="camera", size="resize"):
            try:
                camera = pj.formats.read_one(record["camera"])
            except ValueError:  # perhaps as the file does not tell its size
                camera = pj.formats.read_one(record["camera"], size=picture)
    elif ways == ["K"]:
        camera = _K_camera(record, picture)
        if "crop" not in record:
            _check_centre(camera, setting(record, "pixel_centres"))
    elif (phi := _phi(record)) is None:
        return Start()
    else:
        camera = poseless_camera(phi, *picture)
    if "crop" in record:
        camera = pj.formats.cropped(camera, *window)
    elif (W, H) != (camera.W, camera.H):
        raise ValueError(
            f"`{ways[0]}`: expected a camera of the mask's size {W} x {H}, got one of"
            f" {camera.W} x {camera.H}; if the mask was cut out of its picture, or resized, add"
            " `crop` or `resize`"
        )
    if size != (W, H):
        camera = pj.formats.resized(camera, *size)
    has_pose = ways == ["camera"] or "start" in record
    return Start(camera) if has_pose else Start(phi=camera.phi, lens=camera.lens)


def poseless_camera(phi: Any, W: int, H: int, lens: pj.Lens | None = None) -> pj.Camera:
    """Return a camera of no known pose: 1 unit from the origin."""
    return pj.Camera([0, 0, 1], [0, 0, 0], [0, 1, 0], phi, 1.0, W, H, lens)


def _window(record: Record, size: Size) -> tuple[float, float, int, int]:
    """Return the mask's window (left, top, W, H) in the picture, before it was resized."""
    W, H = numbers_of("resize", record.get("resize", size), 2)
    left, top, w, h = numbers_of("crop", record.get("crop", (0, 0, W, H)), 4)
    for field, sides in (("resize", (W, H)), ("crop", (w, h))):
        if min(sides) < 1 or any(side % 1 for side in sides):
            words = f"expected a width and height in px, got {sides[0]:g} x {sides[1]:g}"
            raise ValueError(f"`{field}`: {words}")
    if (w, h) != (W, H):
        raise ValueError(
            f"`crop`: expected the size of the mask or of `resize`, {W:g} x {H:g}, got {w:g} x"
            f" {h:g}; if the mask was resized after that, add `resize` {w:g} {h:g}"
        )
    return left, top, int(w), int(h)


def _K_camera(record: Record, size: Size) -> pj.Camera:
    """Return the camera of `K`, `dist`, `pixel_centres` and `start`; at the origin without."""
    K, centres, distortion = record["K"], setting(record, "pixel_centres"), None
    if "dist" in record:
        numbers = numbers_of("dist", record["dist"], 4, 5, 8)
        distortion = (pj.Rational if len(numbers) == 8 else pj.BrownConrady)(*numbers)
    if "K" in files_of(record):
        with named(path="K"):
            camera = pj.formats.read_intrinsics(K, size=size, pixel_centres=centres)
        if distortion is not None and camera.distortion is not None:
            raise ValueError(f"`dist`: expected none with the lens of {K!r}")
        matrix, *_ = pj.formats.to_opencv(camera, pixel_centres=centres)
        distortion, size = distortion or camera.distortion, (camera.W, camera.H)
    else:
        matrix = numbers_of("K", K, 4, 9)
        if len(matrix) == 4:
            fx, fy, cx, cy = matrix
            matrix = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    pose = np.reshape(numbers_of("start", record.get("start", np.eye(4)), 16), (4, 4))
    posed = np.reshape(matrix, (3, 3)), pose[:3, :3], pose[:3, 3]
    with named(lens="dist", R="start", t="start"):
        return pj.formats.from_opencv(*posed, *size, pixel_centres=centres, distortion=distortion)


def numbers_of(name: str, value: Any, *counts: int) -> list[float]:
    """Return a value's numbers in a row; a text holds them between blanks or commas.

    Raises ValueError for others than one of these counts of finite numbers.
    """
    with contextlib.suppress(TypeError, ValueError):
        parts = value.replace(",", " ").split() if isinstance(value, str) else value
        numbers = np.asarray(parts, float).ravel()
        if len(numbers) in counts and np.all(np.isfinite(numbers)):
            return numbers.tolist()
    words = f"expected {' or '.join(map(str, counts))} finite numbers"
    raise ValueError(f"`{name}`: {words}, got {value!r}")


def _check_centre(camera: pj.Camera, pixel_centres: Any) -> None:
    """Raise ValueError for a principal point outside the picture; tell if it is far from the
    middle."""
    W, H = camera.W, camera.H
    cx, cy = pj.formats.to_opencv(camera, pixel_centres=pixel_centres)[0][:2, 2]
    if math.hypot(cx - W / 2, cy - H / 2) <= MOST_OFF * W:
        return
    point = (
        f"at ({cx:g}, {cy:g}) px in a picture of {W} x {H}: is the order fx fy cx cy? If the"
        " picture was cut or resized, add `crop`, or `resize` with the size that `K` belongs to"
    )
    if not (0 <= cx < W - 1 and 0 <= cy < H - 1):
        raise ValueError(f"`K`: expected a principal point inside the picture, got one {point}")
    tell(f"note: `K` has its principal point far from the middle, {point}")


def _phi(record: Record) -> float | None:
    """Return the field of view (rad) of `fov`, or of the EXIF data of the photo or the mask."""
    if "fov" in record:
        check_fov(record["fov"])
        return math.radians(record["fov"])
    source, free = "photo" if "photo" in record else "mask", setting(record, "free")
    names = free.split(",") if isinstance(free, str) else free
    focal_is_free = any(name.strip() in ("phi", "d") for name in names)
    with named(path=source):
        photo = record.get(source)
        fov = pj.io.photo_fov(photo) if isinstance(photo, str) else None
    if fov is not None:
        words = f"{math.degrees(fov.phi):.2f} degrees by EXIF's {fov.words}"
        tell(f"phi: {words}, held fixed unless phi is free")
        return fov.phi
    if focal_is_free:
        return None
    raise ValueError(
        "expected the field of view, got none: give `camera`, `K` or `fov`, or add phi to `free`"
        " (the EXIF data do not say it)"
    )


def check_fov(fov: Any) -> None:
    """Raise ValueError unless this is a field of view in degrees; tell if it may be radians."""
    hint, is_real = "", isinstance(fov, int | float) and not isinstance(fov, bool)
    if is_real and 0 < fov < math.pi:
        hint = f": degrees? {fov:g} rad are {math.degrees(fov):.1f} degrees"
    if not (is_real and LEAST_FOV <= fov < 180):
        words = f"expected degrees between {LEAST_FOV:g} and 180, got {fov!r}"
        raise ValueError(f"`fov`: {words}{hint}")
    if hint:
        tell(f"note: `fov`: got {fov:g}{hint}")
