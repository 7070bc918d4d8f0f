"""A linear map given by two functions: itself and its transpose.

`jax.linear_call` offers this, but without a batching rule (0.10), and a loop of unknown length can
be differentiated forward but not transposed. With both directions written down, a derivative that
is a sum over a dynamic number of terms runs under `jvp`, `vjp`, `jacfwd`, `jacrev` and `vmap`.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching
from jaxtyping import Array, PyTree

from .backend import for_this_machine
from .batches import in_turn
from .literals import tidied
from .on_devices import lower, results, spread
from .one_kernel import by_machine
from .tracing import collector_at_rest

Direction = Callable[[list, list], list]


def linear_map(
    forward: Callable[[Any, Any], Any],
    transpose: Callable[[Any, Any], Any],
    residuals: PyTree,
    linear: PyTree,
    like: PyTree,
) -> PyTree:
    """Return forward(residuals, linear), which `transpose(residuals, cotangent)` transposes.

    `forward` must be linear in its second argument; every leaf of `linear` and of the result is a
    float array, and the result is `like` others in shape and type: a program that asks for one
    direction does not trace the other. It can be differentiated with respect to `linear` only. Both
    functions are given and return leaves with one more axis, the last: along it are the vectors
    that are mapped.
    """
    residual_leaves, residual_tree = jax.tree.flatten(residuals)
    one = jax.tree.map(lambda x: jnp.asarray(x)[..., None], linear)
    linear_leaves, linear_tree = jax.tree.flatten(one)
    linear_leaves = spread(linear_leaves, residual_leaves)
    residual_leaves = spread(residual_leaves, linear_leaves)
    out_leaves, out_tree = jax.tree.flatten(like)

    def flat(direction: Callable, given: Any, found: Any) -> Direction:
        @collector_at_rest()
        def call(residual: list, x: list) -> list:
            out = direction(residual_tree.unflatten(residual), given.unflatten(x))
            return found.flatten_up_to(out)

        return call

    out = _linear_map_p.bind(
        *residual_leaves,
        *linear_leaves,
        forward=flat(forward, linear_tree, out_tree),
        transpose=flat(transpose, out_tree, linear_tree),
        n_residuals=len(residual_leaves),
        out_shapes=tuple(((*x.shape, 1), x.dtype) for x in out_leaves),
    )
    # (A sum of one: `vmap` moves its axis to the front in what is indexed or squeezed.)
    return out_tree.unflatten([jnp.sum(x, axis=-1) for x in out])


_linear_map_p = Primitive("pinhole_linear_map")
_linear_map_p.multiple_results = True


def _impl(*args, forward: Direction, transpose: Direction, n_residuals: int, out_shapes: tuple):
    del transpose, out_shapes
    return forward(list(args[:n_residuals]), list(args[n_residuals:]))


def _abstract(*args, forward, transpose, n_residuals, out_shapes):
    del forward, transpose, n_residuals
    return results(args, out_shapes)


def _jvp(primals, tangents, *, n_residuals, **params):
    if any(type(t) is not ad.Zero for t in tangents[:n_residuals]):
        raise NotImplementedError(
            "silhouettes can be differentiated once: second derivatives of coverage are not defined"
            " by its contour alone (use Gauss-Newton, J^T J, in their place)"
        )
    out = _linear_map_p.bind(*primals, n_residuals=n_residuals, **params)
    moving = [ad.instantiate_zeros(t) for t in tangents[n_residuals:]]
    tangent_out = _linear_map_p.bind(
        *primals[:n_residuals], *moving, n_residuals=n_residuals, **params
    )
    return out, tangent_out


def _transpose(cotangents, *args, forward, transpose, n_residuals, out_shapes):
    del out_shapes
    linear = args[n_residuals:]
    shapes = tuple((x.aval.shape, x.aval.dtype) for x in linear)
    out = _linear_map_p.bind(
        *args[:n_residuals],
        *(ad.instantiate_zeros(c) for c in cotangents),
        forward=transpose,
        transpose=forward,
        n_residuals=n_residuals,
        out_shapes=shapes,
    )
    return [None] * n_residuals + out


def _batch(args, dims, *, forward, transpose, n_residuals, out_shapes):
    size = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
    residuals, axes = args[:n_residuals], list(dims[:n_residuals])
    linear = [
        _with_axis(x, d, size) for x, d in zip(args[n_residuals:], dims[n_residuals:], strict=True)
    ]
    if all(d is None for d in axes):
        out = _linear_map_p.bind(
            *residuals,
            *(x.reshape(*x.shape[:-2], -1) for x in linear),
            forward=forward,
            transpose=transpose,
            n_residuals=n_residuals,
            out_shapes=tuple(((*s[:-1], size * s[-1]), dtype) for s, dtype in out_shapes),
        )
        out = [x.reshape(*x.shape[:-1], size, -1) for x in out]
        return out, [x.ndim - 2 for x in out]
    out = _linear_map_p.bind(
        *residuals,
        *(jnp.moveaxis(x, -2, 0) for x in linear),
        forward=_of_each(forward, axes),
        transpose=_of_each(transpose, axes),
        n_residuals=n_residuals,
        out_shapes=tuple(((size, *shape), dtype) for shape, dtype in out_shapes),
    )
    return out, [0] * len(out)


def _of_each(direction: Direction, axes: list) -> Direction:
    """Return a direction of a batch, residuals along these axes: on a CPU one after the other, so
    that what one takes is held once."""

    @for_this_machine()
    def mapped(residuals: list, x: list) -> list:
        beside = jax.vmap(direction, in_axes=(axes, 0))

        def turn(residuals, x):
            pairs = zip(residuals, axes, strict=True)
            moved = [r if d is None else jnp.moveaxis(r, d, 0) for r, d in pairs]
            batched = [d is not None for d in axes], [True] * len(x)
            return in_turn(direction, batched, (moved, x))

        return by_machine(residuals, x, cpu=turn, elsewhere=beside)

    return mapped


def _with_axis(x: Array, axis: int | None, size: int) -> Array:
    """Return an array whose batch axis is the last but one."""
    if axis is None:
        return jnp.broadcast_to(x[..., None, :], (*x.shape[:-1], size, x.shape[-1]))
    return jnp.moveaxis(x, axis, -2)


_linear_map_p.def_impl(_impl)
_linear_map_p.def_abstract_eval(_abstract)
ad.primitive_jvps[_linear_map_p] = _jvp
ad.primitive_transposes[_linear_map_p] = _transpose
batching.primitive_batchers[_linear_map_p] = _batch
lower(_linear_map_p, lambda *args, **params: tidied(partial(_impl, **params))(*args))
