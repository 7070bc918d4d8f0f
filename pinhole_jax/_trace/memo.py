"""What is made of a scene's arrays once, and kept for as long as these are there.

A tree takes as long to make as some hundred thousand rays to search in it. Arrays of JAX never
change: what was made of the same arrays, not of equal ones, is never stale, and asking costs
nothing (`_numerics.memo` knows arrays by what they hold, and reads them for that). A scene that was
moved (`eqx.tree_at`, an `Assembly` in another posture, a pickled copy) has other arrays.
"""

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.core import Tracer

_memo: dict[tuple, tuple[tuple[weakref.ref, ...], Any]] = {}


def can_memoise(arrays: Sequence[Any]) -> bool:
    """Return whether all are arrays of JAX that hold numbers: these are never written to."""
    return all(isinstance(x, jax.Array) and not isinstance(x, Tracer) for x in arrays)


def memoised(kind: Any, arrays: Sequence[jax.Array], make: Callable[[], Any]) -> Any:
    """Return what `make` returns, made once for these arrays and this kind of thing.

    It is made now, also where a program is being traced, and goes with the first of the arrays.
    """
    key = (kind, *(id(x) for x in arrays))
    refs, value = _memo.get(key, ((), None))
    # An identity may be that of an array that is gone, whose entry is just being dropped.
    if refs and all(ref() is x for ref, x in zip(refs, arrays, strict=True)):
        return value
    with jax.ensure_compile_time_eval():
        value = make()
    entry: list = []

    def drop(_: Any, memo: dict = _memo) -> None:  # (at a process's end the module's is gone)
        if memo.get(key, (None,))[0] is entry[0]:  # (another may have taken the place)
            memo.pop(key, None)

    entry.append(tuple(weakref.ref(x, drop) for x in arrays))
    _memo[key] = (entry[0], value)
    return value
