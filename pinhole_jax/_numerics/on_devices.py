"""Values that differ from device to device within `jax.shard_map`.

There JAX keeps, in a value's type, the axes of the devices that it varies over, and refuses loops
and branches that mix values of different axes, such as a counter that starts at 0 and a sum of
values that vary. A function that each device evaluates by itself does not need the axes: it is
traced without them (`lower`), and its results vary over all that its arguments vary over
(`results`).
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import mlir
from jax.sharding import NamedSharding, PartitionSpec

Shapes = Sequence[tuple[tuple[int, ...], Any]]


def varying_axes(arrays: Sequence[Any]) -> frozenset[str]:
    """Return the axes of a `shard_map` over which at least one array varies."""
    if not jax.sharding.get_abstract_mesh().manual_axes:
        return frozenset()
    return frozenset[str]().union(*(_axes(jax.typeof(x)) for x in arrays))


def spread(arrays: Sequence[Any], over: Sequence[Any]) -> list[Any]:
    """Return arrays, each of which varies over all axes that these and `over` vary over."""
    axes = varying_axes([*arrays, *over])
    return [_cast(x, tuple(sorted(axes - _axes(jax.typeof(x))))) for x in arrays]


def results(arguments: Sequence[Any], shapes: Shapes) -> list[ShapedArray]:
    """Return the types of results with the axes of the first argument, which are those of all."""
    like = arguments[0] if arguments else None
    if like is None or not _axes(like):
        return [ShapedArray(shape, dtype) for shape, dtype in shapes]
    place = lambda shape: NamedSharding(like.sharding.mesh, PartitionSpec(*(None for _ in shape)))
    return [like.update(shape, dtype, False, sharding=place(shape)) for shape, dtype in shapes]


def lower(primitive: Primitive, function: Callable[..., Sequence[Any]]) -> None:
    """Let a primitive become that part of a program which a function, traced without axes, is."""
    rule = mlir.lower_fun(function, multiple_results=True)
    plain = lambda kinds: [ShapedArray(x.shape, x.dtype) for x in kinds]

    def lowered(context: Any, *arguments: Any, **params: Any) -> Any:
        avals = {"avals_in": plain(context.avals_in), "avals_out": plain(context.avals_out)}
        return rule(context.replace(**avals), *arguments, **params)

    mlir.register_lowering(primitive, lowered)


def _axes(kind: Any) -> frozenset[str]:
    kind = getattr(kind, "manual_axis_type", None) or kind
    return getattr(kind, "varying", None) or getattr(kind, "vma", frozenset())  # (jax < 0.10: vma)


def _cast(x: Any, axes: tuple[str, ...]) -> Any:
    if not axes:
        return x
    if hasattr(jax.lax, "pcast"):
        return jax.lax.pcast(x, axes, to="varying")
    return jax.lax.pvary(x, axes)  # pyright: ignore
