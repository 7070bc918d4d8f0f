"""Loops that XLA's CPU compiler makes a single kernel of."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
from jax.experimental.xla_metadata import set_xla_metadata

T = TypeVar("T")


def one_kernel(function: Callable) -> Callable:
    """Return a function of arrays that XLA's CPU compiler makes a single kernel of, loops and all.

    Of small loops it does so by itself, by these two marks. There must be no sort, no scatter and
    nothing as long as an array in it: what it fills is an argument. (What it would share out to
    several cores does not compile within a kernel.) All arguments are read: over one that is not,
    or is written over as a whole, the compiler aborts. Under `vmap` it is called for one after the
    other: loops side by side wait for the longest, and copy what they fill at each turn.
    """

    @jax.custom_batching.sequential_vmap
    def call(*arguments: Any) -> Any:
        result = jax.jit(function)(*arguments)
        return set_xla_metadata(result, inlineable="false", xla_cpu_small_call="true")

    return call


def one_by_one(function: Callable[[], T]) -> T:
    """Return what a function of nothing returns, which is not differentiated.

    Under `vmap` it is called for one after the other: its loops copy nothing then.
    """
    made = eqx.filter_closure_convert(function)
    arrays, rest = eqx.partition(made, eqx.is_array)

    @jax.custom_batching.sequential_vmap
    def call(arrays: Any) -> Any:
        return eqx.combine(arrays, rest)()

    return call(jax.lax.stop_gradient(arrays))
