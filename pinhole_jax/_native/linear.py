"""Derivatives of images as linear maps given by two functions: the map and its transpose."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array


def linear(
    push: Callable[[list[Any]], Array],
    pull: Callable[[Array], Sequence[Any]],
    velocities: Sequence[Array | SymbolicZero],
    still: Sequence[Any],
    image: Array,
) -> Array:
    """`push(velocities)`, which JAX transposes by `pull`, also under `vmap`; shaped as the image.

    Velocities of variables that do not move are `still`; they are not pulled back to.

    Both directions make one symmetric map, `(x, y) -> (pull(y), push(x))`, stated as the solution
    of a symmetric linear system. The half that is not used does not run.
    """
    moves = [not isinstance(v, SymbolicZero) for v in velocities]
    moving = lambda values: [x for x, m in zip(values, moves, strict=True) if m]

    def both(_: Any, right: Any) -> tuple[list[Array], Array]:
        left = iter(right[0])
        whole = [next(left) if m else x for x, m in zip(still, moves, strict=True)]
        return moving(pull(right[1])), push(whole)

    x = moving(velocities)
    # (Zeros that are linear in `x`, as JAX asks: the sum of none of its numbers.)
    zero = jnp.broadcast_to(jnp.sum(x[0].reshape(-1)[:0]), image.shape)
    return jax.lax.custom_linear_solve(lambda x: x, (x, zero), both, symmetric=True)[1]


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
