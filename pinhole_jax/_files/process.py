"""JAX as this package's own processes run it: the command, and the workers of many fits."""

import contextlib

import jax

from .cache import cache


def set_up(cached: bool = True) -> None:
    """Set JAX up as the command does: float64, a cache of compiled programs, and the CPU, unless
    `JAX_PLATFORMS` names another machine.

    An application may set this, a library may not: call it first, before JAX has computed anything.
    One fit is many small kernels in turn. An NVIDIA H200 takes 2 to 13 times as long for it, and
    twice as long to compile it. Each process would also claim most of the accelerator's memory.

    ```python
    pj.set_up(cached=False)  # float64, on the CPU
    ```
    """
    jax.config.update("jax_enable_x64", True)
    if not jax.config.jax_platforms:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_platforms", "cpu")
    if cached:
        with contextlib.suppress(ValueError):  # a user without a home folder
            cache()
