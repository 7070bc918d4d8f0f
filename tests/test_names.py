"""Comments and docstrings name modules, names and files that there are."""

import ast
import importlib
import pkgutil
import re
import tokenize
from pathlib import Path

import pytest

import pinhole_jax as pj

ROOT = Path(__file__).parents[1]
FOLDERS = ("pinhole_jax", "tests", "experiments")
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
DOCS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXTS = [*DOCS, ROOT / "experiments" / "README.md", ROOT / "pyproject.toml"]

#: Modules by their last name; formats and mesh files both have a `gltf`.
MODULES: dict[str, list[str]] = {}
for found in pkgutil.walk_packages(pj.__path__, "pinhole_jax."):
    MODULES.setdefault(found.name.rpartition(".")[2], []).append(found.name)

CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
WORD = re.compile(r"(?<![\w.])([A-Za-z_]\w*)(?:\.([A-Za-z]\w*))?")
PATH = re.compile(rf"\b(?:{'|'.join(FOLDERS)})/[\w/]+\.\w+")


def prose_and_names(path):
    """Return a file's comments and docstrings, and all names in its code."""
    with path.open("rb") as file:
        tokens = list(tokenize.tokenize(file.readline))
    prose = [t.string for t in tokens if t.type == tokenize.COMMENT or t.string.endswith('"""')]
    return "\n".join(prose), {t.string for t in tokens if t.type == tokenize.NAME}


def wrong_names(prose, names):
    """Return code in prose that names no module, nothing that one defines, nothing in the file."""
    return [
        code
        for code in CODE.findall(prose)
        for word, attribute in WORD.findall(code)
        if not exists(word, attribute, names)
    ]


def exists(word, attribute, names):
    if word in MODULES and word not in names:
        return attribute in ("", "py") or any(has(module, attribute) for module in MODULES[word])
    return not word.startswith("_") or word in names


def has(module, attribute):
    """True if a module has this; a private one defines it, a public one may re-export it."""
    if not hasattr(imported := importlib.import_module(module), attribute):
        return False
    home = getattr(getattr(imported, attribute), "__module__", module)
    return home.startswith(module) or "._" not in module


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_comments_name_what_there_is(path):
    prose, names = prose_and_names(path)
    # Experiments and tests have modules, too.
    names |= {neighbour.stem for neighbour in path.parent.glob("*.py")} - {*MODULES}
    assert wrong_names(prose, names) == []


@pytest.mark.parametrize("path", [*SOURCES, *TEXTS], ids=lambda path: path.stem)
def test_files_that_are_named_exist(path):
    text = path.read_text(encoding="utf-8")
    assert [name for name in PATH.findall(text) if not (ROOT / name).exists()] == []


def test_wrong_name_is_found():
    prose = "`solver.Stopped`, `looks.View`, `_nowhere`, `io.read_camera`, `_own`, `self._rays`"
    assert wrong_names(prose, {"_own"}) == ["solver.Stopped", "_nowhere", "io.read_camera"]


@pytest.mark.parametrize(
    "path", [p for p in SOURCES if ROOT / "experiments" in p.parents], ids=lambda p: p.stem
)
def test_experiments_import_existing_names(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pinhole_jax"):
            module = importlib.import_module(node.module)
            for name in node.names:
                known = hasattr(module, name.name) or name.name in MODULES
                assert known, f"{node.module} has no {name.name}"
