"""Programs side by side: as many at once as there are cores, the same as one after the other."""

from threading import Barrier, Lock, get_ident

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pinhole_jax._numerics import threads
from pinhole_jax._numerics.threads import in_threads


@pytest.fixture(autouse=True)
def cores(monkeypatch):
    """A machine of two cores, on which nothing is compiled yet."""
    monkeypatch.setattr(threads, "usable_cores", lambda: 2)
    monkeypatch.setattr(threads, "_compiled", set())


def test_calls_run_two_at_once():
    """Else they wait for each other in vain."""
    beside = Barrier(2, timeout=30)

    def meet(x):
        if x > 0:
            beside.wait()
        return jnp.float32(x)

    assert in_threads(meet, list(range(5)), lambda x: "one") == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("count", [1, 2], ids=["one core", "settings of another thread"])
def test_single_thread_runs_all_where_types_would_differ(monkeypatch, count):
    monkeypatch.setattr(threads, "usable_cores", lambda: count)
    lengths, by = [np.dtype("float32"), np.dtype("float64")], []
    if count == 2:
        monkeypatch.setattr(jax.dtypes, "canonicalize_dtype", lambda _: lengths.pop())
    assert in_threads(lambda x: by.append(get_ident()), [1, 2, 3], lambda x: x) == [None] * 3
    assert set(by) == {get_ident()}


def test_errors_in_threads_are_raised():
    def ask(x):
        if x > 3:
            raise ValueError("a mesh without faces")
        return x

    assert in_threads(ask, [1, 2, 3], lambda x: 0) == [1, 2, 3]
    with pytest.raises(ValueError, match="without faces"):
        in_threads(ask, [1, 2, 4], lambda x: 0)


def test_first_call_of_each_program_runs_alone():
    """Several threads would compile the same."""
    running, met, lock = set(), {}, Lock()

    def look(x):
        with lock:
            running.add(x)
        met[x] = len(running)
        with lock:
            running.discard(x)
        return x

    given = ["a1", "a2", "b1", "a3", "b2"]
    assert in_threads(look, given, lambda x: x[0]) == given
    assert met["a1"] == met["b1"] == 1
    assert threads._compiled == {"a", "b"}
