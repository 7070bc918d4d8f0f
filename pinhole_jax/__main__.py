"""The command line: `pinhole-jax fit`, `render` and `convert`; also `python -m pinhole_jax`."""

import argparse
import atexit
import contextlib
import gc
import math
import sys
from collections.abc import Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from ._command.arguments import parse
from ._command.progress import Clock, Progress


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 for a fit that is not to be trusted, 2 on bad input, 130 if
    interrupted."""
    options = parse(arguments)
    for stream in (sys.stdout, sys.stderr):  # names of files need be no text that can be printed
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        run = {"fit": _fit, "render": _render, "convert": _convert}[options.command]
        return run(options)
    except (ValueError, OSError) as error:
        print(f"pinhole-jax {options.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # what was being written is whole or not there
        print(f"pinhole-jax {options.command}: interrupted", file=sys.stderr)
        return 130


def _fit(options: argparse.Namespace) -> int:
    with Progress("reading", options.verbose) as progress:
        _set_up_jax(options)
        import numpy as np

        from . import formats, io, report
        from ._fit.fit_camera import fit_camera
        from ._scene.scene import Scene
        from .plot import overlay

        clock = Clock()
        free = tuple(name.strip() for name in options.free.split(",") if name.strip())
        mask = io.load_mask(options.mask, options.mask_from, progress.tell, invert=options.invert)
        size = mask.shape[1], mask.shape[0]
        start = None if options.camera is None else formats.read_one(options.camera, size=size)
        known = {"phi": None if options.fov is None else options.fov * np.pi / 180}
        if options.K is not None:
            known = _of_K(options, size)
        elif options.dist is not None:
            raise ValueError("`--dist`: expected --K beside it, got none")
        if start is None and known["phi"] is None:
            known["phi"] = _phi_of_photo(options, free, progress)
        weight = None
        if options.weight is not None:
            weight = io.load_mask(options.weight, "luminance") / 255.0
        picture = mask if options.image is None else io.load_image(options.image)
        if picture.shape[:2] != mask.shape:
            (h, w), (H, W) = picture.shape[:2], mask.shape
            raise ValueError(f"`--image`: expected the mask's size {W} x {H}, got {w} x {h}")
        scene = Scene(mesh=io.load_mesh(options.mesh))
        progress.say("fitting (compiling on the first run)")
        told = lambda level: progress.say(str(level))
        given = {**known, "weight": weight, "record": options.report is not None}
        fit = fit_camera(scene, mask, start, free, progress=told, **given)
        progress.say("drawing")
        drawing = overlay(picture, fit.camera, scene)
    folder = Path(options.output)
    io.save_fit(folder / "camera.json", fit)
    io.save_image(folder / "overlay.png", drawing)
    written = [folder / "camera.json", folder / "overlay.png"]
    if options.report is not None and fit.status != "non_finite":
        title = f"Camera of {Path(options.mesh).name} from {Path(options.mask).name}"
        with Progress("drawing the page"):
            report.write(options.report, fit, scene, mask, picture, title)
        written.append(options.report)
    print(fit)
    print(
        f"time       {clock.compiling:.1f} s compile, {clock.elapsed() - clock.compiling:.1f} s run"
    )
    print(f"written    {', '.join(map(str, written))}")
    return 0 if fit.status == "converged" else 1


def _of_K(options: argparse.Namespace, size: tuple[int, int]) -> dict[str, Any]:
    """Return field of view and lens of `--K`, `--dist`, `--pixel-centres`."""
    from . import formats
    from ._camera.distortion import BrownConrady, Rational

    fx, fy, cx, cy = options.K
    K, turn = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    bent = options.dist
    if bent is not None and len(bent) not in (4, 5, 8):
        raise ValueError(f"`--dist`: expected 4, 5 or 8 coefficients, got {len(bent)}")
    model = None if bent is None else (Rational if len(bent) == 8 else BrownConrady)(*bent)
    centres = options.pixel_centres
    camera = formats.from_opencv(K, turn, [0, 0, 0], *size, pixel_centres=centres, distortion=model)
    return {"phi": camera.phi, "lens": camera.lens}


def _phi_of_photo(
    options: argparse.Namespace, free: tuple[str, ...], progress: Progress
) -> float | None:
    """Return what the EXIF data of the photo (or the mask, if it is one) say of phi, and say so."""
    from . import io

    fov = io.photo_fov(options.image or options.mask)
    focal_is_free = bool({"phi", "d"} & {*free})
    if fov is None:
        if not focal_is_free:
            raise ValueError(
                "expected --camera or --fov, or phi among --free, got none of them (and no EXIF"
                " data that tell the field of view)"
            )
        return None
    held = "a first guess" if focal_is_free else "held: phi is not among --free"
    progress.tell(f"phi: {math.degrees(fov.phi):.2f} degrees by EXIF's {fov.words}; {held}")
    return fov.phi


def _render(options: argparse.Namespace) -> int:
    with Progress("rendering"):
        _set_up_jax(options)
        from . import formats, io
        from ._scene.scene import Scene
        from ._silhouette.silhouette import silhouette

        camera = formats.read_one(options.camera)
        if camera.W * camera.H > io.MOST_PIXELS:
            words = f"at most {io.MOST_PIXELS} pixels, got {camera.W} x {camera.H}"
            raise ValueError(f"`camera`: expected {words} (in {options.camera!r})")
        scene = Scene(mesh=io.load_mesh(options.mesh))
        import numpy as np

        image = np.asarray(silhouette(camera, scene))
    io.save_image(options.output, image)
    _say_written(options.output, f"{camera.W} x {camera.H}, {image.mean():.1%} covered")
    return 0


def _convert(options: argparse.Namespace) -> int:
    _set_up_jax(options)
    from . import formats

    size = None if options.size is None else (options.size[0], options.size[1])
    cameras = formats.read(options.input, options.source, size=size)
    formats.write(options.output, cameras, options.target)
    target = options.target or formats.guess_write(options.output)
    sizes = ", ".join(dict.fromkeys(f"{camera.W} x {camera.H}" for camera in cameras.values()))
    count = "1 camera" if len(cameras) == 1 else f"{len(cameras)} cameras"
    _say_written(options.output, f"{target}, {count}, {sizes}")
    return 0


def _say_written(path: str, words: str) -> None:
    """Say so, on stderr where the file went to stdout or a pipe."""
    from ._files.paths import is_stream

    print(f"written    {path} ({words})", file=sys.stderr if is_stream(path) else sys.stdout)


def _set_up_jax(options: argparse.Namespace) -> None:
    """Set what an application may and a library may not: float64, a cache of compiled programs."""
    import jax

    # Tracing makes objects that stay: to look for garbage among them takes a third of the start.
    gc.set_threshold(1_000_000)
    atexit.register(gc.freeze)
    jax.config.update("jax_enable_x64", True)
    if not options.no_cache:
        from ._files.cache import cache

        with contextlib.suppress(ValueError):  # a user without a home folder
            cache()


if __name__ == "__main__":
    sys.exit(main())
