import jax
import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError
from numpy.testing import assert_allclose

from pinhole_jax._numerics.safe import dot, norm, normalize, safe_divide, safe_sqrt


@pytest.mark.parametrize(
    ("function", "at"),
    [
        (safe_sqrt, 0.0),
        (safe_sqrt, -1.0),
        (lambda x: safe_divide(jnp.ones(()), x), 0.0),
        (lambda x: norm(jnp.stack([x, x, x])), 0.0),
        (lambda x: jnp.sum(normalize(jnp.stack([x, x, x]))), 0.0),
    ],
)
def test_singular_points_have_value_and_derivative_zero(function, at):
    value, slope = jax.value_and_grad(function)(at)
    assert (float(value), float(slope)) == (0, 0)


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
def test_norm_neither_under_nor_overflows(scale):
    assert_allclose(norm(scale * jnp.array([3.0, 4, 0])), 5 * scale, rtol=1e-15)
    assert_allclose(normalize(scale * jnp.array([3.0, 4, 0])), [0.6, 0.8, 0])


def test_norm_has_the_derivative_of_a_norm():
    assert_allclose(jax.grad(norm)(jnp.array([3.0, 4, 0])), [0.6, 0.8, 0], rtol=1e-15)


def test_shapes_that_annotations_tell_are_checked_while_tests_run():
    with pytest.raises(TypeCheckError, match="dot"):
        dot(jnp.ones(3), jnp.ones(4))
