"""Levenberg-Marquardt of many fits side by side: fixed shapes, under `vmap`, in one program.

All lanes take a step together, those that are done as well: after few steps the host drops these.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._camera.camera import Camera
from .._mask.pyramid import Level, Pyramid
from .._numerics.cholesky import solve_normal
from .._numerics.jitted import jitted
from .._scene.scene import Ball, Scene
from .linearised import columns_at, look
from .parameters import components
from .priors import Others
from .problem import COSINE, UNIT_PX, Problem, View
from .residuals import Capacity

#: Steps of a program: then lanes that are done are dropped.
STEPS = 6
#: A step is taken if it brings this share of what was promised; from `GOOD` on the next is bolder.
#: (optimistix's numbers.)
FAIR, GOOD, BOLDER, SHORTER = 0.01, 0.99, 3.5, 0.25


class Lane(NamedTuple):
    """A fit on its way down a level: its camera (canonical), how bold the next step is, the steps
    so far, whether it is at rest, and whether a view outgrew the buffers."""

    camera: Camera
    size: Float[Array, ""]
    steps: Int[Array, ""]
    done: Bool[Array, ""]
    overflow: Bool[Array, ""]


class Rig(NamedTuple):
    """A scene, and the middle and radius of what moves are taken about."""

    scene: Scene
    pivot: Float[Array, "*N 3"]
    radius: Float[Array, "*N"]


class Given(NamedTuple):
    """What lanes fit: their rigs (one for all, if `shared`), their pyramids, and that no other
    views are known."""

    rig: Rig
    pyramid: Pyramid
    others: Others
    shared: bool

    def axes(self) -> tuple[Any, ...]:
        """Return along which axes `parts` are the lanes'."""
        return None if self.shared else 0, 0, None

    def parts(self) -> tuple[Any, ...]:
        """Return what `_problem` makes of one lane's parts a problem."""
        return self.rig, self.pyramid, self.others


def _problem(rig: Rig, pyramid: Pyramid, others: Others) -> Problem:
    return Problem(rig.scene, pyramid, Ball(rig.pivot, rig.radius), others)


class _State(NamedTuple):
    """A lane, and the normal equations at its camera: J^T J, J^T r and r^T r of [J, r]; infinite
    squares where they are not known yet."""

    lane: Lane
    normal: Float[Array, "k k"]


@jitted
def descended(
    lanes: Lane,
    given: Given,
    level: Level,
    px: Float[Array, "N"],
    most: Int[Array, ""],
    freed: tuple[str, ...],
    capacity: Capacity,
) -> Lane:
    """Return lanes (of a leading axis) after `STEPS` steps of a level, or fewer if all are done: at
    rest (the next step is shorter than `px`, or changes next to nothing), or `most` steps taken."""
    count, n = len(lanes.done), len(components(freed))

    def step(state, parts, level, px):
        return _stepped(state, _problem(*parts), level, px, most, freed, capacity)

    together = jax.vmap(step, in_axes=(0, given.axes(), 0, 0))

    def further(carried):
        number, state = carried
        return number + 1, together(state, given.parts(), level, px)

    def goes_on(carried):
        number, state = carried
        return (number <= STEPS) & ~jnp.all(state.lane.done)

    unknown = jnp.zeros((count, n + 1, n + 1), lanes.size.dtype).at[:, n, n].set(jnp.inf)
    # (The first evaluates the start, so that the residuals are compiled once.)
    _, state = jax.lax.while_loop(goes_on, further, (jnp.int32(0), _State(lanes, unknown)))
    return state.lane


def _stepped(
    state: _State,
    problem: Problem,
    level: Level,
    px: Float[Array, ""],
    most: Int[Array, ""],
    freed: tuple[str, ...],
    capacity: Capacity,
) -> _State:
    """Return one lane after a step, or after its start is evaluated; as it is if it is done."""
    lane, normal = state
    n = len(normal) - 1
    first = jnp.isinf(normal[n, n])
    A, slope, squares = normal[:n, :n], normal[:n, n], normal[n, n]
    damping = jnp.eye(n, dtype=A.dtype) / lane.size
    y = -solve_normal(A + damping, slope)

    change = y @ A @ y
    flat = change <= COSINE[np.dtype(y.dtype)] ** 2 * squares
    small = jnp.max(jnp.abs(y)) < px / UNIT_PX
    done = lane.done | (~first & (small | flat | (lane.steps >= most)))

    columns, seen, _ = columns_at(y, lane.camera, problem, level, freed, capacity)
    there = jnp.sum(columns[:, None] * columns[None], axis=-1)
    promised = -(2 * slope @ y + change)
    gained = squares - there[n, n]
    fair = first | (gained >= FAIR * promised)
    fair &= jnp.isfinite(there[n, n])
    bolder = jnp.where(gained >= GOOD * promised, BOLDER, 1)
    size = jnp.where(first, lane.size, lane.size * jnp.where(fair, bolder, SHORTER))
    after = Lane(
        camera=jax.tree.map(lambda a, b: jnp.where(fair, a, b), seen.camera, lane.camera),
        size=size.astype(lane.size.dtype),
        steps=lane.steps + jnp.where(first, 0, 1).astype(jnp.int32),
        done=(first & ~fair) | lane.done,
        overflow=lane.overflow | ~seen.load.fits(capacity),
    )
    accepted = jnp.where(fair, there, normal)
    stays = lambda a, b: jnp.where(done, a, b)
    lane = jax.tree.map(stays, lane._replace(done=done), after)
    return _State(lane, stays(normal, accepted))


@jitted
def looked(
    cameras: Camera,
    given: Given,
    level: Level,
    freed: tuple[str, ...],
    capacity: Capacity,
) -> View:
    """Return the views at cameras (all of a leading axis)."""

    def one(camera, parts, level):
        return look(camera, _problem(*parts), level, freed, capacity)

    return jax.vmap(one, in_axes=(0, given.axes(), 0))(cameras, given.parts(), level)
