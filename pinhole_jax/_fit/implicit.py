"""A fit's answer as a function of the fit's inputs: the implicit function theorem.

The fit ends where the gradient of all views' squares is 0. A change of scene, target or weight
moves it by minus the inverse of that gradient's derivative, times the gradient's change. These are
second derivatives, which coverage does not have as a program: they are central differences of exact
first ones. A single camera is a problem of one view; of points, the image is where they project.
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
    (p, p), and its rate of change with the inputs (p,). A vantage has the unknowns."""

    vantage: "Vantage"
    columns: np.ndarray
    bend: np.ndarray
    pull: Array


def velocities_of(slopes: Sequence[Slope]) -> list[tuple[Camera, Array, Array]]:
    """The rates of change of each view's camera, object and size, so that the whole gradient stays
    0.

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
        bend = units[:, None] * slope.bend * units
        alone = _inverse(bend * np.outer(own, own))
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
        _velocity(slope.vantage, follows @ step - alone @ slope.pull)
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
    - `drawn`: draws the image that is compared with a target, by a camera of a scene.
    """

    camera: Camera
    film: Camera
    pose: Pose
    kinds: tuple[str, ...] = eqx.field(static=True)
    place: Pose | None = None
    scale: Float[np.ndarray, ""] = eqx.field(default_factory=lambda: np.ones(()))
    drawn: Callable[[Camera, Any], Array] = eqx.field(static=True, default=silhouette)

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
    """What a view is fitted to: a scene, a target (of coverage) and its weights, the pose of the
    camera's carrier, and the scene's on the object (None: none). Or how fast these change (None:
    not)."""

    scene: Any
    target: Any
    weight: Any = None
    mount: Any = None
    placed: Any = None

    def checked(self, film: Camera) -> "ViewInputs":
        """The inputs, the mask that is the target as coverage."""
        return self._replace(target=as_coverage(check_image("target", self.target, film.W, film.H)))


def _image(y: Array, vantage: Vantage, given: ViewInputs) -> Array:
    camera, place, scale = vantage.moved(y)
    mount, placed = (_as_pose(x, y) for x in (given.mount, given.placed))
    by = jnp.linalg.inv(place @ placed) @ mount
    return vantage.drawn(_transformed(camera, by, scale), given.scene)


def _left(y: Array, vantage: Vantage, share: Any, given: ViewInputs) -> tuple[Array, Array]:
    """What is left of the image after moves, times its weight; and the image."""
    image, to = _image(y, vantage, given), lambda x: jnp.asarray(x, y.dtype)
    return to(share) * to(given.weight) * (image - to(given.target)), image


def slope_of(
    vantage: Vantage,
    given: ViewInputs,
    counted: np.ndarray,
    velocity: ViewInputs,
    columns: np.ndarray,
) -> Slope:
    """The slope of a view whose pixels `counted` so much (H, W) where its fit ended, while what it
    was given changes.

    Half the gradient is J^T times what is left: that changes, and so does J, if anything is left.
    """
    asked = np.ones_like(counted) if given.weight is None else np.asarray(given.weight)
    share, given = counted / np.where(asked > 0, asked, np.inf), given._replace(weight=asked)
    velocity = eqx.filter(velocity, eqx.is_inexact_array)
    is_moving = jax.tree.map(lambda x: x is not None, velocity, is_leaf=lambda x: x is None)
    bend, *look = _bend(vantage, share, given)
    pull = _pull(look, vantage, share, velocity, *eqx.partition(given, is_moving))
    return Slope(vantage, columns, np.asarray(bend, float), pull)


def _by_moves(function: Callable[[Array], Array], steps: Array) -> Array:
    """The derivative of a function by each move, by central differences."""
    across = lambda y, step: (function(y) - function(-y)) / (2 * step)
    return jax.lax.map(lambda pair: across(*pair), (jnp.diag(steps), steps))


@eqx.filter_jit
def _bend(vantage: Vantage, share: Any, given: ViewInputs) -> tuple[Array, ...]:
    """The gradient's derivative (n, n) by moves; and the image's (H, W, n), what is left of it, and
    each move's step of central differences."""
    still = jnp.asarray(vantage.still)
    both = lambda y: (lambda x: (x, x))(_left(y, vantage, share, given))
    (of_left, jacobian), (left, _) = jax.jacfwd(both, has_aux=True)(still)
    touched = jnp.maximum(jnp.sum(jnp.any(jacobian != 0, axis=-1)), 1).astype(still.dtype)
    size = jnp.sqrt(jnp.sum(jacobian**2, axis=(0, 1)) / touched)
    least = jnp.maximum(LEAST_SHOWN * size.max(), 1e-30)
    steps = STEP_PX[still.dtype] / jnp.maximum(size, least)
    product = lambda y: jnp.vdot(left, _image(y, vantage, given))
    bend = jnp.einsum("hwi,hwj->ij", jacobian, of_left) + _by_moves(jax.grad(product), steps)
    return bend, jacobian, left, steps


@eqx.filter_jit
def _pull(
    look: Any,
    vantage: Vantage,
    share: Any,
    velocity: ViewInputs,
    moving: ViewInputs,
    fixed: ViewInputs,
) -> Array:
    """The gradient's rate of change (n,) as what is moving has a velocity."""
    jacobian, left, steps = look

    def rates(y: Array) -> tuple[Array, Array]:
        seen = lambda moving: _left(y, vantage, share, eqx.combine(moving, fixed))
        return jax.jvp(seen, (moving,), (velocity,))[1]

    of_left = rates(jnp.zeros_like(steps))[0]
    product = lambda y: jnp.vdot(left, rates(y)[1])
    return jnp.einsum("hwi,hw->i", jacobian, of_left) + _by_moves(product, steps)


@eqx.filter_jit
def _velocity(vantage: Vantage, step: Array) -> tuple[Camera, Array, Array]:
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
    given, columns = ViewInputs(*inputs).checked(camera), np.arange(len(vantage.still))
    slope = slope_of(vantage, given, weight, ViewInputs(*velocity), columns)
    return velocities_of([slope])[0][0]
