"""Views of a fit, as its solver takes them, without the solver."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from pinhole_jax._native.library import is_available
from pinhole_jax._scene.scene import Ball
from pinhole_jax._solver import looks
from pinhole_jax._solver.priors import no_prior
from pinhole_jax._solver.problem import Problem

FREE = ("pose", "phi")


def problem_of(scene, data):
    real = data.cells.dtype
    scene = jax.tree.map(lambda x: x.astype(real) if x.dtype.kind == "f" else x, scene)
    ball = Ball(jnp.zeros(3, real), jnp.ones((), real))
    return Problem(scene, jax.device_put(data), ball, None, no_prior(FREE, real))


def taken(unit, scene, data, level, size=None):
    """The view at a canonical camera; `size` as `look` has it."""
    if size is None and not is_available():
        pytest.skip("there is no library")
    problem, y = problem_of(scene, data), jnp.zeros(7, data.cells.dtype)
    move = problem.move(unit, level, FREE)
    look = eqx.filter_jit(looks.look)(y, move, problem, level, FREE, size)
    return looks.View.from_origin(looks.Origin(look, problem, level, FREE, size))
