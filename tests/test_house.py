"""The size and the habits of the code stay at or below the ceilings in `tests/house.toml`.

A ceiling only falls. `python tests/test_house.py --update` lowers each one to what is there now:
run it after you delete something, and after a merge that conflicts in `house.toml`. `--update
--grow` also raises ceilings: do that on purpose, and say in the commit what it pays for.
"""

import ast
import io
import re
import subprocess
import sys
import tokenize
import tomllib
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).parents[1]
LEDGER = Path(__file__).with_name("house.toml")

#: Source or prose by path.
Texts = dict[str, str]
Figures = dict[str, int]
Function = ast.FunctionDef | ast.AsyncFunctionDef
Definition = ast.Module | ast.ClassDef | Function

#: A ceiling that is this much above its figure has to be lowered.
SLACK = 1.02
#: A new ceiling of tokens leaves room for small repairs.
ROOM = 1.01
#: Functions of more lines, docstrings not counted, are listed.
LONG = 60

LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
#: Python 3.12 cuts an f-string into pieces, Python 3.11 does not: it counts as one token.
F_STRING_STARTS = getattr(tokenize, "FSTRING_START", None)
F_STRING_ENDS = getattr(tokenize, "FSTRING_END", None)

CPP = {".h", ".hpp", ".cc", ".cpp"}
#: Comments, which are no tokens, then C++'s strings, names and numbers, operators.
CPP_TOKENS = re.compile(
    r"(?P<comment>//[^\n]*|/\*.*?\*/)|R\"(?P<mark>\w*)\(.*?\)(?P=mark)\"|\"(?:\\.|[^\"\\])*\""
    r"|'(?:\\.|[^'\\])'|\.?\d(?:[eEpP][+-]|[\w.'])*|\w+|<=>|\.\.\.|->\*?|(?:<<|>>)=?|::|\+\+|--|&&"
    r"|\|\||##|[-+*/%&|^=!<>]=|\S",
    re.DOTALL,
)
#: Code that is another project's.
VENDORED = "pinhole_jax/_native/xla/"

#: Parts of JAX that it does not promise to keep, and what other packages hide.
PRIVATE_MODULES = re.compile(
    r"jax\.(?:extend|interpreters|_src|config|experimental(?:\.| import )xla_metadata)\b"
    r"|from jax import [^\n]*\b(?:extend|interpreters|config)\b|compiler_options(?==)|XLA_FLAGS"
    r"|\bxla_\w+|\b(?:from|import) (?!pinhole_jax\b)\w[\w.]*\._[a-z]\w*"
)

PHRASES = re.compile(
    # (`for word in words` is code.)
    r"(?<!\bword )(?<!\bwords )(?<!\bw )(?<!\" )"
    r"\b(is told|is said|of what|of which|so many|at hand|in words|goes apart)\b"
)
VAGUE = re.compile(r"Return (what|how|whether|that|where|those)\b")


#: The most words of a docstring's sentence.
MOST_WORDS = 30
#: Last words of names that name no thing.
NO_NOUN = re.compile(
    r"(?!Bed|Feed|Seed|Shed|Speed|Embed)(\w+ed|As|At|Begun|Beside|Between|Done|Drawn|Found|Given|"
    r"Held|Here|Kept|Known|Made|Near|Next|Of|On|Others|Said|Seen|Shown|Some|Still|Swept|Taken|"
    r"Through|Together|Told|Where)$"
)


@cache
def definitions(text: str) -> list[Definition]:
    """A module, and the classes and functions in it."""
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, Definition)]


#: First words of test names that are no nouns.
NO_NOUN_FIRST = re.compile(
    r"test_(an?|the|what|it|its|that|this|these|those|one|of|there|they|which|where|how|with|"
    r"without|from|in|on|by|to|at|nothing|another|every|any|each|both|some|too|only|alone|all)_"
)
#: A promise's test, as pytest calls it.
NODE = re.compile(r"`(tests/test_\w+\.py)::(test_\w+)`")


@cache
def texts() -> Texts:
    """All Python, C++ and Markdown of the project, by path."""
    folders = ("pinhole_jax", "tests", "experiments", "docs")
    paths = [path for name in folders for path in (ROOT / name).rglob("*.*")]
    paths += ROOT.glob("*.md")
    named = {path.relative_to(ROOT).as_posix(): path for path in sorted(paths)}
    return {
        name: path.read_text(encoding="utf-8")
        for name, path in named.items()
        if path.suffix in {".py", ".md", *CPP} and not name.startswith(VENDORED)
    }


def defined(files: Texts, folder: str = "") -> Iterator[tuple[str, Definition]]:
    """All modules, classes and functions below a folder, each with the path of its file."""
    for path, text in files.items():
        if path.endswith(".py") and path.startswith(folder):
            yield from ((path, node) for node in definitions(text))


def area(path: str) -> str:
    """The part of the project that a file belongs to: Markdown is `docs` wherever it is."""
    return "docs" if path.endswith(".md") else path.split("/")[0]


# Figures: each counts something, by file, folder or name.


def token_count(text: str) -> int:
    """The number of names, numbers, strings and operators, docstrings not counted."""
    count, depth, first = 0, 0, True
    for token, following in pairwise(tokenize.generate_tokens(io.StringIO(text).readline)):
        if token.type == F_STRING_ENDS:
            depth -= 1
        elif depth == 0 and token.type in LAYOUT:
            first = first or token.type in {tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
        elif depth == 0:
            alone = first and following.type == tokenize.NEWLINE
            count += not (alone and token.type == tokenize.STRING)
            first = False
        depth += token.type == F_STRING_STARTS
    return count


def cpp_token_count(text: str) -> int:
    """The number of C++'s tokens, comments not counted."""
    return sum(match["comment"] is None for match in CPP_TOKENS.finditer(text))


def tokens(files: Texts) -> Figures:
    """Tokens of each folder, those of C++ by themselves."""
    counts = Counter[str]()
    for name, text in files.items():
        path = PurePosixPath(name)
        if path.suffix == ".py":
            counts[path.parent.as_posix()] += token_count(text)
        elif path.suffix in CPP:
            counts[f"{path.parent}: C++"] += cpp_token_count(text)
    return counts


def twice(names: Iterable[str]) -> Figures:
    """Names that stand more than once, with how often they do."""
    return {name: count for name, count in Counter(names).items() if count > 1}


def class_names(files: Texts) -> list[str]:
    """Names of the package's classes, without leading underscores."""
    nodes = [node for _, node in defined(files, "pinhole_jax/")]
    return [node.name.lstrip("_") for node in nodes if isinstance(node, ast.ClassDef)]


def file_names(files: Texts) -> list[str]:
    """Names of the package's files, without leading underscores."""
    paths = [PurePosixPath(path) for path in files if path.startswith("pinhole_jax/")]
    return [p.stem.lstrip("_") for p in paths if p.suffix == ".py" and p.stem[:2] != "__"]


def classes_of_one_name(files: Texts) -> Figures:
    """Class names that stand more than once in the package."""
    return twice(class_names(files))


def files_of_one_name(files: Texts) -> Figures:
    """File names that stand more than once in the package."""
    return twice(file_names(files))


def doors(files: Texts) -> Figures:
    """Files of the package with the private doors that they go through."""
    python = [path for path in files if re.match(r"pinhole_jax/.*\.py$", path)]
    return {f"{path}: {x}": 1 for path in python for x in PRIVATE_MODULES.findall(files[path])}


def line_count(function: Function) -> int:
    """The number of lines of a function, its docstring not counted."""
    lines = (function.end_lineno or 0) - function.lineno + 1
    if ast.get_docstring(function) is None:
        return lines
    first = function.body[0]
    return lines - ((first.end_lineno or 0) - first.lineno + 1)


def functions(files: Texts) -> Iterator[tuple[str, Function]]:
    """All functions and methods, each with the path of its file."""
    for path, node in defined(files):
        if isinstance(node, Function):
            yield path, node


def long_functions(files: Texts) -> Figures:
    """Functions of more than 60 lines."""
    lengths = {f"{path}: {node.name}": line_count(node) for path, node in functions(files)}
    return {name: length for name, length in lengths.items() if length > LONG}


def flat(text: str) -> str:
    """Prose on one line: comment signs, quotes and line breaks between its words are left out."""
    joined = re.sub(r"['\"]?\s*\n[\s#:>]*(?:[fr]?['\"])?", " ", text.lower())
    return " ".join(joined.split())


def phrases(files: Texts) -> Figures:
    """Banned phrases, by part of the project. (This file lists them.)"""
    return Counter(
        f"{area(path)}: {phrase}"
        for path, text in files.items()
        if path != "tests/test_house.py"
        for phrase in PHRASES.findall(flat(text))
    )


def vague_docstrings(files: Texts) -> Figures:
    """Docstrings that begin with `Return what`, `Return whether` and the like."""
    found = ((path, VAGUE.match(ast.get_docstring(node) or "")) for path, node in defined(files))
    return Counter(f"{area(path)}: {match.group()}" for path, match in found if match)


def long_sentences(files: Texts) -> Figures:
    """Docstring sentences of more than `MOST_WORDS`; examples and tables are none."""
    found: Figures = Counter()
    for path, node in defined(files):
        prose = re.sub(r"```.*?```|^ *\|.*$", "", ast.get_docstring(node) or "", flags=re.S | re.M)
        for sentence in re.split(r"(?<=[.:;?!])\s+|\n\s*- |\n\n", prose):
            found[f"{area(path)}: {sentence[:40]}"] += len(sentence.split()) > MOST_WORDS
    return +found


def names_of_no_thing(files: Texts) -> Figures:
    """Class names and file names that are no nouns."""
    ends = {name: re.split("(?=[A-Z])", name)[-1] for name in class_names(files)}
    ends |= {f"{name}.py": name.split("_")[-1].title() for name in file_names(files)}
    return dict.fromkeys((name for name, end in ends.items() if NO_NOUN.match(end)), 1)


def filler_functions(files: Texts) -> Figures:
    """Functions called `one`, `of`, `at` or `some`."""
    called = ((path, node.name) for path, node in functions(files))
    return Counter(
        f"{area(path)}: {name}"
        for path, name in called
        if re.fullmatch("_*(one|of|at|some)_*", name)
    )


def names_without_a_noun_first(files: Texts) -> Figures:
    """Tests whose names begin with an article, a pronoun or the like."""
    names = [node.name for path, node in functions(files) if path.startswith("tests/")]
    return dict.fromkeys(filter(NO_NOUN_FIRST.match, names), 1)


FIGURES: dict[str, Callable[[Texts], Figures]] = {
    count.__name__: count
    for count in (
        tokens,
        classes_of_one_name,
        files_of_one_name,
        doors,
        long_functions,
        phrases,
        vague_docstrings,
        long_sentences,
        names_of_no_thing,
        filler_functions,
        names_without_a_noun_first,
    )
}


def broken_promises(page: str, files: Texts) -> list[str]:
    """Tests that a page names and no file has."""
    there = {f"{path}::{node.name}" for path, node in functions(files)}
    named = ["::".join(match.groups()) for match in NODE.finditer(page)]
    return [name for name in named if name not in there]


# The ledger.


def complaints(figures: Figures, ceilings: Figures) -> list[str]:
    """What is above its ceiling, and which ceilings are too high."""
    above = [
        f"{name}: {number}, the ceiling is {ceilings.get(name, 0)}. Take it back; or raise the"
        " ceiling with `python tests/test_house.py --update --grow` and say in the commit why."
        for name, number in figures.items()
        if number > ceilings.get(name, 0)
    ]
    loose = [
        f"{name}: {figures.get(name, 0)}, the ceiling is still {ceiling}. Well done: lower it with"
        " `python tests/test_house.py --update`."
        for name, ceiling in ceilings.items()
        if ceiling > SLACK * figures.get(name, 0)
    ]
    return above + loose


def updated(figures: Figures, ceilings: Figures, room: float = 1.0, grow: bool = False) -> Figures:
    """New ceilings: lower ones where the old are too high, higher ones only with `grow`."""
    new = {}
    for name in sorted({*figures, *ceilings}):
        number, old = figures.get(name, 0), ceilings.get(name, 0)
        fitting = int(room * number)
        if old > SLACK * number:
            new[name] = fitting
        else:
            new[name] = fitting if grow and number > old else old
    return {name: ceiling for name, ceiling in new.items() if ceiling}


def as_toml(ledger: dict[str, Figures]) -> str:
    """The text of `house.toml`."""
    lines = ["# Written by `python tests/test_house.py --update`; the ceilings only fall."]
    for title, ceilings in ledger.items():
        lines += ["", f"[{title}]"]
        lines += [f'"{name}" = {ceiling}' for name, ceiling in sorted(ceilings.items())]
    return "\n".join(lines) + "\n"


def main(arguments: list[str]) -> None:
    """Rewrite the ledger, and print the lines that changed."""
    if "--update" not in arguments or set(arguments) - {"--update", "--grow"}:
        sys.exit(__doc__)
    old = tomllib.loads(LEDGER.read_text(encoding="utf-8")) if LEDGER.exists() else {}
    new = {}
    for title, count in FIGURES.items():
        room = ROOM if title == "tokens" else 1.0
        before, figures = old.get(title, {}), count(texts())
        new[title] = updated(figures, before, room, "--grow" in arguments)
        for name in sorted({*before, *new[title]}):
            if before.get(name, 0) != new[title].get(name, 0):
                print(f"{title}, {name}: {before.get(name, 0)} -> {new[title].get(name, 0)}")
    LEDGER.write_text(as_toml(new), encoding="utf-8")


# Tests.


@pytest.mark.parametrize("title", FIGURES)
def test_house_keeps_to_its_ceilings(title):
    ceilings = tomllib.loads(LEDGER.read_text(encoding="utf-8"))
    assert set(ceilings) <= set(FIGURES)
    found = complaints(FIGURES[title](texts()), ceilings.get(title, {}))
    if found:
        pytest.fail("\n".join([f"{title}:", *found]), pytrace=False)


def test_promises_name_tests_that_exist():
    page = texts()["docs/development/promises.md"]
    assert page.count("\n- ") == len(NODE.findall(page)) > 50
    assert broken_promises(page, texts()) == []


def test_wheel_is_as_small_and_imports_as_fast_as_its_page_says():
    page = texts()["docs/how-to/set-up.md"]
    shown = re.search(r"wheel is ([\d.]+) MB.*`import pinhole_jax` takes ([\d.]+) s", page, re.S)
    megabytes, seconds = map(float, shown.groups())
    sources = [path for path in (ROOT / "pinhole_jax").rglob("*.*") if path.is_file()]
    left_out = {*CPP, ".pyc", ".so", ".dylib", ".dll"}
    kept = [path.read_bytes() for path in sources if path.suffix not in left_out]
    library = 0.2  # MB, packed; `nox -s wheel` weighs the whole wheel
    packed = sum(len(zlib.compress(source)) for source in kept) / 1e6 + library
    assert 0.6 * megabytes < packed < 1.1 * megabytes

    code = (
        "import time; t = time.process_time(); import pinhole_jax; print(time.process_time() - t)"
    )
    took = [float(subprocess.check_output([sys.executable, "-c", code])) for _ in range(3)]
    assert min(took) < 2 * seconds  # (a machine may be half as fast)


# The counts, each on small sources that break its rule and on some that do not.

CODE = '''"""Docstring."""

def f(x):  # a comment
    "Another."
    return f"{x + 1} and {x}"
'''
BODY = "\n".join(f"  x = {k}" for k in range(60))
DOCSTRING = f"def f():\n  '''A\n\n  docstring.'''\n{BODY[8:]}"
NESTED = "f'{f'{x}'}' + 1\n" if sys.version_info >= (3, 12) else "f'{x}' + 1\n"
PACKAGE, FIT, TESTS = "pinhole_jax", "pinhole_jax/_fit", "tests"  # with names of no real file
PATH, CPP_PATH, TEST = f"{FIT}/a.py", "x/a.cc", f"{TESTS}/a.py"

DOORS = {
    "from jax.extend.core import Primitive": "jax.extend",
    "from jax import extend": "from jax import extend",
    "import_module('jax._src.core')": "jax._src",
    "from jax.experimental import xla_metadata": "jax.experimental import xla_metadata",
    "jax.jit(f, compiler_options={})": "compiler_options",
    "OPTIONS = {'xla_cpu_small_call': 1}": "xla_cpu_small_call",
    "os.environ['XLA_FLAGS'] = '--dump_to='": "XLA_FLAGS",
    "jax.config.update('jax_enable_x64', True)": "jax.config",
    "from numpy._core import umath": "from numpy._core",
    "from ._src import x": "",
    "from jax.experimental import pallas": "",
    "x = camera.config + jax.extended": "",
}


@pytest.mark.parametrize(
    ("count", "path", "text", "names"),
    [
        *((doors, PATH, text, {f"{PATH}: {x}": 1} if x else {}) for text, x in DOORS.items()),
        (doors, TEST, "from jax import extend", {}),
        (tokens, PATH, CODE, {FIT: 8}),
        (tokens, PATH, "x = [1,\n     2]\n\n# no more\n", {FIT: 7}),
        (tokens, PATH, "'''A docstring\n\nof two lines.'''\n", {FIT: 0}),
        (tokens, PATH, NESTED, {FIT: 3}),
        (tokens, "a.md", CODE, {}),
        (tokens, CPP_PATH, "auto x = a->b::c(1.5e-3, 'x') <<= 2; // y", {"x: C++": 16}),
        (tokens, CPP_PATH, '/* How. */ x = "a \\" // b" R"(c "d" // )";', {"x: C++": 5}),
        (tokens, CPP_PATH, "x = 1'000'000 + .5e+3 && !y <=> z;", {"x: C++": 11}),
        (classes_of_one_name, PATH, "class A: ...\nclass B: ...\nclass _A: ...", {"A": 2}),
        (classes_of_one_name, TEST, "class A: ...\nclass A: ...", {}),
        (long_functions, TEST, f"class A:\n async def f():\n{BODY}", {f"{TEST}: f": 61}),
        (long_functions, TEST, DOCSTRING, {}),
        (phrases, TEST, "# It is\n# told.", {"tests: is told": 1}),
        (phrases, TEST, 'x = ("so "\n     f"many")', {"tests: so many": 1}),
        (phrases, "a/b.md", "Tis told,\n> of\n> which: tolder", {"docs: of which": 1}),
        (phrases, TEST, "[word for word in words] # this told, of whatever, in wordsworth", {}),
        (vague_docstrings, TEST, 'def f(): "Return whether."', {"tests: Return whether": 1}),
        (vague_docstrings, TEST, 'def f(): "Return thatch."', {}),
        (long_sentences, TEST, f'def f(): "{"so " * 31}"', {f"tests: {('so ' * 31)[:40]}": 1}),
        (long_sentences, TEST, f'def f(): "{"so " * 29}on. On."', {}),
        (names_of_no_thing, PATH, "class _PointsSeen: ...\nclass Speed: ...", {"PointsSeen": 1}),
        (names_of_no_thing, f"{PACKAGE}/cut_and_turned.py", "", {"cut_and_turned.py": 1}),
        (filler_functions, TEST, "def office(): ...\ndef _one(): ...", {"tests: _one": 1}),
        (names_without_a_noun_first, TEST, "def test_a_hole(): ...", {"test_a_hole": 1}),
        (names_without_a_noun_first, TEST, "def test_itself(): ...\ndef the_hole(): ...", {}),
    ],
)
def test_rule_counts_what_breaks_it(count, path, text, names):
    assert count({path: text}) == names


def test_file_names_that_stand_twice_are_counted():
    names = ["a/b.py", "c/_b.py", "a/__init__.py", "c/__init__.py", "c/d.py", "b.md"]
    assert files_of_one_name({f"{PACKAGE}/{name}": "" for name in names}) == {"b": 2}


def test_broken_promises_are_found():
    node = f"{TESTS}/test_a.py::test_b"
    files = {f"{TESTS}/test_a.py": "def test_b(): ..."}
    assert broken_promises(f"| `{node}` |", files) == []
    assert broken_promises(f"| `{node}` | `{node}c` |", files) == [f"{node}c"]


@pytest.mark.parametrize(
    ("figure", "ceiling", "message"),
    [
        (101, 100, "a: 101, the ceiling is 100. Take it back"),
        (100, 103, "a: 100, the ceiling is still 103. Well done"),
        (0, 1, "a: 0, the ceiling is still 1. Well done"),
    ],
)
def test_ceilings_neither_give_nor_lag(figure, ceiling, message):
    (complaint,) = complaints({"a": figure, "b": 7}, {"a": ceiling, "b": 7})
    assert complaint.startswith(message)


def test_update_only_lowers_ceilings_unless_they_may_grow():
    figures, ceilings = (
        {"above": 9, "loose": 50, "near": 100},
        {"above": 8, "loose": 90, "near": 101},
    )
    assert updated(figures, ceilings | {"gone": 3}) == {"above": 8, "loose": 50, "near": 101}
    assert updated(figures, ceilings, grow=True) == {"above": 9, "loose": 50, "near": 101}
    assert updated({"new": 1000}, {}) == {}
    assert updated({"new": 1000}, {}, room=1.01, grow=True) == {"new": 1010}


def test_ledger_reads_back_as_it_was_written():
    ledger = {"tokens": {FIT: 3}, "doors": {"a.py: XLA's flags": 1}, "phrases": {}}
    assert tomllib.loads(as_toml(ledger)) == ledger


if __name__ == "__main__":
    main(sys.argv[1:])
