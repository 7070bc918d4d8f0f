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
from .._scene.scene import Scene
from .._solver.moves import Move, camera_velocity, canonical
from .._solver.problem import UNIT_PX
from .._solver.solver import Solver
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
    run: Callable[[Inputs], tuple[Any, Callable[[], "Decided"]]], freed: tuple[str, ...]
) -> Through:
    """Return how a fit of one camera is made differentiable by scene, target and weight; `run` has
    a function that gives what decided."""

    def velocity(result: Any, decided: Callable, inputs: Inputs, velocity: Inputs) -> Camera:
        film, (solver, weight) = result.camera, decided()
        start = canonical(film)
        move = solver.move(start, solver.finest)
        pull = End.of(At(move, film, inputs[0], freed), inputs, weight).pull(inputs, velocity)
        back = pseudo_inverse(_bend(solver, start, weight), solver.dtype)
        return _answer(move, film, freed, back.astype(solver.dtype), pull)

    put = lambda result, camera: result._replace(camera=camera)
    return Through(run, lambda result: result.camera, put, velocity)


class Decided(NamedTuple):
    """What looks at the pixels that decided, and the weights (H, W) of these."""

    solver: Solver
    weight: np.ndarray


def _bend(solver: Solver, camera: Camera, weight: np.ndarray) -> np.ndarray:
    """Return how half the gradient of the squares changes with the moves (n, n)."""
    view = solver.look(camera, solver.finest)
    triangle = np.asarray(view.triangle, float)
    first = triangle.T @ triangle
    if not is_left(float(view.squares), weight):
        return first

    def slope(y: np.ndarray) -> np.ndarray:
        """Return the slope there of the product with what is left here, to first order: what the
        move itself leaves is taken away, as `first` has it exactly."""
        there = solver.look(solver.step(camera, solver.finest, y), solver.finest)
        triangle, along = np.asarray(there.triangle, float), np.asarray(there.along, float)
        return triangle.T @ (along - triangle @ y)

    steps = STEP_PX[solver.dtype] / UNIT_PX * np.eye(len(first))
    return first + differences(slope, steps)


def differences(slope: Callable[[np.ndarray], np.ndarray], steps: np.ndarray) -> np.ndarray:
    """Return how a slope (p,) follows each of some steps (q, p), by as much as this is long:
    (p, q)."""
    return np.array([(slope(y) - slope(-y)) / (2 * np.max(y)) for y in steps]).T


def is_left(squares: float, weight: np.ndarray) -> bool:
    """Return whether what is left of the target, its squares (px^2), is more than nothing."""
    return (squares / weight.size) ** 0.5 > NO_RESIDUAL


def pseudo_inverse(bend: np.ndarray, dtype: Any) -> np.ndarray:
    """Return the inverse of a symmetric matrix whose entries are of a float type."""
    least = 10 * len(bend) * float(np.finfo(dtype).eps)
    return np.linalg.pinv((bend + bend.T) / 2, least, hermitian=True)


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
    def of(cls, at: At, inputs: Inputs, weight: np.ndarray) -> "End":
        """Return the end of a fit, from which a camera may move."""
        film, dtype = at.film, np.dtype(at.film.e.dtype)
        shown, jacobian = image_and_jacobian(np.zeros(at.move.scale.shape, dtype), at)
        target = as_coverage(check_image("target", inputs[1], film.W, film.H))
        difference, weight = np.asarray(shown) - target.astype(dtype), weight.astype(dtype)
        left = is_left(float(np.sum(weight * difference * difference)), weight)
        return cls(at, jacobian, difference, weight, STEP_PX[dtype] / UNIT_PX if left else None)

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


@jitted
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


@jitted
def _answer(move: Move, film: Camera, freed: tuple[str, ...], back: Any, pull: Array) -> Camera:
    """Return how the camera changes so that the gradient stays 0."""
    return camera_velocity(move, film, freed, -back @ pull)


def _of_all(scene: Scene, velocity: Any) -> Any:
    """Return the velocity of a scene's arrays, 0 of those that do not change."""
    solid = eqx.filter(scene, eqx.is_inexact_array)
    still = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), solid)
    return eqx.combine(velocity, still)


@jitted
def _along(places: Any, at: At, velocity: Any) -> Float[Array, "k H W"]:
    """Return the image's rate of change, at some moves (k, n), where the scene moves."""
    solid, fixed = eqx.partition(at.scene, eqx.is_inexact_array)

    def change(y: Any) -> Any:
        shown = lambda solid: image(y, at._replace(scene=eqx.combine(solid, fixed)))
        return jax.jvp(shown, (solid,), (velocity,))[1]

    return jax.lax.map(change, places)
