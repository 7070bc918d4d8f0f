"""A function of arrays that is traced where its program is lowered, and not before.

A program that is differentiated is traced as it is first, and its custom derivatives then: what
these have in place of a function is not used, but tracing it takes as long.
"""

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any

import jax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir
from jaxtyping import PyTree

from .literals import tidied
from .one_kernel import for_cpus, is_for_cpus


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

    out = _later_p.bind(*leaves, function=flat, shapes=tuple((x.shape, x.dtype) for x in shapes))
    return out_tree.unflatten(out)


_later_p = Primitive("pinhole_later")
_later_p.multiple_results = True


def _impl(*args, function, shapes):
    del shapes
    return function(*args)


def _abstract(*args, function, shapes):
    del args, function
    return [ShapedArray(shape, dtype) for shape, dtype in shapes]


def _batch(args, dims, *, function, shapes):
    size = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
    beside = jax.vmap(function, in_axes=tuple(dims))
    more = tuple(((size, *shape), dtype) for shape, dtype in shapes)
    return _later_p.bind(*args, function=beside, shapes=more), [0] * len(shapes)


_later_p.def_impl(_impl)
_later_p.def_abstract_eval(_abstract)
batching.primitive_batchers[_later_p] = _batch
_lowered = lambda *args, **params: tidied(partial(_impl, **params))(*args)
mlir.register_lowering(_later_p, mlir.lower_fun(_lowered, multiple_results=True))
