"""Values that differ from device to device within `jax.shard_map`.

There JAX keeps, in a value's type, the axes of the devices that it varies over. It refuses loops
and calls that mix values of different axes: a counter that starts at 0, a sum of values that vary.
"""

from typing import Any, TypeVar

import jax

#: A tree of arrays.
Tree = TypeVar("Tree")


def spread(arrays: Tree, over: Any) -> Tree:
    """The arrays, all varying over every axis that one of them or of `over` varies over."""
    if not jax.sharding.get_abstract_mesh().manual_axes:
        return arrays
    axes = frozenset[str]().union(*(_axes(jax.typeof(x)) for x in jax.tree.leaves((arrays, over))))
    return jax.tree.map(lambda x: _cast(x, tuple(sorted(axes - _axes(jax.typeof(x))))), arrays)


def _axes(kind: Any) -> frozenset[str]:
    kind = getattr(kind, "manual_axis_type", None) or kind
    return getattr(kind, "varying", None) or getattr(kind, "vma", frozenset())  # (jax < 0.10: vma)


def _cast(x: Any, axes: tuple[str, ...]) -> Any:
    if not axes:
        return x
    if hasattr(jax.lax, "pcast"):
        return jax.lax.pcast(x, axes, to="varying")
    return jax.lax.pvary(x, axes)  # pyright: ignore
