"""What a fit says while it runs, and who is shown it."""

import sys
import time
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from oracles import drawn, lump, usual_camera
from refusals import refusal

import pinhole_jax as pj
from pinhole_jax._files import progress
from pinhole_jax._files.progress import Ticker, say, shown

CAMERA = usual_camera(48, 40)
SCENE = lump(2)
MASK = drawn(CAMERA, SCENE) > 0.5


def test_line_comes_often_where_there_is_no_terminal(monkeypatch, capsys):
    monkeypatch.setattr(progress, "OFTEN", 0.3)
    monkeypatch.setattr(progress, "RENEWED", 0.05)
    with Ticker("reading"):
        say("looking for a view: guess 3 of 16")
        time.sleep(0.8)
    lines = capsys.readouterr().err.splitlines()
    assert 1 <= len(lines) <= 2
    assert all(line.endswith("s  looking for a view: guess 3 of 16") for line in lines)


def test_quick_work_shows_nothing(capsys):
    for live in (False, True):
        with Ticker("reading", live=live):
            say("fitting")
    assert capsys.readouterr().err == ""


def test_fit_tells_what_goes_on_and_how_long_it_took(monkeypatch, capsys):
    monkeypatch.setattr(progress, "SHORT", 0.0)
    assert pj.fit_camera(SCENE, MASK, CAMERA).status == "converged"
    assert capsys.readouterr().err == ""
    pj.fit_camera(SCENE, MASK, CAMERA, progress=True)
    assert capsys.readouterr().err.splitlines()[-1].startswith("fitting: ")


def test_fit_names_its_stages():
    stages = []
    with progress.listening(stages.append):
        pj.fit_camera(SCENE, MASK, CAMERA)
    assert "fitting from the start" in stages


def test_clock_tells_what_was_compiled(monkeypatch):
    monkeypatch.setattr(progress, "SHORT", 1e-9)
    clock = Ticker("fitting")
    assert clock.compiled_words() == ""
    jax.block_until_ready(jax.jit(lambda x: jnp.cos(x) + len("a program of its own"))(1.0))
    assert "compiling (1 programs" in clock.compiled_words()


def test_notebooks_show_a_line_unless_they_are_told_not_to(monkeypatch):
    kernel = SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=0))
    monkeypatch.setitem(sys.modules, "IPython", kernel)
    for asked, is_heard in ((None, True), (False, False)):
        with shown(asked, "fitting") as tell:
            assert (tell is not None) == is_heard


def test_progress_of_another_kind_is_refused():
    with refusal("`progress`: expected True, False, None or a function"):
        pj.fit_camera(SCENE, np.ones((40, 48)), CAMERA, progress="yes")
