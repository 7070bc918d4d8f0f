"""What the command line tells of the camera: a file, K, a field of view, a photo's EXIF data; and
that the mask shows a part of its picture, or is resized."""

import argparse
import contextlib
import math
from collections.abc import Callable
from typing import Any, NamedTuple

from .. import BrownConrady, Camera, Lens, Rational
from .._files.naming import named
from ..formats import cropped, from_opencv, read_intrinsics, read_one, resized, to_opencv
from ..io import photo_fov

Size = tuple[int, int]
#: A field of view (degrees) below this one is none; a principal point that is farther from the
#: middle than this share of the picture's width is unusual.
LEAST_FOV, MOST_OFF = 1.0, 0.1


def names_of(text: str) -> tuple[str, ...]:
    """Return the names of an option, which stand between commas; focal is phi."""
    names = (name.strip() for name in text.split(","))
    return tuple("phi" if name == "focal" else name for name in names if name)


def unplaced(phi: Any, W: int, H: int, lens: Lens | None = None) -> Camera:
    """Return a camera with a known lens and no known pose: 1 unit from the origin."""
    return Camera([0, 0, 1], [0, 0, 0], [0, 1, 0], phi, 1.0, W, H, lens)


class Known(NamedTuple):
    """What `fit_camera` is given: a camera to start from, or field of view (rad) and lens."""

    camera: Camera | None = None
    phi: Any = None
    lens: Lens | None = None


def known(
    options: argparse.Namespace, free: tuple[str, ...], size: Size, tell: Callable[[str], Any]
) -> Known:
    """Return what the options tell of the camera of a mask of this size (W, H).

    Raises ValueError for options that go together with others, and for sizes that differ.
    """
    if options.K is None and options.dist is not None:
        raise ValueError("`--dist`: expected --K beside it, got none")
    window = _window(options, size)
    if options.camera is not None:
        camera = _of_file(options.camera, window.beside)
        return Known(camera=window.of(camera))
    if options.K is not None:
        camera = _of_K(options, window.beside)
        if window.crop is None:
            check_centre(camera, options.pixel_centres, tell)
        camera = window.of(camera, "--K")
        return Known(phi=camera.phi, lens=camera.lens)
    if window.crop:
        raise ValueError(
            "`--crop`: expected --camera or --K beside it (a field of view is that of the whole"
            " photo, whose size --crop does not tell), got none"
        )
    if options.fov is not None:
        check_fov(options.fov, tell)
        phi = math.radians(options.fov)
    else:
        phi = _phi_of_photo(options, free, tell)
    if phi is None or window.before == size:
        return Known(phi=phi)
    with named(phi="--fov"):
        camera = window.of(unplaced(phi, *window.before))
    return Known(phi=camera.phi, lens=camera.lens)


def check_fov(fov: float, tell: Callable[[str], Any]) -> None:
    """Raise ValueError unless this is a field of view in degrees; warn where it may be rad."""
    if not 0 < fov < 180:
        raise ValueError(f"`--fov`: expected degrees between 0 and 180, got {fov:g}")
    words = f"got {fov:g}: degrees? {fov:g} rad are {math.degrees(fov):.1f} degrees"
    if fov < LEAST_FOV:
        raise ValueError(f"`--fov`: expected at least {LEAST_FOV:g} degree, {words}")
    if fov < math.pi:
        tell(f"note: --fov {words}")


def check_centre(camera: Camera, pixel_centres: Any, tell: Callable[[str], Any]) -> None:
    """Raise ValueError where the principal point of `--K` is outside the picture; warn where it is
    far from the middle."""
    size = W, H = camera.W, camera.H
    (_, _, cx), (_, fy, cy), _ = to_opencv(camera, pixel_centres=pixel_centres)[0].tolist()
    near = lambda x, y: math.hypot(x - W / 2, y - H / 2) <= MOST_OFF * W
    if near(cx, cy):
        return
    if near(cy, cx):
        hint = "are CX and CY exchanged?"
    elif near(fy, cy):
        hint = "the order is FX FY CX CY"
    else:
        hint = "was the picture resized? --resize W H is the size that --K belongs to"
        if min(cx, cy) > 0 and abs(cx / W / (cy / H) - 1) < MOST_OFF:
            hint += f" (some {2 * cx:.0f} x {2 * cy:.0f})"
    point = f"({cx:g}, {cy:g}) px in a picture of {_words(size)}: {hint}"
    if not (0 <= cx <= W and 0 <= cy <= H):
        raise ValueError(f"`--K`: expected a principal point inside the picture, got {point}")
    off = f"{cx - W / 2:+.0f}, {cy - H / 2:+.0f} px from the middle"
    tell(f"note: --K has its principal point {off}, at {point}")


class _Window(NamedTuple):
    """What of the camera's picture the mask shows: its window (left, top, W, H; None: all), the
    size (W, H) before it was resized, and the mask's."""

    crop: tuple[float, float, int, int] | None
    before: Size
    size: Size

    @property
    def beside(self) -> Size:
        """Return a picture's size that holds the window."""
        if self.crop is None:
            return self.before
        left, top, W, H = self.crop
        return math.ceil(max(left, 0)) + W, math.ceil(max(top, 0)) + H

    def of(self, camera: Camera, option: str = "--camera") -> Camera:
        """Return the mask's camera, where this is the whole picture's."""
        with named(W="--crop", H="--crop"):
            if self.crop is not None:
                camera = cropped(camera, *self.crop)
        if self.crop is None and self.before != (camera.W, camera.H):
            size = _words((camera.W, camera.H))
            if self.before != self.size:
                words = f"expected the size of {option}, {size}, got {_words(self.before)}"
                raise ValueError(f"`--resize`: {words}")
            raise ValueError(
                f"`{option}`: expected a camera of {_words(self.before)}, got one of {size}; if"
                " MASK was cut out of its picture, or resized, add --crop or --resize"
            )
        return camera if self.before == self.size else resized(camera, *self.size)


def _window(options: argparse.Namespace, size: Size) -> _Window:
    crop = None
    before = size if options.resize is None else (options.resize[0], options.resize[1])
    if min(before) < 1:
        raise ValueError(f"`--resize`: expected a width and height in px, got {_words(before)}")
    if options.crop is not None:
        left, top, W, H = options.crop
        if W % 1 or H % 1 or min(W, H) < 1:
            raise ValueError(f"`--crop`: expected a width and height in px, got {W:g} x {H:g}")
        crop = (left, top, int(W), int(H))
        if crop[2:] != before and options.resize is None:
            raise ValueError(
                f"`--crop`: expected MASK's size {_words(size)}, got {_words(crop[2:])}; if it was"
                f" resized after that, add --resize {crop[2]} {crop[3]}"
            )
        if crop[2:] != before:
            words = f"expected the size of --crop, {_words(crop[2:])}, got {_words(before)}"
            raise ValueError(f"`--resize`: {words}")
    return _Window(crop, before, size)


def _words(size: Size) -> str:
    return f"{size[0]} x {size[1]}"


def _of_file(path: str, size: Size) -> Camera:
    """Return a file's camera; of this size where it does not hold its own."""
    with named(path="--camera", size="--resize"):
        with contextlib.suppress(ValueError):
            return read_one(path)
        return read_one(path, size=size)


def _of_K(options: argparse.Namespace, size: Size) -> Camera:
    """Return a camera with the intrinsics of `--K`, `--dist`, `--pixel-centres`."""
    centres = options.pixel_centres
    model = None
    if options.dist is not None:
        model = (Rational if len(options.dist) == 8 else BrownConrady)(*options.dist)
    if isinstance(options.K, str):
        with named(path="--K"):
            camera = read_intrinsics(options.K, size=size, pixel_centres=centres)
        if model is not None and camera.distortion is not None:
            raise ValueError(f"`--dist`: expected none beside the lens of {options.K!r}")
        if model is None:
            return camera
        matrices = to_opencv(camera, pixel_centres=centres)
        return from_opencv(*matrices, camera.W, camera.H, pixel_centres=centres, distortion=model)
    fx, fy, cx, cy = options.K
    if not all(map(math.isfinite, options.K)):
        words = " ".join(f"{x:g}" for x in options.K)
        raise ValueError(f"`--K`: expected four finite numbers (px), got {words}")
    K, turn = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    with named(K="--K", lens="--dist"):
        return from_opencv(K, turn, [0, 0, 0], *size, pixel_centres=centres, distortion=model)


def _phi_of_photo(
    options: argparse.Namespace, free: tuple[str, ...], tell: Callable[[str], Any]
) -> float | None:
    """Return what the EXIF data of the photo (or the mask, if it is one) say of phi, and say so."""
    fov = photo_fov(options.image or options.mask)
    focal_is_free = bool({"phi", "d"} & {*free})
    if fov is None:
        if not focal_is_free:
            raise ValueError(
                "expected --camera, --K or --fov, or phi among --free, got none of them (and no"
                " EXIF data that tell the field of view)"
            )
        return None
    held = "a first guess" if focal_is_free else "held: phi is not among --free"
    tell(f"phi: {math.degrees(fov.phi):.2f} degrees by EXIF's {fov.words}; {held}")
    return fov.phi
