"""What README and docs/ show, runs: their Python, their commands (on small files); and their lists
are the code's.

The Python blocks of a page run in order and share their names, as a reader would paste them. Those
of pages that say `run: true` run while the site is built.
"""

import ast
import functools
import importlib
import inspect
import json
import os
import re
import shlex
import textwrap
import tomllib
from pathlib import Path

import figures
import jax
import numpy as np
import pytest
from chosen import full, long
from folders import in_trimesh
from oracles import usual_camera
from processes import printed
from results import check_found

import pinhole_jax as pj
from pinhole_jax import __main__ as command, io, shapes
from pinhole_jax._fit.words import STATUSES

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SHOWN = re.compile(r"^::: pinhole_jax\.([\w.]+)$", re.M)


def docstrings(name):
    """The reference's text on a public name: its docstring, with a class's methods'."""
    thing = functools.reduce(getattr, name.split("."), pj)
    members = vars(thing).values() if inspect.isclass(thing) else ()
    methods = [getattr(part, "__func__", part) for part in members]
    methods = [m for m in methods if inspect.isfunction(m) and not m.__name__.startswith("_")]
    return "\n\n".join(inspect.getdoc(part) or "" for part in [thing, *methods])


#: All pages by their path, with what the site puts into them.
TEXTS = {
    path.relative_to(ROOT).as_posix(): SHOWN.sub(
        lambda shown: f"{shown[0]}\n\n{docstrings(shown[1])}", path.read_text(encoding="utf-8")
    )
    for path in [
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
        ROOT / "experiments" / "README.md",
        *sorted(DOCS.rglob("*.md")),
    ]
}
README = TEXTS["README.md"]
#: The examples of all pages beside it continue its block.
REFERENCE = "docs/reference/index.md"
BLOCK = re.compile(r"^( *)```(\w*)\n(.*?)^\1```$", re.M | re.S)
LINK = re.compile(r"\]\((?!\w+:)([^)#\s]*)(?:#([\w.-]+))?\)")
#: The files that stand for words in capitals.
FILES = {"MESH": "part.ply", "MASK": "mask.png", "PHOTO": "photo.png", "FOLDER": "folder"}

#: A mesh and a resolution as the Python has them, so that the commands find its programs compiled.
CAMERA = usual_camera(256, 256)


def blocks(language, page=README):
    return [textwrap.dedent(text) for _, word, text in BLOCK.findall(page) if word == language]


def runs_in_the_site(page):
    return TEXTS[page].startswith("---\nrun: true\n")


#: Pages that take 20 s and show what other tests ask for.
DEAR = {
    *("docs/how-to/gradients.md", "docs/how-to/lenses.md", "docs/how-to/render.md"),
    *("docs/reference/fits.md", "docs/reference/images.md"),
}
#: Pages whose Python runs here.
PYTHON = [
    page
    for page, text in TEXTS.items()
    if blocks("python", text) and not runs_in_the_site(page) and page != REFERENCE
]
#: Fits on a page, and how many degrees they may be off.
FOUND = {
    "README.md": ("fit", 1e-4),
    "docs/how-to/many-views.md": ("joint", 1e-4),
    "docs/how-to/masks.md": ("fit", 1.5),
    "docs/how-to/sam-masks.md": ("fit", 1),
    "docs/how-to/focal-prior.md": ("fit", 1),
    "docs/how-to/questions.md": ("fit found held known_to_1_percent", 0.5),
}


def commands(pages=TEXTS):
    return [
        line for page in pages for block in blocks("sh", TEXTS[page]) for line in block.splitlines()
    ]


def slugs(text):
    """Return the anchors of a page's headings, as GitHub and ProperDocs make them."""
    heads = re.findall(r"^#+ (.*)$", BLOCK.sub("", text), re.M)
    words = (re.sub(r"[`*]|\[([^\]]*)\]\([^)]*\)", r"\1", head) for head in heads)
    return {re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", w).strip().lower()) for w in words}


def public_names():
    """Yield each public name, of modules each one that it shows, with what it is."""
    package = {pj.fit_many, pj.fit_one}  # `pj.batch` repeats them
    for name, thing in vars(pj._public).items():
        if name.startswith("_"):
            continue
        if not inspect.ismodule(thing):
            yield name, thing
        elif (home := thing.__name__) == f"pinhole_jax.{name}" != "pinhole_jax.testing":
            homes = home, "pinhole_jax.show", "pinhole_jax.formats.native"
            for part, own in vars(thing).items():
                made = getattr(own, "__module__", "").startswith(homes)
                is_code = inspect.isfunction(own) or inspect.isclass(own)
                if is_code and made and part[0] != "_" and own not in package:
                    yield f"{name}.{part}", own


def annotations_of(thing):
    """Yield what a public function, or a class's fields and public methods, say of types."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(thing)))).body
    for part in [node] if isinstance(node, ast.FunctionDef) else node.body:
        name = part.name if isinstance(part, ast.FunctionDef) else ""
        if isinstance(part, ast.AnnAssign) and not part.target.id.startswith("_"):
            yield part.annotation
        elif isinstance(part, ast.FunctionDef) and not re.match(r"_(?!_)", name):
            yield from (arg.annotation for arg in ast.walk(part.args) if isinstance(arg, ast.arg))
            yield part.returns


def test_public_names_declare_their_types():
    """None of them is `Any`, which a reader and a type checker learn nothing from."""
    for name, thing in public_names():
        said = [ast.unparse(annotation) for annotation in annotations_of(thing) if annotation]
        assert not [words for words in said if re.search(r"\bAny\b", words)], name


def test_code_blocks_have_known_languages():
    for page, text in TEXTS.items():
        assert {word for _, word, _ in BLOCK.findall(text)} <= {"python", "sh", "text", ""}, page
        assert len(BLOCK.findall(text)) * 2 == len(re.findall(r"^ *```", text, re.M)), page


def test_commands_are_of_programs_that_tests_know():
    first = {line.split()[0].removeprefix(".venv/bin/") for line in commands()}
    tools = {"nox", "python"}  # of CONTRIBUTING
    assert first == {"python3", "pinhole-jax", "blender", *tools}


@pytest.fixture
def another_cache(monkeypatch, tmp_path):
    """The user's cache folder is the test's, and has in it what tests share."""
    before = jax.config.jax_compilation_cache_dir
    least = jax.config.jax_persistent_cache_min_compile_time_secs
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "pinhole_jax").symlink_to(before)
    yield tmp_path / "pinhole_jax"
    pj.cache(before)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", least)


def test_programs_are_kept_where_the_cache_is(another_cache):
    another_cache.unlink()
    assert pj.cache() == another_cache
    jax.jit(lambda x: x + 1)(2.0)
    assert any(another_cache.iterdir())


@pytest.mark.parametrize("page", [full(page) if page in DEAR else long(page) for page in PYTHON])
def test_python_runs(page, another_cache, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("experiments").symlink_to(ROOT / "experiments")  # as in the repository's folder
    names = {}
    shared = blocks("python", TEXTS[REFERENCE]) if page.startswith("docs/reference/") else []
    for number, block in enumerate(shared + blocks("python", TEXTS[page]), 1):
        exec(compile(block, f"{page}, block {number}", "exec"), names)
    fits, most = FOUND.get(page, ("", 0))
    for fit in map(names.get, fits.split()):
        check_found(fit, names["truth"], most)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with all files that the commands read."""
    monkeypatch.chdir(tmp_path)
    # What the command sets for its own process would change those of the other tests.
    monkeypatch.setattr(command, "_set_up_jax", lambda *_, **__: None)
    mesh, camera = shapes.bumpy(), CAMERA.replace(phi=np.deg2rad(34.4))
    in_trimesh(mesh).export(FILES["MESH"])
    coverage = np.asarray(pj.silhouette(camera, pj.Scene(mesh)))
    io.save_image(FILES["MASK"], coverage)
    io.save_image(FILES["PHOTO"], 1 - coverage[..., None] * np.array([0.4, 0.75, 0.9]))
    io.save_camera("CAMERA.json", camera)
    io.save_camera("START.json", CAMERA.replace(e=[0.5, 1.2, 5], phi=0.62))
    return tmp_path


@pytest.mark.long
def test_commands_run_and_write_what_they_say(folder, capsys):
    pages = [page for page in TEXTS if not runs_in_the_site(page)]
    lines = [line for line in commands(pages) if line.startswith("pinhole-jax ")]
    assert len(lines) >= 5
    for line in lines:
        words = [FILES.get(word, word) for word in shlex.split(line)[1:]]
        assert command.main(words) == 0, (line, capsys.readouterr())
        # It has printed each file that it wrote.
        written = re.search(r"^written +(.*)$", capsys.readouterr().out, re.M)[1]
        assert all(Path(path).exists() for path in re.sub(r" \(.*", "", written).split(", "))


#: What pages say that run while the site is built; those that every gate runs.
SAID = {
    "tutorials/robot-camera": "converged",
    "reference/command": "--mask-from",
    "tutorials/many-fits": r"'converged': 9\}",
    "tutorials/mask-to-camera": "converged",
    "tutorials/photo-to-blender": "rank_deficient",
    "tutorials/shape-from-views": r"between: 0\.[0-7]\d* before, 0\.9[5-9]\d* after",
}
SOON = [*SAID][:3]


@pytest.mark.parametrize("pages", [long(SOON), full([*SAID])])
def test_site_builds_and_shows_its_results(tmp_path, pages):
    pytest.importorskip("properdocs")
    pytest.importorskip("mkdocstrings_handlers.python")
    site, cache = tmp_path / "site", ROOT / ".pytest_cache" / "of_the_site"
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "XDG_CACHE_HOME": str(cache)}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    environment["DRAFT"] = ",".join(f"{page}.md" for page in pages) if pages == SOON else ""
    printed("-m", "properdocs", "build", "--site-dir", site, cwd=ROOT, env=environment)

    for page in pages:
        shown = (site / page / "index.html").read_text(encoding="utf-8")
        assert re.search(SAID[page], shown), page
    loaded = r'<(?:script|img|link)[^>]* (?:src|href)="https?:[^"]*"'
    for path in site.rglob("*.html"):  # nothing is loaded from elsewhere
        assert not re.search(loaded, path.read_text()), path
    for path in site.rglob("*.ipynb"):
        cells = json.loads(path.read_text())["cells"]
        assert any(cell.get("outputs") for cell in cells), path


@pytest.fixture
def hooks():
    pytest.importorskip("properdocs")
    return importlib.import_module("hooks")


def test_page_shows_the_output_of_its_code(hooks, another_cache):
    page = "# A\n\n```python\nx = 2\nprint(x, 'printed')\n```\n\nprose\n\n```python\nx + 40\n```\n"
    cells = hooks.run(page, "a.md")
    shown = hooks.as_page(cells, "a")
    assert re.findall(r"```\{ \.text \.output[^}]*\}\n(.*)\n```", shown) == ["2 printed", "42"]
    notebook = json.loads(hooks.as_notebook(cells))["cells"]
    assert [cell["cell_type"] for cell in notebook][:4] == ["markdown", "code"] * 2
    assert notebook[1]["outputs"][0]["text"] == "2 printed\n"
    assert notebook[3]["outputs"][0]["data"] == {"text/plain": "42"}
    with pytest.raises(hooks.PluginError, match=r"a\.md, block 1: ZeroDivisionError"):
        hooks.run("```python\n1 / 0\n```\n", "a.md")


def test_tables_of_figures_are_those_of_the_experiments():
    for page, text in TEXTS.items():
        assert "<!-- fig" not in text or figures.filled(text) == text, page


def test_figure_of_a_table_is_the_rounded_number_of_the_json():
    text = (ROOT / "experiments" / "results" / "real_chessboards.json").read_text()
    wrong = "<!-- figures: instead -->\n\n| OpenCV |\n\nThen."
    filled = figures.filled(wrong)
    assert f"the same {json.loads(text)['fit_points']['rms_px']:.4f} px |\n\nThen." in filled


def test_install_lines_name_what_there_is():
    lines = [line for line in commands(["README.md"]) if line.startswith("python3 ")]
    assert len(lines) == 2
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras, groups = settings["project"]["optional-dependencies"], settings["dependency-groups"]
    text = "\n".join(commands())
    named = ",".join(re.findall(r"'\.\[([\w,]+)\]'", text)).split(",")
    assert set(named) <= set(extras)
    assert set(re.findall(r"--group (\w+)", text)) <= set(groups)
    (script,) = re.findall(r"\.venv/bin/python (\S+\.py)", "\n".join(lines))
    assert (ROOT / script).is_file()
    table = TEXTS["docs/how-to/set-up.md"].partition("| extra |")[2].partition("\n\n")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.M)) == set(extras)


def test_links_lead_to_files_and_their_headings():
    for page, text in TEXTS.items():
        for link, anchor in LINK.findall(BLOCK.sub("", text)):
            path = ((ROOT / page).parent / link).resolve() if link else ROOT / page
            assert path.exists(), (page, link)
            if anchor and not anchor.startswith("pinhole_jax."):
                assert anchor in slugs(path.read_text(encoding="utf-8")), (page, link, anchor)


def test_names_of_the_library_exist():
    for name in set(re.findall(r"\bpj\.([a-zA-Z_][\w.]*\w)", "\n".join(TEXTS.values()))):
        thing = pj
        for part in name.split("."):
            if inspect.isfunction(thing) or inspect.isclass(thing):
                break  # what an object has is not looked up
            thing = getattr(thing, part)


def test_public_names_are_in_the_reference_with_an_example():
    pages = [text for page, text in TEXTS.items() if page.startswith("docs/reference/")]
    told = {name for text in pages for name in SHOWN.findall(text)}
    names = [name for name, _ in public_names()]
    assert len(names) > 80
    assert [name for name in names if name not in told] == []
    assert [name for name in names if not blocks("python", docstrings(name))] == []


def test_formats_commands_and_statuses_are_documented():
    convert = TEXTS["docs/how-to/convert.md"]
    assert [name for name in pj.formats.FORMATS if f"`{name}`" not in convert] == []
    table = TEXTS["docs/explanation/error-bars.md"].partition("| status | meaning |")[2]
    assert dict(re.findall(r"\| `(\w+)` \| (.*) \|", table.partition("\n\n")[0])) == STATUSES
    shown = re.findall(r"^## (.*)$", TEXTS["docs/reference/command.md"], re.M)
    assert [name for name in shown if f"pinhole-jax {name} " not in "\n".join(TEXTS.values())] == []


def test_readme_is_short_and_its_picture_light():
    assert len(README.split()) < 520
    (moving,) = re.findall(r"!\[[^\]]*\]\((.*)\)", README)
    assert (ROOT / moving).stat().st_size < 2e6


def test_version_stands_in_one_place():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert "version" in project["dynamic"]
    assert "version" not in (ROOT / "CITATION.cff").read_text().replace("cff-version", "")
    latest = re.search(r"^## ([\d.]+)", TEXTS["CHANGELOG.md"], re.M)
    assert latest[1] == pj.__version__


def test_map_lists_each_module_once():
    (text,) = (x for x in blocks("text", TEXTS["docs/development/index.md"]) if x[:8] == "__main__")
    mapped = re.findall(r"(?m)^(\w+(?: {1,2}\w+)*)(?: {3,}|$)", text)
    modules = {path.parent.stem for path in (ROOT / "pinhole_jax").glob("*/__init__.py")}
    modules |= {path.stem for path in (ROOT / "pinhole_jax").glob("*.py")}
    assert sorted(" ".join(mapped).split()) == sorted(modules - {"__init__"})
