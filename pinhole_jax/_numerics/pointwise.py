"""Programs for any number of points: few sizes are compiled, points are filled up to one."""

import math
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .arrays import stands_alone

S = TypeVar("S")

#: Sizes that there are programs for: each takes 0.1 to 4 s to compile, a thousand points some 10
#: microseconds. Beyond the last there are four from one power of two to the next.
SIZES = (64, 256, 1024, 4096)


def room(number: int) -> int:
    """Return the least size that holds a number of points."""
    unit = 1 << max((number - 1).bit_length() - 3, 0)
    return next((size for size in SIZES if size >= number), number + -number % unit)


def padded(points: np.ndarray, number: int, value: Any = None) -> np.ndarray:
    """Return points padded to a number, with copies of the first or with a value."""
    size = number - len(points)
    added = np.broadcast_to(points[:1] if value is None else value, (size, *points.shape[1:]))
    return np.concatenate([points, added.astype(points.dtype)]) if size else points


def pointwise(function: Callable[[S, Any], Any]) -> Callable[[S, Any], Any]:
    """Compile a function of something and of points (*batch, m), each by itself.

    Outside of other programs, on a CPU, it is compiled for few sizes.
    """
    run: Any = eqx.filter_jit(function)

    @wraps(function)
    def run_padded(of: S, points: Any) -> Any:
        lead = points.shape[:-1]
        number = math.prod(lead)
        if not (number and may_be_padded(of, points)):
            return run(of, points)
        rows = np.asarray(points).reshape(number, -1)
        found = np.asarray(run(of, padded(rows, room(number))))
        return jnp.asarray(found[:number].reshape(*lead, -1), found.dtype)

    return run_padded


def may_be_padded(*given: Any) -> bool:
    """Return True if a call with these arrays is a program of its own, on the default CPU.

    There NumPy reads arrays without a copy.
    """
    if jax.default_backend() != "cpu" or not stands_alone(given):
        return False
    return not any(getattr(x, "committed", False) for x in jax.tree.leaves(given))
