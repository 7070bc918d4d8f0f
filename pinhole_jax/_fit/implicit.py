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
TWISTS = {"pose": slice(0, 6), "position": slice(3, 6), "orientation": slice(0, 3)}


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
        dtype, units = slope.pull.dtype, unit[slope.columns]
        bend, own = units[:, None] * slope.bend * units, count[slope.columns] == 1
        place = np.searchsorted(shared, slope.columns[~own])
        back, across = _inverse(bend[np.ix_(own, own)]), bend[np.ix_(own, ~own)]
        left[np.ix_(place, place)] += bend[np.ix_(~own, ~own)] - across.T @ back @ across
        # (What is linear in the pulls is products with matrices: entries one by one are a program
        # each.)
        toward = np.zeros((len(shared), len(own)))
        toward[np.ix_(place, ~own)] = np.eye(len(place))
        toward[np.ix_(place, own)] = -across.T @ back
        alone = np.zeros(bend.shape)
        alone[np.ix_(own, own)] = back
        parts.append(
            [
                jnp.asarray(x, dtype)
                for x in (units[:, None] * toward.T, units[:, None] * alone * units)
            ]
        )
        pull = pull + jnp.asarray(toward * units, dtype) @ slope.pull
    step = -jnp.asarray(_inverse(left), pull.dtype) @ pull
    return [
        by_shared @ step - by_own @ slope.pull
        for (by_shared, by_own), slope in zip(parts, slopes, strict=True)
    ]


def _inverse(bend: np.ndarray) -> np.ndarray:
    least = 10 * len(bend) * float(np.finfo(bend.dtype).eps)
    return np.linalg.pinv((bend + bend.T) / 2, least, hermitian=True)


class Vantage(eqx.Module):
    """A camera that sees an object, and its unknowns.

    - `camera`: canonical, in its carrier's frame; `film`: its film.
    - `pose`: the frame that twists of the camera are taken in.
    - `place`: the object's pose in the world; `scale`: its size.
    - `units` (n,): the sizes of moves; `kinds`: what they move: motions, `OBJECT`, `SCALE`, and
      parameters of the lens.
    """

    camera: Camera
    film: Camera
    pose: Float[Array, "4 4"] | Pose
    place: Float[Array, "4 4"] | Pose
    scale: Float[Array, ""] | Float[np.ndarray, ""]
    units: Float[Array, "n"] | np.ndarray
    kinds: tuple[str, ...] = eqx.field(static=True)

    def moved(self, y: Array) -> tuple[Camera, Array, Array]:
        """The camera on its film, the object's pose and its size after moves."""
        camera, place, scale = self.camera, jnp.asarray(self.place), jnp.asarray(self.scale)
        step, begin = y * self.units, 0
        for kind in self.kinds:
            part = step[begin : begin + number_of(kind)]
            begin += number_of(kind)
            if kind in TWISTS:
                motion, pose = _motion(part, TWISTS[kind]), jnp.asarray(self.pose)
                camera = _transformed(camera, pose @ motion @ _inverted(pose))
            elif kind == OBJECT:
                place = place @ _motion(part, TWISTS["pose"])
            elif kind == SCALE:
                scale = scale * jnp.exp(part[0])
            else:
                for leaf in PARAMETERS[kind].leaves:
                    camera = eqx.tree_at(leaf.of, camera, leaf.moved(leaf.of(camera), part))
        return on_film(camera, self.film), place, scale


def vantage_of(
    camera: Camera,
    film: Camera,
    pose: Pose,
    kinds: tuple[str, ...],
    place: Pose | None = None,
    scale: float = 1.0,
) -> Vantage:
    """A vantage whose moves are in units as such."""
    place, units = np.eye(4) if place is None else place, np.ones(sum(map(number_of, kinds)))
    to = lambda x: np.asarray(x, film.e.dtype)
    return Vantage(camera, film, to(pose), to(place), to(scale), to(units), kinds)


def number_of(kind: str) -> int:
    """The number of moves of a kind."""
    sizes = {OBJECT: 6, SCALE: 1}
    return sizes[kind] if kind in sizes else len(components((kind,)))


def _rigid(turn: Array, shift: Array) -> Array:
    top = jnp.concatenate([turn, shift[:, None]], axis=1)
    return jnp.concatenate([top, jnp.asarray([[0, 0, 0, 1]], top.dtype)])


def _motion(part: Array, where: slice) -> Array:
    twist = jnp.zeros(6, part.dtype).at[where].set(part)
    return _rigid(rotation(twist[:3]), twist[3:])


def _inverted(pose: Any) -> Array:
    back = pose[:3, :3].T
    return _rigid(back, -back @ pose[:3, 3])


def _transformed(camera: Camera, by: Array, scale: Any = 1.0) -> Camera:
    turned = by[:3, :3]
    point = lambda q: (turned @ q + by[:3, 3]) / scale
    values = point(camera.e), point(camera.p), turned @ camera.u
    return eqx.tree_at(lambda c: (c.e, c.p, c.u), camera, values)


class Arrangement(NamedTuple):
    """What a camera sees: a scene, what carries the camera, and the scene's pose on the object."""

    scene: Scene
    mount: Any
    placed: Any


def arrangement_of(scene: Scene, dtype: Any, mount: Any = None, placed: Any = None) -> Arrangement:
    """What is seen, in a float type."""
    known = (np.eye(4) if x is None else x for x in (mount, placed))
    return Arrangement(scene, *(np.asarray(x, dtype) for x in known))


@eqx.filter_jit
def _image(y: Array, vantage: Vantage, arranged: Arrangement) -> Array:
    camera, place, scale = vantage.moved(y)
    by = _inverted(place @ arranged.placed) @ arranged.mount
    return silhouette(_transformed(camera, by, scale), arranged.scene)


@eqx.filter_jit
def _image_and_jacobian(y: Any, vantage: Vantage, arranged: Arrangement) -> tuple[Array, Array]:
    both = lambda y: (lambda x: (x, x))(_image(y, vantage, arranged))
    jacobian, value = jax.jacfwd(both, has_aux=True)(y)
    return value, jacobian


class End(NamedTuple):
    """Where a fit ended in a view: the image's `jacobian` (H, W, n) there by moves, the image less
    the target (H, W), and how much pixels count (H, W).

    `step`: of the differences that give second derivatives, in px; None where what is left of the
    target is as good as nothing.
    """

    vantage: Vantage
    arranged: Arrangement
    jacobian: np.ndarray
    difference: np.ndarray
    weight: np.ndarray
    step: float | None

    def slope(self, columns: np.ndarray, counts: float, weight: Any, velocity: Any) -> Slope:
        """How the fit's squares bend with the unknowns at `columns`, and how the data pull at them;
        both times `counts`, the view's weight.

        `weight` is the user's; `velocity` that of target, weight and `Arrangement`, None for
        those that do not change.
        """
        units = np.asarray(self.vantage.units, float)
        n, dtype, rows = len(units), self.weight.dtype, self.jacobian.astype(float)
        bend = np.einsum("hwm,hw,hwn->mn", rows, self.weight, rows, optimize=True)
        places = np.zeros((1, n), dtype)
        if self.step is not None:
            each = self.step * np.eye(n, dtype=dtype)
            places = np.concatenate([places, each, -each])
            slopes = np.asarray(_slopes(self, places[1:]), float)
            bend = bend + (slopes[:n] - slopes[n:]) / (2 * self.step)
        of_target, of_weight, moving = velocity
        share = None
        if of_weight is not None:
            given = np.asarray(weight)
            share = np.where(given > 0, self.weight / np.where(given > 0, given, 1), 0)
        scene = eqx.filter(self.arranged.scene, False)
        if jax.tree.leaves(moving.scene):  # (all of a scene's arrays move, or none)
            solid = eqx.filter(self.arranged.scene, eqx.is_inexact_array)
            still = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), solid)
            scene = eqx.combine(moving.scene, still)
        pull = _pull(self, places, of_target, share, of_weight, moving._replace(scene=scene))
        bend, pull = bend / np.outer(units, units), pull / units.astype(dtype)
        return Slope(columns, counts * bend, counts * pull)


@eqx.filter_jit
def _slopes(end: End, places: Any) -> Array:
    """The derivative (k, n) of the image's product with what is left, at some moves."""
    held = end.weight * end.difference
    product = lambda y: jnp.sum(held * _image(y, end.vantage, end.arranged))
    return jax.lax.map(jax.grad(product), places)


@eqx.filter_jit
def _pull(
    end: End, places: Any, of_target: Any, share: Any, of_weight: Any, moving: Arrangement
) -> Array:
    """The rate at which the data's velocities change the gradient (n,) while the camera stays."""
    dtype, toward, changes = end.weight.dtype, jnp.zeros_like(end.difference), None
    if jax.tree.leaves(moving):
        is_moving = jax.tree.map(lambda x: x is not None, moving, is_leaf=lambda x: x is None)
        solid, fixed = eqx.partition(end.arranged, is_moving)

        def change(y: Array) -> Array:
            image = lambda solid: _image(y, end.vantage, eqx.combine(solid, fixed))
            return jax.jvp(image, (solid,), (moving,))[1]

        changes = jax.lax.map(change, places)
        toward = changes[0]
    if of_target is not None:
        toward = toward - of_target.astype(dtype)
    toward = end.weight * toward
    if of_weight is not None:
        toward = toward + share.astype(dtype) * of_weight.astype(dtype) * end.difference
    pull = jnp.einsum("hwn,hw->n", end.jacobian, toward)
    if changes is not None and end.step is not None:
        along = jnp.einsum("khw,hw->k", changes[1:], end.weight * end.difference)
        ahead, behind = jnp.split(along, 2)
        pull = pull + (ahead - behind) / (2 * end.step)
    return pull


def end_of(vantage: Vantage, arranged: Arrangement, target: Any, weight: np.ndarray) -> End:
    """The end of a fit to a target, in units of moves that show as a pixel's do."""
    film, dtype = vantage.film, np.dtype(vantage.film.e.dtype)
    image, jacobian = _image_and_jacobian(np.zeros_like(vantage.units), vantage, arranged)
    target = as_coverage(check_image("target", target, film.W, film.H))
    difference, weight = np.asarray(image) - target.astype(dtype), weight.astype(dtype)
    left = float(np.mean(weight * difference * difference)) ** 0.5
    rows = np.asarray(jacobian)
    touched = max(int(np.sum(np.any(rows != 0, axis=-1))), 1)
    size = np.sqrt(np.sum(rows**2, axis=(0, 1)) / touched)
    units = 1 / np.maximum(size, max(LEAST_SHOWN * size.max(), np.finfo(dtype).tiny))
    vantage = eqx.tree_at(lambda v: v.units, vantage, units.astype(dtype))
    step = STEP_PX[dtype] if left > NO_RESIDUAL else None
    return End(vantage, arranged, (rows * units).astype(dtype), difference, weight, step)


@eqx.filter_jit
def velocity_of(vantage: Vantage, step: Array) -> tuple[Camera, Array, Array]:
    """The rates of change of a vantage's camera, object and size, with unknowns that move so."""
    y = step / vantage.units
    return jax.jvp(vantage.moved, (jnp.zeros_like(y),), (y,))[1]


def camera_velocity(
    camera: Camera,
    freed: tuple[str, ...],
    inputs: tuple[Scene, Any, Any],
    weight: np.ndarray,
    velocity: tuple[Any, Any, Any],
) -> Camera:
    """The rate of change of a camera that was fitted to scene, target and weight, where pixels of
    these weights (H, W) decided."""
    scene, of_target, of_weight = velocity
    vantage = vantage_of(canonical(camera), camera, pose_of(camera), freed)
    end = end_of(vantage, arrangement_of(inputs[0], camera.e.dtype), inputs[1], weight)
    rates = of_target, of_weight, Arrangement(scene, None, None)
    (step,) = steps_of([end.slope(np.arange(len(vantage.units)), 1.0, inputs[2], rates)])
    return velocity_of(end.vantage, step)[0]
