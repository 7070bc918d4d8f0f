"""A fit's answer as a function of the fit's inputs: the implicit function theorem.

The fit ends where the sum of all views' J^T w (image - target) is 0 (J: the image's derivative by
the unknowns), so a change of scene, target or weight moves it by minus the inverse of that sum's
derivative, times its change. That takes the image's second derivatives, which coverage does not
have as a program; where the residual is not 0 they are central differences of its exact first
derivatives. A single camera is a problem of one view.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._camera.poses import Pose, pose_of
from .._mask.target import as_coverage, check_image
from .._numerics.arrays import is_concrete
from .._scene.scene import Scene
from .._silhouette.silhouette import silhouette
from .._solver.moves import canonical, on_film, rotation
from .._solver.parameters import PARAMETERS, components

#: The step of central differences, in px, by float type. (Derivatives by it agree with refits to
#: 1e-4 where masks are exact, to 1e-2 and 3e-2 of noisy and hard ones, whose second derivatives
#: jump: of two noisy masks to 1e-6 with up to 3e-4, to 3e-3 with 1e-3.)
STEP_PX = {np.dtype(np.float32): 0.03, np.dtype(np.float64): 1e-4}
#: Below this root mean square over the image the residual's part of the second derivative is left
#: out: it is as small as that.
NO_RESIDUAL = 1e-5
#: An unknown that shows less than this share of the best-seen one has that one's unit times this.
LEAST_SHOWN = 1e-3
#: Unknowns beside a camera's own parameters: an object's pose and its size.
OBJECT, SCALE = "object", "scale"
#: The part of a twist (a rotation vector, a shift) that each motion of a camera has.
MOTIONS = {"pose": slice(0, 6), "position": slice(3, 6), "orientation": slice(0, 3)}


def through(
    run: Callable[[Any], tuple[Any, Any]],
    inputs: Any,
    answer: Callable[[Any], Any],
    velocity: Callable[[Any, Any, Any, Any], Any],
    names: str = "`target`, `scene`, `weight`",
) -> Any:
    """The result of a fit to inputs, its answer differentiable by those of them that are traced.

    - `run`: makes the result of inputs, and something that `velocity` needs.
    - `answer`: the part of the result that is differentiable, a pytree.
    - `velocity`: the answer's rate of change, given the result, that something, the inputs and
      their velocities: None for those that do not change.
    - `names`: the arguments that inputs come from, as errors name them.
    """
    changing, fixed = eqx.partition(inputs, lambda leaf: not is_concrete(leaf))
    results: list[Any] = []

    def solve(changing: Any) -> tuple[Any, Any, Any]:
        if not is_concrete(*jax.tree.leaves(changing)):
            raise ValueError(
                f"{names}: expected concrete arrays, got traced ones; a fit runs outside"
                " `jit` and `vmap` (in `grad`, `jvp` and `jacfwd`, if these are outside)"
            )
        whole = eqx.combine(changing, fixed)
        result, end = run(whole)
        results.append(result)
        return result, end, whole

    @jax.custom_jvp
    def answer_of(changing: Any) -> Any:
        return answer(solve(changing)[0])

    @answer_of.defjvp
    def answer_rate(primals: Any, tangents: Any) -> tuple[Any, Any]:
        solved = solve(primals[0])
        return answer(solved[0]), velocity(*solved, tangents[0])

    found = answer_of(changing)
    return eqx.tree_at(answer, results[-1], found)


def check_plain(**given: Any) -> None:
    """Raise ValueError where some of these arguments, which no derivative knows, are given."""
    if names := ", ".join(f"`{name}`" for name, value in given.items() if value):
        raise ValueError(f"{names}: expected none where the fit is differentiated")


class Slope(NamedTuple):
    """Half the gradient of a view's squares by the unknowns `columns` (p,): its derivative by these
    (p, p), and its rate of change with the inputs (p,)."""

    columns: np.ndarray
    bend: np.ndarray
    pull: Array


def steps_of(slopes: Sequence[Slope]) -> list[Array]:
    """The rates of change of each view's unknowns, so that the whole gradient stays 0.

    What one view alone depends on is eliminated, so the cost is linear in the views.
    """
    columns = np.concatenate([slope.columns for slope in slopes])
    count, size = np.bincount(columns), np.zeros(columns.max() + 1)
    for slope in slopes:
        size[slope.columns] += np.abs(np.diag(slope.bend))
    unit = np.where(size > 0, size, 1.0) ** -0.5
    shared = np.flatnonzero(count > 1)
    left, parts = np.zeros((len(shared), len(shared))), []
    pull = jnp.zeros(len(shared), slopes[0].pull.dtype)
    for slope in slopes:
        units, own = unit[slope.columns], count[slope.columns] == 1
        bend, alone = units[:, None] * slope.bend * units, np.zeros(slope.bend.shape)
        alone[np.ix_(own, own)] = _inverse(bend[np.ix_(own, own)])
        follows = (slope.columns[:, None] == shared).astype(float)
        follows -= alone @ bend @ follows
        left += follows.T @ bend @ follows
        # (What is linear in the pulls is products with matrices: entries one by one are a program
        # each.)
        each = units[:, None] * follows, units[:, None] * alone * units
        follows, alone = (jnp.asarray(x, slope.pull.dtype) for x in each)
        parts.append((follows, alone))
        pull = pull + follows.T @ slope.pull
    step = -jnp.asarray(_inverse(left), pull.dtype) @ pull
    return [
        follows @ step - alone @ slope.pull
        for (follows, alone), slope in zip(parts, slopes, strict=True)
    ]


def _inverse(bend: np.ndarray) -> np.ndarray:
    least = 10 * len(bend) * float(np.finfo(bend.dtype).eps)
    return np.linalg.pinv((bend + bend.T) / 2, least, hermitian=True)


class Vantage(eqx.Module):
    """A camera that sees an object, and its unknowns.

    - `camera`: canonical, in its carrier's frame; `film`: its film.
    - `pose`: the frame that twists of the camera are taken in.
    - `kinds`: what moves, in its own units: motions of the camera, `OBJECT`, `SCALE`, and
      parameters of the lens.
    - `place`: the object's pose in the world (None: the world's); `scale`: its size.
    """

    camera: Camera
    film: Camera
    pose: Pose
    kinds: tuple[str, ...] = eqx.field(static=True)
    place: Pose | None = None
    scale: Float[np.ndarray, ""] = eqx.field(default_factory=lambda: np.ones(()))

    @property
    def still(self) -> Float[np.ndarray, "n"]:
        """No moves."""
        return np.zeros(sum(map(number_of, self.kinds)), self.film.e.dtype)

    def moved(self, y: Array) -> tuple[Camera, Array, Array]:
        """The camera on its film, the object's pose and its size after moves."""
        camera, pose, place = self.camera, _as_pose(self.pose, y), _as_pose(self.place, y)
        scale, ends = jnp.asarray(self.scale, y.dtype), np.cumsum([*map(number_of, self.kinds)])
        for kind, part in zip(self.kinds, jnp.split(y, ends[:-1]), strict=True):
            if kind in MOTIONS:
                motion = _motion(part, MOTIONS[kind])
                camera = _transformed(camera, pose @ motion @ jnp.linalg.inv(pose))
            elif kind == OBJECT:
                place = place @ _motion(part, MOTIONS["pose"])
            elif kind == SCALE:
                scale = scale * jnp.exp(part[0])
            else:
                for leaf in PARAMETERS[kind].leaves:
                    camera = eqx.tree_at(leaf.of, camera, leaf.moved(leaf.of(camera), part))
        return on_film(camera, self.film), place, scale


def number_of(kind: str) -> int:
    """The number of moves of a kind: one, but of an object's pose and a camera's parameters."""
    if kind == OBJECT:
        return 6
    return len(components((kind,))) if kind in PARAMETERS else 1


def _as_pose(pose: Any, like: Array) -> Array:
    return jnp.asarray(np.eye(4) if pose is None else pose, like.dtype)


def _motion(part: Array, where: slice) -> Array:
    twist = jnp.zeros(6, part.dtype).at[where].set(part)
    turn, shift = rotation(twist[:3]), twist[3:]
    return jnp.eye(4, dtype=part.dtype).at[:3, :3].set(turn).at[:3, 3].set(shift)


def _transformed(camera: Camera, by: Array, scale: Any = 1.0) -> Camera:
    turned = by[:3, :3]
    point = lambda q: (turned @ q + by[:3, 3]) / scale
    values = point(camera.e), point(camera.p), turned @ camera.u
    return eqx.tree_at(lambda c: (c.e, c.p, c.u), camera, values)


class ViewInputs(NamedTuple):
    """What a view is fitted to: a scene, a mask and its weights, the pose of the camera's carrier,
    and the scene's on the object (None: none). Or how fast these change (None: not)."""

    scene: Any
    target: Any
    weight: Any = None
    mount: Any = None
    placed: Any = None


def _image(y: Array, vantage: Vantage, given: ViewInputs) -> Array:
    camera, place, scale = vantage.moved(y)
    mount, placed = (_as_pose(x, y) for x in (given.mount, given.placed))
    by = jnp.linalg.inv(place @ placed) @ mount
    return silhouette(_transformed(camera, by, scale), given.scene)


@eqx.filter_jit
def _image_and_jacobian(y: Any, vantage: Vantage, given: ViewInputs) -> tuple[Array, Array]:
    both = lambda y: (lambda x: (x, x))(_image(y, vantage, given))
    jacobian, value = jax.jacfwd(both, has_aux=True)(y)
    return value, jacobian


def slope_of(
    vantage: Vantage,
    given: ViewInputs,
    counted: np.ndarray,
    velocity: ViewInputs,
    columns: np.ndarray,
) -> Slope:
    """The slope of a view whose pixels `counted` so much (H, W) where its fit ended, while what it
    was given changes."""
    film, dtype, weight = vantage.film, vantage.still.dtype, counted.astype(vantage.still.dtype)
    seen = given._replace(target=None, weight=None)
    image, jacobian = map(np.asarray, _image_and_jacobian(vantage.still, vantage, seen))
    target = as_coverage(check_image("target", given.target, film.W, film.H))
    difference = image - target.astype(dtype)
    is_met = float(np.mean(weight * difference * difference)) ** 0.5 <= NO_RESIDUAL

    velocity = eqx.filter(velocity, eqx.is_inexact_array)
    moves = velocity._replace(target=None, weight=None)
    is_moving = jax.tree.map(lambda x: x is not None, moves, is_leaf=lambda x: x is None)
    moving, fixed = eqx.partition(seen, is_moving)
    data = jacobian, weight, difference
    bend, rates = _derivatives(_looks(jacobian, is_met), vantage, moving, fixed, *data)
    by_image = np.moveaxis(jacobian, -1, 0)
    if velocity.target is not None:
        rates = rates._replace(target=-weight * by_image)
    if velocity.weight is not None:
        asked = np.asarray(given.weight)
        share = np.where(asked > 0, weight / np.where(asked > 0, asked, 1), 0)
        rates = rates._replace(weight=(share * difference).astype(dtype) * by_image)
    return Slope(columns, np.asarray(bend, float), _along(rates, velocity, vantage.still))


def _looks(jacobian: np.ndarray, is_met: bool) -> tuple[np.ndarray, ...]:
    """The looks that make each row of second derivatives: its own column of the jacobian, and
    unless the target is met the difference of the residuals' two, a step ahead and behind."""
    n, dtype = jacobian.shape[-1], jacobian.dtype
    touched = max(int(np.sum(np.any(jacobian != 0, axis=-1))), 1)
    size = np.sqrt(np.sum(jacobian.astype(float) ** 2, axis=(0, 1)) / touched)
    step = STEP_PX[dtype] / np.maximum(size, max(LEAST_SHOWN * size.max(), 1e-30))
    column, none = np.eye(n), np.zeros((n, n))
    at = np.stack([none, np.diag(step), -np.diag(step)], axis=1)
    looks = at, np.stack([column, none, none], axis=1), np.outer(0.5 / step, [0, 1, -1])
    return tuple(x[:, : 1 if is_met else 3].astype(dtype) for x in looks)


@eqx.filter_jit
def _derivatives(
    looks: Any,
    vantage: Vantage,
    moving: ViewInputs,
    fixed: ViewInputs,
    jacobian: Any,
    weight: Any,
    difference: Any,
) -> tuple[Array, ViewInputs]:
    """Sums over each row's looks (n, k): the derivatives, by moves and by what is moving, of the
    image's product with columns of the jacobian, and with what is left, both weighed."""

    def derivative(look: Any) -> tuple[Array, ViewInputs]:
        at, along, of_residual = look
        image = lambda y, moving: _image(y, vantage, eqx.combine(moving, fixed))
        held = weight * (jacobian @ along + of_residual * difference)
        return jax.vjp(image, at, moving)[1](held)

    summed = lambda row: jax.tree.map(lambda x: x.sum(axis=0), jax.lax.map(derivative, row))
    return jax.lax.map(summed, looks)


@eqx.filter_jit
def _along(derivative: ViewInputs, velocity: ViewInputs, still: Any) -> Array:
    """A derivative (n, ...) by inputs, times their velocity: moves of a type."""
    pairs = zip(jax.tree.leaves(derivative), jax.tree.leaves(velocity), strict=True)
    moves = (jnp.tensordot(by, v.astype(by.dtype), v.ndim).astype(still.dtype) for by, v in pairs)
    return sum(moves, jnp.asarray(still))


@eqx.filter_jit
def velocity_of(vantage: Vantage, step: Array) -> tuple[Camera, Array, Array]:
    """The rates of change of a vantage's camera, object and size, with unknowns that move so."""
    return jax.jvp(vantage.moved, (jnp.zeros_like(step),), (step,))[1]


def camera_velocity(
    camera: Camera,
    freed: tuple[str, ...],
    inputs: tuple[Scene, Any, Any],
    weight: np.ndarray,
    velocity: tuple[Any, Any, Any],
) -> Camera:
    """The rate of change of a camera that was fitted to scene, target and weight, where pixels of
    these weights (H, W) decided."""
    vantage = Vantage(canonical(camera), camera, pose_of(camera), freed)
    columns = np.arange(len(vantage.still))
    slope = slope_of(vantage, ViewInputs(*inputs), weight, ViewInputs(*velocity), columns)
    return velocity_of(vantage, *steps_of([slope]))[0]
