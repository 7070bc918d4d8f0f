#!/usr/bin/env python3
# /// script
# dependencies = ["nox[uv]>=2025.10"]
# ///
"""The gate's steps, one session each: `nox -l` lists them, `nox -s lint` runs one, `.ci/run` all.

A step that needs no environment of its own runs in nox's: `uv pip install -e . --group dev` makes
it, or pip 25.1. Words after `--` go to pytest: `nox -s tests -- tests/test_camera.py`.
"""

import functools
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import nox

nox.needs_version = ">=2025.10"
nox.options.envdir = os.environ.get("NOX_ENVDIR", ".nox")
nox.options.default_venv_backend = "uv"
nox.options.reuse_existing_virtualenvs = True
nox.options.stop_on_first_error = True

ROOT = Path(__file__).parent
# The tools beside nox, also where its environment is not activated.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
here = nox.session(python=False, default=False)
apart = functools.partial(nox.session, default=False)  # in an environment of its own


def newest() -> str:
    """The newest released Python of this machine that has venv."""

    def number(python: str) -> int:
        """A Python's minor version, from its path."""
        return int((re.findall(r"3\.(\d+)", python) or ["0"])[-1])

    folder = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = sorted(map(str, folder.glob("3.*/bin/python3")))
    found += filter(None, (shutil.which(f"python3.{minor}") for minor in range(11, 30)))
    code = "import venv, ensurepip, sys; sys.exit(sys.version_info.releaselevel != 'final')"
    for python in sorted(found, key=number, reverse=True):
        if number(python) <= sys.version_info.minor:
            break
        if subprocess.run([python, "-c", code], capture_output=True, check=False).returncode == 0:
            return python
    return sys.executable


def lowest() -> Iterator[str]:
    """The lowest versions that pyproject.toml claims, as pip's constraints."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for requirement in [*project["dependencies"], *project["optional-dependencies"]["test"]]:
        # 4.10 stands for what is published as 4.10.0.82; a post-release is one version.
        fixed = re.sub(r">=([\d.]+)(?!\S*post)(\S*)", r"==\1.*\2", requirement)
        yield fixed.replace(">=", "==")


def files(names: str) -> list[str]:
    """The test files of some names."""
    return [f"tests/test_{name}.py" for name in names.split()]


def pytest(session: nox.Session, *arguments: str, **env: str) -> None:
    """Run tests, one process to a core."""
    words = ("-m", "pytest", "-n", "auto", "--dist", "loadfile")
    session.run("python", *words, *arguments, *session.posargs, env=env)


@nox.session(python=False)
def lint(session: nox.Session) -> None:
    """Formats, types, layers, spelling, Markdown, workflows, and habits of a Python package."""
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")
    session.run("pyright")
    session.run("lint-imports")
    session.run("codespell")
    session.run("rumdl", "check", "--silent", ".")
    session.run("zizmor", "--offline", "--quiet", "--pedantic", ".github")
    session.run("repo-review", ".", "--format", "rich", "--show", "err", silent=False)


@nox.session(python=False)
def types(session: nox.Session) -> None:
    """All public names have types."""
    session.run("pyright", "--verifytypes", "pinhole_jax", "--ignoreexternal")


@nox.session(python=False)
def tests(session: nox.Session) -> None:
    """The README's test command."""
    pytest(session)


@here
def long(session: nox.Session) -> None:
    """The tests that take long; one of them builds the documentation."""
    pytest(session, "-m", "long", "--durations", "25")


DRAWN = files("silhouette gradients fit_camera")


@here
def arrays(session: nox.Session) -> None:
    """Some tests without the compiled library: JAX's arrays draw."""
    pytest(session, *DRAWN, "tests/test_trace.py", PINHOLE_JAX_NATIVE="0")


@here
def sanitized(session: nox.Session) -> None:
    """Hostile scenes against a library with sanitizers; then a minute of fuzzing."""
    library = f"{session.create_tmp()}/libpinhole.so"
    checks = "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", "-g", "-O1"
    kind = "-std=c++17", "-shared", "-fPIC", "-fvisibility=hidden", "-pthread"
    source = "pinhole_jax/_native/handlers.cc"
    session.run("g++", *kind, *checks, source, "-o", library, external=True)
    # (Exceptions of C++ want its library loaded as early.)
    said = [
        session.run("g++", f"-print-file-name={name}.so", external=True, silent=True)
        for name in ("libasan", "libstdc++")
    ]
    loaded = " ".join(str(path).strip() for path in said)
    options = {"ASAN_OPTIONS": "detect_leaks=0", "LD_PRELOAD": loaded}
    env = {"PINHOLE_JAX_NATIVE": library, **options}
    pytest(session, *files("native walker stress garbage"), **env)
    session.run("python", "tests/fuzz_native.py", "--seconds", "60", env=env)


@apart()
def no_compiler(session: nox.Session) -> None:
    """An install as where there is no C++ compiler: the package installs, and arrays draw."""
    session.install(".", "--refresh-package", "pinhole-jax", env={"CXX": "no-compiler"})
    session.chdir(session.create_tmp())
    said = session.run("python", "-m", "pinhole_jax", "--version", silent=True)
    if said is not None and "arrays" not in str(said):  # (None: nothing ran, --install-only)
        session.error(f"--version says {said}")


@here
def fuzz(session: nox.Session) -> None:
    """Damaged files for each reader of meshes, cameras, robots and masks, a minute in all."""
    session.run("python", "tests/fuzz_readers.py", "--seconds", "60", *session.posargs)


@here
def first_use(session: nox.Session) -> None:
    """A newcomer's first steps with the sdist and the wheel."""
    folder = f"{session.create_tmp()}/first"
    session.run("python", "experiments/startup.py", "first-use", folder, "--all", "--borrow")


@apart(name="lowest")
def lowest_versions(session: nox.Session) -> None:
    """What each module does first, with the lowest versions of what it needs."""
    constraints = Path(session.create_tmp()) / "lowest.txt"
    constraints.write_text("\n".join(lowest()), encoding="utf-8")
    session.install("-e", ".[test]", "--constraint", str(constraints))
    session.run("python", "--version")
    first = "import camera rays distortion scene io files formats_files parameters polygons"
    # All annotations are checked, not only those that tell shapes.
    checked = "--jaxtyping-packages=pinhole_jax,beartype.beartype"
    pytest(session, *files(f"{first} kinds main"), checked)


#: What a newer Python, and the newer JAX and NumPy for it, could change: also what scikit-image
#: draws, shapely cuts and pycollada reads; coverage, gradients and fits by their values.
NEWER = [*DRAWN, *files("import camera scene io formats_files main native walker trace robots")]


@apart(name="newest", python=newest())
def newest_python(session: nox.Session) -> None:
    """Some tests with the newest Python of this machine, and the newest JAX for it."""
    session.install("-e", ".[test]")
    session.run("python", "--version")
    pytest(session, *NEWER)


@apart(python="3.14t")
def free_threaded(session: nox.Session) -> None:
    """Some tests without the interpreter's lock, where JAX and all else have wheels for it."""
    tools = ("beartype", "hypothesis", "pytest", "pytest-xdist", "shapely")
    session.install("-e", ".", *tools)
    pytest(session, *files("import camera rays scene safe silhouette"))


@apart()
def wheel(session: nox.Session) -> None:
    """The sdist and a wheel, tried in a clean environment; `-- all`: each platform's, in dist/."""
    session.install(*nox.project.dependency_groups(nox.project.load_toml(), "release"))
    folder = "dist" if session.posargs else session.create_tmp()
    shutil.rmtree(folder, ignore_errors=True)
    session.run("python", ".ci/wheels", folder, *session.posargs)
    session.run("python", ".ci/try_wheel", folder)


@apart()
def try_wheel(session: nox.Session) -> None:
    """The wheel for this machine that is in dist/, in a clean environment."""
    session.install("uv")
    session.run("python", ".ci/try_wheel", "dist")


@here
def docs(session: nox.Session) -> None:
    """The documentation, all of its pages run, in site/; `DRAFT=1 nox -s docs` runs none."""
    session.run("properdocs", "build", env={"NO_MKDOCS_2_WARNING": "1"})


@apart(python=newest())
def canary(session: nox.Session) -> None:
    """Raise the upper bounds of pyproject.toml to what is published; then all tests, the worst
    errors, no mask, Jacobian or fit that takes 3 times as long beside a plain loop, and a guided
    minute of fuzzing for each reader."""
    session.run("python", ".ci/canary")
    session.install("-e", ".[test]", "numba", "--group", "fuzz", "--upgrade")
    session.run("python", "--version")
    pytest(session)
    gate = ("python", "experiments/frozen.py", "--gate", "--only")
    session.run(*gate, "errors")
    session.run(*gate, "speed", "--times", "3")
    session.run("python", "tests/fuzz_readers.py", "--seconds", "1440")


if __name__ == "__main__":
    nox.main()
