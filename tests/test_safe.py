import jax
import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from pinhole_jax._numerics.safe import dot, norm, normalize, safe_divide, safe_sqrt


@pytest.mark.parametrize(
    "function, at",
    [
        (safe_sqrt, 0.0),
        (safe_sqrt, -1.0),
        (lambda x: safe_divide(jnp.ones(()), x), 0.0),
        (lambda x: norm(jnp.stack([x, x, x])), 0.0),
        (lambda x: jnp.sum(normalize(jnp.stack([x, x, x]))), 0.0),
    ],
)
def test_singular_points_have_value_and_derivative_zero(function, at):
    value, slope = jax.jit(jax.value_and_grad(function))(at)
    assert (float(value), float(slope)) == (0, 0)


def test_shapes_that_annotations_tell_are_checked_while_tests_run():
    with pytest.raises(TypeCheckError, match="dot"):
        dot(jnp.ones(3), jnp.ones(4))
