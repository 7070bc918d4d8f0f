"""The command line: `pinhole-jax fit`, `render` and `convert`; also `python -m pinhole_jax`."""

import argparse
import atexit
import contextlib
import gc
import json
import math
import sys
import threading
import time
from collections.abc import Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from . import __version__
from ._camera.distortion import MODELS
from ._fit.parameters import NAMES
from ._fit.words import STATUSES

#: The models of a lens's distortion, with their coefficients, as a camera file has them.
DISTORTIONS = "\n  ".join(
    json.dumps({"model": name, **dict.fromkeys(model.powers, 0)}) for name, model in MODELS.items()
)
EPILOG = """\
camera files are JSON with the parameters of Frisvad's note, world units and radians:
  {"e": [x, y, z], "p": [x, y, z], "u": [x, y, z], "phi": 0.6, "d": 1, "W": 256, "H": 256}
eye e, view point p, up u, vertical field of view phi, camera constant d, resolution W x H; "lens"
may add {"principal_point": [x, y], "aspect": 1} (px, origin at the bottom left, y up), and in it
"distortion", one of OpenCV's models:
  DISTORTIONS
Masks are grey images (white is the object), or images whose transparency is the mask; --mask-from
reads others:
  alpha                 the transparency
  luminance             the brightness, whatever it is
  label=N               a label image's pixels of this grey value or palette entry
  background=COLOR      a photo before a background of one colour (white, #1e90ff): what is farther
                        from it in CIE Lab than Otsu's threshold (scikit-image), or than T with
                        background=COLOR,T; edges are soft where colours mix
Pictures are PNG, JPEG, TIFF, WebP, BMP or PNM. What is written replaces a file; to /dev/stdout or
a pipe it is written through, and devices are refused.
""".replace("DISTORTIONS", DISTORTIONS)

STATUS = "\n".join(
    ["the status of a fit is converged where its camera is to be trusted, else why it is not:"]
    + [f"  {status:16}{meaning}" for status, meaning in STATUSES.items()]
)

CONVERT = """\
Turn the cameras of IN into another program's file. Formats, and the endings that ask for them:
  json            the one below                    .json
  opencv          cv::FileStorage YAML             .yaml .yml
  colmap          a folder of text files           a folder (colmap-binary: of .bin files)
  nerf            NeRF, nerfstudio, instant-ngp    transforms*.json
  blender         Blender's settings as JSON       *blender*.json
  blender-script  a script to run in Blender       .py (written only)
  gltf            glTF 2.0                         .gltf .glb
  pytorch3d       PyTorch3D's arrays as JSON       *pytorch3d*.json
  mitsuba         Mitsuba XML                      .xml
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 for a fit that is not to be trusted, 2 on bad input, 130 if
    interrupted."""
    options = _parser().parse_args(arguments)
    for stream in (sys.stdout, sys.stderr):  # names of files need be no text that can be printed
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        return options.run(options)
    except (ValueError, OSError) as error:
        print(f"pinhole-jax {options.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # what was being written is whole or not there
        print(f"pinhole-jax {options.command}: interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pinhole-jax",
        description="A differentiable pinhole camera: recover it from a mask, or render a mask.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"pinhole-jax {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    fit = commands.add_parser(
        "fit",
        help="recover the camera from a mesh and a mask",
        description="Recover the camera that sees MESH as MASK: from a start some 20 degrees off,"
        " or\nwithout one from the field of view (or, with phi among --free, from nothing).\n"
        "Writes camera.json and overlay.png, prints parameters with their standard errors.\n"
        "Photos that were taken sideways are turned upright as their EXIF data say.\n"
        "Exit status: 0 converged, 1 not to be trusted (the status says why), 2 bad input.",
        epilog=f"{STATUS}\n\n{EPILOG}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    fit.add_argument("mesh", metavar="MESH", help="triangles: obj, ply, stl, glb, gltf or off")
    fit.add_argument("mask", metavar="MASK", help="image of the camera's size, white on black")
    start = fit.add_mutually_exclusive_group()
    start.add_argument(
        "--camera",
        metavar="START",
        help="where to start (else: search): a camera file, see below, or any that `convert` reads;"
        " FILE:NAME is one of several",
    )
    start.add_argument(
        "--K",
        nargs=4,
        type=float,
        metavar=("FX", "FY", "CX", "CY"),
        help="known intrinsics in px (OpenCV's K), to search with",
    )
    start.add_argument(
        "--fov",
        type=float,
        metavar="DEGREES",
        help="vertical field of view, to search with (default: what the EXIF data of PHOTO say)",
    )
    fit.add_argument(
        "--dist",
        nargs="+",
        type=float,
        metavar="K1",
        help="with --K: OpenCV's k1 k2 p1 p2, k3, k4 k5 k6",
    )
    fit.add_argument(
        "--pixel-centres",
        choices=("integer", "half"),
        default="integer",
        help="where CX, CY of --K count from: the first pixel's centre is 0 (OpenCV) or 0.5"
        " (COLMAP); default: %(default)s",
    )
    fit.add_argument(
        "--free",
        default="pose",
        metavar="NAMES",
        help=f"what to fit, with commas, of {', '.join(NAMES)}: pose is position and orientation,"
        " phi and d are the focal length in two ways, distortion is all coefficients of the lens;"
        " the rest stays as it is at the start (default: %(default)s)",
    )
    fit.add_argument(
        "--mask-from", metavar="HOW", help="how to read MASK, see below (default: at first sight)"
    )
    fit.add_argument("--weight", metavar="IMAGE", help="grey image: how much each pixel counts")
    fit.add_argument("--image", metavar="PHOTO", help="what to draw the outline on (default: MASK)")
    fit.add_argument(
        "--report", metavar="PAGE.html", help="write a page with pictures, errors, all formats"
    )
    fit.add_argument("--verbose", action="store_true", help="say on stderr what goes on")
    fit.add_argument(
        "-o", "--output", default="out", metavar="FOLDER", help="(default: %(default)s)"
    )
    _add_cache(fit)
    fit.set_defaults(run=_fit)

    render = commands.add_parser(
        "render",
        help="render the mask that a camera sees",
        description="Render MESH as CAMERA.json sees it: exact coverage, 8 bits.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    render.add_argument("mesh", metavar="MESH", help="triangles: obj, ply, stl, glb, gltf or off")
    render.add_argument("camera", metavar="CAMERA.json")
    render.add_argument(
        "-o", "--output", default="mask.png", metavar="IMAGE", help="(default: %(default)s)"
    )
    _add_cache(render)
    render.set_defaults(run=_render)

    convert = commands.add_parser(
        "convert",
        help="turn a camera file into another program's",
        description=CONVERT,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    convert.add_argument("input", metavar="IN", help="a camera file; of COLMAP, the model's folder")
    convert.add_argument("output", metavar="OUT", help="what to write")
    convert.add_argument("--from", dest="source", metavar="FORMAT", help="(default: IN says it)")
    convert.add_argument("--to", dest="target", metavar="FORMAT", help="(default: OUT says it)")
    convert.add_argument(
        "--size",
        nargs=2,
        type=int,
        metavar=("W", "H"),
        help="the image's size in px, where IN does not hold it (glTF, some NeRF files)",
    )
    convert.set_defaults(run=_convert, no_cache=True)
    return parser


def _add_cache(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--no-cache",
        action="store_true",
        help="do not keep compiled programs in the user's cache folder",
    )


def _fit(options: argparse.Namespace) -> int:
    clock = _Clock()
    with _Progress("reading", options.verbose) as progress:
        _set_up_jax(options)
        import numpy as np

        from . import formats, io, report
        from ._fit.fit_camera import fit_camera
        from ._scene.scene import Scene
        from .plot import overlay

        free = tuple(name.strip() for name in options.free.split(",") if name.strip())
        mask = io.load_mask(options.mask, options.mask_from, progress.tell)
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
    io.save_camera(
        folder / "camera.json",
        fit.camera,
        fit={
            "status": fit.status,
            "iou": fit.iou,
            "rms": fit.rms if fit.rms == fit.rms else None,
            "weak": list(fit.weak),
            "modes": [io.camera_to_dict(mode.camera) for mode in fit.modes],
            "std": {
                name: std if std < float("inf") else None
                for name, std in zip(fit.names, fit.std.tolist(), strict=True)
            },
        },
    )
    io.save_image(folder / "overlay.png", drawing)
    written = [folder / "camera.json", folder / "overlay.png"]
    if options.report is not None and fit.status != "non_finite":
        title = f"Camera of {Path(options.mesh).name} from {Path(options.mask).name}"
        with _Progress("drawing the page"):
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

    fx, fy, cx, cy = options.K
    K, turn = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    bent = options.dist
    if bent is not None and len(bent) not in (4, 5, 8):
        raise ValueError(f"`--dist`: expected 4, 5 or 8 coefficients, got {len(bent)}")
    model = (
        None if bent is None else MODELS["Rational" if len(bent) == 8 else "BrownConrady"](*bent)
    )
    centres = options.pixel_centres
    camera = formats.from_opencv(K, turn, [0, 0, 0], *size, pixel_centres=centres, distortion=model)
    return {"phi": camera.phi, "lens": camera.lens}


def _phi_of_photo(
    options: argparse.Namespace, free: tuple[str, ...], progress: "_Progress"
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
    with _Progress("rendering"):
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


class _Clock:
    """Time since it was made, and how much of it JAX spent tracing and compiling."""

    def __init__(self) -> None:
        import jax.monitoring

        self.compiling = 0.0
        self._begin = time.perf_counter()
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **kwargs: Any) -> None:
        del kwargs
        if event in (
            "/jax/core/compile/jaxpr_to_mlir_module_duration",
            "/jax/core/compile/backend_compile_duration",
            "/jax/core/compile/jaxpr_trace_duration",
        ):
            self.compiling += duration_secs

    def elapsed(self) -> float:
        return time.perf_counter() - self._begin


class _Progress:
    """A line on the terminal that says what goes on, once it has gone on for a second.

    Where `verbose`, all of it goes to stderr line by line.
    """

    def __init__(self, text: str, verbose: bool = False) -> None:
        self._text, self._verbose = text, verbose
        self._done = threading.Event()
        self._thread: threading.Thread | None = None

    def say(self, text: str) -> None:
        self._text = text
        if self._verbose:
            self.tell(text)

    def tell(self, text: str) -> None:
        """Print a line that is to stay."""
        clear = "\r\x1b[K" if self._thread is not None else ""
        print(f"{clear}{text}", file=sys.stderr, flush=True)

    def __enter__(self) -> "_Progress":
        if sys.stderr.isatty() and not self._verbose:
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        begin = time.perf_counter()
        shown = False
        while not self._done.wait(0.2):
            seconds = time.perf_counter() - begin
            if seconds > 1:
                shown = True
                print(
                    f"\r\x1b[K{seconds:4.0f} s  {self._text}", end="", file=sys.stderr, flush=True
                )
        if shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
