"""A fit's residuals and their derivatives at a camera, as one table, and its triangle R."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._mask.pyramid import Level
from .._numerics.one_kernel import at_once
from .._numerics.thin_qr import triangle
from .moves import Move, moved, reported
from .problem import Problem
from .residuals import Capacity, residuals


def table_at(
    y: Float[Array, "n"],
    move: Move,
    problem: Problem,
    level: Level,
    freed: tuple[str, ...],
    capacity: Capacity,
) -> tuple[Float[Array, "m n+1"], tuple[Camera, Any]]:
    """Return the derivatives of all residuals and these, [J, r], and what else is known there: the
    camera; sums, load, the reported parameters' derivatives, touched pixels, the derivatives
    (m, n), the squares of a prior and of what other views know."""

    def step(y, move):
        camera = moved(move, y, freed)
        return camera, reported(move.camera, camera, freed)

    def at(y):
        camera, values = at_once(step)(y, move)
        here = problem.scene, problem.pyramid, level, capacity
        (r, rest), sums, load, pixels = residuals(camera, *here)
        known = problem.others.residuals(values)
        if problem.prior is not None:
            known = jnp.concatenate([known, problem.prior.residuals(camera, freed)])
        r = jnp.concatenate([r, rest[None], known])
        return (r, values), (r, camera, sums, load, pixels, jnp.sum(known * known))

    (jacobian, to_reported), (r, camera, *sums, pixels, prior) = jax.jacfwd(at, has_aux=True)(y)
    # (What is beside the pixels comes first: there are fewer of these than there is room for.)
    table = jnp.roll(jnp.concatenate([jacobian, r[:, None]], axis=1), len(r) - len(pixels.cell), 0)
    seen = *sums, to_reported, move.scale, pixels, jacobian, prior
    return table, (camera, seen)


def triangle_at(
    y: Float[Array, "n"],
    move: Move,
    problem: Problem,
    level: Level,
    freed: tuple[str, ...],
    capacity: Capacity,
) -> tuple[Float[Array, "k k"], tuple[Camera, Any]]:
    """Return R (n + 1, n + 1) of `table_at`'s table, and what else is known there."""
    table, seen = table_at(y, move, problem, level, freed, capacity)
    return triangle(table), seen
