"""Programs of which XLA's CPU compiler makes a single kernel; what it cannot ends the process."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pinhole_jax._numerics.backend import for_this_machine
from pinhole_jax._numerics.one_kernel import (
    at_once,
    on_cpu,
    one_kernel,
    rows,
    rows_of_each,
    with_slopes,
)


def running(x, steps, unused):
    del unused
    put = lambda k, x: jax.lax.dynamic_update_slice(x, (x[k - 1] + steps[k])[None], (k,))
    return jax.lax.fori_loop(1, len(x), put, x), jnp.array(3.0)


def test_loop_is_one_kernel_with_constants_and_unused_arguments():
    steps, unused = jnp.arange(5.0), jnp.ones((7, 3))
    kernel = lambda x: one_kernel(running)(x, steps, unused)  # (`steps` is a constant)
    program = jax.jit(kernel).lower(jnp.ones(5)).compile().as_text()
    assert program is not None
    assert " while(" not in program[program.index("\nENTRY") :]
    expected = np.array([1, 2, 4, 7, 11.0])
    np.testing.assert_array_equal(jax.jit(kernel)(jnp.ones(5))[0], expected)
    several = jnp.outer(jnp.arange(3.0), jnp.ones(5))
    found, three = jax.jit(jax.vmap(kernel))(several)
    np.testing.assert_array_equal(found, np.arange(3.0)[:, None] + expected - 1)
    assert three.tolist() == [3] * 3


def test_branch_for_other_machines_is_traced_where_needed():
    traced = []

    def elsewhere(x):
        traced.append(x)
        return 2 * x

    double = lambda x: on_cpu(lambda x: x + x, x, elsewhere=elsewhere)
    with for_this_machine():
        assert jax.jit(double)(jnp.ones(3)).tolist() == [2, 2, 2]
    assert not traced
    assert jax.jit(lambda x: double(x))(jnp.ones(3)).tolist() == [2, 2, 2]
    assert traced


def polar(x, unit):
    length = jnp.sqrt(jnp.sum(x["at"] ** 2))
    return {"length": length * unit, "angle": jnp.arctan2(x["at"][1], x["at"][0]) + x["turn"]}


@pytest.mark.parametrize("transform", [jax.jacfwd, jax.jacrev, lambda f: jax.vmap(jax.jacfwd(f))])
def test_derivative_comes_with_the_value(transform):
    x = {"at": jnp.array([3.0, 4.0]), "turn": jnp.array(0.5)}
    if transform not in (jax.jacfwd, jax.jacrev):
        x = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), x)
    at = lambda function: jax.jit(transform(lambda x: function(x, jnp.array(2.0))))(x)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), at(at_once(polar)), at(polar)
    )


def test_slopes_come_with_the_value():
    unit, at = jnp.array(2.0), jnp.array([3.0, 4.0])
    of = lambda at, unit: polar({"at": at, "turn": jnp.array(0.5)}, unit)
    value, slopes = jax.jit(lambda at: with_slopes(of, at, unit))(at)
    expected = {"length": 10.0, "angle": np.arctan2(4, 3) + 0.5}
    along = {"length": [1.2, 1.6], "angle": [-0.16, 0.12]}
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), value, expected)
    for name, slope in along.items():
        np.testing.assert_allclose(slopes[name], slope, rtol=1e-12)


def test_second_derivative_goes_step_by_step():
    bend = lambda x: at_once(lambda x: {"y": jnp.sin(x["at"])})({"at": x})["y"]
    assert jax.jit(jax.grad(jax.grad(bend)))(jnp.array(0.3)) == pytest.approx(-np.sin(0.3))


def test_held_arguments_are_not_differentiated():
    x = {"at": jnp.array([3.0, 4.0]), "turn": jnp.array(0.5)}
    by_unit = jax.grad(lambda unit: at_once(polar)(x, unit)["length"])(jnp.array(2.0))
    assert by_unit == 0


@pytest.mark.parametrize("number", [1, 5])
def test_rows_are_one_kernel_and_not_differentiated(number):
    ids, table = jnp.arange(number, dtype=jnp.int32), jnp.linspace(1, 2, 7)
    row = lambda i, table: [table[i] ** 2, 1 / table[i + 1]]
    held = np.asarray(table)
    expected = np.stack([held[:number] ** 2, 1 / held[1 : number + 1]], axis=1)
    np.testing.assert_allclose(jax.jit(lambda *a: rows(row, *a))(ids, table), expected)
    both = lambda i, table: lambda k: [table[i + k]]
    pairs = rows_of_each(both, 2, ids, table)
    np.testing.assert_array_equal(pairs[..., 0], np.stack([held[:number], held[1 : number + 1]], 1))
    many = jax.vmap(lambda table: rows(row, ids, table))(jnp.stack([table, 2 * table]))
    np.testing.assert_allclose(many[0], expected)
    assert not np.any(jax.grad(lambda table: jnp.sum(rows(row, ids, table)))(table))
