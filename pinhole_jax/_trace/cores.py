"""Rays shared out to the machine's cores: XLA runs a program's walk on one of them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from .._camera.rays import Rays
from .._numerics.arrays import is_concrete
from .._numerics.machine import usable_cores
from .._numerics.threads import in_threads
from .packets import begins_anew

#: A share has this many rays at the least (of a million, shares of 8000 to 130 000 take as long).
LEAST = 1 << 15
#: Shares for each core.
EACH = 4


def by_cores(find: Callable[[Any, Rays], Any], where: Any, rays: Rays) -> Any:
    """Return what `find` finds `where` of rays, arrays with their batch axes first, on all cores.

    Where something is traced, rays are few or not on a CPU, or their number does not divide, it is
    asked once.
    """
    number = _shares(rays) if is_concrete(*jax.tree.leaves((where, rays))) else 1
    if number == 1:
        return find(where, rays)
    parts = _shared_out(rays, number)
    shapes = tuple((x.shape, str(x.dtype)) for x in jax.tree.leaves((where, parts[0])))
    program = find, shapes
    found = in_threads(lambda part: find(where, part), parts, lambda _: program)
    return jax.tree.map(lambda *x: jnp.concatenate(x), *found)


def _shares(rays: Rays) -> int:
    """Return in how many equal shares rays are searched for."""
    origin, direction = rays
    whole = origin.ndim == 1 or origin.shape == direction.shape
    if not (whole and direction.ndim > 1):
        return 1
    if jax.default_backend() != "cpu" or (cores := usable_cores()) == 1:
        return 1
    unit = begins_anew(direction.shape[:-1])
    most = min(EACH * cores, direction.size // 3 // LEAST)
    divides = (k for k in range(most, 1, -1) if direction.shape[0] % (k * unit) == 0)
    return next(divides, 1)


def _shared_out(rays: Rays, number: int) -> list[Rays]:
    origin, direction = rays
    directions = jnp.split(direction, number)
    origins = [origin] * number if origin.ndim == 1 else jnp.split(origin, number)
    return [Rays(o, d) for o, d in zip(origins, directions, strict=True)]
