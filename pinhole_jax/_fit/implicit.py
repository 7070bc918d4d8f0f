"""How a fitted camera moves with what it was fitted to: the implicit function theorem.

The fit ends where g = J^T w (image - target) is 0 (J: the image's derivative by the moves of the
camera), so a change of scene, target or weight moves it by -(dg/dmoves)^-1 dg. That takes the
image's second derivatives, which coverage does not have as a program; where the residual is not 0
they are central differences of its exact first derivatives.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._mask.target import as_coverage, check_image
from .._numerics.arrays import is_concrete
from .._numerics.jitted import jitted
from .._scene.scene import Scene, bounding_sphere
from .._solver.moves import Move, camera_velocity, canonical, scales
from .full_image import At, image, image_and_jacobian

#: The step of central differences, in px, by float type. (Derivatives by it agree with refits to
#: 1e-4 where masks are exact, to 1e-2 and 3e-2 of noisy and hard ones, whose second derivatives
#: jump.)
STEP_PX = {np.dtype(np.float32): 0.1, np.dtype(np.float64): 1e-3}
#: Below this root mean square over the image the residual's part of the second derivative is left
#: out: it is as small as that.
NO_RESIDUAL = 1e-5

Inputs = tuple[Scene, Any, Any]


class Through(NamedTuple):
    """How a fit's result is made differentiable.

    - `run`: returns the result of inputs, and something that `velocity` needs.
    - `answer`: what of the result is differentiable, a pytree.
    - `put`: returns the result with such an answer in place of its own.
    - `velocity`: returns the answer's rate of change, given the result, that something, the inputs
      and their velocities: None of what does not change.
    - `names`: the arguments that inputs come from, as errors name them.
    """

    run: Callable[[Any], tuple[Any, Any]]
    answer: Callable[[Any], Any]
    put: Callable[[Any, Any], Any]
    velocity: Callable[[Any, Any, Any, Any], Any]
    names: str = "`target`, `scene`, `weight`"

    def __call__(self, inputs: Any) -> Any:
        """Return the result, its answer differentiable by those of the inputs that are traced."""
        changing, fixed = eqx.partition(inputs, lambda leaf: not is_concrete(leaf))
        box: list[Any] = []

        def solve(changing: Any) -> tuple[Any, Any]:
            if not is_concrete(*jax.tree.leaves(changing)):
                raise ValueError(
                    f"{self.names}: expected concrete arrays, got traced ones; a fit runs outside"
                    " `jit` and `vmap` (in `grad`, `jvp` and `jacfwd`, if these are outside)"
                )
            result, more = self.run(eqx.combine(changing, fixed))
            box.append(result)
            return result, more

        @jax.custom_jvp
        def answer_of(changing: Any) -> Any:
            return self.answer(solve(changing)[0])

        @answer_of.defjvp
        def _(primals: Any, tangents: Any) -> tuple[Any, Any]:
            result, more = solve(primals[0])
            still = eqx.combine(primals[0], fixed)
            return self.answer(result), self.velocity(result, more, still, tangents[0])

        answer = answer_of(changing)
        return self.put(box[-1], answer)


def check_plain(**given: Any) -> None:
    """Raise ValueError where some of these arguments, which no derivative knows, are given."""
    if any(given.values()):
        names = ", ".join(f"`{name}`" for name in given)
        raise ValueError(f"{names}: expected none where the fit is differentiated")


def of_camera(
    run: Callable[[Inputs], tuple[Any, Callable[[], np.ndarray]]], freed: tuple[str, ...]
) -> Through:
    """Return how a fit of one camera is made differentiable by scene, target and weight; `run` has
    a function that gives the weights (H, W) of the pixels that decided."""

    def velocity(result: Any, decided: Callable, inputs: Inputs, velocity: Inputs) -> Camera:
        camera = result.camera
        start, scene = canonical(camera), inputs[0]
        pivot, radius = (jnp.asarray(x, camera.e.dtype) for x in bounding_sphere(scene))
        size = scales(start, pivot, radius, jnp.asarray(camera.H, camera.e.dtype), freed)
        at = At(Move(start, pivot, size), camera, scene, freed)
        pull, bend = pulled(at, inputs, velocity, decided())
        step = -jnp.linalg.pinv(bend, hermitian=True) @ pull
        return camera_velocity(at.move, camera, freed, step)

    put = lambda result, camera: result._replace(camera=camera)
    return Through(run, lambda result: result.camera, put, velocity)


class Pulled(NamedTuple):
    """How half the gradient of the sum of squares, by a camera's moves, changes: with the inputs
    (n,), and with the moves (n, n)."""

    pull: Float[Array, "n"]
    bend: Float[Array, "n n"]


def pulled(
    at: At, inputs: Inputs, velocity: Inputs, weight: np.ndarray, unit_px: float = 1.0
) -> Pulled:
    """Return how the gradient changes where pixels have a weight (H, W) and the moves are in units
    of this many px."""
    scene, target, given_weight = inputs
    dtype = at.film.e.dtype
    zero = jnp.zeros_like(at.move.scale)
    shown, J = image_and_jacobian(zero, at)
    goal = jnp.asarray(as_coverage(check_image("target", target, at.film.W, at.film.H)), dtype)
    w, difference = jnp.asarray(weight, dtype), shown - goal
    scene_velocity, target_velocity, weight_velocity = velocity
    held = w * difference
    left = float(jnp.sqrt(jnp.mean(held * difference))) > NO_RESIDUAL
    h = STEP_PX[np.dtype(dtype)] / unit_px
    places = zero[None]
    if left:
        steps = h * jnp.eye(len(zero), dtype=dtype)
        places = jnp.concatenate([places, steps, -steps])
    changes = jnp.zeros((len(places), *shown.shape), dtype)
    if jax.tree.leaves(scene_velocity):
        changes = _along(places, at, _of_all(scene, scene_velocity))
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
    return Pulled(pull, (bend + bend.T) / 2)


def _of_all(scene: Scene, velocity: Any) -> Any:
    """Return the velocity of a scene's arrays, 0 of those that do not change."""
    solid = eqx.filter(scene, eqx.is_inexact_array)
    return eqx.combine(velocity, jax.tree.map(jnp.zeros_like, solid))


@jitted
def _slopes(places: Float[Array, "k n"], at: At, held: Any) -> Float[Array, "k n"]:
    """Return at some moves the derivative of the image's product with `held`."""
    return jax.lax.map(jax.grad(lambda y: jnp.sum(held * image(y, at))), places)


@jitted
def _along(places: Float[Array, "k n"], at: At, velocity: Any) -> Float[Array, "k H W"]:
    """Return the image's rate of change, at some moves, where the scene moves with a velocity."""
    solid, fixed = eqx.partition(at.scene, eqx.is_inexact_array)

    def change(y: Any) -> Any:
        shown = lambda solid: image(y, at._replace(scene=eqx.combine(solid, fixed)))
        return jax.jvp(shown, (solid,), (velocity,))[1]

    return jax.lax.map(change, places)
