"""A linear map given by two functions: itself and its transpose."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array


def linear(
    forward: Callable[[Any], Array],
    transpose: Callable[[Array], Any],
    x: Any,
    like: jax.ShapeDtypeStruct,
) -> Array:
    """`forward(x)` of a tree x, which JAX transposes by `transpose`, also under `vmap`.

    Both directions make one symmetric map, `(x, y) -> (transpose(y), forward(x))`, stated as the
    solution of a symmetric linear system. The half that is not used does not run.
    """
    # (Zeros that are linear in `x`, as JAX asks: the sum of none of its numbers.)
    zero = jnp.broadcast_to(jnp.sum(jax.tree.leaves(x)[0].reshape(-1)[:0]), like.shape)
    both = lambda _, right: (transpose(right[1]), forward(right[0]))
    return jax.lax.custom_linear_solve(lambda x: x, (x, zero), both, symmetric=True)[1]


def moves_of(tangents: Any) -> Any:
    """A tree of True for each variable that moves, and False for others."""
    return jax.tree.map(lambda tangent: not isinstance(tangent, SymbolicZero), tangents)


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
