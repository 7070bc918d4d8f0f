"""A function of arrays that is traced where its program is lowered, and not before.

A program that is differentiated is traced as it is first, and its custom derivatives then: what
these have in place of a function is not used, but tracing it takes as long.
"""

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import jax
from jax.extend.core import Primitive
from jax.interpreters import batching
from jaxtyping import PyTree

from .backend import for_cpus, is_for_cpus
from .on_devices import lower, results, spread, varying_axes


def later(function: Callable[..., PyTree], like: PyTree, *arguments: PyTree) -> PyTree:
    """Return function(*arguments), arrays that are `like` others in shape and type.

    It cannot be differentiated: it is for functions whose derivative is given.
    """
    leaves, tree = jax.tree.flatten(arguments)
    shapes, out_tree = jax.tree.flatten(like)
    context = for_cpus if is_for_cpus() else nullcontext

    def flat(*leaves: Any) -> list:
        with context():
            return out_tree.flatten_up_to(function(*tree.unflatten(leaves)))

    leaves = spread(leaves, ())
    out = _later_p.bind(*leaves, function=flat, shapes=tuple((x.shape, x.dtype) for x in shapes))
    return out_tree.unflatten(out)


def on_each_device(function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
    """Return function(*arguments), where arrays vary over the devices of a `shard_map` too.

    Each device works it out by itself there, and it cannot be differentiated.
    """
    leaves, tree = jax.tree.flatten(arguments)
    if not varying_axes(leaves):
        return function(*arguments)
    plain = tree.unflatten([jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves])
    return later(function, jax.eval_shape(function, *plain), *arguments)


_later_p = Primitive("pinhole_later")
_later_p.multiple_results = True


def _impl(*args, function, shapes):
    del shapes
    return function(*args)


def _abstract(*args, function, shapes):
    del function
    return results(args, shapes)


def _batch(args, dims, *, function, shapes):
    size = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
    beside = jax.vmap(function, in_axes=tuple(dims))
    more = tuple(((size, *shape), dtype) for shape, dtype in shapes)
    return _later_p.bind(*args, function=beside, shapes=more), [0] * len(shapes)


_later_p.def_impl(_impl)
_later_p.def_abstract_eval(_abstract)
batching.primitive_batchers[_later_p] = _batch
lower(_later_p, _impl)
