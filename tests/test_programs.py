"""Programs that are kept as traced are found again, and never taken for others."""

import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
import pytest
from oracles import drawn

import pinhole_jax as pj
from pinhole_jax._files import programs
from pinhole_jax._files.process import set_up
from pinhole_jax._numerics.jitted import options

WHERE = f"{__name__}:raised"
HERE = Path(__file__).parent
traces = []


class Pair(NamedTuple):
    first: object
    second: object


@eqx.filter_jit
def raised(x, power, pair):
    return Pair(x**power + pair.first, {"sum": x.sum()})


#: A class of the package, as far as its name says.
Pair.__module__ = pj.__name__


class Theirs(NamedTuple):
    first: object
    second: object


class Looked(Exception):
    """A fit came as far as its program."""


LENS = pj.Lens((24.0, 20.0), distortion=pj.BrownConrady(k1=0.01))


def answer():
    return Pair(0, {"sum": 0})


def called(x, power=2, first=1.0):
    return programs.call(WHERE, (x, power, Pair(np.float32(first), None)), answer)


@pytest.fixture
def kept(tmp_path, monkeypatch):
    def counted(*arguments, real=programs._traced):
        traces.append(arguments)
        return real(*arguments)

    monkeypatch.setattr(programs, "_traced", counted)
    programs.keep_in(tmp_path / "traced")
    traces.clear()
    yield tmp_path / "traced"
    programs.keep_in(None)


def another_process(kept):
    programs.keep_in(None)  # nothing is known of before
    programs.keep_in(kept)


X = np.arange(3, dtype=np.float32)


def test_programs_of_an_earlier_process_are_not_traced_again(kept):
    first = called(X)
    assert len(traces) == len(list(kept.iterdir())) == 1
    another_process(kept)
    second = called(X, first=2.0)
    assert len(traces) == 1
    assert np.array_equal(first.first, X**2 + 1)
    assert np.array_equal(second.first, X**2 + 2)
    assert second.second["sum"] == 3


@pytest.mark.parametrize(
    "other",
    [
        lambda: called(X, power=3),
        lambda: called(X, power=True),  # equal to 1, and hashed as that is
        lambda: called(X, power=2.0),
        lambda: called(X[:2]),
        lambda: called(jax.numpy.asarray(X)[None]),
    ],
)
def test_different_programs_are_kept_apart(kept, other):
    called(X), called(X, power=1)
    another_process(kept)
    traces.clear()
    other()
    assert len(traces) == 1
    assert len(list(kept.iterdir())) == 3


def test_switches_of_jax_keep_programs_apart(kept):
    called(X)
    with jax.default_matmul_precision("highest"):
        called(X)
    assert len(list(kept.iterdir())) == 2


def test_program_is_compiled_once(kept, tmp_path, monkeypatch, compiled):
    """Though to trace it imports its module, and what is read again is another object."""
    (tmp_path / "apart.py").write_text(
        "import equinox as eqx\nfrom test_programs import Pair\n\n@eqx.filter_jit\n"
        "def apart(x):\n    return Pair(x + 1, None)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    for _ in range(2):
        programs.call("apart:apart", (X,), lambda: Pair(0, None))
    assert len(compiled) == 1


def test_code_or_versions_make_another_program(kept, monkeypatch):
    called(X)
    for name, other in (("_source", lambda: "other code"), ("version", lambda _: "1.0")):
        monkeypatch.setattr(programs, name, other)
        another_process(kept)
        called(X)
    assert len(traces) == len(list(kept.iterdir())) == 3


def test_code_that_changed_while_the_process_ran_keeps_nothing(kept, monkeypatch):
    monkeypatch.setattr(programs, "_source", lambda: "other code")
    called(X)
    assert len(traces) == 1
    assert not kept.exists()


@pytest.mark.parametrize(
    ("name", "other"), [("_source", lambda: None), ("version", lambda name: version(name + "?"))]
)
def test_unknown_code_or_versions_keep_nothing(kept, monkeypatch, name, other):
    monkeypatch.setattr(programs, name, other)
    another_process(kept)
    assert np.array_equal(called(X).first, X**2 + 1)
    assert not kept.exists()


@pytest.mark.parametrize(
    "watched",
    [
        lambda: jax.debug_nans(True),
        jax.disable_jit,
        lambda: jax.default_device(jax.devices("cpu")[0]),
    ],
)
def test_debug_modes_of_jax_keep_nothing(kept, watched):
    with watched():
        assert np.array_equal(called(X).first, X**2 + 1)
    assert not kept.exists()


def test_function_of_the_same_name_is_not_confused(kept, monkeypatch):
    called(X)
    other = eqx.filter_jit(lambda x, power, pair: Pair(-x, {"sum": x.sum()}))
    monkeypatch.setattr(sys.modules[__name__], "raised", other)
    # (Its code is none of this package's: by the files it is the same one.)
    monkeypatch.setattr(programs, "_read", lambda path: None)
    assert np.array_equal(called(X).first, -X)


def test_foreign_classes_are_not_kept(kept):
    """Its code may change without a sign, and its name may be one of ours."""
    arguments = X, 2, Theirs(np.float32(1), None)
    assert np.array_equal(programs.call(WHERE, arguments, answer).first, X**2 + 1)
    assert not kept.exists()


def test_wrong_structure_of_the_answer_keeps_nothing(kept):
    found = programs.call(WHERE, (X, 2, Pair(np.float32(1), None)), lambda: Pair(0, 0))
    assert found.second["sum"] == 3
    assert not kept.exists()


def test_setting_the_same_folder_again_changes_nothing(kept):
    called(X)
    before = dict(programs._programs)
    programs.keep_in(kept)
    assert programs._programs == before


@pytest.mark.parametrize("option", ["xla_disable_hlo_passes", "xla_of_another_age"])
def test_quick_programs_use_the_option_where_it_is_known(kept, monkeypatch, option):
    monkeypatch.setattr(programs, "QUICK", {option: ""})
    given = []
    compile_ = jax.stages.Lowered.compile

    def told(self, compiler_options=None):
        given.append(compiler_options)
        return compile_(self, compiler_options)

    monkeypatch.setattr(jax.stages.Lowered, "compile", told)
    programs.keep_in(kept, quick=True)
    assert np.array_equal(called(X).first, X**2 + 1)
    known = option == "xla_disable_hlo_passes"
    assert given == [{**options(), **programs.QUICK}] + [options()] * (not known)
    programs.keep_in(kept)
    assert np.array_equal(called(X).first, X**2 + 1)
    assert given[-1] == options()
    assert len(traces) == 1


@pytest.mark.parametrize("what", ["prior, bounds and a lens", "spheres"])
def test_fit_programs_can_be_kept(kept, what, monkeypatch):
    """The structure of its answer is known before it is traced."""
    camera = pj.Camera([3.0, 1, 0.8], [0, 0, 0], [0, 0, 1], 0.8, W=48, H=40)
    spheres = pj.Spheres(np.eye(3) / 2, np.full(3, 0.4))
    scene, names, more = pj.Scene(spheres=spheres), ("pose",), {}
    if what != "spheres":
        camera = eqx.tree_at(lambda c: c.lens, camera, LENS, is_leaf=lambda x: x is None)
        scene, names = pj.Scene(mesh=pj.shapes.bumpy(2)), ("pose", "phi", "k1")
        more = {"prior": {"phi": (0.8, 0.1)}, "bounds": {"phi": (0.2, 2.0)}}

    def kept_or_not(where, arguments, answer):
        found = eqx.filter_eval_shape(programs._function(where), *arguments)
        assert jax.tree.structure(found) == jax.tree.structure(answer())
        assert programs._path(where, arguments) is not None
        raise Looked

    monkeypatch.setattr(programs, "call", kept_or_not)
    with pytest.raises(Looked):
        pj.fit_camera(scene, np.eye(40, 48) + np.eye(40, 48, 1), camera, names, **more)


def test_local_functions_keep_nothing(kept):
    programs.call(WHERE, (X, 2, Pair(1.0, lambda: 0)), answer)
    assert not kept.exists()


@pytest.mark.parametrize("damage", [b"", b"x" * 500, None])
def test_damaged_file_is_written_anew(kept, damage):
    called(X)
    [path] = kept.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + b"?" if damage is None else damage)
    another_process(kept)
    assert np.array_equal(called(X).first, X**2 + 1)
    assert len(traces) == 2
    assert programs._read(path) is not None


def test_unwritable_folder_keeps_nothing(kept):
    kept.write_text("a file, not a folder")
    assert np.array_equal(called(X).first, X**2 + 1)


FIT = """
import sys
import numpy as np, pinhole_jax as pj
pj.cache(sys.argv[1])
scene = pj.Scene(mesh=pj.shapes.bumpy(3))
truth = pj.Camera([3, 1, 0.8], [0, 0, 0], [0, 0, 1], 0.8, W=96, H=80)
start = pj.Camera([3, 1.1, 0.8], [0, 0, 0], [0, 0, 1], 0.8, W=96, H=80)
fit = pj.fit_camera(scene, np.load(sys.argv[2]), start)
print(fit.status, *(np.asarray(x).tobytes().hex() for x in (fit.camera.e, fit.covariance)))
print("optimistix" in sys.modules)
"""


@pytest.mark.long
def test_later_process_finds_the_same_camera_without_tracing(tmp_path):
    truth = pj.Camera([3, 1, 0.8], [0, 0, 0], [0, 0, 1], 0.8, W=96, H=80)
    np.save(tmp_path / "mask.npy", drawn(truth, pj.Scene(pj.shapes.bumpy(3))))
    words = [sys.executable, "-c", FIT, tmp_path / "cache", tmp_path / "mask.npy"]
    said = []
    for _ in range(2):
        done = subprocess.run(words, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        said.append(done.stdout.split())
    assert said[0][:-1] == said[1][:-1]
    assert said[0][0] == "converged"
    assert (said[0][-1], said[1][-1]) == ("True", "False")


def test_functions_called_by_name_exist():
    """The functions that are called by their names."""
    root = HERE.parent / "pinhole_jax"
    named = {
        name
        for path in root.rglob("*.py")
        for name in re.findall(r'"(pinhole_jax[\w.]*:\w+)"', path.read_text())
    }
    assert named
    assert all(callable(programs._function(name)) for name in named)


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
