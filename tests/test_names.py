"""Comments and docstrings name modules, names and files that there are."""

import ast
import importlib
import re
import tokenize
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("pinhole_jax", "tests", "experiments")
SOURCES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
DOCS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXTS = [*DOCS, ROOT / "experiments" / "README.md", ROOT / "pyproject.toml"]

CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
WORD = re.compile(r"(?<![\w.])([A-Za-z_]\w*)(?:\.([A-Za-z]\w*))?")
PATH = re.compile(rf"\b(?:{'|'.join(FOLDERS)})/[\w/]+\.\w+")


def prose_and_names(path):
    """Return a file's comments and docstrings, and all names in its code."""
    with path.open("rb") as file:
        tokens = list(tokenize.tokenize(file.readline))
    prose = [t.string for t in tokens if t.type == tokenize.COMMENT or t.string.endswith('"""')]
    return "\n".join(prose), {t.string for t in tokens if t.type == tokenize.NAME}


TOLD = {path: prose_and_names(path) for path in SOURCES}
#: The names in modules of the package, by their last name; formats and mesh files both have a
#: `gltf`.
MODULES: dict[str, set[str]] = defaultdict(set)
for path in (ROOT / "pinhole_jax").rglob("*.py"):
    MODULES[path.parent.name if path.stem == "__init__" else path.stem] |= TOLD[path][1]
    MODULES[path.parent.name].add(path.stem)
del MODULES["pinhole_jax"]


def wrong_names(prose, names):
    """Return code in prose that names no module, nothing that one has, nothing in the file."""

    def exists(word, attribute):
        if word in MODULES and word not in names:
            return attribute in ("", "py") or attribute in MODULES[word]
        return not word.startswith("_") or word in names

    return [c for c in CODE.findall(prose) if not all(exists(*word) for word in WORD.findall(c))]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_comments_name_what_there_is(path):
    prose, names = TOLD[path]
    # Experiments and tests have modules, too.
    names = names | {neighbour.stem for neighbour in path.parent.glob("*.py")} - {*MODULES}
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
            known = {*dir(importlib.import_module(node.module)), *MODULES}
            assert {name.name for name in node.names} <= known
