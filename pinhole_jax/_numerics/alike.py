"""Which functions do the same: by their code, and by what they hold."""

from collections.abc import Callable, Hashable
from functools import partial
from types import FunctionType
from typing import Any

import jax
import numpy as np

#: What is known to be the same if it is equal: of just these types (JAX's own numbers are integers
#: that have a type of their own, too), or of these and those derived from them.
PLAIN = bool, int, str, bytes, type(None)
DERIVED = type, np.dtype, jax.tree_util.PyTreeDef


class _Unknown(Exception):
    """What a function holds may be anything: an array, or one that is being traced."""


def name_of(function: Callable) -> Hashable:
    """Return what is equal for functions that do the same with the same arguments (they may be made
    anew, from one place in the code); None for one that holds what is more than numbers, words and
    such functions."""
    try:
        return _name(function, ())
    except _Unknown:
        return None


def _name(x: Any, within: tuple[Any, ...]) -> Hashable:
    named = lambda *held: tuple(_name(y, (*within, x)) for y in held)
    if any(x is y for y in within):
        raise _Unknown  # it holds itself
    if isinstance(x, FunctionType):
        cells = [cell.cell_contents for cell in x.__closure__ or ()]
        held = *cells, *(x.__defaults__ or ()), *(x.__kwdefaults__ or {}).values()
        return x.__module__, x.__code__, named(*held)
    if isinstance(x, partial):
        return partial, *named(x.func, *x.args), tuple(x.keywords), named(*x.keywords.values())
    if type(x) in (tuple, list):
        return type(x), named(*x)
    if type(x) is float:
        return float, x.hex()  # 0.0 is equal to -0.0
    if type(x) in PLAIN or isinstance(x, DERIVED):
        return type(x), x
    raise _Unknown
