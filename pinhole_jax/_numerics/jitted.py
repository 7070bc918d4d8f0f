"""Functions compiled in less time than JAX takes for them."""

from collections.abc import Callable
from contextlib import suppress
from functools import cache, update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

import equinox as eqx
import jax

from .arrays import is_concrete
from .passes import LEFT_OUT

P = ParamSpec("P")
T = TypeVar("T")

#: What XLA is told of programs on a CPU: fewer passes. A mask, its gradient and a fit take 5 to
#: 15 % less of the processor to compile, and run as fast (5k and 328k faces, jaxlib 0.10 and 0.12).
#: Less work on each kernel (`xla_backend_optimization_level` 1 or 2) saves as much again, but a fit
#: then takes a quarter longer.
OPTIONS: dict[str, str] = {"xla_disable_hlo_passes": ",".join(LEFT_OUT)}


class jitted(Generic[P, T]):
    """A function as `equinox.filter_jit` makes it, compiled with `OPTIONS` where JAX lets it.

    JAX takes no options within another program: there it is a part of that one.
    """

    def __init__(self, function: Callable[P, T]):
        update_wrapper(self, function)
        self._part: Any = eqx.filter_jit(function)
        self._own: Any = eqx.filter_jit(function, compiler_options=OPTIONS)  # pyright: ignore

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        return self._program(args, kwargs)(*args, **kwargs)

    def lower(self, *args: P.args, **kwargs: P.kwargs) -> Any:
        """Return the program of some arguments, not compiled yet, and without options."""
        return self._part.lower(*args, **kwargs)

    def made(self) -> int:
        """Return how many programs there are by now."""
        return sum(f._cached._cache_size() for f in (self._own, self._part))

    def _program(self, args: Any, kwargs: Any) -> Any:
        return self._own if stands_alone(args, kwargs) and options() else self._part


def options() -> dict[str, str]:
    """Return what XLA is to be told of a program; nothing where it is told to do still less."""
    return {} if jax.config.read("jax_disable_most_optimizations") or not _known() else OPTIONS


#: A program in a program, which else runs: in 6 microseconds.
_nothing = jax.jit(lambda: 0)


def stands_alone(*given: Any) -> bool:
    """Return whether what is called with this is a program of its own: no part of another."""
    return is_concrete(*jax.tree.leaves(given)) and not is_within_another()


def is_within_another() -> bool:
    """Return whether a program is being traced now."""
    return not is_concrete(_nothing())


@cache
def _known() -> bool:
    """Return whether programs run on a CPU, and this XLA knows `OPTIONS`."""
    if jax.default_backend() == "cpu":
        with suppress(RuntimeError):
            return bool(jax.jit(lambda: True, compiler_options=OPTIONS)())
    return False
