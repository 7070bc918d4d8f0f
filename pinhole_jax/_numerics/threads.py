"""Programs side by side, a thread each: JAX runs what one thread asks for one after the other."""

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

import jax

from .._files.machine import usable_cores

X = TypeVar("X")
Y = TypeVar("Y")

#: Programs that were run: from the second time on none is compiled.
_compiled: set[Hashable] = set()


def in_threads(
    run: Callable[[X], Y], given: Sequence[X], program: Callable[[X], Hashable]
) -> list[Y]:
    """Return the results of `run` for each item, as many at once as there are cores.

    `program` names the compiled program that an item takes. The first item of each program runs
    alone, since several threads would compile the same. One thread does it all on other devices
    than CPUs, and where threads would use other types: JAX's `with` blocks of settings hold for one
    thread only.
    """
    ask = lambda x: jax.block_until_ready(run(x))
    cores = min(usable_cores(), len(given)) if jax.default_backend() == "cpu" else 1
    if cores <= 1:
        return [ask(x) for x in given]
    found: dict[int, Y] = {}
    for k, x in enumerate(given):
        if (name := program(x)) not in _compiled:
            found[k] = ask(x)
            _compiled.add(name)
    rest = {k: x for k, x in enumerate(given) if k not in found}
    longest = lambda: jax.dtypes.canonicalize_dtype(float)
    with ThreadPoolExecutor(cores) as threads:
        alike = threads.submit(longest).result() == longest()
        found.update(zip(rest, (threads.map if alike else map)(ask, rest.values()), strict=True))
    return [found[k] for k in range(len(given))]


def some_at_once(given: Iterable[X]) -> Iterator[list[X]]:
    """Yield the items in lists, each of as many as there are cores."""
    rest = iter(given)
    while some := list(islice(rest, usable_cores())):
        yield some
