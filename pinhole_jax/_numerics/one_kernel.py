"""Loops that XLA's CPU compiler makes a single kernel of."""

from collections.abc import Callable
from typing import Any

import jax
from jax.experimental.xla_metadata import set_xla_metadata


def one_kernel(function: Callable) -> Callable:
    """Return a function of arrays that XLA's CPU compiler makes a single kernel of, loops and all.

    Of small loops it does so by itself, by these two marks. There must be no sort, no scatter and
    nothing as long as an array in it: what it fills is an argument. (What it would share out to
    several cores does not compile within a kernel.) Under `vmap` it is called for one after the
    other: loops side by side wait for the longest, and copy what they fill at each turn.
    """

    @jax.custom_batching.sequential_vmap
    def call(*arguments: Any) -> Any:
        # A table that is a constant would be moved into the loop: a parameter that nothing reads
        # then ends the process (`ir_emitter.cc`, "All or none of the slices ...").
        arguments = jax.lax.optimization_barrier(arguments)
        result = jax.jit(function)(*arguments)
        return set_xla_metadata(result, inlineable="false", xla_cpu_small_call="true")

    return call
