"""The command line: `pinhole-jax fit`, `render`, `hand-eye`, `check`, `batch`, `studio`, `convert`;
also `python -m pinhole_jax`."""

import argparse
import atexit
import gc
import sys
from collections.abc import Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from ._command.arguments import parse
from ._command.progress import Clock, Progress
from ._files.interrupt import STATUS, ending_at_once
from ._files.naming import named, renamed

#: What the command calls the arguments of `load_mesh` and `Mesh`, and of `fit_camera`.
MESH = {"path": "MESH", "vertices": "MESH"}
FITTED = {
    "target": "MASK",
    "scene": "MESH",
    "camera": "--camera",
    "free": "--free",
    "phi": "--fov",
    "weight": "--weight",
    "photo": "--image",
}
#: The program of `silhouette`.
SILHOUETTE = "pinhole_jax._silhouette.silhouette:_silhouette"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 for a fit that is not to be trusted, 2 on bad input, 130 if
    interrupted."""
    options = parse(arguments)
    interrupted = f"pinhole-jax {options.command}: interrupted"
    for stream in (sys.stdout, sys.stderr):  # names of files need be no text that can be printed
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        run = {
            "fit": _fit,
            "render": _render,
            "hand-eye": _hand_eye,
            "check": _check,
            "batch": _batch,
            "studio": _studio,
            "convert": _convert,
        }
        with ending_at_once(interrupted):
            return run[options.command](options)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        print(f"pinhole-jax {options.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # what was being written is whole or not there
        print(interrupted, file=sys.stderr)
        return STATUS


def _fit(options: argparse.Namespace) -> int:
    with Progress("reading", options.verbose) as progress:
        _set_up_jax(options)
        from . import formats, io, report
        from ._command.known import known
        from ._command.outputs import check_outputs, replaced
        from ._files.pictures import three_channels
        from ._fit.fit_camera import fit_camera
        from ._scene.scene import Scene
        from ._solver.parameters import as_names
        from .plot import disagreement, overlay

        clock = Clock()
        progress.count(clock)
        free = as_names(options.free)
        written = [Path(options.output) / name for name in ("camera.json", "overlay.png")]
        check_outputs(output=written[0], report=options.report)
        with named(path="MASK", mask_from="--mask-from"):
            mask = io.load_mask(
                options.mask, options.mask_from, progress.tell, invert=options.invert
            )
        if options.tidy:
            mask, done = io.tidy_mask(mask)
            progress.tell(f"mask: {'; '.join(done) or 'no crumbs, no pinholes'}")
        camera, phi, lens = known(options, free, (mask.shape[1], mask.shape[0]), progress.tell)
        weight, picture = _beside(options, mask)
        with named(**MESH):
            scene = Scene(
                mesh=io.load_mesh(
                    options.mesh, say=lambda words: progress.tell(renamed(words, MESH))
                )
            )
        progress.say("fitting (the first time compiles: seconds)")
        photo = three_channels(picture) if options.refine else None
        fit_arguments = {"phi": phi, "lens": lens, "weight": weight, "photo": photo}
        on_step = lambda level: progress.say(str(level))
        record = options.report is not None
        with named(**FITTED):
            fit = fit_camera(
                scene, mask, camera, free, progress=on_step, record=record, **fit_arguments
            )
        finite = fit.status != "non_finite"
        progress.say("drawing")
        drawing = overlay(picture, fit.camera, scene)
        notes = disagreement(fit.camera, scene, mask) if finite else ()
    print(fit)
    for note in notes:
        print(f"note       {note}")
    if finite:
        print(formats.object_pose(fit, pixel_centres=options.pixel_centres))
    print(
        f"time       {clock.compiling:.1f} s compile, {clock.elapsed() - clock.compiling:.1f} s run"
    )
    written += [options.report] if options.report is not None and finite else []
    words = f"written    {', '.join(map(str, written))}{replaced(written)}"
    with named(path="--output"):
        io.save_fit(written[0], fit, pixel_centres=options.pixel_centres)
        io.save_image(written[1], drawing)
    if written[2:]:
        title = f"Camera of {Path(options.mesh).name} from {Path(options.mask).name}"
        with Progress("drawing the page"), named(path="--report"):
            centres = options.pixel_centres
            report.write(written[2], fit, scene, mask, picture, title, pixel_centres=centres)
    print(words)
    return 0 if fit.status == "converged" else 1


def _beside(options: argparse.Namespace, mask: Any) -> tuple[Any, Any]:
    """Return the weights of `--weight`, None without, and the picture to draw on."""
    from . import io
    from ._command.photos import photo_beside

    weight, picture = None, mask
    if options.refine and options.image is None:
        raise ValueError("`--refine`: expected a photo, --image PHOTO")
    if options.weight is not None:
        with named(path="--weight"):
            weight = io.load_mask(options.weight, "luminance") / 255.0
    if options.image is not None:
        picture = photo_beside(options.image, mask, "--image")
    return weight, picture


def _render(options: argparse.Namespace) -> int:
    with Progress("rendering") as progress:
        _set_up_jax(options)
        from . import formats, io
        from ._files import programs
        from ._scene.scene import Scene, check_view

        with named(path="CAMERA"):
            camera = formats.read_one(options.camera)
        if camera.W * camera.H > io.MOST_PIXELS:
            words = f"at most {io.MOST_PIXELS} pixels, got {camera.W} x {camera.H}"
            raise ValueError(f"`CAMERA`: expected {words} (in {options.camera!r})")
        with named(**MESH):
            scene = Scene(
                mesh=io.load_mesh(
                    options.mesh, say=lambda words: progress.tell(renamed(words, MESH))
                )
            )
        import numpy as np

        check_view(camera, scene)
        image = np.asarray(programs.call(SILHOUETTE, (camera, scene, True), lambda: 0.0))
    with named(path="--output"):
        io.save_image(options.output, image)
    _say_written(options.output, f"{camera.W} x {camera.H}, {image.mean():.1%} covered")
    return 0


def _hand_eye(options: argparse.Namespace) -> int:
    with Progress("reading", options.verbose) as progress:
        _set_up_jax(options, quick=False)
        from ._command.hand_eye import hand_eye

        progress.count(Clock())
        return hand_eye(options, progress.say, progress.tell)


def _check(options: argparse.Namespace) -> int:
    with Progress("reading", options.verbose) as progress:
        _set_up_jax(options)
        from ._command.check import check

        progress.count(Clock())
        return check(options, progress.say, progress.tell)


def _batch(options: argparse.Namespace) -> int:
    with Progress("reading", options.verbose) as progress:
        from ._command.batch import batch

        return batch(
            options, progress.say, progress.tell, lambda: _set_up_jax(options, quick=False)
        )


def _studio(options: argparse.Namespace) -> int:
    with Progress("reading", options.verbose) as progress:
        _set_up_jax(options, quick=False)
        from ._command.studio import studio

        run = studio(options, progress.say, progress.tell)
    run()
    return 0


def _convert(options: argparse.Namespace) -> int:
    _set_up_jax(options)
    from . import formats

    size = None if options.size is None else (options.size[0], options.size[1])
    with named(path="IN", format="--from", size="--size"):
        cameras = formats.read(options.input, options.source, size=size)
    with named(path="OUT", format="--to", cameras="IN"):
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


def _set_up_jax(options: argparse.Namespace, quick: bool = True) -> None:
    """Set JAX up (`quick` programs but for those who run them often)."""
    from ._files.process import set_up

    # Tracing makes objects that stay: to look for garbage among them takes a third of the start.
    gc.set_threshold(1_000_000)
    atexit.register(gc.freeze)
    set_up(not options.no_cache, quick=quick)


if __name__ == "__main__":
    sys.exit(main())
