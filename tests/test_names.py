"""Comments and docstrings name modules, names and files that there are."""

import ast
import importlib
import io
import re
import tokenize
from collections import defaultdict
from functools import cache
from pathlib import Path

from test_house import ROOT, texts

FOLDERS = ("pinhole_jax", "tests", "experiments")
SOURCES = [Path(name) for name in texts() if name.startswith(FOLDERS) and name.endswith(".py")]

CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
WORD = re.compile(r"(?<![\w.])([A-Za-z_]\w*)(?:\.([A-Za-z]\w*))?")
PATH = re.compile(rf"\b(?:{'|'.join(FOLDERS)})/[\w/]+\.\w+")


@cache
def prose_and_names(path):
    """Return a file's comments and docstrings, and all names in its code."""
    tokens = [*tokenize.generate_tokens(io.StringIO(texts()[path.as_posix()]).readline)]
    prose = [t.string for t in tokens if t.type == tokenize.COMMENT or t.string.endswith('"""')]
    return "\n".join(prose), {t.string for t in tokens if t.type == tokenize.NAME}


@cache
def modules():
    """Return the names in modules of the package, by their last name; formats and mesh files both
    have a `gltf`."""
    found = defaultdict(set)
    for path in SOURCES:
        if path.parts[0] == "pinhole_jax":
            name = path.parent.name if path.stem == "__init__" else path.stem
            found[name] |= prose_and_names(path)[1]
            found[path.parent.name].add(path.stem)
    del found["pinhole_jax"]
    return found


def wrong_names(prose, names):
    """Return code in prose that names no module, nothing that one has, nothing in the file."""

    def exists(word, attribute):
        if word in modules() and word not in names:
            return attribute in ("", "py") or attribute in modules()[word]
        return not word.startswith("_") or word in names

    return [c for c in CODE.findall(prose) if not all(exists(*word) for word in WORD.findall(c))]


def test_comments_name_what_there_is():
    for path in SOURCES:
        prose, names = prose_and_names(path)
        # Experiments and tests have modules, too.
        beside = {other.stem for other in (ROOT / path.parent).glob("*.py")} - {*modules()}
        assert wrong_names(prose, names | beside) == [], path


def test_files_that_are_named_exist():
    for name in {*texts(), "pyproject.toml"} - {"CHANGELOG.md", "docs/hooks.py"}:
        text = (ROOT / name).read_text(encoding="utf-8")
        assert [found for found in PATH.findall(text) if not (ROOT / found).exists()] == [], name


def test_wrong_name_is_found():
    prose = "`solver.Stopped`, `looks.View`, `_nowhere`, `io.read_camera`, `_own`, `self._rays`"
    assert wrong_names(prose, {"_own"}) == ["solver.Stopped", "_nowhere", "io.read_camera"]


def test_experiments_import_existing_names():
    for path in [path for path in SOURCES if path.parts[0] == "experiments"]:
        for node in ast.walk(ast.parse(texts()[path.as_posix()])):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pinhole_jax"):
                known = {*dir(importlib.import_module(node.module)), *modules()}
                assert {name.name for name in node.names} <= known, path
