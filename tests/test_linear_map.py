import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pinhole_jax._numerics.linear_map import linear_map


def forward(n, x):
    """Sum_{k<n} (k+1) x, by a loop of unknown length: JAX alone cannot transpose it."""
    return jax.lax.fori_loop(0, n, lambda k, s: s + (k + 1.0) * x, jnp.zeros_like(x))


def apply(n, x):
    return linear_map(forward, forward, n, x, x)


X = jnp.array([1.0, -2.0, 3.0])


def test_value_and_derivatives_in_both_modes():
    np.testing.assert_array_equal(apply(3, X), 6 * X)
    np.testing.assert_array_equal(jax.jacfwd(lambda x: apply(3, x))(X), 6 * np.eye(3))
    np.testing.assert_array_equal(jax.jacrev(lambda x: apply(3, x))(X), 6 * np.eye(3))
    np.testing.assert_array_equal(jax.jit(jax.grad(lambda x: apply(3, x)[1]))(X), [0, 6, 0])


def test_batches_over_residuals_and_over_what_is_linear():
    counts = jnp.array([1, 2, 3])
    np.testing.assert_array_equal(
        jax.vmap(apply, (0, None))(counts, X), np.array([1, 3, 6])[:, None] * np.asarray(X)
    )
    np.testing.assert_array_equal(
        jax.jit(jax.vmap(apply, (None, 1), 1))(2, X[None, :] * jnp.ones((2, 1))),
        3 * np.tile(X, (2, 1)),
    )
    slopes = jax.vmap(jax.grad(lambda x, n: jnp.sum(apply(n, x))), (None, 0))(X, counts)
    np.testing.assert_array_equal(slopes, np.repeat([[1], [3], [6]], 3, 1))


def test_batch_on_a_cpu_runs_one_after_the_other():
    """What one takes for its loop is held once, not for each."""

    def with_room(n, x):
        room = jnp.zeros(1 << 16) + x[:1, 0]
        return x + jax.lax.fori_loop(0, n, lambda k, room: room + k, room)[5]

    batch = jax.jit(jax.vmap(lambda n: linear_map(with_room, with_room, n, X, X)))
    used = batch.lower(jnp.arange(64)).compile().memory_analysis()
    if jax.default_backend() == "cpu":
        assert used.temp_size_in_bytes < 8 * 8 << 16


def test_jacobian_maps_all_directions_at_once():
    widths = []

    def twice(r, x):
        widths.append(x.shape)
        return 2.0 * x

    jax.jit(jax.jacfwd(lambda x: linear_map(twice, twice, (), x, x)))(X)
    assert widths[-1] == (3, 3)


def test_nonlinear_argument_has_no_derivative():
    def scaled(s):
        return linear_map(lambda r, x: r * x, lambda r, y: r * y, s, X, X).sum()

    with pytest.raises(NotImplementedError, match="differentiated once"):
        jax.grad(scaled)(2.0)
