"""What the command understands, and how it says so. JAX is not imported here: help, the version and
words about a typo come at once."""

import argparse
import json
from collections.abc import Sequence
from typing import Any

from .. import __version__
from ..names import DISTORTIONS, FREE, STATUSES

#: The models of a lens's distortion, with their coefficients, as a camera file has them.
EXAMPLES = "\n  ".join(
    json.dumps({"model": name, **dict.fromkeys(names, 0)}) for name, names in DISTORTIONS.items()
)
EPILOG = """\
camera files are JSON with the parameters of Frisvad's note, world units and radians:
  {"e": [x, y, z], "p": [x, y, z], "u": [x, y, z], "phi": 0.6, "d": 1, "W": 256, "H": 256}
eye e, view point p, up u, vertical field of view phi, camera constant d, resolution W x H; "lens"
may add {"principal_point": [x, y], "aspect": 1} (px, origin at the bottom left, y up), and in it
"distortion", one of OpenCV's models:
  EXAMPLES
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
""".replace("EXAMPLES", EXAMPLES)

STATUS = "\n".join(
    ["the status of a fit is converged where its camera is to be trusted, else why it is not:"]
    + [f"  {status:16}{meaning}" for status, meaning in STATUSES.items()]
)

CONVERT = """\
Turn the cameras of IN into another program's file. Formats, and the endings that ask for them:
  json            the one below                    .json
  opencv          cv::FileStorage YAML (or XML)    .yaml .yml .xml
  colmap          a folder of text files           a folder (colmap-binary: of .bin files)
  nerf            NeRF, nerfstudio, instant-ngp    transforms*.json
  blender         Blender's settings as JSON       *blender*.json
  blender-script  a script to run in Blender       .py (written only)
  gltf            glTF 2.0                         .gltf .glb
  pytorch3d       PyTorch3D's arrays as JSON       *pytorch3d*.json
  mitsuba         Mitsuba XML (the root decides)   .xml
"""


DATASETS = """\
a data set is one of
  BOP      a split's folder, or one scene's: scene_camera.json, scene_gt.json, mask_visib
  a table  .csv, .jsonl or .parquet: a record a row, with the columns id, mesh, mask, and of K (four
           numbers or nine), dist, fov, camera, start, free, ... what is known; paths are relative
           to it
  a folder with one mesh, masks (or a folder `masks`), and camera.json, --K or --fov
RESULTS holds rows as JSON lines: status, camera, K, R, t, covariance, seconds, and why a record
failed. Processes on several machines may share it, each with a --shard of its own.
"""


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the options of a command line (None: this process's); `command` is which command.

    Ends the process after help or the version, and with 2 and words where something is wrong.
    """
    return _parser().parse_args(arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pinhole-jax",
        description="A differentiable pinhole camera: recover it from a mask, or render a mask.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"pinhole-jax {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_fit(commands)
    _add_render(commands)
    _add_hand_eye(commands)
    _add_check(commands)
    _add_batch(commands)
    _add_studio(commands)
    _add_convert(commands)
    return parser


def _add_fit(commands: Any) -> None:
    fit = _command(
        commands,
        "fit",
        help="recover the camera from a mesh and a mask",
        description="Recover the camera that sees MESH as MASK: from a start some 20 degrees off,"
        " or\nwithout one from the field of view (or, with phi among --free, from nothing).\n"
        "Writes camera.json and overlay.png, prints parameters with their standard errors.\n"
        "Photos that were taken sideways are turned upright as their EXIF data say.\n"
        "Exit status: 0 converged, 1 not to be trusted (the status says why), 2 bad input.",
        epilog=f"{STATUS}\n\n{EPILOG}",
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
    _add_K(start)
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
        help="where CX, CY of --K (and of the K that is told) count from: the first pixel's centre"
        " is 0 (OpenCV) or 0.5 (COLMAP); default: %(default)s",
    )
    fit.add_argument(
        "--crop",
        nargs=4,
        type=float,
        metavar=("LEFT", "TOP", "W", "H"),
        help="MASK shows this window (px from the top left) of the picture that --K or START is of",
    )
    fit.add_argument(
        "--resize",
        nargs=2,
        type=int,
        metavar=("W", "H"),
        help="MASK was resized from W x H px (with --crop: after it) to the size that it has",
    )
    fit.add_argument(
        "--free",
        default="pose",
        metavar="NAMES",
        help=f"what to fit, with commas, of {', '.join(FREE)}: pose is position and orientation,"
        " phi and d are the focal length in two ways, distortion is all coefficients of the lens;"
        " the rest stays as it is at the start (default: %(default)s)",
    )
    fit.add_argument(
        "--mask-from", metavar="HOW", help="how to read MASK, see below (default: at first sight)"
    )
    fit.add_argument("--invert", action="store_true", help="what MASK covers is the background")
    fit.add_argument("--tidy", action="store_true", help="drop MASK's crumbs, fill its pinholes")
    fit.add_argument("--weight", metavar="IMAGE", help="grey image: how much each pixel counts")
    fit.add_argument("--image", metavar="PHOTO", help="what to draw the outline on (default: MASK)")
    fit.add_argument(
        "--refine", action="store_true", help="fit to the colours of --image, too, where they tell"
    )
    fit.add_argument(
        "--report", metavar="PAGE.html", help="write a page with pictures, errors, all formats"
    )
    _add_folder(fit)
    _add_cache(fit)


def _add_render(commands: Any) -> None:
    render = _command(
        commands,
        "render",
        help="render the mask that a camera sees",
        description="Render MESH as CAMERA sees it: exact coverage, 8 bits.",
    )
    render.add_argument("mesh", metavar="MESH", help="triangles: obj, ply, stl, glb, gltf or off")
    render.add_argument("camera", metavar="CAMERA", help="a camera file, as `fit --camera` reads")
    render.add_argument(
        "-o", "--output", default="mask.png", metavar="IMAGE", help="(default: %(default)s)"
    )
    _add_cache(render)


def _add_hand_eye(commands: Any) -> None:
    robot = _command(
        commands,
        "hand-eye",
        help="recover the camera that sees a robot, from a URDF, joint angles and masks",
        description="Recover the one camera that sees ROBOT, with its joints as JOINTS say row by"
        " row, as\nthe MASKs: in the frame of its base, or with --in-hand in that of a link.\n"
        "Writes camera.json and overlay_K.png, prints the camera with its standard errors and\n"
        "which masks disagree. Needs yourdfpy: pip install 'pinhole-jax[robots]'.\n"
        "Exit status: 0 converged, 1 not to be trusted (the status says why), 2 bad input.",
        epilog=f"{STATUS}\n\n{EPILOG}",
    )
    robot.add_argument("robot", metavar="ROBOT", help="a URDF file, its meshes beside it")
    robot.add_argument(
        "joints",
        metavar="JOINTS",
        help="angles (rad): a CSV file whose first line has the joints' names, or JSON with"
        " `names` and `postures`, perhaps with `unit`: deg",
    )
    robot.add_argument("masks", metavar="MASK", nargs="+", help="an image for each row of JOINTS")
    start = robot.add_mutually_exclusive_group(required=True)
    start.add_argument(
        "--camera", metavar="START", help="where to start: a file that `fit --camera` reads"
    )
    _add_K(start)
    robot.add_argument("--dist", nargs="+", type=float, metavar="K1", help="as in `fit`")
    robot.add_argument(
        "--pixel-centres",
        choices=("integer", "half"),
        default="integer",
        help="as in `fit` (default: %(default)s)",
    )
    robot.add_argument("--in-hand", metavar="LINK", help="the link that carries the camera")
    robot.add_argument(
        "--leave-out", metavar="LINKS", help="links that the masks do not show, with commas"
    )
    robot.add_argument(
        "--free", default="pose", metavar="NAMES", help="as in `fit`: pose, phi, ..."
    )
    robot.add_argument("--mask-from", metavar="HOW", help="how to read the MASKs, see below")
    robot.add_argument(
        "--images", metavar="PHOTO", nargs="+", help="what to draw the outlines on (default: MASKs)"
    )
    robot.add_argument(
        "--refine", action="store_true", help="fit to the colours of --images, too, where they tell"
    )
    robot.add_argument(
        "--joint-zeros",
        type=float,
        metavar="SIGMA",
        help="find the zeros of the turning joints, too, which are known to this many degrees",
    )
    robot.add_argument(
        "--holdout", action="store_true", help="fit each half of the postures, too: do they agree?"
    )
    robot.add_argument(
        "--propose",
        metavar="JOINTS",
        help="say what a mask more would tell in each of these postures (a file as JOINTS)",
    )
    robot.add_argument("--report", metavar="PAGE.html", help="write one page about all of it")
    _add_folder(robot)
    _add_cache(robot)


def _add_check(commands: Any) -> None:
    check = _command(
        commands,
        "check",
        help="say whether a mask is still explained by a camera, or how it has moved",
        description="Say whether CAMERA still sees MESH as MASK, by how many standard errors not,"
        " and which way\nit has moved; or a robot: check CAMERA ROBOT.urdf JOINTS MASK...\n"
        "Exit status: 0 it has not moved, 1 it has or the masks do not tell, 2 bad input.",
        epilog=f"{STATUS}\n\n{EPILOG}",
    )
    check.add_argument(
        "camera",
        metavar="CAMERA",
        help="any file that `convert` reads; of one that `fit` wrote the errors count, too",
    )
    check.add_argument("mesh", metavar="MESH", help="as in `fit`; or a URDF file")
    check.add_argument("joints", metavar="MASK", nargs="?", help="as in `fit`; of a robot JOINTS")
    check.add_argument("masks", metavar="MASK", nargs="*", help="of a robot, one for each posture")
    check.add_argument("--in-hand", metavar="LINK", help="as in `hand-eye`")
    check.add_argument("--leave-out", metavar="LINKS", help="as in `hand-eye`")
    check.add_argument("--free", default="pose", metavar="NAMES", help="as in `fit`")
    check.add_argument("--mask-from", metavar="HOW", help="how to read the MASKs, see below")
    check.add_argument("--verbose", action="store_true", help="say on stderr what goes on")
    check.add_argument("-o", "--output", metavar="CAMERA.json", help="write where it is now")
    _add_cache(check)


def _add_batch(commands: Any) -> None:
    batch = _command(
        commands,
        "batch",
        help="recover the cameras of a whole data set",
        description="Recover the camera of each record of DATASET; append a row for each to the"
        " parts in\nRESULTS. What is stopped, by whatever, goes on with --resume.\n"
        "Exit status: 0 each record has a row, 1 some have no fit (their rows say why), 2 bad"
        " input.",
        epilog=DATASETS,
    )
    batch.add_argument("dataset", metavar="DATASET", nargs="?", help="see below")
    batch.add_argument("-o", "--output", metavar="RESULTS", required=True, help="a folder")
    batch.add_argument("--workers", type=int, metavar="K", help="processes (default: one a core)")
    batch.add_argument(
        "--shard", default="1/1", metavar="I/N", help="fit the I-th of N parts of DATASET alone"
    )
    batch.add_argument("--resume", action="store_true", help="fit what has no row in RESULTS yet")
    batch.add_argument(
        "--retry", metavar="STATUSES", help="fit these anew, too: failed,timed_out,crashed"
    )
    batch.add_argument(
        "--time-limit",
        type=float,
        default=600.0,
        metavar="SECONDS",
        help="what one record may take, 0: any time (default: %(default)g)",
    )
    batch.add_argument("--merge", metavar="TABLE", help="write all rows: .parquet, .jsonl, .csv")
    batch.add_argument("--report", metavar="PAGE.html", help="write totals and the worst rows")
    batch.add_argument(
        "--write",
        nargs=2,
        metavar=("ID", "CAMERA"),
        help="write a row's camera as any file that `convert` writes",
    )
    batch.add_argument("--start", action="store_true", help="start from BOP's poses, else search")
    batch.add_argument("--models", metavar="FOLDER", help="BOP's models (default: beside it)")
    batch.add_argument("--detections", metavar="COCO.json", help="masks instead of BOP's own")
    known = batch.add_mutually_exclusive_group()
    _add_K(known)
    known.add_argument("--fov", type=float, metavar="DEGREES", help="where DATASET says nothing")
    batch.add_argument(
        "--pixel-centres",
        choices=("integer", "half"),
        default="integer",
        help="as in `fit`, of --K (default: %(default)s)",
    )
    batch.add_argument("--free", default="pose", metavar="NAMES", help="as in `fit`")
    batch.add_argument("--mask-from", metavar="HOW", help="as in `fit`")
    batch.add_argument("--verbose", action="store_true", help="say on stderr what goes on")
    _add_cache(batch)


def _add_studio(commands: Any) -> None:
    studio = _command(
        commands,
        "studio",
        help="get the camera of a photo by hand and eye: a page in the browser",
        description="Open a page in the browser: the mesh before the photo, to turn, to paint a"
        " mask for,\nto fit, and to export in every format. Served on this machine alone, to who"
        " has the\naddress that is printed. Needs aiohttp: pip install 'pinhole-jax[studio]'.",
    )
    studio.add_argument(
        "mesh", metavar="MESH", nargs="?", help="triangles: obj, ply, stl, glb, gltf or off"
    )
    studio.add_argument("photo", metavar="PHOTO", nargs="?", help="a picture of it")
    studio.add_argument("--session", metavar="FILE", help="go on with what the page saved")
    start = studio.add_mutually_exclusive_group()
    start.add_argument(
        "--camera", metavar="START", help="where to begin: a file that `fit --camera` reads"
    )
    _add_K(start)
    start.add_argument(
        "--fov",
        type=float,
        metavar="DEGREES",
        help="vertical field of view (default: what the EXIF data of PHOTO say, or 40)",
    )
    studio.add_argument("--dist", nargs="+", type=float, metavar="K1", help="as in `fit`")
    studio.add_argument(
        "--pixel-centres",
        choices=("integer", "half"),
        default="integer",
        help="as in `fit` (default: %(default)s)",
    )
    studio.add_argument(
        "--up", choices=("x", "y", "z"), default="y", help="MESH's upward axis (default: y)"
    )
    studio.add_argument("--mask", metavar="MASK", help="begin with this mask")
    studio.add_argument("--mask-from", metavar="HOW", help="how to read MASK, see below")
    studio.add_argument(
        "--port", type=int, default=0, metavar="N", help="(default: any that is free)"
    )
    studio.add_argument("--no-browser", action="store_true", help="print the address, open nothing")
    _add_folder(studio)
    _add_cache(studio)


def _add_convert(commands: Any) -> None:
    convert = _command(
        commands,
        "convert",
        help="turn a camera file into another program's",
        description=CONVERT,
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
    convert.set_defaults(no_cache=True)


def _add_K(start: Any) -> None:
    start.add_argument(
        "--K",
        nargs=4,
        type=float,
        metavar=("FX", "FY", "CX", "CY"),
        help="known intrinsics in px (OpenCV's K), to search with",
    )


def _add_folder(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--verbose", action="store_true", help="say on stderr what goes on")
    parser.add_argument(
        "-o", "--output", default="out", metavar="FOLDER", help="(default: %(default)s)"
    )


def _add_cache(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--no-cache",
        action="store_true",
        help="do not keep compiled programs in the user's cache folder",
    )


def _command(
    commands: Any, name: str, help: str, description: str, epilog: str = EPILOG
) -> argparse.ArgumentParser:
    return commands.add_parser(
        name,
        help=help,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
