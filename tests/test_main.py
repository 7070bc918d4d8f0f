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
from chosen import full
from oracles import drawn, turned
from PIL import ExifTags, Image
from scipy.ndimage import binary_dilation
from test_plot import fit_of

import pinhole_jax as pj
from pinhole_jax import __main__ as command, io, shapes
from pinhole_jax._camera.distortion import MODELS
from pinhole_jax._command.arguments import VERBS, parse
from pinhole_jax._command.options import record_of
from pinhole_jax._files.naming import named, renamed
from pinhole_jax._files.process import set_up
from pinhole_jax._files.progress import Ticker
from pinhole_jax._fit.words import STATUSES
from pinhole_jax._solver.parameters import NAMES, check_free
from pinhole_jax.batch.inputs import read_mask, read_start
from pinhole_jax.names import DISTORTIONS, FREE, STATUSES as STATUSES_TOLD

CAMERA = pj.Camera([0.3, 1.0, 5.0], [0.1, 0, 0], [0.2, 1, 0.1], 0.6, 1.0, 96, 80)


SCENE = pj.Scene(mesh=shapes.bumpy(3))


def run(*arguments, cache):
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    return subprocess.run(
        [sys.executable, "-m", "pinhole_jax", *map(str, arguments)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    import trimesh

    folder = tmp_path_factory.mktemp("main")
    mesh = shapes.bumpy(3)
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(folder / "bumpy.ply")
    io.save_camera(folder / "truth.json", CAMERA)
    io.save_camera(folder / "start.json", turned(CAMERA, [1, 2, 3], 8, 1.05))
    return folder


@pytest.mark.parametrize("report", [False, full(True)])
def test_render_then_fit(folder, report):
    cache = folder / "cache"
    rendered = run(
        "render",
        folder / "bumpy.ply",
        folder / "truth.json",
        "-o",
        folder / "mask.png",
        cache=cache,
    )
    assert rendered.returncode == 0, rendered.stderr
    assert "96 x 80" in rendered.stdout
    assert io.load_image(folder / "mask.png").shape == (80, 96)

    out = folder / "out"
    fitted = run(
        "fit",
        folder / "bumpy.ply",
        folder / "mask.png",
        "--camera",
        folder / "start.json",
        *(("--report", out / "page.html") if report else ()),
        "-o",
        out,
        cache=cache,
    )
    assert fitted.returncode == 0, fitted.stderr
    assert re.fullmatch(r"( *\d+ s  .*\n)*", fitted.stderr)  # a line every ten seconds
    if report:
        assert "Camera of bumpy.ply from mask.png" in (out / "page.html").read_text()
        assert str(out / "page.html") in fitted.stdout
    for words in (
        "parameter",
        "one sigma",
        "e_x",
        "status     converged",
        "IoU",
        "s compile",
        "s run",
    ):
        assert words in fitted.stdout
    angle, _ = pj.pose_error(io.load_camera(out / "camera.json"), CAMERA)
    assert np.rad2deg(angle) < 0.05  # the mask has 8 bits
    fit = io.load_fit(out / "camera.json")
    assert fit.status == "converged"
    assert str(fit) in fitted.stdout
    assert np.all(np.isfinite(fit.covariance))
    assert io.load_image(out / "overlay.png").shape[1] >= 800
    assert any(cache.rglob("*"))  # compiled programs are kept

    # Later: has the camera moved? By half a degree, another mask says.
    io.save_image(folder / "pushed.png", drawn(turned(CAMERA, [1, 2, 3], 0.5, 1.0), SCENE))
    pushed = run(
        "check", out / "camera.json", folder / "bumpy.ply", folder / "pushed.png", cache=cache
    )
    assert pushed.returncode == 1, pushed.stderr
    assert "moved: " in pushed.stdout
    assert "turned by 0.5 degrees" in pushed.stdout


@pytest.mark.long
def test_still_camera_has_not_moved(folder):
    mask = drawn(CAMERA, SCENE)
    io.save_image(folder / "still.png", mask)
    io.save_fit(folder / "still.json", pj.fit_camera(SCENE, mask, CAMERA))
    files = folder / "still.json", folder / "bumpy.ply", folder / "still.png"
    still = run("check", *files, cache=folder / "cache")
    assert still.returncode == 0, still.stdout + still.stderr
    assert "not moved: " in still.stdout


@pytest.mark.long
def test_photo_refines_the_camera(folder):
    mask = drawn(CAMERA, SCENE) > 0.5
    io.save_image(folder / "photo.png", 1.0 * mask)
    io.save_image(folder / "large.png", 1.0 * binary_dilation(mask, iterations=2))
    files = folder / "bumpy.ply", folder / "large.png", "--camera", folder / "start.json"
    photo = "--image", folder / "photo.png", "--refine"
    refined = run("fit", *files, *photo, "-o", folder / "out", cache=folder / "cache")
    assert refined.returncode == 0, refined.stderr
    assert "the camera is the photo's" in refined.stdout
    angle, _ = pj.pose_error(io.load_camera(folder / "out" / "camera.json"), CAMERA)
    assert np.rad2deg(angle) < 0.5  # 2 px too large: 3.4 without the photo


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fit", "no.ply", "dot.png", "--camera", "start.json"), "`MESH`: expected a mesh file"),
        (
            ("fit", "bumpy.ply", "no.png", "--camera", "start.json"),
            "`MASK`: expected an image file",
        ),
        (
            ("fit", "bumpy.ply", "small.png", "--camera", "start.json"),
            "`--camera`: expected a camera of the mask's size 9 x 9, got one of 96 x 80; if",
        ),
        (
            ("fit", "bumpy.ply", "black.png", "--camera", "start.json"),
            "`MASK`: expected a mask that covers",
        ),
        (
            ("fit", "bumpy.ply", "black.png", "--camera", "start.json", "--free", "zoom"),
            "`--free`: expected names",
        ),
        (
            ("fit", "bumpy.ply", "black.png"),
            "give `--camera`, `--K` or `--fov`, or add phi to `--free`",
        ),
        (
            ("fit", "bumpy.ply", "black.png", "--fov", "34", "--image", "small.png"),
            "`--image`: expected the mask's size 96 x 80, got 9 x 9",
        ),
        (
            ("fit", "bumpy.ply", "black.png", "--fov", "34", "--refine"),
            "`--refine`: expected a photo beside it, got none: add --image PHOTO",
        ),
        (
            ("fit", "bumpy.ply", "black.png", "--fov", "34", "--mask-from", "label=9"),
            "no pixel with the label 9; there are 0",
        ),
        (
            ("fit", "bumpy.ply", "inverted.png", "--fov", "34"),
            "covers 100% of its border, like a black object on white; give `--invert`, or where it"
            " is right `--mask-from luminance`",
        ),
        (("fit", "bumpy.ply", "sevens.png", "--fov", "34"), "`--mask-from label=7` if its object"),
        (
            ("fit", "bumpy.ply", "dot.png", "--fov", "234"),
            "`--fov`: expected degrees between 0 and 180, got 234",
        ),
        (
            ("fit", "bumpy.ply", "dot.png", "--fov", "34", "--free", "phi"),
            "`--camera`: expected a camera to start from where the pose is not free",
        ),
        (
            ("fit", "bumpy.ply", "dot.png", "--K", "nan", "1", "1", "1"),
            "`--K`: expected 4 or 9 finite numbers, got 'nan,1,1,1'",
        ),
        (
            ("fit", "bumpy.ply", "bumpy.ply", "--fov", "34"),
            "bumpy.ply': cannot identify image file\n",
        ),
        (
            ("render", "bumpy.ply", "black.png"),
            "`CAMERA`: expected a folder (COLMAP) or one of .json",
        ),
    ],
)
def test_bad_input_is_one_line_and_status_2(folder, arguments, message, capsys):
    Image.new("L", (9, 9)).save(folder / "small.png")
    Image.new("L", (96, 80)).save(folder / "black.png")
    dot = Image.new("L", (96, 80))
    dot.paste(255, (30, 20, 60, 50))
    dot.save(folder / "dot.png")
    dot.point(lambda value: 7 * (value > 0)).save(folder / "sevens.png")
    inverted = Image.new("L", (96, 80), 255)
    inverted.paste(0, (30, 20, 60, 50))
    inverted.save(folder / "inverted.png")
    files = [folder / a if "." in a else a for a in arguments]
    assert command.main([*map(str, files), "-o", str(folder / "nothing"), "--no-cache"]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1
    assert not (folder / "nothing").exists()


def test_bad_input_ends_a_process_with_status_2(folder):
    done = run("fit", folder / "no.ply", "no.png", "-o", folder / "x", cache=folder / "cache")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "`MASK`: expected an image file" in done.stderr


@pytest.mark.long
def test_untrustworthy_fit_exits_with_1(folder):
    behind = pj.Camera([0.3, 1, 5], [0.3, 1, 9], [0.2, 1, 0.1], 0.6, 1.0, 96, 80)
    io.save_camera(folder / "behind.json", behind)
    mask = (drawn(CAMERA, SCENE) > 0.5).astype(np.uint8) * 255
    Image.fromarray(mask).save(folder / "hard.png")
    done = run(
        "fit",
        folder / "bumpy.ply",
        folder / "hard.png",
        "--camera",
        folder / "behind.json",
        "--free",
        "phi",
        "-o",
        folder / "lost",
        cache=folder / "cache",
    )
    assert done.returncode == 1, done.stderr
    assert "status     no_overlap" in done.stdout


@pytest.mark.long
def test_fit_needs_no_start(folder):
    # A photo before a blue background; its EXIF data tell the field of view: no start, no --fov.
    mask = drawn(CAMERA, SCENE)[..., None]
    photo = Image.fromarray(np.uint8(mask * [220, 90, 40] + (1 - mask) * [0, 0, 255] + 0.5))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 1
    f35 = np.hypot(36, 24) / np.hypot(96, 80) * 80 / (2 * np.tan(0.3))
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm.value: round(f35)}
    photo.save(folder / "photo.png", exif=exif)
    out, how = folder / "found", ("--mask-from", "background=blue", "--free", "pose,phi")
    files = (folder / "bumpy.ply", folder / "photo.png")
    done = run("fit", *files, *how, "--verbose", "-o", out, cache=folder / "cache")
    assert done.returncode == 0, done.stderr
    assert np.rad2deg(pj.pose_error(io.load_camera(out / "camera.json"), CAMERA)[0]) < 0.2
    assert f"by EXIF's FocalLengthIn35mmFilm {round(f35)} mm; a first guess" in done.stderr
    assert "mask: what differs from blue by more than" in done.stderr
    assert "96 x 80 pixels: " in done.stderr


def test_convert_there_and_back(folder, monkeypatch, capsys):
    cache = folder / "cache"
    there = run("convert", folder / "truth.json", folder / "truth.yaml", cache=cache)
    assert there.returncode == 0, there.stderr
    assert there.stdout.endswith("truth.yaml (opencv, 1 camera, 96 x 80)\n")
    back = run(
        "convert", folder / "truth.yaml", folder / "back.json", "--size", 96, 80, cache=cache
    )
    assert back.returncode == 0, back.stderr
    camera = io.load_camera(folder / "back.json")
    assert max(map(float, pj.pose_error(camera, CAMERA))) < 1e-12
    # (What these say needs no process of its own, as above.)
    monkeypatch.setattr(command, "_set_up_jax", lambda *_, **__: None)
    files = [str(folder / name) for name in ("back.json", "x", "y.glb")]
    assert command.main(["convert", *files[:2], "--to", "colmap-binary"]) == 0
    assert "x (colmap-binary, 1 camera, 96 x 80)" in capsys.readouterr().out
    assert command.main(["convert", *files[1:], "--from", "usd"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "pinhole-jax convert: `--from`: expected one of json, opencv" in told


@pytest.mark.long
def test_user_without_a_home_keeps_no_programs(folder):
    code = (
        "import pwd, sys; pwd.getpwuid = lambda uid: {}[uid];"
        "from pinhole_jax.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    environment = {k: v for k, v in os.environ.items() if k not in ("HOME", "XDG_CACHE_HOME")}
    files = [folder / name for name in ("bumpy.ply", "truth.json")]
    done = subprocess.run(
        [sys.executable, "-c", code, "render", *files, "-o", folder / "homeless.png"],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert io.load_image(folder / "homeless.png").shape == (80, 96)


def test_enormous_picture_is_not_rendered(folder):
    endless = {**io.camera_to_dict(CAMERA), "W": 20_000, "H": 20_000}
    del endless["pose"]
    (folder / "endless.json").write_text(json.dumps(endless))
    done = run("render", folder / "bumpy.ply", folder / "endless.json", cache=folder / "cache")
    assert done.returncode == 2
    assert "`CAMERA`: expected at most 178956970 pixels, got 20000 x 20000" in done.stderr
    assert "endless.json" in done.stderr


def test_help_says_what_a_camera_file_is(folder):
    for words in (["fit"], ["render"], ["convert"]):
        done = run(*words, "--help", cache=folder)
        assert done.returncode == 0
        assert '"phi": 0.6' in done.stdout
        assert max(map(len, done.stdout.splitlines())) <= 100


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--help"], 0, "usage: pinhole-jax"),
        (["fit", "--help"], 0, "usage: pinhole-jax fit"),
        (["render", "--help"], 0, "usage: pinhole-jax render"),
        (["convert", "--help"], 0, "usage: pinhole-jax convert"),
        (["--version"], 0, f"pinhole-jax {pj.__version__}"),
        (["fit", "a.ply", "b.png", "--fvo", "3"], 2, "unrecognized arguments: --fvo 3"),
        (["fit", "a.ply"], 2, "the following arguments are required: MASK"),
        (["fti"], 2, "invalid choice: 'fti'"),
        ([], 2, "the following arguments are required: COMMAND"),
    ],
)
def test_help_and_words_about_a_typo_need_no_jax(arguments, status, words):
    code = (
        "import atexit, runpy, sys; sys.argv = ['pinhole-jax', *sys.argv[1:]];"
        "heavy = ('jax', 'numpy', 'equinox', 'PIL', 'trimesh', 'skimage', 'scipy');"
        "atexit.register(lambda: print('loaded', [m for m in heavy if m in sys.modules]));"
        "runpy.run_module('pinhole_jax', run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == status
    assert words in done.stdout + done.stderr
    assert done.stdout.endswith("loaded []\n")


def test_help_lists_what_the_tables_hold():
    assert FREE == NAMES
    assert STATUSES_TOLD == STATUSES
    assert {name: tuple(model.powers) for name, model in MODELS.items()} == DISTORTIONS


def help_of(name, capsys):
    with pytest.raises(SystemExit):
        command.main([name, "--help"])
    return capsys.readouterr().out


def test_help_names_all_that_may_be_free(capsys):
    text = " ".join(help_of("fit", capsys).partition("--free NAMES ")[2].split())
    named = re.search(r"what to fit, of (.*?):", text)[1].split(", ")
    assert tuple(named) == NAMES
    for name in named:
        lens = pj.Lens([48, 40], distortion=pj.Rational())
        assert check_free(name, pj.Camera([0, 0, 5], [0, 0, 0], [0, 1, 0], 0.6, 1, 96, 80, lens))


def test_help_has_groups_and_an_example_of_each_command(capsys):
    for name in VERBS:
        text = help_of(name, capsys)
        (example,) = re.findall(r"^example: pinhole-jax (.*)$", text, re.M)
        assert parse(shlex.split(example)).command == name
        assert ("label=N" in text) == (name not in ("render", "convert"))
    assert re.search(r"^camera:$(.|\n)*^masks:$(.|\n)*^output:$", help_of("fit", capsys), re.M)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["fit", "a.ply", "b.png", "--fvo", "3"], "--fvo 3 (did you mean --fov?)"),
        (["fit", "a.ply"], "required: MASK"),
        (["render", "a.ply", "b.json", "--fov", "3"], "unrecognized arguments: --fov 3"),
    ],
)
def test_typo_shows_the_usage_of_its_command(words, told, capsys):
    with pytest.raises(SystemExit, match="2"):
        command.main(words)
    said = capsys.readouterr().err
    assert said.startswith(f"usage: pinhole-jax {words[0]} ")
    assert told in said
    assert f"`pinhole-jax {words[0]} --help`" in said


def test_closed_pipe_is_silent():
    code = (
        "import sys\nfrom pinhole_jax import __main__ as command\n"
        "command._run = lambda _: print('converged')\nsys.exit(command.main([]))"
    )
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-c", code], stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert (done.returncode, done.stderr) == (command.PIPE, b"")


def test_crumbs_go_and_are_told_unless_they_are_to_stay(folder, capsys):
    mask = drawn(CAMERA, SCENE) > 0.5
    crumbs = mask.copy()
    crumbs[2, 2] = True
    for asked, kept in (("", False), ("--no-tidy", True)):
        io.save_image(folder / "crumbs.png", crumbs)
        options = parse(["fit", "a.ply", str(folder / "crumbs.png"), *asked.split()])
        said = Ticker("reading", live=False, names=options.names)
        found = read_mask(record_of(options), said.tell)
        assert np.array_equal(found > 127, crumbs if kept else mask)
        assert capsys.readouterr().err.splitlines() == (
            []
            if kept
            else ["mask: 1 island of at most 1 px dropped; turn this off with `--no-tidy`"]
        )


def test_mesh_and_mask_exchanged_are_told(folder, capsys):
    files = [str(folder / name) for name in ("any.png", "bumpy.ply")]
    assert command.main(["fit", *files, "--fov", "34"]) == 2
    assert "are `MESH` and `MASK` exchanged?" in capsys.readouterr().err


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


def test_help_says_what_each_status_means(capsys):
    text = help_of("fit", capsys)
    for status, meaning in STATUSES.items():
        assert re.search(rf"^  {status} +{re.escape(meaning)}$", text, re.M)


@pytest.mark.parametrize("status", STATUSES)
def test_converged_fit_alone_exits_with_0(folder, status, monkeypatch, capsys):
    fit = fit_of(CAMERA, ("e_x",), [0.1])._replace(status=status)
    if status == "non_finite":
        fit = fit._replace(rms=np.nan, iou=np.nan)
    monkeypatch.setattr(pj, "fit_camera", lambda *_, **__: fit)
    # What the command sets for its own process would change those of the other tests.
    monkeypatch.setattr(command, "_set_up_jax", lambda *_, **__: None)
    Image.new("L", (96, 80)).save(folder / "any.png")
    files = [str(folder / name) for name in ("bumpy.ply", "any.png")]
    code = command.main(["fit", *files, "--fov", "34", "-o", str(folder / status)])
    assert code == (0 if status == "converged" else 1)
    assert f"status     {status}   ({STATUSES[status]})\n" in capsys.readouterr().out
    assert io.load_fit(folder / status / "camera.json").status == status


def test_inverted_mask_is_turned_on_request(folder, monkeypatch):
    given = []
    fit = fit_of(CAMERA, ("e_x",), [0.1])
    fitted = lambda scene, mask, *_, **__: given.append(mask) or fit
    monkeypatch.setattr(pj, "fit_camera", fitted)
    monkeypatch.setattr(command, "_set_up_jax", lambda *_, **__: None)
    mask = np.zeros((80, 96), np.uint8)
    mask[20:50, 30:60] = 255
    Image.fromarray(255 - mask).save(folder / "negative.png")
    files = [str(folder / name) for name in ("bumpy.ply", "negative.png")]
    out = str(folder / "turned")
    assert command.main(["fit", *files, "--fov", "34", "--invert", "-o", out]) == 0
    np.testing.assert_array_equal(given[0], mask)


def test_version_is_printed(capsys):
    with pytest.raises(SystemExit, match="0"):
        command.main(["--version"])
    printed = rf"pinhole-jax {re.escape(pj.__version__)} \((compiled library|arrays) on CPUs\)\n"
    assert re.fullmatch(printed, capsys.readouterr().out)


def test_interrupt_prints_one_line_and_exits_with_130(monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "_set_up_jax", lambda *_, **__: None)
    monkeypatch.setattr("pinhole_jax._command.render.run", interrupted)
    assert command.main(["render", "a.obj", "c.json", "-o", "x.png"]) == 130
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
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (130, "pinhole-jax render: interrupted\n")
    assert (folder / "half.txt").exists() == (within == "nullcontext()")
    (folder / "half.txt").unlink(missing_ok=True)


def known_of(*words, size=(96, 80)):
    """Return the camera of a command line; errors are as the command prints them."""
    options = parse(["fit", "a.ply", "b.png", *map(str, words)])
    said = lambda text: print(renamed(text, options.names))
    with named(**options.names):
        return read_start(record_of(options), size, said)


def test_known_intrinsics_are_read_as_opencv_has_them():
    camera, phi, lens = known_of("--K", 90, 91, 47.5, 40)
    assert camera is None
    np.testing.assert_allclose(phi, 2 * np.arctan(80 / 2 / 91))
    np.testing.assert_allclose(lens.principal_point, [48, 80 - 40.5])
    np.testing.assert_allclose(lens.aspect, 90 / 91)
    bent = known_of("--K", 90, 91, 47.5, 40, "--dist", 0.1, 0, 0, 0, 0, 0.01, 0, 0)
    assert type(bent.lens.distortion) is pj.Rational
    with pytest.raises(ValueError, match="`--dist`: expected 4 or 5 or 8 finite numbers"):
        known_of("--K", 90, 91, 47.5, 40, "--dist", 0.1)
    with pytest.raises(ValueError, match="`--dist`: expected `--K` beside it, got none"):
        known_of("--fov", 30, "--dist", 0.1, 0, 0, 0)


def test_numbers_and_names_are_read_with_commas_and_without():
    words = ["--K", "90,91,47.5,40", "--dist", "-0.21,0.07,0,0", "--free", "pose", "focal", "k1"]
    options = parse(["fit", *words, "a.ply", "b.png"])
    assert (options.K, options.dist) == ("90,91,47.5,40", "-0.21,0.07,0,0")
    assert options.free == "pose,phi,k1"
    assert (options.mesh, options.mask) == ("a.ply", "b.png")
    apart = parse(["fit", "--dist", "-.2", "1e-2", "0", "0", "a.ply", "b.png", "--K", "k.yaml"])
    assert (apart.dist, apart.K, apart.mesh) == ("-.2,1e-2,0,0", "k.yaml", "a.ply")


def test_file_of_intrinsics_is_that_of_the_whole_picture(tmp_path):
    path = tmp_path / "k.json"
    path.write_text(json.dumps({"fx": 90, "fy": 91, "cx": 47.5, "cy": 40, "w": 96, "h": 80}))
    _, phi, lens = known_of("--K", path, "--dist", -0.1, 0, 0, 0)
    np.testing.assert_allclose(phi, 2 * np.arctan(80 / 2 / 91))
    np.testing.assert_allclose(lens.principal_point, [48, 80 - 40.5])
    assert float(lens.distortion.k1) == pytest.approx(-0.1)
    with pytest.raises(ValueError, match="`--K`: expected a camera of the mask's size 48 x 40"):
        known_of("--K", path, size=(48, 40))


def rays_of(camera, phi, lens):
    """Return a picture's rays by what `fit_camera` is given."""
    if camera is None:
        camera = pj.Camera([0, 0, 1], [0, 0, 0], [0, 1, 0], phi, 1.0, 96, 80, lens)
    else:
        camera = camera.replace(e=[0, 0, 1], p=[0, 0, 0], u=[0, 1, 0])
    return np.asarray(pj.camera_rays(camera).direction)


def test_cropped_and_resized_photos_keep_the_rays(folder):
    # Of a photo of 400 x 300 px: a window, one that was shrunk to a half, the whole one shrunk.
    fx, fy, cx, cy, k1 = 310, 308, 205, 140, -0.05
    K, turn = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.diag([1.0, -1, -1])
    bent = pj.BrownConrady(k1)
    of = lambda *size: pj.formats.from_opencv(
        K, turn, [0, 0, 1], *size, pixel_centres="integer", distortion=bent
    )
    io.save_camera(folder / "photo.json", of(400, 300))
    ways = [
        ("--K", fx, fy, cx, cy, "--dist", k1, 0, 0, 0),
        ("--camera", folder / "photo.json"),
    ]
    whole = np.asarray(pj.camera_rays(of(400, 300)).direction)
    for way in ways:
        window = rays_of(*known_of(*way, "--crop", 120, 60, 96, 80))
        np.testing.assert_allclose(window, whole[60:140, 120:216], atol=1e-9)
        half = rays_of(*known_of(*way, "--crop", 100, 40, 192, 160, "--resize", 192, 160))
        corners = whole[40:200, 100:292].reshape(80, 2, 96, 2, 3).mean(axis=(1, 3))
        np.testing.assert_allclose(half, corners, atol=1e-4)
        small = rays_of(*known_of(*way, "--resize", 400, 300))
        np.testing.assert_allclose(small[40, 48], whole[151, 201], atol=3e-3)
    # A file that holds no size has a window's rays all the same.
    pj.formats.write_opencv(folder / "bare.yaml", {"photo": of(400, 300)})
    lines = (folder / "bare.yaml").read_text().splitlines(keepends=True)
    (folder / "bare.yaml").write_text("".join(x for x in lines if not x.startswith("image_")))
    bare = rays_of(*known_of("--camera", folder / "bare.yaml", "--crop", 120, 60, 96, 80))
    np.testing.assert_allclose(bare, whole[60:140, 120:216], atol=1e-9)
    # What is shrunk alike both ways keeps its field of view; else pixels are no longer square.
    assert known_of("--fov", 30, "--resize", 192, 160).lens is None
    np.testing.assert_allclose(known_of("--fov", 30, "--resize", 96, 160).phi, np.deg2rad(30))
    np.testing.assert_allclose(known_of("--fov", 30, "--resize", 96, 160).lens.aspect, 2)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--fov", 30, "--crop", 0, 0, 96, 80), "`--crop`: expected `--camera` or `--K` beside it"),
        (
            ("--K", 90, 91, 47, 40, "--crop", 0, 0, 48, 40),
            "`--crop`: expected the mask's size 96 x 80, got 48 x 40; .* add `--resize` 48 40",
        ),
        (
            ("--K", 90, 91, 47, 40, "--crop", 0, 0, 48, 40, "--resize", 50, 40),
            "`--resize`: expected the size of `--crop`, 48 x 40, got 50 x 40",
        ),
        (("--K", 90, 91, 47, 40, "--crop", 0, 0, 0, 40), "`--crop`: expected a width and height"),
        (("--K", 90, 91, 47, 40, "--resize", 0, 40), "`--resize`: expected a width and height"),
        (("--K", 0, 91, 47, 40), "`--K`: expected positive focal lengths in px"),
        (
            ("--camera", "START", "--resize", 9, 9),
            "`--resize`: expected the size of the camera of `--camera`, 96 x 80, got 9 x 9",
        ),
        (("--camera", "no.json"), "`--camera`: expected a camera file, got 'no.json': no such"),
    ],
)
def test_options_that_do_not_go_together_are_named(folder, words, message):
    words = [folder / "start.json" if word == "START" else word for word in words]
    with pytest.raises(ValueError, match=message):
        known_of(*words)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("`path`: expected a file", "`MESH`: expected a file"),
        ("`phi`: got nothing", "`phi`: got nothing"),
        ("give `size` (on the command line: --size W H)", "give `--size W H`"),
        ("or `mask_from` alpha (--mask-from alpha)", "or `--mask-from alpha`"),
    ],
)
def test_errors_name_the_arguments_of_the_command(text, told):
    with pytest.raises(ValueError, match=f"^{re.escape(told)}$"), named(path="MESH"):
        raise FileNotFoundError(text)


@pytest.mark.long
def test_fit_with_K_needs_no_pose(folder):
    """The camera is found from K alone, off the image's middle."""
    K, R, t = [[150, 0, 55], [0, 150, 33], [0, 0, 1]], np.diag([1.0, -1, -1]), [0.1, 0.2, 5]
    truth = pj.formats.from_opencv(K, R, t, 96, 80, pixel_centres="integer")
    io.save_image(folder / "off.png", drawn(truth, SCENE))
    arguments = (folder / "bumpy.ply", folder / "off.png", "--K", 150, 150, 55, 33)
    done = run("fit", *arguments, "-o", folder / "off", cache=folder / "cache")
    found = io.load_camera(folder / "off" / "camera.json")
    angle, distance = pj.pose_error(found, truth)
    assert (np.rad2deg(angle) < 0.3) & (distance < 0.05), done.stdout
    np.testing.assert_allclose(found.lens.principal_point, truth.lens.principal_point)


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (["truth.json", "bumpy.ply"], "`MASK`: expected one image of MESH"),
        (["truth.json", "bumpy.ply", "a.png", "b.png"], "`MASK`: expected one image of MESH"),
        (["truth.json", "arm.urdf", "joints.csv"], "`MASK`: expected JOINTS, and an image"),
        (["none.json", "bumpy.ply", "a.png"], "`CAMERA`: expected"),
    ],
)
def test_check_names_what_is_missing(folder, monkeypatch, capsys, files, words):
    monkeypatch.chdir(folder)
    assert command.main(["check", "--no-cache", *files]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("status", "sigma", "ended"),
    [("converged", 1.0, 0), ("converged", 9.0, 1), ("misfit", 9.0, 3), ("non_finite", 0.0, 3)],
)
def test_check_ends_with_what_it_found(status, sigma, ended, folder, monkeypatch, capsys):
    from pinhole_jax._command import check

    fit = fit_of(CAMERA, ("e_x",), [0.01])._replace(status=status)
    monkeypatch.setattr(check, "_mesh_fit", lambda *_: fit)
    monkeypatch.setattr(check, "drift", lambda *_: pj.drift(fit, fit)._replace(sigma=sigma))
    assert command.main(["check", str(folder / "truth.json"), "a.ply", "b.png"]) == ended
    assert ended or "not moved: 1.0 sigma" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("K", "more", "words"),
    [
        ((90, 91, 47, 40), (), ""),
        ((90, 91, 44, 46), (), ""),
        (
            (90, 91, 60, 40),
            (),
            "+12, +0 px from the middle, at (60, 40) px in a picture",
        ),
        ((90, 91, 96, 80), ("--resize", 192, 160), ""),
        ((90, 91, 38, 50), (), "are cx and cy exchanged?"),
        ((90, 91, 24, 20), (), "the size that `--K` belongs to: `--resize` W H (about 48 x 40)"),
        ((90, 91, 300, 20), ("--crop", 250, 0, 96, 80), ""),
    ],
)
def test_principal_point_far_from_the_middle_is_noted(K, more, words, capsys):
    known_of("--K", *K, *more)
    assert words in capsys.readouterr().out
    if not words:
        known_of("--K", *K, *more)
        assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("K", "size", "words"),
    [
        ((600, 600, 120, 320), (640, 240), r"\(120, 320\) px .* 640 x 240: are cx and cy exch"),
        ((900, 320, 900, 240), (640, 480), "the order is fx fy cx cy"),
        ((900, 900, 960, 540), (640, 360), r"was the picture resized\? .* \(about 1920 x 1080\)"),
        ((900, 900, -3, 540), (640, 360), "inside the picture, .* was the picture resized"),
    ],
)
def test_principal_point_outside_the_picture_is_refused(K, size, words):
    with pytest.raises(ValueError, match=rf"`--K`: expected a principal point .*{words}"):
        known_of("--K", *K, size=size)


def test_field_of_view_in_rad_is_questioned(capsys):
    with pytest.raises(ValueError, match=r"`--fov`: .* 0\.577: degrees\? 0\.577 rad are 33\.1"):
        known_of("--fov", 0.577)
    known_of("--fov", 1.2)
    assert "note: `--fov`: got 1.2: degrees?" in capsys.readouterr().out
    known_of("--fov", 4)
    assert capsys.readouterr().out == ""


def test_output_that_cannot_be_written_is_found_before_the_fit(folder, monkeypatch, capsys):
    (folder / "file").write_text("x")
    monkeypatch.setattr(io, "load_mask", lambda *_, **__: pytest.fail("began"))
    monkeypatch.setattr(command, "_set_up_jax", lambda *_, **__: None)
    fit = ["fit", str(folder / "bumpy.ply"), "mask.png", "--fov", "34", "--no-cache"]
    for more, option in (
        (("-o", folder / "file" / "out"), "--output"),
        (("-o", folder / "new", "--report", folder), "--report"),
    ):
        assert command.main([*fit, *map(str, more)]) == 2
        assert f"`{option}`: expected a file to write, got" in capsys.readouterr().err
    assert not (folder / "new").exists()


def test_fit_is_printed_where_it_cannot_be_written(folder, monkeypatch, capsys):
    fit = fit_of(CAMERA, ("e_x",), [0.1])
    monkeypatch.setattr(pj, "fit_camera", lambda *_, **__: fit)
    monkeypatch.setattr(command, "_set_up_jax", lambda *_, **__: None)
    io.save_image(folder / "dot.png", drawn(CAMERA, SCENE))
    words = ["fit", str(folder / "bumpy.ply"), str(folder / "dot.png"), "--fov", "34"]
    words += ["-o", str(folder / "full")]
    command.main(words)
    assert "(replaced" not in capsys.readouterr().out
    command.main(words)
    there = [str(folder / "full" / name) for name in ("camera.json", "overlay.png")]
    assert f"{', '.join(there)} (replaced {', '.join(there)})" in capsys.readouterr().out

    def full(*_, **__):
        raise OSError("No space left on device")

    monkeypatch.setattr(io, "save_fit", full)
    assert command.main(words) == 2
    told = capsys.readouterr()
    assert "one sigma" in told.out
    assert told.err == "pinhole-jax fit: No space left on device\n"


@pytest.mark.parametrize(("said", "expected"), [("", "cpu"), ("cuda,cpu", "cuda,cpu")])
def test_own_processes_use_the_cpu_by_default(said, expected):
    before = jax.config.jax_platforms
    try:
        jax.config.update("jax_platforms", said)
        set_up(cached=False)
        assert jax.config.jax_platforms == expected
        assert jax.config.jax_enable_x64
    finally:
        jax.config.update("jax_platforms", before)
