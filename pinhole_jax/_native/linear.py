"""A linear map given by two functions: itself and its transpose."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array


def linear(
    forward: Callable[[list[Array]], Array],
    transpose: Callable[[Array], list[Array]],
    x: list[Array],
    like: jax.ShapeDtypeStruct,
) -> Array:
    """`forward(x)`, which JAX transposes by `transpose`, also under `vmap`.

    Both directions make one symmetric map, `(x, y) -> (transpose(y), forward(x))`, stated as the
    solution of a symmetric linear system. The half that is not used does not run.
    """
    # (Zeros that are linear in `x`, as JAX asks: the sum of none of its numbers.)
    zero = jnp.broadcast_to(jnp.sum(x[0].reshape(-1)[:0]), like.shape)
    both = lambda _, right: (transpose(right[1]), forward(right[0]))
    return jax.lax.custom_linear_solve(lambda x: x, (x, zero), both, symmetric=True)[1]


def moving_of(values: Sequence[Any], moves: Sequence[bool]) -> list[Any]:
    """The values of the variables that move."""
    return [x for x, m in zip(values, moves, strict=True) if m]


def merged(moving: Sequence[Any], still: Sequence[Any], moves: Sequence[bool]) -> list[Any]:
    """The values of all variables, from those that move and those that do not."""
    left = iter(moving)
    return [next(left) if m else x for x, m in zip(still, moves, strict=True)]


@jax.custom_jvp
def differentiable_once(x: Any) -> Any:
    """`x`, held: to differentiate by it is an error."""
    return x


@differentiable_once.defjvp
def _refused(primals: Any, tangents: Any):
    raise NotImplementedError(
        "silhouettes can be differentiated once: second derivatives of coverage are not defined by"
        " its contour alone (use Gauss-Newton, J^T J, in their place)"
    )
