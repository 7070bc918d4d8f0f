"""Levenberg-Marquardt in one compiled program (optimistix, with a linear solver of lineax).

Both take a while to import, so this is imported where a fit begins.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._mask.pyramid import Level
from .looks import look
from .parameters import components
from .problem import COSINE, UNIT_PX, Problem

#: Steps of a level that can be told one by one.
RECORDED = 64


class _PathState(NamedTuple):
    """The solver's state, and where the first steps came to."""

    solver: Any
    path: Float[Array, "RECORDED n"]


class _LevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix's Levenberg-Marquardt, which also stops when the next step is negligible, or after
    `steps`, and has its way and what it last accepted among its `stats`.

    Its own test compares residuals entry by entry; here they change places from step to step. It
    never stops while steps are rejected (in float32, at the rounding floor, until `max_steps`).
    """

    rtol: float
    atol: Any
    settled: Any
    steps: Any
    norm: Callable
    descent: optx.AbstractDescent
    search: optx.AbstractSearch
    verbose: Callable

    def __init__(self, atol: Any, settled: Any, steps: Any):
        self.rtol, self.atol, self.norm = 0.0, atol, optx.max_norm
        self.settled, self.steps = settled, steps
        self.descent = optx.DampedNewtonDescent(linear_solver=lx.QR())
        self.search = _TrustRegion()
        self.verbose = _silent

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Any:
        state = super().init(fn, y, args, options, f_struct, aux_struct, tags)
        return _PathState(state, jnp.zeros((RECORDED, *y.shape), y.dtype))

    def step(self, fn, y, args, options, state: Any, tags) -> Any:
        y, solver, aux = super().step(fn, y, args, options, state.solver, tags)
        path = state.path.at[state.solver.num_steps].set(y, mode="drop")
        return y, _PathState(solver, path), aux

    def postprocess(self, fn, y, aux, args, options, state: Any, tags, result):
        del fn, args, options, tags, result
        return y, aux, {"path": state.path, "look": state.solver.aux}

    def terminate(self, fn, y, args, options, state: Any, tags):
        del fn, args, options, tags
        state = state.solver
        step = state.y_eval - y
        change = state.f_info.jac.mv(step)
        count = jnp.maximum(state.aux.sums.touched, 1)
        share = jnp.maximum(COSINE[np.dtype(step.dtype)] ** 2, self.settled**2 / count)
        flat = _sum_squares(change) <= share * _sum_squares(state.f_info.residual)
        small = jnp.max(jnp.abs(step)) < self.atol
        enough = state.num_steps >= self.steps
        return ~state.first_step & (small | flat | enough), state.result


class _TrustRegion(optx.ClassicalTrustRegion):
    """optimistix's, with its step size in the problem's float type, not the configuration's."""

    def init(self, y, f_info_struct):
        state = super().init(y, f_info_struct)
        return eqx.tree_at(lambda s: s.step_size, state, state.step_size.astype(y.dtype))


def _sum_squares(x: Array) -> Array:
    return jnp.sum(x * x)


def _silent(**kwargs: Any) -> None:
    del kwargs


def _residual(y: Float[Array, "n"], args: Any):
    """The function that optimistix sees: module level and all data in `args`, to compile once.

    It is linear in y about each point, so its Jacobian is a table that is worked out once a step:
    R of [J, r] = Q R, whose few rows have the sums of squares, and all that steps are made of, of
    the thousands.
    """
    at = jax.lax.stop_gradient(y)
    move, problem, level, freed, size = args
    seen = look(at, move, problem, level, freed.value, size.value)
    return seen.rows[:, -1] + seen.rows[:, :-1] @ (y - at), seen


class _Static(eqx.Module):
    """A static value inside a pytree of arguments."""

    value: Any = eqx.field(static=True)


@eqx.filter_jit
def descended(camera: Camera, problem: Problem, level: Level, px, settled, steps, freed, size):
    """The number of steps until they are shorter than `px` or than this share of a standard error
    (`settled`), at most `steps`; where the first of them ended, and the look at the end. After one
    step (which evaluates the start) that is at the start.
    """
    move = problem.move(camera, level, freed)
    args = (move, problem, level, _Static(freed), _Static(size))
    zero = jnp.zeros(len(components(freed)), problem.pyramid.cells.dtype)
    solver = _LevenbergMarquardt(px / UNIT_PX, settled, steps)
    found = optx.least_squares(
        _residual, solver, zero, args, has_aux=True, max_steps=None, throw=False
    )
    return tuple(found.stats[name] for name in ("num_steps", "path", "look"))
