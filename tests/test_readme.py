"""What README shows, runs: its Python, its commands (on small files); and its lists are the code's.

Python blocks run in order and share their names, as a reader would paste them.
"""

import ast
import re
import shlex
import textwrap
import tomllib
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

import pinhole_jax as pj
from pinhole_jax import __main__ as command, io, shapes
from pinhole_jax._files import programs
from pinhole_jax._fit.words import STATUSES

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
QUESTIONS = (ROOT / "docs" / "questions.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^( *)```(\w*)\n(.*?)^\1```$", re.M | re.S)
#: The files that stand for README's words in capitals.
FILES = {"MESH": "part.ply", "MASK": "mask.png", "PHOTO": "photo.png", "FOLDER": "folder"}

#: A mesh and a resolution as the Python has them, so that the commands find its programs compiled.
Camera = lambda e, phi: pj.Camera(e, [0.1, 0, 0], [0.2, 1, 0.1], phi, W=256, H=256)


def blocks(language, page=README):
    return [textwrap.dedent(text) for _, word, text in BLOCK.findall(page) if word == language]


def commands():
    return [line for block in blocks("sh") for line in block.splitlines()]


def test_there_is_no_block_that_no_test_knows():
    assert {word for _, word, _ in BLOCK.findall(README)} == {"python", "sh", ""}
    assert len(BLOCK.findall(README)) * 2 == len(re.findall(r"^ *```", README, re.M))
    assert {line.split()[0] for line in commands()} == {"python3", "pinhole-jax", "blender"}


@pytest.fixture
def another_cache(monkeypatch, tmp_path):
    """The user's cache folder is the test's, and has in it what tests share."""
    before = jax.config.jax_compilation_cache_dir
    least = jax.config.jax_persistent_cache_min_compile_time_secs
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "pinhole_jax").symlink_to(before)
    yield tmp_path / "pinhole_jax"
    pj.cache(before)
    programs.keep_in(None)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least)


def test_programs_are_kept_where_the_cache_is(another_cache):
    another_cache.unlink()
    assert pj.cache() == another_cache
    jax.jit(lambda x: x + 1)(2.0)
    assert any(another_cache.iterdir())


@pytest.mark.long
def test_python_runs_and_finds_the_cameras(capsys, another_cache):
    names = {}
    first, second, third = blocks("python")
    exec(compile(first, "README.md, first example", "exec"), names)
    assert names["fit"].status == names["found"].status == "converged"
    assert re.search(r"degrees, world units off: \S+e-", capsys.readouterr().out)

    exec(compile(second, "README.md, lenses", "exec"), names)
    assert names["fit"].status == "converged"
    assert abs(float(names["fit"].camera.lens.distortion.k1) + 0.27) < 1e-6
    assert max(view.rms_px for view in names["views"]) < 1e-6

    exec(compile(third, "README.md, an arm", "exec"), names)
    assert names["joint"].status == "converged"
    assert np.rad2deg(pj.pose_error(names["joint"].camera, names["truth"])[0]) < 1e-4


@pytest.mark.long
def test_the_code_of_the_ten_questions_runs():
    names = {}
    for block in blocks("python", QUESTIONS):
        exec(compile(block, "docs/questions.md", "exec"), names)
    for name in ("fit", "found", "held", "known_to_1_percent"):
        assert names[name].status == "converged"
        angle, _ = pj.pose_error(names[name].camera, names["truth"])
        assert np.rad2deg(angle) < 0.5
    assert names["masks"].shape == (2, 80, 96)
    assert len(names["pair"].faces) == 2 * len(names["scene"].mesh.faces)


def test_the_ten_questions_are_those_that_are_answered():
    asked = re.findall(r"^\d+\. \[(.*)\]\(#(.*)\)$", QUESTIONS, re.M)
    answered = re.findall(r"^## (\d+)\. (.*)$", QUESTIONS, re.M)
    assert [question for question, _ in asked] == [question for _, question in answered]
    for (_, anchor), (number, question) in zip(asked, answered, strict=True):
        words = re.sub(r"[^\w\s-]", "", f"{number} {question}").lower()
        assert anchor == words.replace(" ", "-")
    assert len(asked) == 10
    named = set(re.findall(r"`pj\.([\w.]+)", QUESTIONS)) | set(
        re.findall(r"\bpj\.([\w.]+)", QUESTIONS)
    )
    for name in named:
        thing = pj
        for part in name.split("."):
            thing = getattr(thing, part)
    assert "(docs/questions.md)" in README


def write_mesh(path):
    mesh = shapes.bumpy()
    corners = "\n".join(" ".join(map(str, v)) for v in np.asarray(mesh.vertices).tolist())
    faces = "\n".join("3 " + " ".join(map(str, f)) for f in np.asarray(mesh.faces).tolist())
    counts = f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\n"
    counts += f"property float z\nelement face {len(mesh.faces)}\n"
    header = f"ply\nformat ascii 1.0\n{counts}property list uchar int vertex_indices\nend_header\n"
    path.write_text(f"{header}{corners}\n{faces}\n")


def write_pictures(mask_path, photo_path, camera):
    """Write what the camera sees: a mask, and a photo before a white background."""
    coverage = np.asarray(pj.silhouette(camera, pj.Scene(mesh=shapes.bumpy())))[..., None]
    Image.fromarray(np.uint8(255 * coverage[..., 0] + 0.5)).save(mask_path)
    photo = 255 * (1 - coverage) + np.array([150, 60, 20]) * coverage
    Image.fromarray(np.uint8(photo + 0.5)).save(photo_path)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with all files that the commands read."""
    monkeypatch.chdir(tmp_path)
    # What the command sets for its own process would change those of the other tests.
    monkeypatch.setattr(command, "_set_up_jax", lambda options: None)
    write_mesh(tmp_path / FILES["MESH"])
    camera = Camera([0.3, 1, 5], np.deg2rad(34.4))
    write_pictures(FILES["MASK"], FILES["PHOTO"], camera)
    io.save_camera("CAMERA.json", camera)
    io.save_camera("START.json", Camera([0.5, 1.2, 5], 0.62))

    (tmp_path / "out").mkdir()
    write_mesh(tmp_path / "out" / "cup.ply")
    write_pictures("out/mask.png", "out/photo.png", Camera([0.5, 1.7, 8.5], np.deg2rad(20)))
    return tmp_path


@pytest.mark.long
def test_commands_run_and_write_what_they_say(folder, capsys):
    lines = [line for line in commands() if line.startswith("pinhole-jax ")]
    assert len(lines) == 7
    for line in lines:
        words = [FILES.get(word, word) for word in shlex.split(line)[1:]]
        assert command.main(words) == 0, (line, capsys.readouterr())
        # It has printed each file that it wrote.
        written = re.search(r"^written +(.*)$", capsys.readouterr().out, re.M)[1]
        assert all(Path(path).exists() for path in re.sub(r" \(.*", "", written).split(", "))
    for line in commands():
        if line.startswith("blender "):
            ast.parse(Path(line.split()[-1]).read_text())


def test_install_lines_name_what_there_is():
    lines = [line for line in commands() if line.startswith("python3 ")]
    assert len(lines) == 2
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = extras["optional-dependencies"]
    for line in lines:
        venv, install, use = (part.split() for part in line.split(" && "))
        assert venv == ["python3", "-m", "venv", ".venv"]
        assert install[:3] == [".venv/bin/pip", "install", "-q"]
        assert use[0] == ".venv/bin/python"
        for extra in re.findall(r"\[(\w+)\]", install[-1]):
            assert extra in extras
        for word in use[1:]:
            assert not word.endswith(".py") or (ROOT / word).is_file()


def test_links_lead_to_files():
    links = re.findall(r"\]\(([^)#]+)(?:#[\w-]+)?\)", README)
    assert len(links) > 8
    for link in links:
        assert (ROOT / link).exists(), link


def test_names_of_the_library_exist():
    names = set(re.findall(r"`pj\.([\w.]+)", README))
    assert len(names) > 8
    for name in names:
        thing = pj
        for part in name.split("."):
            thing = getattr(thing, part)


def test_statuses_are_those_of_a_fit():
    table = README.partition("| status | meaning |")[2].partition("\n\n")[0]
    assert dict(re.findall(r"\| `(\w+)` \| (.*) \|", table)) == STATUSES


def test_the_map_has_every_module_once():
    (text,) = (block for block in blocks("") if block.startswith("__main__"))
    columns = [re.split(r" {3,}", line)[0] for line in text.splitlines()]
    mapped = " ".join(columns).split()
    modules = {
        path.stem
        for path in (ROOT / "pinhole_jax").iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert sorted(mapped) == sorted(modules - {"__init__"})
