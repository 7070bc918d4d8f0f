"""A function that is traced where its program is lowered."""

import jax
import jax.numpy as jnp
import numpy as np

from pinhole_jax._numerics.backend import for_cpus, is_for_cpus
from pinhole_jax._numerics.later import later

X = jnp.array([1.0, -2.0, 3.0])


def test_function_is_not_traced_for_its_derivative_alone():
    traced = []

    def whole(x):
        traced.append(x)
        return {"sum": jnp.sum(x), "square": x * x}

    @jax.custom_jvp
    def f(x):
        return later(whole, {"sum": x[0], "square": x}, x)

    @f.defjvp
    def _(primals, tangents):
        (x,), (t,) = primals, tangents
        return {"sum": jnp.sum(x), "square": x * x}, {"sum": jnp.sum(t), "square": 2 * x * t}

    slope = jax.jit(jax.grad(jax.jit(lambda x: jnp.sum(f(x)["square"]))))(X)
    np.testing.assert_array_equal(slope, 2 * X)
    assert not traced
    np.testing.assert_array_equal(jax.jit(f)(X)["square"], X * X)
    assert len(traced) == 1
    assert f(X)["sum"] == 2.0


def test_batches_go_along_any_axis():
    both = lambda x, y: later(lambda x, y: x + 2.0 * y, x, x, y)
    found = jax.jit(jax.vmap(both, (1, None)))(jnp.stack([X, 2 * X], 1), X)
    np.testing.assert_array_equal(found, np.stack([3 * X, 4 * X]))


def test_choice_of_cpu_lasts_until_lowering():
    seen = []

    def look(x):
        seen.append(is_for_cpus())
        return x

    with for_cpus():
        program = jax.jit(lambda x: later(look, x, x)).trace(X)
    program.lower()
    jax.jit(lambda x: later(look, x, x)).lower(X)
    assert seen == [True, False]
