"""Which functions do the same: what is traced of one then stands for the other."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pinhole_jax._numerics import one_kernel as module
from pinhole_jax._numerics.alike import name_of
from pinhole_jax._numerics.one_kernel import one_kernel


def times(factor, inner=None):
    def run(x):
        return factor * (x if inner is None else inner(x))

    return run


def default(x, factor=2):
    return factor * x


def holding_itself(x):
    def run(n):
        return x if n == 0 else run(n - 1)

    return run


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (times(2), times(2), True),
        (times(2), times(3), False),
        (times(2), times(2.0), False),  # of another type
        (times(1), times(True), False),
        (times(2.0), times(2.0), True),
        (times(0.0), times(-0.0), False),
        (times(2, default), times(2, default), True),
        (times(2, times(3)), times(2, times(3)), True),
        (times(2, times(3)), times(2, times(4)), False),
        (partial(default, factor=3), partial(default, factor=3), True),
        (partial(default, factor=3), partial(default, factor=4), False),
        (partial(default, 3), partial(default, factor=3), False),
        (times((1, "a", jnp.float32, np.dtype(float))), times((1, "a", jnp.float32)), False),
    ],
)
def test_functions_do_the_same_if_their_code_and_all_they_hold_are_equal(one, other, same):
    assert name_of(one) is not None
    assert (name_of(one) == name_of(other)) == same


@pytest.mark.parametrize(
    "function",
    [
        times(np.ones(2)),
        times(jnp.ones(2)),
        times(object()),
        times(np.float64(2)),
        holding_itself(1),
        jax.jit(default),
        partial(default, np.ones(2)),
        times((1, [jnp.ones(2)])),
    ],
)
def test_function_that_closes_over_an_unknown_object_has_no_name(function):
    assert name_of(function) is None


def test_traced_values_give_a_function_no_name():
    named = []
    jax.jit(lambda x: named.append(name_of(times(x))) or x)(1.0)
    assert named == [None]


def test_equal_kernels_are_traced_once():
    @jax.jit
    def program(x):
        y = sum(one_kernel(times(k, default))(x) for k in (2, 3, 2, 2))
        return y + one_kernel(times(5))(x)

    x = jnp.arange(3.0)
    module._flats.clear()
    np.testing.assert_array_equal(program(x), 2 * (2 + 3 + 2 + 2) * x + 5 * x)
    assert len(module._flats) == 3
    text = program.lower(x).as_text()
    assert text.count("func.func private @jaxpr_as_fun") == 3


def test_kernels_differ_by_their_types():
    for dtype in (jnp.float32, jnp.int32, jnp.float32):
        assert one_kernel(times(2))(jnp.ones(2, dtype)).dtype == dtype


def test_no_more_functions_are_held_than_are_kept(monkeypatch):
    monkeypatch.setattr(module, "KEPT", 3)
    monkeypatch.setattr(module, "_flats", {})
    for k in range(8):
        assert one_kernel(times(k))(jnp.ones(2))[0] == k
        assert len(module._flats) <= 3
