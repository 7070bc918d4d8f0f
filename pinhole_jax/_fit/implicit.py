"""How a fitted camera moves with what it was fitted to: the implicit function theorem.

The fit ends where g = J^T w (image - target) is 0 (J: the image's derivative by the moves of the
camera), so a change of scene, target or weight moves it by -(dg/dmoves)^-1 dg. That takes the
image's second derivatives, which coverage does not have as a program; where the residual is not 0
they are central differences of its exact first derivatives.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._numerics.arrays import is_concrete
from .._scene.scene import Scene, bounding_sphere
from .full_image import At, image, image_and_jacobian
from .moves import Move, canonical, units
from .target import check_image, shares

#: The step of central differences, in px, by float type.
STEP_PX = {np.dtype(np.float32): 0.1, np.dtype(np.float64): 1e-3}
#: Below this root mean square over the image the residual's part of the second derivative is left
#: out: it is as small as that.
NO_RESIDUAL = 1e-5

Inputs = tuple[Scene, Any, Any]


def through(run: Callable[[Inputs], tuple[Any, Callable]], inputs: Inputs, names: tuple) -> Any:
    """Return what `run` does, with a camera that is differentiable by the scene, target and weight.

    `run` takes these three and returns its result, and a function that gives the weights (H, W) of
    the pixels that decided.
    """
    changing, fixed = eqx.partition(inputs, eqx.is_inexact_array)
    box: list[Any] = []

    def solve(changing: Any) -> tuple[Camera, Callable]:
        if not is_concrete(*jax.tree.leaves(changing)):
            raise ValueError(
                "`target`, `scene`, `weight`: expected concrete arrays, got traced ones; a fit runs"
                " outside `jit` and `vmap` (in `grad`, `jvp` and `jacfwd`, if these are outside)"
            )
        result, decided = run(eqx.combine(changing, fixed))
        box.append(result)
        return result.camera, decided

    @jax.custom_jvp
    def camera_of(changing: Any) -> Camera:
        return solve(changing)[0]

    @camera_of.defjvp
    def _(primals: Any, tangents: Any) -> tuple[Camera, Camera]:
        camera, decided = solve(primals[0])
        still = eqx.combine(primals[0], fixed)
        return camera, _velocity(camera, still, tangents[0], decided(), names)

    camera = camera_of(changing)
    return box[-1]._replace(camera=camera)


def _velocity(
    camera: Camera,
    inputs: Inputs,
    velocity: Inputs,
    weight: np.ndarray,
    names: tuple[str, ...],
) -> Camera:
    """Return how the camera moves when scene, target and weight do."""
    scene, target, given_weight = inputs
    dtype = camera.e.dtype
    unit = canonical(camera)
    pivot, radius = (jnp.asarray(x, dtype) for x in bounding_sphere(scene))
    size = units(unit, pivot, radius, jnp.asarray(camera.H, dtype), names)
    move = Move(unit, pivot, size)
    at = At(move, camera, scene, names)
    zero = jnp.zeros_like(move.unit)
    shown, J = image_and_jacobian(zero, at)
    goal = jnp.asarray(shares(check_image("target", target, camera.W, camera.H)), dtype)
    w, difference = jnp.asarray(weight, dtype), shown - goal
    scene_velocity, target_velocity, weight_velocity = velocity
    held = w * difference
    left = float(jnp.sqrt(jnp.mean(held * difference))) > NO_RESIDUAL
    h = STEP_PX[np.dtype(dtype)]
    places = zero[None]
    if left:
        steps = h * jnp.eye(len(zero), dtype=dtype)
        places = jnp.concatenate([places, steps, -steps])
    changes = _along(places, at, scene_velocity)
    # dg by what changes while the camera stays: linear in the velocities.
    toward = changes[0]
    if target_velocity is not None:
        toward = toward - target_velocity.astype(dtype)
    toward = w * toward
    if weight_velocity is not None:
        share = np.where(np.asarray(given_weight) > 0, weight / np.asarray(given_weight), 0)
        toward = toward + jnp.asarray(share, dtype) * weight_velocity.astype(dtype) * difference
    pull = jnp.einsum("hwn,hw->n", J, toward)
    bend = jnp.einsum("hwm,hwn,hw->mn", J, J, w)
    if left:
        ahead, behind = jnp.split(_slopes(places[1:], at, held), 2)
        bend = bend + (ahead - behind) / (2 * h)
        ahead, behind = jnp.split(jnp.einsum("khw,hw->k", changes[1:], held), 2)
        pull = pull + (ahead - behind) / (2 * h)
    step = -jnp.linalg.pinv((bend + bend.T) / 2, hermitian=True) @ pull
    return jax.jvp(at.camera, (zero,), (step,))[1]


@eqx.filter_jit
def _slopes(places: Float[Array, "k n"], at: At, held: Any) -> Float[Array, "k n"]:
    """Return at some moves the derivative of the image's product with `held`."""
    return jax.lax.map(jax.grad(lambda y: jnp.sum(held * image(y, at))), places)


@eqx.filter_jit
def _along(places: Float[Array, "k n"], at: At, velocity: Any) -> Float[Array, "k H W"]:
    """Return the image's rate of change, at some moves, where the scene moves with a velocity."""
    solid, fixed = eqx.partition(at.scene, eqx.is_inexact_array)

    def change(y: Any) -> Any:
        shown = lambda solid: image(y, at._replace(scene=eqx.combine(solid, fixed)))
        return jax.jvp(shown, (solid,), (velocity,))[1]

    return jax.lax.map(change, places)
