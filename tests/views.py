"""The solver of a mask, and views of a fit as it takes them, without it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import cast

from pinhole_jax._mask.mask import Mask
from pinhole_jax._native.library import is_available
from pinhole_jax._scene.scene import Ball
from pinhole_jax._solver import looks
from pinhole_jax._solver.priors import no_prior
from pinhole_jax._solver.problem import Problem
from pinhole_jax._solver.solver import Solver
from pinhole_jax._solver.subject import Subject

FREE = ("pose", "phi")


def solver_of(camera, scene, shown):
    """The solver of a pose by a mask, in float32, and the mask."""
    mask = Mask(shown, np.ones(shown.shape), camera)
    return Solver.on(Subject.from_scene(scene, np.float32), mask, ("pose",), 64), mask


def problem_of(scene, data):
    real = data.cells.dtype
    scene = cast(scene, real)
    ball = Ball(jnp.zeros(3, real), jnp.ones((), real))
    return Problem(scene, jax.device_put(data), ball, None, no_prior(FREE, real))


def taken(unit, scene, data, level, size=None):
    """The view at a canonical camera; `size` as `look` has it."""
    if size is None and not is_available():
        pytest.skip("there is no library")
    problem, y = problem_of(scene, data), jnp.zeros(7, data.cells.dtype)
    move = problem.move(unit, level, FREE)
    look = eqx.filter_jit(looks.look)(y, move, problem, level, FREE, size)
    return looks.View.from_look(look, looks.Origin(unit, problem, level, FREE, size))
