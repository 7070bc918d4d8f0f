"""The command's arguments, as tables. JAX is not imported here: help, the version and messages
about a typo appear at once."""

import argparse
import re
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cache
from typing import Any, NamedTuple, NoReturn

from .. import __version__
from .._files.native_library import is_switched_off, library_path
from ..names import FREE, STATUSES

#: Numbers with commas between.
NUMBERS = re.compile(r"(?i:[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|[-+]?(nan|inf)|,)+")
FILES = """\
camera files are JSON with the parameters of Frisvad's note, world units and radians:
  {"e": [x, y, z], "p": [x, y, z], "u": [x, y, z], "phi": 0.6, "d": 1, "W": 256, "H": 256}
eye e, view point p, up u, vertical field of view phi, camera constant d, resolution W x H; "lens"
may add {"principal_point": [x, y], "aspect": 1} (px, origin at the bottom left, y up), and in it
"distortion", one of OpenCV's models:
  {"model": "BrownConrady", "k1": 0, "k2": 0, "p1": 0, "p2": 0, "k3": 0}
  {"model": "Rational", "k1": 0, "k2": 0, "p1": 0, "p2": 0, "k3": 0, "k4": 0, "k5": 0, "k6": 0}
  {"model": "Fisheye", "k1": 0, "k2": 0, "k3": 0, "k4": 0}
Pictures are PNG, JPEG, TIFF, WebP, BMP or PNM. An output file replaces the one at its path;
/dev/stdout and pipes are written to, other devices are refused.
"""
MASKS = """\
Masks are grey images (white is the object), or images whose transparency is the mask; --mask-from
reads others:
  alpha                 the transparency
  luminance             the brightness, whatever it is
  label=N               a label image's pixels of this grey value or palette entry
  background=COLOR      a photo before a background of one colour (white, #1e90ff): pixels farther
                        from it in CIE Lab than Otsu's threshold (scikit-image), or than T with
                        background=COLOR,T; edges are soft where colours mix
"""

STATUS = "\n".join(
    ["status of a fit: trust the camera if it is `converged`; otherwise the status says why not"]
    + [f"  {status:16}{meaning}" for status, meaning in STATUSES.items()]
)

CONVERT = """\
Write the cameras of IN as another program's file. Formats, and the endings that select them:
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
  a table  .csv or .jsonl: a record a row, with the columns id, mesh, mask, and what you know of K
           (four numbers, nine, or a file), dist, fov, camera, start, crop, free, ...; paths are
           relative to the table
  a folder with one mesh, masks (or a folder `masks`), and camera.json, --K or --fov
RESULTS holds rows as JSON lines: status, camera, K, R, t, covariance, seconds, and the reason if a
record failed. Processes on several machines may share it, each with its own --shard.
"""


def _names_in(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _join_values(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with the values of --K, --dist and --free joined by commas.

    So a value may begin with a minus, and MESH may follow it.
    """
    option, result = "", []
    for word in arguments:
        is_number = option in ("--K", "--dist") and NUMBERS.fullmatch(word)
        is_name = option == "--free" and {*word.split(",")} <= {*FREE, "focal", ""}
        if is_number or is_name:
            result[-1] += f"{',' if '=' in result[-1] else '='}{word.strip(',')}"
        else:
            option = word
            result.append(word)
    return result


class Verb(NamedTuple):
    """A command: a line, a description, its options in order (`|` joins those that exclude each
    other, `!` requires one of them), an example, and an epilog."""

    help: str
    description: str
    options: str
    example: str
    epilog: str = FILES


TRUST = "Exit status: 0 converged, 1 do not trust it (the status says why), 2 bad input."
FITTED = f"{STATUS}\n\n{MASKS}\n{FILES}"
VERBS = {
    "fit": Verb(
        "recover the camera from a mesh and a mask",
        f"""\
Recover the camera that sees MESH as MASK: from a start up to 20 degrees off, or
without one by a search of all views (give the field of view, or --free phi, too).
Writes camera.json and overlay.png, prints parameters with their standard errors.
Photos taken sideways are turned upright by their EXIF data.
{TRUST}""",
        """mesh mask --camera|--K|--fov --dist --pixel-centres --crop --resize --free --mask-from
        --invert --tidy|--no-tidy --weight --image --refine --report --verbose -o/--output
        --no-cache""",
        "part.stl mask.png --fov 34 --free pose phi --report page.html",
        FITTED,
    ),
    "render": Verb(
        "render the mask that a camera sees",
        "Render MESH as CAMERA sees it: exact coverage, 8 bits.",
        "mesh camera -o/--output --no-cache",
        "part.stl camera.json -o mask.png",
    ),
    "hand-eye": Verb(
        "recover the camera that sees a robot, from a URDF, joint angles and masks",
        f"""\
Recover the one camera that sees ROBOT as the MASKs, one for each row of JOINTS: in the
frame of its base, or with --in-hand in that of a link.
Writes camera.json and overlay_K.png, prints the camera with its standard errors, and
the masks that disagree.
{TRUST}""",
        """robot joints masks !--camera|--K --dist --pixel-centres --in-hand --leave-out --free
        --mask-from --tidy|--no-tidy --images --refine --joint-zeros --holdout --propose --report
        --verbose -o/--output --no-cache""",
        "arm.urdf joints.csv mask_*.png --K calibration.yaml --report page.html",
        FITTED,
    ),
    "check": Verb(
        "check with a new mask whether a camera has moved, or whether error bars hold",
        """\
Compare CAMERA with the camera that sees MESH as MASK: has it moved, by how many
standard errors, and which way? For a robot: check CAMERA ROBOT.urdf JOINTS MASK...
With --split: do two halves of the outline, or of a robot's views, agree?
Exit status: 0 it has not moved (halves agree), 1 it has (they do not), 3 the masks
cannot tell, 2 bad input.""",
        """camera mesh files --split --in-hand --leave-out --free --mask-from --tidy|--no-tidy
        --verbose -o/--output --no-cache""",
        "out/camera.json part.stl mask.png",
        FITTED,
    ),
    "batch": Verb(
        "recover the cameras of a whole data set",
        """\
Recover the camera of each record of DATASET; append a row for each to the parts in
RESULTS. If it is stopped, continue with --resume.
Exit status: 0 each record has a row, 1 some have no fit (their rows say why), 2 bad input.""",
        """dataset -o/--output --workers --shard --resume --retry --time-limit --merge --write
        --start --models --detections --camera|--K|--fov --dist --pixel-centres --crop --resize
        --free --mask-from --invert --tidy|--no-tidy --weight --track --verbose --no-cache""",
        "set.csv -o results --workers 4 --merge table.csv",
        f"{DATASETS}\n{MASKS}",
    ),
    "studio": Verb(
        "find the camera of a photo by hand, in the browser",
        """\
Open a page in the browser: turn the mesh over the photo, paint a mask, fit, and export
the camera in every format. Only this machine can open it, at the printed
address. Needs aiohttp: pip install 'pinhole-jax[studio]'.""",
        """mesh photo --session --camera|--K|--fov --dist --pixel-centres --up --mask --mask-from
        --port --no-browser --verbose -o/--output --no-cache""",
        "part.stl photo.jpg --fov 34",
        f"{MASKS}\n{FILES}",
    ),
    "convert": Verb(
        "convert a camera file to another program's format",
        CONVERT,
        "input output --from --to --size",
        "camera.json transforms.json",
    ),
}
#: The options by the headings of the help (those without one first): each as the usage shows it,
#: and its help. A command before an option's name: for that one alone. After it are metavar (none:
#: a switch), `?`, `*`, `+` for how many or `!` where it is required, type, default.
OPTIONS = {
    "": """
mesh MESH                       triangles: obj, ply, stl, glb, gltf or off
check mesh MESH                 as in `fit`; or a URDF file
studio mesh MESH?               triangles: obj, ply, stl, glb, gltf or off
mask MASK                       image of the camera's size, white on black
camera CAMERA                   a camera file, as `fit --camera` reads
check camera CAMERA             any file that `convert` reads; if `fit` wrote it, its errors
                                count, too
robot ROBOT                     a URDF file, its meshes beside it
joints JOINTS                   angles (rad): a CSV file whose first line has the joints' names,
                                or JSON with `names` and `postures`, perhaps with `unit`: deg
masks MASK+                     an image for each row of JOINTS
files MASK*                     as in `fit`; for a robot JOINTS, then a MASK for each row
dataset DATASET?                see below
photo PHOTO?                    a photo of the object
input IN                        a camera file; of COLMAP, the model's folder
output OUT                      the file to write
--session FILE                  continue a saved session
--from FORMAT                   (default: from IN)
--to FORMAT                     (default: from OUT)
--size W H: int                 image size in px, if IN has none (glTF, some NeRF files)
""",
    "camera": """
--camera START                  start here instead of searching: a camera file (see below), or
                                any that `convert` reads; FILE:NAME selects one of several
--K K                           known intrinsics for the search: FX FY CX CY in px (OpenCV's),
                                or a file with them: OpenCV's or ROS's calibration, COLMAP's
                                cameras.txt, JSON with K
--fov DEGREES: float            vertical field of view for the search (default: from PHOTO's
                                EXIF data)
batch --fov DEGREES: float      unless DATASET says otherwise
studio --fov DEGREES: float     vertical field of view (default: from PHOTO's EXIF data, else
                                40)
--dist K1,K2,...                with --K: OpenCV's k1 k2 p1 p2, k3, k4 k5 k6
--pixel-centres {integer,half} = integer  where CX, CY of --K (and of the K that is printed)
                                count from: the first pixel's centre is 0 (OpenCV) or 0.5
                                (COLMAP); default: %(default)s
--crop LEFT TOP W H: float      MASK shows this window (px from the top left) of the picture of
                                --K or --camera
--resize W H: int               the size of MASK, px, before it was resized (with --crop: after
                                cropping)
--in-hand LINK                  the link that carries the camera
--start                         start from BOP's poses, else search
--up {x,y,z} = y                MESH's upward axis (default: y)
""",
    "masks": """
--mask-from HOW                 how to read masks, see below (default: from the picture itself)
batch --mask-from HOW           as in `fit`
--invert                        MASK covers the background
--tidy                          drop crumbs and fill holes of MASK up to 1/200 of the object
                                (else 1/1000)
--no-tidy                       take MASK as it is, with its crumbs and pinholes
--weight IMAGE                  grey image: how much each pixel counts
--models FOLDER                 BOP's models (default: beside it)
--detections COCO.json          masks instead of BOP's own
--mask MASK                     begin with this mask
""",
    "fit": f"""
--free NAMES: free = pose       what to fit, of {", ".join(FREE)}: pose
                                is position and orientation, phi (or focal) and d both set the
                                focal length, distortion is all coefficients of the lens; the
                                rest keeps its starting value (default: %(default)s)
--track                         fit in order, each from the last camera (frames of a video)
--refine                        fit to the edges in the photos, too, where they are clear
--leave-out LINKS: names =      links that the masks do not show, with commas
--joint-zeros SIGMA: float      find the zeros of the turning joints, too, which are known to
                                this many degrees
--split                         fit two halves of MASK's outline (odd and even MASKs of a
                                robot); compare them
--holdout                       fit each half of the postures, too, and compare them
--propose JOINTS                predict how much a mask in each of these postures would help (a
                                file like JOINTS)
""",
    "rows": """
--workers K: int                processes (default: one a core)
--shard I/N = 1/1               fit the I-th of N parts of DATASET alone
--resume                        fit the records that have no row in RESULTS yet
--retry STATUSES: names =       fit these anew, too: failed,timed_out,crashed
--time-limit SECONDS: float = 600  most time for one record, 0: no limit (default: %(default)s)
--merge TABLE                   write all rows: .jsonl or .csv
--write ID CAMERA               write a row's camera as any file that `convert` writes
""",
    "output": """
--image PHOTO                   draw the outline on this (default: MASK)
--images PHOTO+                 draw the outlines on these (default: MASKs)
--report PAGE.html              write a page with pictures, errors, all formats
hand-eye --report PAGE.html     write a page with all results
--port N: int = 0               (default: any that is free)
--no-browser                    print the address, open nothing
--verbose                       report each step on stderr
-o/--output FOLDER = out        (default: %(default)s)
render -o/--output IMAGE = mask.png  (default: %(default)s)
check -o/--output CAMERA.json   write where it is now
batch -o/--output RESULTS!      a folder
--no-cache                      do not keep compiled programs in the user's cache folder
""",
}
FORM = re.compile(
    r"^((?:[a-z-]+ )?(?:[a-z]+|-\S+)) ?(.*?)([?*+!]?)(?:: (\w+))?(?: = ?(\S*))?  +(.*(?:\n +.*)*)",
    re.MULTILINE,
)
FORMS = {
    form[1]: (title, *form.groups()[1:])
    for title, table in OPTIONS.items()
    for form in FORM.finditer(table)
}
#: (The focal length is phi's other name.)
TYPES = {
    None: str,
    "float": float,
    "int": int,
    "names": _names_in,
    "free": lambda text: re.sub(r"\bfocal\b", "phi", ",".join(_names_in(text))),
}
#: Other names that the library has for what an option gives.
ALIASES = {
    "mask": "target",
    "masks": "target mask",
    "files": "target mask",
    "mesh": "scene",
    "fov": "phi",
    "image": "photo",
    "images": "photo",
    "camera": "cameras",
    "dist": "lens",
    "output": "out",
    "dataset": "items",
}


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the options of a command line (None: this process's).

    `command` is the command, and `names` has what users call each argument of the library. Ends
    the process after help or the version, and with 2 and a message for a bad command line.
    """
    parser = _Parser(
        prog="pinhole-jax",
        description="A differentiable pinhole camera: recover it from a mask, or render a mask.",
        epilog="`pinhole-jax COMMAND --help` has each command's options, and an example.",
    )
    native = library_path() is not None and not is_switched_off()
    version = f"pinhole-jax {__version__} ({'compiled library' if native else 'arrays'} on CPUs)"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, verb in VERBS.items():
        _add(commands, name, verb)
    words = _join_values(sys.argv[1:] if arguments is None else arguments)
    options, unknown = parser.parse_known_args(words)
    if unknown:
        known = options.names.values()
        near = [name for word in unknown for name in get_close_matches(word, known, 1)]
        hint = f" (did you mean {near[0]}?)" if near else ""
        options.own.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
    return options


def _add(commands: Any, name: str, verb: Verb) -> None:
    """Add a command's parser."""
    text = f"{verb.description.rstrip()}\n\nexample: pinhole-jax {name} {verb.example}"
    own = commands.add_parser(name, help=verb.help, description=text, epilog=verb.epilog)
    group_of, actions = cache(own.add_argument_group), []
    for part in verb.options.split():
        options = part.lstrip("!").split("|")
        title, *_ = FORMS[options[0]]
        group: Any = group_of(title) if title else own
        if len(options) > 1:
            group = group.add_mutually_exclusive_group(required=part[0] == "!")
        for option in options:
            actions.append(group.add_argument(*option.split("/"), **_keywords(name, option)))
    own.set_defaults(verbose=False, no_cache=name == "convert", own=own, names=_names(actions))


class _Parser(argparse.ArgumentParser):
    """A parser whose errors show the first line of the command's own usage, and where help is."""

    def __init__(self, **keywords: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **keywords)

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        self.exit(2, f"{self.prog}: error: {message}\nSee `{self.prog} --help`.\n")


def _names(actions: Sequence[argparse.Action]) -> dict[str, str]:
    """Return the user's names of the library's arguments: `mesh` is MESH, `crop` is --crop."""
    return {
        name: action.option_strings[-1] if action.option_strings else str(action.metavar)
        for action in actions
        for name in (action.dest, *ALIASES.get(action.dest, "").split())
    }


def _keywords(verb: str, option: str) -> dict[str, Any]:
    """Return the arguments of `add_argument` for a command's option."""
    _, metavar, mark, kind, default, words = FORMS.get(f"{verb} {option}", FORMS[option])
    if not metavar:
        return {"help": words, "action": "store_true"}
    keywords = {"help": words, "type": TYPES[kind], "default": default}
    if metavar[0] == "{":
        return {**keywords, "choices": metavar[1:-1].split(",")}
    names = tuple(metavar.split())
    if len(names) > 1:
        return {**keywords, "metavar": names, "nargs": len(names)}
    number = {"required": True} if mark == "!" else {"nargs": mark or None}
    return {**keywords, "metavar": metavar, **number}
