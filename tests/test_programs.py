"""Programs that are kept as traced are found again, and never taken for others."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
import pytest

from pinhole_jax._files import programs

WHERE = f"{__name__}:raised"
HERE = Path(__file__).parent
traces = []


class Pair(NamedTuple):
    first: object
    second: object


@eqx.filter_jit
def raised(x, power, pair):
    return Pair(x**power + pair.first, {"sum": x.sum()})


def called(x, power=2, first=1.0):
    pair = Pair(np.float32(first), None)
    return programs.call(WHERE, (x, power, pair), lambda: Pair(0, {"sum": 0}))


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
    programs.keep_in(kept)  # and nothing is known of before


X = np.arange(3, dtype=np.float32)


def test_what_an_earlier_process_traced_is_not_traced_again(kept):
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
def test_another_program_is_another_one(kept, other):
    called(X), called(X, power=1)
    another_process(kept)
    traces.clear()
    other()
    assert len(traces) == 1
    assert len(list(kept.iterdir())) == 3


def test_a_switch_of_jax_makes_another_program(kept):
    called(X)
    with jax.default_matmul_precision("highest"):
        called(X)
    assert len(list(kept.iterdir())) == 2


def test_code_or_versions_make_another_program(kept, monkeypatch):
    called(X)
    for name in ("_source", "_versions"):
        another_process(kept)
        monkeypatch.setattr(programs, name, lambda name=name: name)
        called(X)
    assert len(traces) == len(list(kept.iterdir())) == 3


def test_nothing_is_kept_where_each_call_is_watched(kept):
    with jax.debug_nans(True):
        called(X)
    assert not kept.exists()


def test_nothing_is_kept_that_only_this_process_can_name(kept):
    programs.call(WHERE, (X, 2, Pair(1.0, lambda: 0)), lambda: Pair(0, {"sum": 0}))
    assert not kept.exists()


@pytest.mark.parametrize("damage", [b"", b"x" * 500, None])
def test_a_damaged_file_is_written_anew(kept, damage):
    called(X)
    [path] = kept.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + b"?" if damage is None else damage)
    another_process(kept)
    assert np.array_equal(called(X).first, X**2 + 1)
    assert len(traces) == 2
    assert programs._read(path) is not None


def test_a_folder_that_cannot_be_written_to_keeps_nothing(kept):
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
def test_a_later_process_finds_the_same_camera_without_tracing_the_fit(tmp_path):
    import pinhole_jax as pj

    truth = pj.Camera([3, 1, 0.8], [0, 0, 0], [0, 0, 1], 0.8, W=96, H=80)
    np.save(tmp_path / "mask.npy", np.asarray(pj.silhouette(truth, pj.Scene(pj.shapes.bumpy(3)))))
    words = [sys.executable, "-c", FIT, tmp_path / "cache", tmp_path / "mask.npy"]
    said = []
    for _ in range(2):
        done = subprocess.run(words, capture_output=True, text=True, env=dict(os.environ))
        assert done.returncode == 0, done.stderr
        said.append(done.stdout.split())
    assert said[0][:-1] == said[1][:-1]
    assert said[0][0] == "converged"
    assert (said[0][-1], said[1][-1]) == ("True", "False")


def test_what_is_named_is_there():
    """The functions that are called by their names."""
    root = HERE.parent / "pinhole_jax"
    named = {
        name
        for path in root.rglob("*.py")
        for name in re.findall(r'"(pinhole_jax[\w.]*:\w+)"', path.read_text())
    }
    assert named
    assert all(callable(programs._function(name)) for name in named)
