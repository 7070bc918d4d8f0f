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
        start, dtype = canonical(camera), camera.e.dtype
        pivot, radius = (np.asarray(x, dtype) for x in bounding_sphere(inputs[0]))
        move = _move(start, pivot, radius, np.asarray(camera.H, dtype), freed)
        end = End.of(At(move, camera, inputs[0], freed), inputs, decided())
        return _answer(move, camera, freed, end.back(), end.pull(inputs, velocity))

    put = lambda result, camera: result._replace(camera=camera)
    return Through(run, lambda result: result.camera, put, velocity)


class End(NamedTuple):
    """Where a fit ended: the image's `jacobian` (H, W, n) there by moves, the image less the target
    (H, W), and how much pixels count (H, W).

    `step`: of the differences that tell second derivatives, in the moves' unit; None where what is
    left of the target is as good as nothing.
    """

    at: At
    jacobian: Float[Array, "H W n"]
    difference: np.ndarray
    weight: np.ndarray
    step: float | None

    @classmethod
    def of(cls, at: At, inputs: Inputs, weight: np.ndarray, unit_px: float = 1.0) -> "End":
        """Return the end of a fit whose moves are in units of this many px."""
        film, dtype = at.film, np.dtype(at.film.e.dtype)
        shown, jacobian = image_and_jacobian(np.zeros(at.move.scale.shape, dtype), at)
        target = as_coverage(check_image("target", inputs[1], film.W, film.H))
        difference, weight = np.asarray(shown) - target.astype(dtype), weight.astype(dtype)
        left = float(np.mean(weight * difference * difference)) ** 0.5
        step = STEP_PX[dtype] / unit_px if left > NO_RESIDUAL else None
        return cls(at, jacobian, difference, weight, step)

    def back(self) -> np.ndarray:
        """Return the inverse of how half the gradient changes with the moves (n, n)."""
        bend, n = self.seen(), self.jacobian.shape[-1]
        if self.step is not None:
            places = self._places()[1:]
            slopes = np.asarray(_slopes(places, self.at, self.weight * self.difference))
            bend = bend + (slopes[:n] - slopes[n:]) / (2 * self.step)
        least = 10 * n * float(np.finfo(bend.dtype).eps)
        return np.linalg.pinv((bend + bend.T) / 2, least, hermitian=True)

    def seen(self) -> np.ndarray:
        """Return how half the gradient changes with the moves where nothing is left (n, n)."""
        rows = np.asarray(self.jacobian).reshape(-1, self.jacobian.shape[-1])
        return rows.T @ (self.weight.reshape(-1, 1) * rows)

    def left_along(self, at: At) -> np.ndarray:
        """Return what is left of the target along the image's derivative elsewhere (n,)."""
        still = np.zeros(at.move.scale.shape, self.weight.dtype)
        rows = np.asarray(image_and_jacobian(still, at)[1], float)
        return np.einsum("hwn,hw->n", rows, self.weight * self.difference)

    def pull(self, inputs: Inputs, velocity: Inputs) -> Float[Array, "n"]:
        """Return how half the gradient changes with the inputs while the camera stays: linear in
        their velocities."""
        scene, of_target, of_weight = velocity
        changes = share = None
        if jax.tree.leaves(scene):
            changes = _along(self._places(), self.at, _of_all(inputs[0], scene))
        if of_weight is not None:
            given = np.asarray(inputs[2])
            share = np.where(given > 0, self.weight / np.where(given > 0, given, 1), 0)
            share = share.astype(self.weight.dtype)
        return _pull(self._replace(at=None), changes, of_target, share, of_weight)

    def _places(self) -> np.ndarray:
        """Return no move; and, where second derivatives count, a step each way along each."""
        n, dtype = self.jacobian.shape[-1], self.weight.dtype
        if self.step is None:
            return np.zeros((1, n), dtype)
        each = self.step * np.eye(n, dtype=dtype)
        return np.concatenate([np.zeros((1, n), dtype), each, -each])


@eqx.filter_jit
def _move(start: Camera, pivot: Any, radius: Any, H: Any, freed: tuple[str, ...]) -> Move:
    return Move(start, pivot, scales(start, pivot, radius, H, freed))


@eqx.filter_jit
def _pull(end: End, changes: Any, of_target: Any, share: Any, of_weight: Any) -> Array:
    """Return `End.pull`, with the image's changes (k, H, W) at its places while the scene moves."""
    dtype, toward = end.weight.dtype, jnp.zeros_like(end.difference)
    if changes is not None:
        toward = changes[0]
    if of_target is not None:
        toward = toward - of_target.astype(dtype)
    toward = end.weight * toward
    if of_weight is not None:
        toward = toward + share * of_weight.astype(dtype) * end.difference
    pull = jnp.einsum("hwn,hw->n", end.jacobian, toward)
    if changes is not None and end.step is not None:
        along = jnp.einsum("khw,hw->k", changes[1:], end.weight * end.difference)
        ahead, behind = jnp.split(along, 2)
        pull = pull + (ahead - behind) / (2 * end.step)
    return pull


@eqx.filter_jit
def _answer(move: Move, film: Camera, freed: tuple[str, ...], back: Any, pull: Array) -> Camera:
    """Return how the camera changes so that the gradient stays 0."""
    return camera_velocity(move, film, freed, -back @ pull)


def _of_all(scene: Scene, velocity: Any) -> Any:
    """Return the velocity of a scene's arrays, 0 of those that do not change."""
    solid = eqx.filter(scene, eqx.is_inexact_array)
    still = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), solid)
    return eqx.combine(velocity, still)


@eqx.filter_jit
def _slopes(places: Any, at: At, held: Any) -> Float[Array, "k n"]:
    """Return at some moves (k, n) the derivative of the image's product with `held`."""
    return jax.lax.map(jax.grad(lambda y: jnp.sum(held * image(y, at))), places)


@eqx.filter_jit
def _along(places: Any, at: At, velocity: Any) -> Float[Array, "k H W"]:
    """Return the image's rate of change, at some moves (k, n), where the scene moves."""
    solid, fixed = eqx.partition(at.scene, eqx.is_inexact_array)

    def change(y: Any) -> Any:
        shown = lambda solid: image(y, at._replace(scene=eqx.combine(solid, fixed)))
        return jax.jvp(shown, (solid,), (velocity,))[1]

    return jax.lax.map(change, places)
