"""The command as a user runs it: in a process of its own."""

import json
import os
import re
import shlex
import subprocess
import sys

import jax
import numpy as np
import pytest
from chosen import full, long
from folders import in_trimesh
from numpy.testing import assert_allclose, assert_array_equal
from oracles import camera_ahead, drawn, lump, off, turned, usual_camera
from PIL import ExifTags, Image
from processes import python
from refusals import pairs, refusal
from results import degrees, fit_at
from scipy.ndimage import binary_dilation

import pinhole_jax as pj
from pinhole_jax import __main__ as command, io
from pinhole_jax._camera.distortion import MODELS
from pinhole_jax._command.arguments import VERBS, parse
from pinhole_jax._command.options import record_of
from pinhole_jax._files.naming import named, renamed
from pinhole_jax._files.process import set_up
from pinhole_jax._files.progress import NOTES, listening
from pinhole_jax._fit.words import STATUSES
from pinhole_jax._solver.parameters import NAMES
from pinhole_jax.batch.inputs import read_start
from pinhole_jax.names import DISTORTIONS, FREE, STATUSES as STATUSES_TOLD

CAMERA = usual_camera()


SCENE = lump(3)
#: A camera of NeRF's kind, without its resolution.
SIZELESS = """{"camera_angle_x": 1, "frames": [{"file_path": "a", "transform_matrix":
    [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]]}]}"""
#: What a command prints while it works: a line every ten seconds.
WAITED = r"( *\d+ s  .*\n)*"


def run(words, cache, before="-m pinhole_jax"):
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    return python(*before.split(), *words.split(), env=environment)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A mesh, cameras and masks, with a cache of programs beside them."""
    folder = tmp_path_factory.mktemp("main")
    in_trimesh(SCENE.mesh).export(folder / "bumpy.ply")
    io.save_camera(folder / "truth.json", CAMERA)
    endless = {**io.camera_to_dict(CAMERA), "W": 20_000, "H": 20_000, "pose": None}
    (folder / "endless.json").write_text(json.dumps(endless))
    (folder / "sizeless.json").write_text(SIZELESS)
    io.save_camera(folder / "start.json", turned(CAMERA, 8, 1.05))
    io.save_image(folder / "mask.png", drawn(CAMERA, SCENE))
    dot = Image.new("L", (96, 80))
    dot.save(folder / "black.png")
    dot.resize((9, 9)).save(folder / "small.png")
    dot.paste(255, (20, 20, 70, 60))
    dot.save(folder / "dot.png")
    dot.point(lambda value: 255 - value).save(folder / "inverted.png")
    dot.point(lambda value: 7 * (value > 0)).save(folder / "sevens.png")
    return folder


@pytest.fixture
def here(folder, monkeypatch):
    """The folder, from which commands run in this process as it is set up."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(command, "_set_up_jax", lambda *_, **__: None)
    return folder


def main(words):
    return command.main(words.split())


@pytest.fixture
def fitted(here, monkeypatch):
    """A fit that the command finds at once, and the arguments that it was asked with."""
    fit, asked = fit_at(CAMERA, [0.1], ("e_x",)), []

    def fit_camera(*arguments, **more):
        asked.append((arguments, more))
        return fit

    monkeypatch.setattr(pj, "fit_camera", fit_camera)
    return fit, asked


@pytest.mark.parametrize("report", [long(""), full("--report out/page.html")])
def test_render_then_fit_then_check(folder, report):
    cache, out = folder / "cache", folder / "out"
    rendered = run(f"render {folder}/bumpy.ply {folder}/truth.json -o {folder}/drawn.png", cache)
    assert rendered.returncode == 0, rendered.stderr
    assert "96 x 80" in rendered.stdout
    assert_array_equal(io.load_image(folder / "drawn.png"), io.load_image(folder / "mask.png"))

    report = report.replace("out/", f"{out}/")
    fit = f"fit {folder}/bumpy.ply {folder}/drawn.png --camera {folder}/start.json"
    fitted = run(f"{fit} {report} -o {out}", cache)
    assert fitted.returncode == 0, fitted.stderr
    assert re.fullmatch(WAITED, fitted.stderr)
    for path in report.split()[1:]:
        assert "Camera of bumpy.ply from drawn.png" in (out / "page.html").read_text()
        assert path in fitted.stdout
    for words in ("one sigma", "e_x", "status     converged", "IoU", "s compile", "s run"):
        assert words in fitted.stdout
    fit = io.load_fit(out / "camera.json")
    assert degrees(fit, CAMERA) < 0.05  # the mask has 8 bits
    assert str(fit) in fitted.stdout
    assert np.all(np.isfinite(fit.covariance))
    assert io.load_image(out / "overlay.png").shape[1] >= 800
    assert any(cache.rglob("*"))  # compiled programs are kept

    # Later: has the camera moved? By half a degree, another mask says.
    io.save_image(folder / "pushed.png", drawn(turned(CAMERA, 0.5, 1.0), SCENE))
    pushed = run(f"check {out}/camera.json {folder}/bumpy.ply {folder}/pushed.png", cache)
    assert pushed.returncode == 1, pushed.stderr
    assert "moved: " in pushed.stdout
    assert "turned by 0.5 degrees" in pushed.stdout


@pytest.mark.long
def test_photo_refines_the_camera(here, capsys):
    mask = drawn(CAMERA, SCENE) > 0.5
    io.save_image("photo.png", 1.0 * mask)
    io.save_image("large.png", 1.0 * binary_dilation(mask, iterations=2))
    main("fit bumpy.ply large.png --camera start.json --image photo.png --refine -o refined")
    assert "fitted to the photo" in capsys.readouterr().out
    assert (
        degrees(io.load_fit("refined/camera.json"), CAMERA) < 0.5
    )  # 2 px too large: 3.4 without the photo


@pairs(
    "words, message",
    {
        "fit no.ply dot.png --camera start.json": "`MESH`: expected a mesh file",
        "fit bumpy.ply no.png --camera start.json": "`MASK`: expected an image file",
        "fit bumpy.ply small.png --camera start.json": (
            "`--camera`: expected a camera of the mask's size 9 x 9, got one of 96 x 80; if"
        ),
        "fit bumpy.ply black.png --camera start.json": "`MASK`: expected a mask that covers",
        "fit bumpy.ply dot.png --camera start.json --free zoom": "`--free`: expected names",
        "fit bumpy.ply dot.png": "give `--camera`, `--K` or `--fov`, or add phi to `--free`",
        "fit bumpy.ply dot.png --fov 34 --image small.png": (
            "`--image`: expected the mask's size 96 x 80, got 9 x 9"
        ),
        "fit bumpy.ply dot.png --fov 34 --refine": "`--refine`: expected a photo",
        "fit bumpy.ply black.png --fov 34 --mask-from label=9": (
            "no pixel with the label 9; there are 0"
        ),
        "fit bumpy.ply inverted.png --fov 34": (
            "covers 100% of its border, like a black object on white, or labels amid void; give"
            " `--invert`, or where it is right `--mask-from luminance`"
        ),
        "fit bumpy.ply sevens.png --fov 34": "`--mask-from label=7`",
        "fit bumpy.ply dot.png --fov 234": "`--fov`: expected degrees between 1 and 180, got 234",
        "fit bumpy.ply dot.png --fov 34 --free phi": (
            "`--camera`: expected a camera to start from, as the pose is not free"
        ),
        "fit bumpy.ply dot.png --K nan 1 1 1": "`--K`: expected 4 or 9 finite numbers, got 'nan",
        "fit bumpy.ply bumpy.ply --fov 34": "bumpy.ply': cannot identify image file\n",
        "fit dot.png bumpy.ply --fov 34": "are `MESH` and `MASK` exchanged?",
        "render bumpy.ply black.png": "`CAMERA`: expected a folder (COLMAP) or one of .json",
        "render bumpy.ply endless.json": (
            "`CAMERA`: expected at most 178956970 pixels, got 20000 x 20000 (in 'endless.json')"
        ),
        "check truth.json bumpy.ply": "`MASK`: expected one image of MESH",
        "check truth.json bumpy.ply a.png b.png": "`MASK`: expected one image of MESH",
        "check truth.json arm.urdf joints.csv": "`MASK`: expected JOINTS, and an image",
        "check none.json bumpy.ply a.png": "`CAMERA`: expected",
        "convert sizeless.json y.glb": "give `--size W H`",
        "convert truth.json y.glb --from usd": "`--from`: expected one of json, opencv",
    },
)
def test_bad_input_is_one_line_and_status_2(here, words, message, capsys):
    output = "" if words.startswith("convert") else " -o nothing"
    assert main(words + output) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (here / "nothing").exists()


@pytest.mark.long
def test_fit_needs_no_start(here, capsys):
    # A photo before a blue background; its EXIF data tell the field of view: no start, no --fov.
    mask = drawn(CAMERA, SCENE)[..., None]
    photo = Image.fromarray(np.uint8(mask * [220, 90, 40] + (1 - mask) * [0, 0, 255] + 0.5))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 1
    f35 = round(np.hypot(36, 24) / np.hypot(96, 80) * 80 / (2 * np.tan(0.3)))
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm.value: f35}
    photo.save("blue.png", exif=exif)
    words = "--mask-from background=blue --free pose,phi --verbose -o found"
    assert main(f"fit bumpy.ply blue.png {words}") == 0
    assert degrees(io.load_fit("found/camera.json"), CAMERA) < 0.2
    error = capsys.readouterr().err
    assert f"by EXIF's FocalLengthIn35mmFilm {f35} mm, held fixed unless phi is free" in error
    assert "mask: what differs from blue by more than" in error
    assert "96 x 80 pixels: " in error


def test_convert_there_and_back(here, capsys):
    assert main("convert truth.json truth.yaml") == 0
    assert capsys.readouterr().out.endswith("truth.yaml (opencv, 1 camera, 96 x 80)\n")
    assert main("convert truth.yaml back.json --size 96 80") == 0
    camera = io.load_camera("back.json")
    assert off(camera, CAMERA) < 1e-12
    assert main("convert back.json x --to colmap-binary") == 0
    assert "x (colmap-binary, 1 camera, 96 x 80)" in capsys.readouterr().out


@pytest.mark.long
def test_user_without_a_home_keeps_no_programs(folder, monkeypatch):
    script = folder / "homeless.py"
    script.write_text(
        "import os, pwd, sys; pwd.getpwuid = lambda uid: {}[uid];"
        "del os.environ['HOME'], os.environ['XDG_CACHE_HOME'];"
        "from pinhole_jax.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    words = f"render {folder}/bumpy.ply {folder}/truth.json -o {folder}/homeless.png"
    done = run(words, folder, before=str(script))
    assert done.returncode == 0
    assert re.fullmatch(WAITED, done.stderr)
    assert io.load_image(folder / "homeless.png").shape == (80, 96)


@pytest.mark.parametrize(
    "arguments, status, words",
    [
        ("--help", 0, "usage: pinhole-jax"),
        ("fit --help", 0, "usage: pinhole-jax fit"),
        ("--version", 0, rf"^pinhole-jax {re.escape(pj.__version__)} \((compiled|arrays).* CPUs\)"),
        ("fti", 2, "invalid choice: 'fti'"),
        ("", 2, "the following arguments are required: COMMAND"),
    ],
)
def test_help_and_words_about_a_typo_need_no_jax(arguments, status, words):
    code = (
        "import atexit, runpy, sys; sys.argv = ['pinhole-jax', *sys.argv[1:]];"
        "heavy = ('jax', 'numpy', 'equinox', 'PIL', 'trimesh', 'skimage', 'scipy');"
        "atexit.register(lambda: print('loaded', [m for m in heavy if m in sys.modules]));"
        "runpy.run_module('pinhole_jax', run_name='__main__')"
    )
    done = python("-c", code, *arguments.split())
    assert done.returncode == status
    assert re.search(words, done.stdout + done.stderr)
    assert done.stdout.endswith("loaded []\n")


def test_help_lists_what_the_tables_hold():
    assert FREE == NAMES
    assert STATUSES_TOLD == STATUSES
    assert {name: tuple(model.powers) for name, model in MODELS.items()} == DISTORTIONS


def help_of(name, capsys):
    with pytest.raises(SystemExit):
        command.main([name, "--help"])
    return capsys.readouterr().out


def test_help_has_groups_and_an_example_of_each_command(capsys):
    for name in VERBS:
        text = help_of(name, capsys)
        (example,) = re.findall(r"^example: pinhole-jax (.*)$", text, re.M)
        assert parse(shlex.split(example)).command == name
        assert ("label=N" in text) == (name not in ("render", "convert"))
        assert max(map(len, text.splitlines())) <= 100
    assert re.search(r"^camera:$(.|\n)*^masks:$(.|\n)*^output:$", help_of("fit", capsys), re.M)


@pairs(
    "words, message",
    {
        "fit a.ply b.png --fvo 3": "--fvo 3 (did you mean --fov?)",
        "fit a.ply": "required: MASK",
        "render a.ply b.json --fov 3": "unrecognized arguments: --fov 3",
    },
)
def test_typo_shows_the_usage_of_its_command(words, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(words)
    error, name = capsys.readouterr().err, words.split()[0]
    assert error.startswith(f"usage: pinhole-jax {name} ")
    assert message in error
    assert f"`pinhole-jax {name} --help`" in error


def test_closed_pipe_is_silent():
    code = (
        "import sys\nfrom pinhole_jax import __main__ as command\n"
        "command._run = lambda _: print('converged')\nsys.exit(command.main([]))"
    )
    reader, writer = os.pipe()
    os.close(reader)
    streams = {"stdout": writer, "stderr": subprocess.PIPE}
    done = python("-c", code, capture_output=False, **streams)
    os.close(writer)
    assert (done.returncode, done.stderr) == (command.PIPE, "")


@pytest.mark.parametrize(
    "words, expected, said",
    [
        (
            "crumbs.png",
            "dot.png",
            "mask: 1 island of at most 1 px dropped; turn this off with",
        ),
        ("crumbs.png --no-tidy", "crumbs.png", ""),
        ("inverted.png --invert", "dot.png", ""),
    ],
)
def test_mask_is_fitted_as_the_options_say(fitted, capsys, words, expected, said):
    with Image.open("dot.png") as dot:
        dot.putpixel((2, 2), 255)
        dot.save("crumbs.png")
    main(f"fit bumpy.ply {words} --fov 34 -o masks")
    assert_array_equal(fitted[1][0][1]["target"], io.load_image(expected))
    error = capsys.readouterr().err
    assert said in error
    assert ("island" in error) == bool(said)


def test_help_shows_camera_files_that_can_be_read(capsys):
    text = help_of("render", capsys).replace("[x, y, z]", "[1, 2, 3]").replace("[x, y]", "[48, 40]")
    camera = json.loads(re.search(r'\{"e": .*\}', text)[0])
    camera |= {"p": [0, 0, 0], "u": [0, 1, 0]}
    lens = json.loads(re.search(r'\{"principal_point": .*?\}', text)[0])
    models = [json.loads(found) for found in re.findall(r'\{"model": .*?\}', text)]
    assert [bent["model"] for bent in models] == ["BrownConrady", "Rational", "Fisheye"]
    for bent in models:
        read = io.camera_from_dict({**camera, "lens": {**lens, "distortion": bent}})
        written = io.camera_to_dict(read)
        assert written["lens"] == {**lens, "distortion": bent}
        assert camera.keys() <= written.keys()


@pytest.mark.parametrize("status", STATUSES)
def test_converged_fit_alone_exits_with_0(fitted, status, monkeypatch, capsys):
    fit = fitted[0]._replace(status=status)
    if status == "non_finite":
        fit = fit._replace(rms=np.nan, iou=np.nan)
    monkeypatch.setattr(pj, "fit_camera", lambda *_, **__: fit)
    code = main(f"fit bumpy.ply dot.png --fov 34 -o {status}")
    assert code == (0 if status == "converged" else 1)
    assert f"status     {status}   ({STATUSES[status]})\n" in capsys.readouterr().out
    assert io.load_fit(f"{status}/camera.json").status == status


def test_interrupt_prints_one_line_and_exits_with_130(here, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("pinhole_jax._command.render.run", interrupted)
    assert main("render a.obj c.json -o x.png") == 130
    assert capsys.readouterr().err == "pinhole-jax render: interrupted\n"


@pytest.mark.parametrize("within", ["nullcontext()", "interrupts_raise()"])
def test_interrupt_that_is_swallowed_still_ends_the_command(folder, within):
    """As JAX's callbacks and exits lose it; what is being written is removed first."""
    script = f"""
import signal, sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from pinhole_jax import __main__ as command
from pinhole_jax._files.interrupt import interrupts_raise

def lost(*_):
    half = Path("half.txt")
    try:
        with {within}:
            half.touch()
            signal.raise_signal(signal.SIGINT)
    finally:
        half.unlink()
    return 0

command._set_up_jax = lambda _: None
command._verb = lambda _: SimpleNamespace(run=lost)
signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background it may be ignored
sys.exit(command.main(["render", "a.obj", "c.json"]))
"""
    done = python("-c", script, cwd=folder)
    assert (done.returncode, done.stderr) == (130, "pinhole-jax render: interrupted\n")
    assert (folder / "half.txt").exists() == (within == "nullcontext()")
    (folder / "half.txt").unlink(missing_ok=True)


def start_of(words, size=(96, 80)):
    """Return the camera of a command line; errors are as the command prints them."""
    options = parse(["fit", *words.split(), "a.ply", "b.png"])
    tell = lambda text: print(renamed(text, options.names))
    with named(**options.names), listening(tell, NOTES):
        return read_start(record_of(options), size)


def test_known_intrinsics_are_read_as_opencv_has_them(tmp_path):
    path = tmp_path / "k.json"
    path.write_text(json.dumps({"fx": 90, "fy": 91, "cx": 47.5, "cy": 40, "w": 96, "h": 80}))
    for K in ("90 91 47.5 40", path):
        camera, phi, lens = start_of(f"--K {K} --dist -.1 0 0 0 0 1e-2 0 0")
        assert camera is None
        assert_allclose(phi, 2 * np.arctan(80 / 2 / 91))
        assert_allclose(lens.principal_point, [48, 80 - 40.5])
        assert_allclose(lens.aspect, 90 / 91)
        assert type(lens.distortion) is pj.Rational
        assert float(lens.distortion.k1) == pytest.approx(-0.1)
    with refusal("`--K`: expected a camera of the mask's size 48 x 40"):
        start_of(f"--K {path}", (48, 40))


def rays_of(camera, phi, lens):
    """Return a picture's rays by what `fit_camera` is given."""
    ahead = camera_ahead()
    camera = camera or ahead.replace(phi=phi, lens=lens)
    return np.asarray(pj.camera_rays(camera.replace(e=ahead.e, p=ahead.p, u=ahead.u)).direction)


def test_cropped_and_resized_photos_keep_the_rays(here):
    # Of a photo of 400 x 300 px: a window, one that was shrunk to a half, the whole one shrunk.
    K, turn = [[310, 0, 205], [0, 308, 140], [0, 0, 1]], np.diag([1.0, -1, -1])
    photo = pj.formats.from_opencv(
        K, turn, [0, 0, 1], 400, 300, pixel_centres="integer", distortion=pj.BrownConrady(-0.05)
    )
    io.save_camera("photo.json", photo)
    whole = np.asarray(pj.camera_rays(photo).direction)
    window = whole[60:140, 120:216]
    for way in ("--K 310 308 205 140 --dist -0.05 0 0 0", "--camera photo.json"):
        rays = rays_of(*start_of(f"{way} --crop 120 60 96 80"))
        assert_allclose(rays, window, atol=1e-9)
        half = rays_of(*start_of(f"{way} --crop 100 40 192 160 --resize 192 160"))
        corners = whole[40:200, 100:292].reshape(80, 2, 96, 2, 3).mean(axis=(1, 3))
        assert_allclose(half, corners, atol=1e-4)
        small = rays_of(*start_of(f"{way} --resize 400 300"))
        assert_allclose(small[40, 48], whole[151, 201], atol=3e-3)
    # A file that holds no size has a window's rays all the same.
    pj.formats.write_opencv("bare.yaml", {"photo": photo})
    lines = (here / "bare.yaml").read_text().splitlines(keepends=True)
    (here / "bare.yaml").write_text("".join(x for x in lines if not x.startswith("image_")))
    bare = rays_of(*start_of("--camera bare.yaml --crop 120 60 96 80"))
    assert_allclose(bare, window, atol=1e-9)
    # A picture shrunk alike both ways keeps its field of view; else pixels are no longer square.
    assert start_of("--fov 30 --resize 192 160").lens is None
    _, phi, lens = start_of("--fov 30 --resize 96 160")
    assert_allclose((phi, lens.aspect), (np.deg2rad(30), 2))


@pairs(
    "words, message",
    {
        "--fov 30 --crop 0 0 96 80": "`--crop`: expected `--camera` or `--K` with it",
        "--fov 30 --dist 0.1 0 0 0": "`--dist`: expected `--K` with it, got none",
        "--K 90 91 47.5 40 --dist 0.1": "`--dist`: expected 4 or 5 or 8 finite numbers",
        "--K 90 91 47 40 --crop 0 0 48 40": (
            "`--crop`: expected the size of the mask.* 96 x 80, got 48 x 40; .* `--resize` 48 40"
        ),
        "--K 90 91 47 40 --crop 0 0 48 40 --resize 50 40": (
            "`--crop`: expected the size of the mask or of `--resize`, 50 x 40, got 48 x 40"
        ),
        "--K 90 91 47 40 --crop 0 0 0 40": "`--crop`: expected a width and height",
        "--K 90 91 47 40 --resize 0 40": "`--resize`: expected a width and height",
        "--K 0 91 47 40": "`--K`: expected positive focal lengths in px",
        "--camera start.json --resize 9 9": (
            "`--camera`: expected a camera of the mask's size 9 x 9, got one of 96 x 80"
        ),
        "--camera no.json": "`--camera`: expected a camera file, got 'no.json': no such",
        "--fov 0.577": r"`--fov`: expected degrees between 1 and 180, got 0\.577",
    },
)
def test_options_that_do_not_go_together_are_named(here, words, message):
    with refusal(message):
        start_of(words)


@pytest.mark.parametrize(
    "status, sigma, ended",
    [("converged", 1.0, 0), ("converged", 9.0, 1), ("misfit", 9.0, 3), ("non_finite", 0.0, 3)],
)
def test_check_ends_with_its_finding(here, status, sigma, ended, monkeypatch, capsys):
    fit = fit_at(CAMERA, [0.01], ("e_x",), status=status)
    motion = pj.drift(fit, fit)._replace(sigma=sigma)
    for name, result in {"fit_camera": fit, "drift": motion}.items():
        monkeypatch.setattr(f"pinhole_jax._command.check.{name}", lambda *_, x=result, **__: x)
    assert main("check truth.json bumpy.ply mask.png") == ended
    assert ended or "not moved: 1.0 sigma" in capsys.readouterr().out


@pytest.mark.parametrize("times, ended", [(1.0, 0), (0.1, 1)])
def test_check_of_halves_ends_with_its_finding(here, times, ended, monkeypatch, capsys):
    """Both halves' eyes are a standard error off, one each way, or ten."""

    def fit_camera(*_, weight=None):
        side = 0 if weight is None else 1 if weight[0, 0] else -1
        camera = CAMERA.replace(phi=CAMERA.phi + 0.001 * side)
        return fit_at(camera, [0.001 * times], ("phi",))

    monkeypatch.setattr("pinhole_jax._command.check.fit_camera", fit_camera)
    assert main("check truth.json bumpy.ply mask.png --split --free phi") == ended
    assert ("TOO NARROW" in capsys.readouterr().out) == bool(ended)


@pytest.mark.parametrize("K", ["600 600 120 320", "900 320 900 240", "900 900 -3 120"])
def test_principal_point_outside_the_picture_is_refused(K):
    with refusal("`--K`: expected a principal point inside .* fx fy cx cy.* `--resize` with the"):
        start_of(f"--K {K}", (640, 240))


@pairs(
    "options, words",
    {
        "--K 90 91 47 40": "",
        "--K 90 91 44 46": "",
        "--K 90 91 96 80 --resize 192 160": "",
        "--K 90 91 300 20 --crop 250 0 96 80": "",
        "--K 90 91 60 40": "far from the middle, at (60, 40) px in a picture of 96 x 80: is the",
        "--fov 4": "",
        "--fov 1.2": "note: `--fov`: got 1.2: degrees?",
    },
)
def test_unlikely_cameras_are_noted(options, words, capsys):
    start_of(options)
    said = capsys.readouterr().out
    assert words in said
    assert bool(words) == bool(said)


def test_output_that_cannot_be_written_is_found_before_the_fit(here, monkeypatch, capsys):
    (here / "file").write_text("x")
    monkeypatch.setattr(io, "load_mask", lambda *_, **__: pytest.fail("began"))
    for more, option in (("-o file/out", "--output"), ("-o new --report .", "--report")):
        assert main(f"fit bumpy.ply mask.png --fov 34 {more}") == 2
        assert f"`{option}`: expected a file to write, got" in capsys.readouterr().err
    assert not (here / "new").exists()


def test_fit_is_printed_where_it_cannot_be_written(fitted, monkeypatch, capsys):
    words = "fit bumpy.ply mask.png --fov 34 -o full"
    main(words)
    assert "(replaced" not in capsys.readouterr().out
    main(words)
    files = "full/camera.json (replaced), full/overlay.png (replaced)"
    assert f"written    {files}\n" in capsys.readouterr().out

    def full(*_, **__):
        raise OSError("No space left on device")

    monkeypatch.setattr(io, "save_fit", full)
    assert main(words) == 2
    printed = capsys.readouterr()
    assert "one sigma" in printed.out
    assert printed.err == "pinhole-jax fit: No space left on device\n"


@pytest.mark.parametrize("said, expected", [("", "cpu"), ("cuda,cpu", "cuda,cpu")])
def test_own_processes_use_the_cpu_by_default(said, expected):
    before = jax.config.jax_platforms
    try:
        jax.config.update("jax_platforms", said)
        set_up(cached=False)
        assert jax.config.jax_platforms == expected
        assert jax.config.jax_enable_x64
    finally:
        jax.config.update("jax_platforms", before)
