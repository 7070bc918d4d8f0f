"""The package's own programs are compiled in less time, alone and within others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pinhole_jax._numerics import jitted as module
from pinhole_jax._numerics.jitted import OPTIONS, jitted, options

X = np.arange(1.0, 4.0)


@jitted
def doubled(x, times=2):
    """Say what it does."""
    return {"value": times * x, "times": times}


@pytest.fixture
def told(monkeypatch):
    """What XLA is told of each program that is compiled."""
    given = []
    own, part = doubled._own, doubled._part
    monkeypatch.setattr(doubled, "_own", lambda *a, **k: given.append(OPTIONS) or own(*a, **k))
    monkeypatch.setattr(doubled, "_part", lambda *a, **k: given.append({}) or part(*a, **k))
    return given


@pytest.mark.usefixtures("optimised")
def test_options_apply_to_outer_programs_alone(told):
    """JAX refuses options within another program, whether that hands on its arguments or not."""
    assert options() == OPTIONS
    np.testing.assert_array_equal(doubled(X)["value"], 2 * X)
    assert told == [OPTIONS]
    value = lambda x: jnp.sum(doubled(x, times=3)["value"])
    assert jax.jit(value)(X) == jnp.sum(jax.vmap(value)(X)) == 18
    np.testing.assert_array_equal(jax.grad(value)(X), 3.0)
    np.testing.assert_array_equal(jax.jit(jax.grad(value))(X), 3.0)
    assert {} in told
    assert told.count(OPTIONS) == 1
    of_a_constant = jax.jit(lambda x: x + doubled(X)["value"])
    np.testing.assert_array_equal(of_a_constant(X), 3 * X)
    assert told.count(OPTIONS) == 1


def test_hurried_compiler_gets_no_options(told):
    if not jax.config.read("jax_disable_most_optimizations"):
        pytest.skip("the compiler is as users have it")
    assert doubled(X)["times"] == 2
    assert told == [{}]


@pytest.mark.usefixtures("optimised")
def test_compiler_that_does_not_know_an_option_gets_none(monkeypatch):
    monkeypatch.setattr(module, "OPTIONS", {"xla_of_another_age": 1})
    module._known.cache_clear()
    assert options() == {}
    module._known.cache_clear()


def test_wrapped_function_keeps_its_name_and_docstring():
    assert (doubled.__name__, doubled.__doc__) == ("doubled", "Say what it does.")
    assert "multiply" in doubled.lower(X).as_text()


def test_programs_are_counted():
    made = []
    for shape in (7, 7, 8):
        doubled(np.ones(shape))
        made.append(doubled.made())
    assert made[1:] == [made[0], made[0] + 1]
