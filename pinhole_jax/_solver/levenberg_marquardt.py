"""Levenberg-Marquardt of one view, in one compiled program.

All that is few numbers is a single kernel: each small step of it would take the compiler as long as
one that goes through thousands.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._camera.camera import Camera
from .._mask.pyramid import Level
from .._numerics.jitted import jitted
from .._numerics.one_kernel import on_cpu, put
from .._numerics.safe import times
from .._numerics.thin_qr import solved, triangle_of
from .linearised import Seen, columns_at
from .parameters import components
from .problem import BOLDER, COSINE, FAIR, GOOD, SHORTER, UNIT_PX, Problem, View
from .residuals import Capacity, Pixels

#: Steps of a level that can be told one by one.
RECORDED = 64
#: How many columns hold what is known of pixels.
OF_PIXELS = 5


class _Known(NamedTuple):
    """Where a descent is: the move from its start, R of [J, r] there, and what else is `seen`; how
    bold the next step is, and how many there were (0: nothing is known yet). Arrays, or
    their shapes."""

    y: Any
    R: Any
    seen: Any
    size: Any
    steps: Any


class _Carried(NamedTuple):
    """A descent on its way: whether it goes on, and to which move; `_Known`, flat; the first moves;
    the residuals, their derivatives and the pixels at the last one that was taken."""

    goes_on: Bool[Array, ""]
    ahead: Float[Array, "n"]
    known: Float[Array, "_"]
    path: Float[Array, "RECORDED n"]
    columns: Float[Array, "c m"]


@jitted
def descended(
    camera: Camera,
    problem: Problem,
    level: Level,
    px: Any,
    steps: Any,
    freed: tuple[str, ...],
    capacity: Capacity,
) -> tuple[Camera, Int[Array, ""], Float[Array, "RECORDED n"], View]:
    """Return the camera after this many steps at most, or when steps are shorter than `px`; how
    many it took, the first of them, and the view: after one step (which evaluates the start) of the
    start.

    A step that does not bring what was promised is not taken, and the next one is shorter. (It is
    not differentiated.)
    """
    given = camera, problem, level, freed, capacity
    y = jnp.zeros(len(components(freed)), problem.pyramid.target.dtype)
    columns, number, seen, pixels = eqx.filter_eval_shape(_looked, y, *given)
    known = _known_like(y, seen)

    def further(carried):
        columns, _, seen, pixels = _looked(carried.ahead, *given)
        columns = jnp.concatenate([columns, _as_columns(pixels, columns)])
        there = triangle_of(columns, len(y) + 1), _flat(seen, y.dtype)
        advanced = lambda *of: _advanced(known, *of)
        goes_on, taken, ahead, *few = on_cpu(advanced, *carried[1:4], *there, px, steps)
        columns = jnp.where(taken, columns, carried.columns)
        return _Carried(goes_on, ahead, few[0], few[1], columns)

    rows = len(columns) + OF_PIXELS
    none = lambda *shape: jnp.zeros(shape, y.dtype)
    few = none(_size(known)), none(RECORDED, len(y)), none(rows, columns.shape[1])
    start = _Carried(jnp.array(True), y, *few)
    end = jax.lax.while_loop(lambda carried: carried.goes_on, further, start)

    seen, R, taken = on_cpu(lambda flat: _told(known, seen, flat), end.known)
    pixels = _as_pixels(end.columns[len(columns) :, : len(pixels.cell)], level)
    view = seen.view(R, pixels, end.columns[: len(y), :number].T)
    return seen.camera, taken, end.path, view


_looked = jitted(columns_at)


def _advanced(
    like: _Known,
    ahead: Float[Array, "n"],
    flat: Float[Array, "_"],
    path: Float[Array, "RECORDED n"],
    R: Float[Array, "k k"],
    seen: Float[Array, "s"],
    px: Any,
    most: Any,
) -> tuple[Any, ...]:
    """Return whether to go on, whether the step `ahead` is taken, where R and what else is `seen`
    are known now; and what `_Carried` has of few numbers thereafter."""
    known, n = _unflat(flat, like), len(ahead)
    first, residual = known.steps == 0, known.R[:, n]
    squares = _squares(residual)
    promised = _squares(times(known.R[:, :n], ahead - known.y) + residual) - squares
    gained = _squares(R[:, n]) - squares
    taken = first | (gained <= FAIR * promised)
    good = ~first & (gained < GOOD * promised) & (promised < 0)
    longer = jnp.where(taken, jnp.where(good, BOLDER, 1), SHORTER).astype(flat.dtype)
    now = _Known(
        jnp.where(taken, ahead, known.y),
        jnp.where(taken, R, known.R),
        jnp.where(taken, seen, known.seen),
        jnp.where(first, 1, known.size) * longer,
        known.steps + 1,
    )
    place = jnp.minimum(known.steps.astype(jnp.int32), RECORDED - 1)
    path = put(path, jnp.where(known.steps < RECORDED, now.y, path[place]), place)
    ahead = now.y + _step(now)
    # (From where the last step began: so a descent ends one step after it might.)
    step = ahead - known.y
    change = _squares(times(now.R[:, :n], step))
    flat_there = change <= COSINE[np.dtype(step.dtype)] ** 2 * _squares(now.R[:, n])
    small = jnp.max(jnp.abs(step)) < px / UNIT_PX
    finite = jnp.all(jnp.isfinite(ahead)) & jnp.all(jnp.isfinite(now.R))
    goes_on = finite & ~(small | flat_there | (now.steps.astype(jnp.int32) >= most))
    return goes_on, taken, ahead, _flat(now, step.dtype), path


def _step(known: _Known) -> Float[Array, "n"]:
    """Return the damped step from what is known."""
    n, dtype = len(known.y), known.y.dtype
    there_is = known.size > jnp.finfo(dtype).eps
    damping = jnp.where(there_is, 1 / jnp.where(there_is, known.size, 1), jnp.finfo(dtype).max)
    damped = jnp.sqrt(damping) * jnp.eye(n, n + 1, dtype=dtype)
    return -solved(jnp.concatenate([known.R, damped]))


def _squares(x: Float[Array, "_"]) -> Float[Array, ""]:
    return jnp.sum(x * x)


def _told(like: _Known, seen: Seen, flat: Float[Array, "_"]) -> tuple[Any, ...]:
    """Return what is known as it is told: what else is seen there, R, the number of steps."""
    known = _unflat(flat, like)
    return _unflat(known.seen, seen), known.R, known.steps.astype(jnp.int32)


def _known_like(y: Float[Array, "n"], seen: Seen) -> _Known:
    """Return the shapes of what is known of moves like y, and where this is `seen`."""
    shape = lambda *sizes: jax.ShapeDtypeStruct(sizes, y.dtype)
    n = len(y)
    return _Known(shape(n), shape(n + 1, n + 1), shape(_size(seen)), shape(), shape())


def _size(like: Any) -> int:
    return sum(math.prod(x.shape) for x in jax.tree.leaves(like))


def _flat(tree: Any, dtype: Any) -> Float[Array, "_"]:
    """Return all numbers of a tree, whole ones among them, in one float type."""
    return jnp.concatenate([jnp.ravel(x).astype(dtype) for x in jax.tree.leaves(tree)])


def _unflat(numbers: Float[Array, "_"], like: Any) -> Any:
    """Return the tree that numbers are of (`_flat`)."""
    leaves, tree = jax.tree.flatten(like)
    ends = np.cumsum([_size(x) for x in leaves]).tolist()
    parts = (numbers[end - _size(x) : end] for end, x in zip(ends, leaves, strict=True))
    return tree.unflatten(
        part.reshape(x.shape).astype(x.dtype) for part, x in zip(parts, leaves, strict=True)
    )


def _as_columns(pixels: Pixels, columns: Float[Array, "c m"]) -> Float[Array, "5 m"]:
    """Return pixels as columns, their cells bit by bit."""
    dtype = columns.dtype
    whole = {4: jnp.int32, 8: jnp.int64}[dtype.itemsize]
    cell = jax.lax.bitcast_convert_type(pixels.cell.astype(whole), dtype)
    after, before = (x.astype(dtype) for x in (pixels.covered_after, pixels.covered_before))
    rows = [cell, pixels.coverage, pixels.weight, after]
    rows = [jnp.pad(x, (0, columns.shape[1] - len(x))) for x in rows]
    return jnp.stack([*rows, jnp.broadcast_to(before, rows[0].shape)])


def _as_pixels(columns: Float[Array, "5 P"], level: Level) -> Pixels:
    """Return the pixels of a level that these columns are of."""
    cell, coverage, weight, after, before = columns
    whole = {4: jnp.int32, 8: jnp.int64}[cell.dtype.itemsize]
    cell = jax.lax.bitcast_convert_type(cell, whole).astype(jnp.int32)
    return Pixels(level, cell, coverage, weight, after > 0, before[0] > 0)
