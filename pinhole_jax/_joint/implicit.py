"""How the answer of a joint fit moves with what it was fitted to (see `implicit`).

Half the gradient of all squares, by the unknowns x, is the sum of views' M^T g, where a view's g is
by the moves of its own camera and M how these follow x. It is 0 where the fit ends; how it changes
with x, and with transforms that are known, central differences say; with masks and scenes, each
view's own.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._camera.camera import Camera
from .._camera.poses import Pose, adjoint, at_pose, exponential, inverse
from .._fit.full_image import At
from .._fit.implicit import End, Through, check_plain
from .._numerics.arrays import is_concrete
from .._solver.looks import View
from .._solver.moves import on_film
from .._solver.parameters import PARAMETERS
from .._solver.problem import UNIT_PX
from .agreement import Agreement
from .descent import Layout
from .problem import JointProblem
from .views import (
    MOTIONS,
    POSE,
    SCALE,
    TWIST,
    Eye,
    JointView,
    State,
    stepped,
    stretched,
)

#: What of a view a joint fit is differentiated by.
DIFFERENTIABLE = ("scene", "target", "weight", "mount", "placed")


class Part(NamedTuple):
    """What ended a fit of views that hang together: the problem, how far they agree, which of all
    views they are."""

    problem: JointProblem
    found: Agreement
    numbers: list[int]


class Answer(NamedTuple):
    """What of a joint fit is differentiable: cameras, objects' poses and scales, by name."""

    cameras: dict[str, Camera]
    poses: dict[str, Any]
    scales: dict[str, Any]


class Differentiable(NamedTuple):
    """What of a fit's result is differentiable, and the result with another `Answer`."""

    answer: Callable[[Any], Answer]
    put: Callable[[Any, Answer], Any]


def differentiable(
    run: Callable[[Sequence[JointView]], tuple[Any, list[Part]]],
    views: Sequence[JointView],
    of: Differentiable,
    refused: Mapping[str, Any],
) -> Any:
    """Return the fit that `run` returns, its answer differentiable by what is traced of views.

    Raises ValueError where something is traced, and something given that is `refused` then.
    """
    if is_concrete(*jax.tree.leaves(views)):
        return run(views)[0]
    check_plain(**refused)
    of_views = lambda inputs: [
        view._replace(**dict(zip(DIFFERENTIABLE, given, strict=True)))
        for view, given in zip(views, inputs, strict=True)
    ]

    def velocity(fit: Any, parts: list[Part], inputs: Any, velocity: Any) -> Answer:
        moving = [_velocity(part, inputs, velocity) for part in parts]
        whole = [
            {k: v for some in kind for k, v in some.items()} for kind in zip(*moving, strict=True)
        ]
        return Answer(
            *({k: of[k] for k in own} for own, of in zip(of.answer(fit), whole, strict=True))
        )

    inputs = [tuple(getattr(view, name) for name in DIFFERENTIABLE) for view in views]
    return Through(lambda inputs: run(of_views(inputs)), of.answer, of.put, velocity)(inputs)


def _velocity(part: Part, inputs: Any, velocity: Any) -> Answer:
    """Return the rates of change of a part's cameras, objects and scales."""
    problem, found, numbers = part
    problem, weights = _deciding(problem)
    layout, state = problem.layout, found.descent.state
    dtype = layout.eyes[0].solver.dtype
    pull, bend = jnp.zeros(layout.size, dtype), np.zeros((layout.size, layout.size))
    for k, (number, weight) in enumerate(zip(numbers, weights, strict=True)):
        place, of_view = layout.columns(k), _OfView(problem, k, state, weight)
        counts = float(found.weights[k])
        end = of_view.end(inputs[number])
        changes = of_view.by_inputs(end, inputs[number], velocity[number])
        pull = pull.at[place].add(counts * changes)
        bend[np.ix_(place, place)] += counts * of_view.by_unknowns(end)
    back = np.linalg.pinv((bend + bend.T) / 2, hermitian=True)
    step = -jnp.asarray(back, dtype) @ pull
    return jax.jvp(lambda x: _moved(problem, state, x), (jnp.zeros_like(step),), (step,))[1]


def _deciding(problem: JointProblem) -> tuple[JointProblem, list[np.ndarray]]:
    """Return the problem whose views look at the pixels that decided, and the weights (H, W) of
    these in each view."""
    reach, near, weights = problem.outlier_px, {}, []
    for k, eye in enumerate(problem.layout.eyes):
        if eye.solver.kind.exact or reach is None:
            weights.append(eye.mask.weight)
        else:
            edge = eye.mask.near_edge(reach)
            near[k] = eye.weighed(edge, only_finest=True)
            weights.append(edge.image())
    return problem.seeing(near), weights


class _OfView(NamedTuple):
    """What a view's part of the gradient changes with; `weight` (H, W) is of the pixels that
    decided."""

    problem: JointProblem
    number: int
    state: State
    weight: np.ndarray

    @property
    def eye(self) -> Eye:
        return self.problem.layout.eyes[self.number]

    def end(self, inputs: Any) -> End:
        """Return where the fit ended in the view, with all pixels (a look leaves out crowded
        ones)."""
        return End.of(self._at(self.eye, self.state), inputs[:3], self.weight, UNIT_PX)

    def _at(self, eye: Eye, state: State) -> At:
        start = eye.solver.move(eye.canonical(state), eye.solver.finest)
        return At(start, eye.mask.camera, eye.solver.subject.given, eye.solver.freed)

    def by_unknowns(self, end: End) -> np.ndarray:
        """Return how it changes with the unknowns that it depends on (p, p)."""
        layout = self.problem.layout
        place, unknowns, eyes = layout.columns(self.number), layout.unknowns, layout.eyes

        def there(step: np.ndarray) -> np.ndarray:
            x = np.zeros(layout.size)
            x[place] = step
            return self._slope(end, self.eye, stepped(self.state, unknowns, x, eyes))

        return self._changes(end, there, self._moves(self.eye, self.state))

    def by_inputs(self, end: End, inputs: Any, velocity: Any) -> Float[Array, "p"]:
        """Return its rate of change (p,) with scene, target and weight, mount and place."""
        eye, dtype = self.eye, self.eye.solver.dtype
        own = end.pull(inputs[:3], velocity[:3])
        result = jnp.asarray(self._moves(eye, self.state).T, dtype) @ own
        on_mount = self.state.poses[eye.moving] @ eye.rig
        in_scene = stretched(eye.pose(self.state), eye.scale(self.state))
        if velocity[3] is not None:
            result = result + self._by_transform(end, "mount", on_mount, 1) @ _twist(
                eye.mount, velocity[3]
            )
        if velocity[4] is not None:
            result = result + self._by_transform(end, "placed", in_scene, -1) @ _twist(
                eye.placed, velocity[4]
            )
        return result

    def _by_transform(self, end: End, name: str, after: Pose, sign: int) -> Float[Array, "p 6"]:
        """Return how it changes with a twist of a known transform, `after` which the camera's pose
        stands; the scene's moves the other way round."""
        eye, before = self.eye, getattr(self.eye, name)
        moves = (
            sign * eye.by_motion(self.state, self._look(eye, self.state)) @ adjoint(inverse(after))
        )

        def there(twist: np.ndarray) -> np.ndarray:
            moved: Any = {name: before @ exponential(twist), "standing": []}
            return self._slope(end, replace(eye, **moved), self.state)

        return jnp.asarray(self._changes(end, there, moves), eye.solver.dtype)

    def _look(self, eye: Eye, state: State) -> View:
        return eye.solver.look(eye.canonical(state), eye.solver.finest)

    def _moves(self, eye: Eye, state: State) -> np.ndarray:
        return eye.moves(state, self._look(eye, state), self.problem.layout.of(self.number))

    def _slope(self, end: End, eye: Eye, state: State) -> np.ndarray:
        """Return the slope (p,) that what is left of the target has along the image's derivative in
        another state."""
        return self._moves(eye, state).T @ end.left_along(self._at(eye, state))

    def _changes(
        self, end: End, slope: Callable[[np.ndarray], np.ndarray], moves: np.ndarray
    ) -> np.ndarray:
        """Return how the gradient (p,) follows a vector (q,) that makes moves (n, q): by what is
        seen, and by how the `slope` of what is left changes."""
        result = self._moves(self.eye, self.state).T @ np.asarray(end.seen(), float) @ moves
        if end.step is None:
            return result
        size = np.maximum(np.max(np.abs(moves), axis=0), 1e-300)
        steps = np.diag(end.step / size)
        return result + np.array([(slope(x) - slope(-x)) / (2 * np.max(x)) for x in steps]).T


def _twist(pose: Pose, change: Any) -> Float[Array, "6"]:
    """Return a rigid transform's rate of change as a twist in its own frame."""
    moved = jnp.asarray(inverse(pose), change.dtype) @ change
    skew = (moved[:3, :3] - moved[:3, :3].T) / 2
    return jnp.concatenate([jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]]), moved[:3, 3]])


def _moved(problem: JointProblem, state: State, x: Float[Array, "size"]) -> Answer:
    """Return the answer after a step that is so short that its square is nothing."""
    layout, cameras = problem.layout, {}
    owners = {eye.camera: eye.owners for eye in layout.eyes}
    for name, film in problem.cameras.items():
        pose = state.poses[problem.moving[name]]
        unit = at_pose(state.lenses[name], pose @ problem.rig.get(name, np.eye(4)))
        if (twist := _twist_of(layout, problem.moving[name], x)) is not None:
            unit = _carried(unit, pose, twist)
        for row, owner in owners[name].items():
            place = layout.place(owner, row)
            for leaf in PARAMETERS[row].leaves:
                unit = eqx.tree_at(leaf.of, unit, leaf.moved(leaf.of(unit), x[place]))
        cameras[name] = on_film(unit, film)
    objects = {eye.object for eye in layout.eyes if eye.object is not None}
    of = lambda name, kind: x[layout.place(name, kind)]
    return Answer(
        cameras,
        {name: _turned(state.poses[name], of(name, POSE)) for name in objects},
        {
            u.name: state.scales[u.name] * jnp.exp(of(u.name, SCALE)[0])
            for u in layout.unknowns
            if u.kind == SCALE
        },
    )


def _twist_of(layout: Layout, name: str, x: Float[Array, "size"]) -> Float[Array, "6"] | None:
    """Return the twist that a step has for a pose, None where no part of that is free."""
    whole = None
    for kind, part in MOTIONS.items():
        if (place := layout.place(name, kind)) is not None:
            whole = jnp.zeros(TWIST, x.dtype) if whole is None else whole
            whole = whole.at[part].add(x[place])
    return whole


def _carried(unit: Camera, pose: Pose, twist: Float[Array, "6"]) -> Camera:
    """Return a camera that goes with a pose, after a short twist of this one."""
    rotation, place = (jnp.asarray(a, twist.dtype) for a in (pose[:3, :3], pose[:3, 3]))
    turn, shift = rotation @ twist[:3], rotation @ twist[3:]
    point = lambda q: q + jnp.cross(turn, q - place) + shift
    moved = point(unit.e), point(unit.p), unit.u + jnp.cross(turn, unit.u)
    return eqx.tree_at(lambda c: (c.e, c.p, c.u), unit, moved)


def _turned(pose: Pose, twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """Return a pose after a short twist."""
    x, y, z, *shift = twist
    rows = [[0, -z, y, shift[0]], [z, 0, -x, shift[1]], [-y, x, 0, shift[2]], [0, 0, 0, 0]]
    rates = jnp.stack([jnp.stack([jnp.asarray(v, twist.dtype) for v in row]) for row in rows])
    start = jnp.asarray(pose, twist.dtype)
    return start + start @ rates
