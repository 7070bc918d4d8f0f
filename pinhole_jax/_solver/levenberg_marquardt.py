"""Levenberg-Marquardt in one compiled program (optimistix, with a linear solver of lineax).

Both take a while to import, so this is imported where a fit begins.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._mask.pyramid import Level
from .looks import Sums, look
from .moves import Move
from .problem import COSINE, UNIT_PX, Problem

#: Steps of a level that can be told one by one.
RECORDED = 64


class _TrustRegion(optx.ClassicalTrustRegion):
    """optimistix's, with its step size in the problem's float type, not the configuration's, and
    where the last steps ended (RECORDED, n)."""

    def init(self, y, f_info_struct) -> Any:
        state = super().init(y, f_info_struct)
        state = eqx.tree_at(lambda s: s.step_size, state, state.step_size.astype(y.dtype))
        return state, jnp.zeros((RECORDED, *y.shape), y.dtype)

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state: Any) -> Any:
        before, path = state
        found: Any = super().step(first_step, y, y_eval, f_info, f_eval_info, before)
        size, accept, result, after = found
        end = jnp.where(accept, y_eval, y)
        return size, accept, result, (after, jnp.concatenate([path[1:], end[None]]))


def _sum_squares(x: Array) -> Array:
    return jnp.sum(x * x)


def _silent(**kwargs: Any) -> None:
    del kwargs


class _LevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix's Levenberg-Marquardt, which also stops when the next step is negligible, or after
    `steps`.

    Its own test compares residuals entry by entry; here they change places from step to step. It
    never stops while steps are rejected (in float32, at the rounding floor, until `max_steps`).
    """

    atol: Any
    settled: Any
    steps: Any
    rtol: float = 0.0
    norm: Callable = eqx.field(default=optx.max_norm)
    descent: optx.AbstractDescent = optx.DampedNewtonDescent(linear_solver=lx.QR())
    search: optx.AbstractSearch = _TrustRegion()
    verbose: Callable = eqx.field(default=_silent)

    def terminate(self, fn, y, args, options, state: Any, tags):
        del fn, args, options, tags
        step = state.y_eval - y
        change = state.f_info.jac.mv(step)
        count = jnp.maximum(Sums(*state.aux.sums).touched, 1)
        share = jnp.maximum(COSINE[np.dtype(step.dtype)] ** 2, self.settled**2 / count)
        flat = _sum_squares(change) <= share * _sum_squares(state.f_info.residual)
        small = jnp.max(jnp.abs(step)) < self.atol
        enough = state.num_steps >= self.steps
        return ~state.first_step & (small | flat | enough), state.result


@partial(jax.jit, static_argnames=("freed", "size"))
def descended(camera: Camera, problem: Problem, level: Level, px, settled, steps, freed, size):
    """The number of steps until they are shorter than `px` or than this share of a standard error
    (`settled`), at most `steps`; where the last of them ended, and the look at the end. After one
    step (which evaluates the start) that is at the start.
    """

    def residual(y: Float[Array, "n"], args: tuple[Move, Problem, Level]):
        # It is linear in y about each point, so its Jacobian is a table that is worked out once a
        # step: R of [J, r] = Q R, whose few rows have the sums of squares, and all that steps are
        # made of, of the thousands.
        at = jax.lax.stop_gradient(y)
        seen = look(at, *args, freed, size)
        return seen.rows[:, -1] + seen.rows[:, :-1] @ (y - at), seen

    args = problem.move(camera, level, freed), problem, level
    solver = _LevenbergMarquardt(atol=px / UNIT_PX, settled=settled, steps=steps)
    # (Its function is new each time: outside of a program it would compile anew.)
    found = optx.least_squares(
        residual, solver, problem.still(freed), args, has_aux=True, max_steps=None, throw=False
    )
    end: Any = found.state
    return end.num_steps, end.search_state[1], end.aux
