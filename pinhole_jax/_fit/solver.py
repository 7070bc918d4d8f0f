"""A fit of one scene to one mask: levels from coarse to fine, and buffers that grow as needed."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .._files import programs
from .._numerics.tracing import collector_at_rest
from .._scene.scene import (
    Scene,
    astype,
    ball_about,
    bounding_box,
    padded,
    with_or_without_border,
)
from .edges import Weights, counted, total, within
from .kinds import Kind, kind_of
from .moves import Bounds, Move, moved
from .outline_errors import OutlineErrors, is_drawn, outline_errors
from .priors import Others, Prior, no_others
from .problem import (
    COARSE_PX,
    FINE_PX,
    Problem,
    View,
    like_descended,
    move as move_of,
    move_about,
)
from .pyramid import LEAST_CELLS, Level, Pyramid, pyramid
from .residuals import Capacity
from .revolution import Revolution, revolutions, some_of
from .room import LEAST_ROOM, ROOMIER, first_room, more_room, size_of
from .symmetry import Turn, turns_of_a_mesh
from .target import Window, inside_of, object_window

#: Noise leaves at most so many standard errors more than on average.
ERRORS = 4.0
#: What a hard edge leaves in a pixel of the outline, and what 8 bits do.
ONE_BIT, LEAST_VARIANCE = 1 / 12, 1 / 12 / 255**2
#: A pixel of the outline is off if its residual is this many standard deviations of the kind's.
OFF_TIMES = 3.0
#: A step that is negligible (px) where a fit goes on to fewer pixels: half as many steps as to the
#: end of what float32 resolves, and squares within a hundred thousandth.
CONTINUED_PX = 5e-3
#: Pyramids of more cells than this (200 MB in float32) are not kept.
KEPT_CELLS = 2**23
#: Where there are finer levels, a fit looks for what is far away on this one, where the object has
#: 128 to 256 px. A residual tells of an outline that is a pixel away at most: of 12 degrees ten
#: steps took 10 to 12 back on this level, 1.5 on one where the object had 1500 px.
FAR_LEVEL = 3
#: Named, since optimistix takes a third of this package's import.
DESCENDED = "pinhole_jax._fit.levenberg_marquardt:descended"


class Stop(NamedTuple):
    """Where steps on a level ended: the camera (canonical), the level, their number."""

    unit: Camera
    level: Level
    steps: int


class Found(NamedTuple):
    """A camera (canonical), what is seen there, the steps taken on each level; the way there, from
    the start (0 steps) on, by levels or (a solver that records) by steps; whether the last steps
    ended by themselves, not at a limit."""

    unit: Camera
    view: View
    steps: tuple[int, ...]
    way: tuple[Stop, ...] = ()
    ended: bool = False


def onward(before: Found, after: Found) -> Found:
    """Return what a further descent found, with the steps of both."""
    steps, way = before.steps + after.steps, before.way + after.way[1:]
    return after._replace(steps=steps, way=way)


def last_px(kind: Kind, dtype: Any, continued: bool) -> float:
    """Return what step (px) is negligible on the finest level. What is `continued` on fewer pixels,
    as any mask that is not exact, moves by more then."""
    return CONTINUED_PX if continued and not kind.exact else FINE_PX[np.dtype(dtype)]


def explained_by(kind: Kind, levels: list[Level], dtype: Any) -> list[Level]:
    """Return levels that know what residual a mask's kind explains, where it says so."""
    if not kind.exact:
        return levels
    explained = np.asarray(OFF_TIMES * kind.variance**0.5, dtype)
    return [level._replace(explained=explained) for level in levels]


class _Asked(NamedTuple):
    """What a pyramid is made of."""

    target: np.ndarray
    weights: Weights
    window: Window
    least: int
    only_finest: bool

    def same(self, other: "_Asked") -> bool:
        """Return whether another one's pyramid is the same."""
        a, b = self.weights, other.weights
        rest = self.target is other.target and self[2:] == other[2:]
        if not isinstance(a, np.ndarray) or not isinstance(b, np.ndarray):
            return rest and a is b
        return rest and (a is b or np.array_equal(a, b))


class Solver:
    """One scene and mask; holds the buffers' sizes, which grow where a view outgrows them."""

    def __init__(
        self,
        scene: Scene,
        target: np.ndarray,
        weights: np.ndarray,
        dtype: Any,
        names: tuple[str, ...],
        max_steps: int,
        bounds: Bounds | None = None,
        prior: Prior | None = None,
        record: bool = False,
        continued: bool = False,
        least_cells: int = LEAST_CELLS,
    ):
        self._least_cells = least_cells
        self._bounds, self._prior, self._record = bounds, prior, record
        self.dtype, self.names, self.max_steps = np.dtype(dtype), names, max_steps
        self._others: Others | None = None
        self._errors: tuple[View, OutlineErrors | None] | None = None
        self._made: list[tuple[_Asked, tuple[Pyramid, list[Level]]]] = []
        self._target = target
        self.ball = ball_about(self._shown(scene))
        self.mesh = _mesh_of(scene)
        self.window = object_window(target)
        self.capacity = first_room(scene, inside_of(self.window.of(target)))
        self.kind = kind_of(self.window.of(target), self.window.of(weights), dtype)
        self.fine_px = last_px(self.kind, self.dtype, continued)
        self.weigh(weights)

    def weigh(
        self,
        weights: Weights,
        target: np.ndarray | None = None,
        only_finest: bool = False,
    ) -> None:
        """Set how much each pixel counts, and if given another target; until it is called again,
        there may be the finest level alone."""
        if target is not None:
            self._target = target
        self._only_finest = only_finest
        #: Walks all round a line: from there another need not be taken.
        self.walked: list[tuple[Camera, Revolution, list[Found]]] = []
        self._weights = weights
        size = size_of(self.capacity.pieces)
        least = self._least_cells * 4 ** ((size + 1) // 2)
        asked = _Asked(self._target, weights, self.window, least, only_finest)
        levels, self.levels = self._pyramid(asked)
        # Few programs: the larger image's has room for the longer outline, and the other way round.
        if self.capacity.pieces > 1:
            size = (levels.cells // LEAST_CELLS).bit_length() // 2
            pieces = max(self.capacity.pieces, LEAST_ROOM.pieces * ROOMIER**size)
            self.capacity = self.capacity._replace(pieces=pieces)
        self.levels = explained_by(self.kind, self.levels, self.dtype)
        seen = within(weights, self.levels[-1].window())
        self._beside = total(weights) - total(seen)
        self._counted = counted(seen)
        self.finest = len(self.levels) - 1
        others = self._others or no_others(self.names, self.dtype)
        self.problem = Problem(self._scene, levels, self.ball, others, self._bounds, self._prior)

    def _pyramid(self, asked: "_Asked") -> tuple[Pyramid, list[Level]]:
        """Return the levels of a target with weights: those of the first weights, which fits come
        back to, and of the last are kept, but for large ones."""
        for before, made in self._made:
            if before.same(asked):
                return made
        host, levels = pyramid(
            asked.target,
            asked.weights,
            self.dtype,
            window=asked.window,
            least=asked.least,
            only_finest=asked.only_finest,
        )
        made = jax.device_put(host), levels
        if made[0].target.size <= KEPT_CELLS:
            first = [x for x in self._made[:1] if x[0].weights is not asked.weights]
            self._made = [*first, (asked, made)]
        return made

    @property
    def target(self) -> np.ndarray:
        """Return the mask (H, W) that is fitted."""
        return self._target

    @property
    def far(self) -> int:
        """Return the number of the level on which what is far away is looked for: the finest where
        a prior or other views count, whose residuals are weighed against that level's."""
        alone = self._prior is None and self._others is None
        return min(FAR_LEVEL, self.finest) if alone else self.finest

    @cached_property
    def points(self) -> np.ndarray:
        """Return some hundreds of the mesh's vertices (n, 3), or none."""
        return some_of(self.mesh[0])

    @cached_property
    def revolutions(self) -> list[Revolution]:
        """Return the lines that the mesh is round about, but for a part of it."""
        return revolutions(self.mesh[0])

    @cached_property
    def turns(self) -> list[Turn]:
        """Return the turns that bring most of the mesh's faces to other faces."""
        return turns_of_a_mesh(*self.mesh)

    def misfit_above_noise(self, view: View) -> float:
        """Return the mean square residual of an outline pixel, all squares put on these pixels but
        what noise leaves in others."""
        touched = float(view.sums.touched)
        noise = self.kind.far * max(self._counted - touched, 0.0)
        return max(view.squares - noise, 0.0) / max(touched, 1.0)

    def explains(self, view: View) -> bool:
        """Return whether a right camera may leave these squares in a mask of this kind.

        Noise that is even says how much it leaves in all, and how exactly: what is beyond that is
        something else, as a handle that only the mask shows.
        """
        misfit, kind = self.misfit_above_noise(view), self.kind
        if not kind.spread:
            return bool(misfit <= kind.most)
        excess = (misfit - kind.variance) * max(float(view.sums.touched), 1.0)
        return bool(excess <= ERRORS * kind.spread)

    def errors(self, view: View) -> OutlineErrors | None:
        """Return how the mask's outline errs, as a view's shows it; None for a mask that is
        computed and explained, and where too little is seen."""
        if self.kind.exact and self.kind.explains(view.touched_misfit, False):
            return None
        if self._errors is None or self._errors[0] is not view:
            weight = np.asarray(view.pixels.weight)
            scale = float(np.median(weight[weight > 0])) if np.any(weight > 0) else 1.0
            noise = max(self.kind.variance, view.touched_misfit) / scale
            noise = float(np.clip(noise, LEAST_VARIANCE, ONE_BIT))  # more is no noise of pixels
            found = outline_errors(view, self._target, self._weights, noise, self.kind.hard)
            self._errors = view, found
        return self._errors[1]

    def variance(self, view: View) -> float:
        """Return by what, times two, squares at two cameras differ for each standard error between
        them: a residual's variance, larger where neighbours err together."""
        variance, errors = max(self.kind.variance, view.touched_misfit), self.errors(view)
        if errors is None:
            return variance
        if is_drawn(errors):  # what lies beside the outline is of these errors, too
            return view.squares / errors.independent
        return variance * max(float(view.sums.touched) / errors.independent, 1.0)

    def show(self, scene: Scene) -> None:
        """Look at a scene whose vertices are elsewhere from now on; moves are taken as before."""
        self._shown(scene)
        self.problem = eqx.tree_at(lambda p: p.scene, self.problem, self._scene)

    def share(self, other: "Solver") -> None:
        """Look at the arrays of another one that was made of the same scene."""
        self._scene, self.mesh = other._scene, other.mesh
        self.problem = eqx.tree_at(lambda p: p.scene, self.problem, self._scene)

    def _shown(self, scene: Scene) -> np.ndarray:
        """Keep a scene; return its box."""
        self._scene = with_or_without_border(padded(astype(scene, self.dtype)))
        box = np.asarray(bounding_box(scene), float)
        self._corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(8, 3)
        return box

    def design(self, view: View) -> float:
        """Return how many times as large as of independent residuals the variance is that a mask's
        errors leave, in the mean of what it determines (a survey's design effect)."""
        errors, triangle = self.errors(view), np.asarray(view.triangle, float)
        if errors is None or not np.any(triangle):
            return 1.0
        inverse = np.linalg.pinv(triangle)
        spread = np.trace(inverse.T @ errors.gradient @ inverse) / np.linalg.matrix_rank(triangle)
        return errors.computed + float(spread) / max(view.touched_misfit, self.kind.least)

    def begin(self, unit: Camera, level: int) -> View:
        """Return the view at a camera while it is being worked out, for `look`: views of several
        solvers are worked out side by side."""
        self._widen(unit)
        return self._further(unit, self.levels[level], 0.0, 1, self.capacity)[-1]

    def look(self, unit: Camera, level: int, begun: View | None = None) -> View:
        """Return the view at a camera (that was `begun` there); capacities get half as much room
        again as it takes."""
        while True:
            view = self.begin(unit, level) if begun is None else begun
            begun = None
            room = more_room(self.capacity, view.load)
            if room == self.capacity:
                share = float(self.levels[level].scale) / len(self._target)
                weight = float(view.sums.weight) + share**2 * self._beside
                return view._replace(sums=view.sums._replace(weight=np.asarray(weight)))
            larger = size_of(room.pieces) > size_of(self.capacity.pieces)
            self.capacity = room
            if larger:
                self.weigh(self._weights, only_finest=self._only_finest)

    def hear(self, others: Others | None) -> None:
        """Count what other views know from now on, None: nothing. They weigh the prior, too."""
        self.walked, self._others = [], others
        known = others or no_others(self.names, self.dtype)
        self.problem = eqx.tree_at(lambda p: p.others, self.problem, known)

    def _weighs_prior(self) -> bool:
        return self._prior is not None and self._others is None

    def _believe(self, unit: Camera, level: int) -> None:
        if self._weighs_prior():
            self.believe(self.look(unit, level).touched_misfit)

    def believe(self, misfit: float) -> None:
        """Weigh the prior by the mean square that a touched pixel's residual errs by."""
        if self._prior is None:
            return
        noise = np.sqrt(max(misfit, np.finfo(self.dtype).eps ** 2))
        put = lambda prior: eqx.tree_at(lambda p: p.noise, prior, np.asarray(noise, self.dtype))
        self._prior = put(self._prior)
        self.problem = eqx.tree_at(lambda p: p.prior, self.problem, self._prior)

    def _widen(self, unit: Camera) -> None:
        """Look at the whole film from now on if a camera may show the scene beside the window."""
        if self.holds(unit):
            return
        H, W = self._target.shape
        self.window = Window(0, 0, W, H)
        self.weigh(self._weights, only_finest=self._only_finest)

    def holds(self, unit: Camera) -> bool:
        """Return whether a camera shows nothing of the scene beside the window, as far as a box
        about it tells."""
        H, W = self._target.shape
        if self.window == (0, 0, W, H):
            return True
        if unit.lens is not None and unit.lens.distortion is not None:
            return False
        x, y, z = on_film_plane(unit, self._corners).T
        shown = H * np.stack([x / z, y / z], axis=-1)
        return bool(np.all(z > 0) and self.window.holds(shown, W, H))

    def move(self, unit: Camera, level: int) -> Move:
        """Return where moves of a camera start, in the solver's units."""
        return move_of(unit, self.problem, self.levels[level], self.names)

    def step(self, unit: Camera, level: int, y: np.ndarray) -> Camera:
        """Return the camera moved by y (n,) in the solver's units."""
        about = self.problem.pivot, self.problem.radius, self.problem.bounds
        y = np.asarray(y, self.dtype)
        return _step(unit, about, self.levels[level].scale, y, self.names)

    def solve(
        self,
        unit: Camera,
        levels: Sequence[int],
        told: Callable[[Stop], None] | None = None,
        coarse_px: float = COARSE_PX,
        fine_px: float | None = None,
        steps: int | None = None,
        looks: bool = True,
    ) -> Found:
        """Return the camera found from level to level, and its view on the last of them.

        Steps of `coarse_px`, on the finest level of `fine_px` (None: of what the fit asks for), are
        negligible; at most so many `steps` are taken on a level. Without `looks` the view is
        differentiated by moves of where the last steps began.
        """
        most = min(steps or self.max_steps, self.max_steps)
        way, taken = [Stop(unit, self.levels[levels[0]], 0)], []
        self._widen(unit)
        while True:
            capacity, window, end = self.capacity, self.window, None
            for number in levels:
                self._believe(unit, number)
                level = self.levels[number]
                finest = number == self.finest
                tolerance = (fine_px or self.fine_px) if finest else coarse_px
                further, n, path, end = self._further(unit, level, tolerance, most, capacity)
                stop = Stop(further, level, int(n))
                stops = self._each_step(unit, number, stop, path) if self._record else [stop]
                way += stops
                if self._weighs_prior():
                    self.believe(end.touched_misfit)
                unit = further
                taken.append(stop.steps)
                if told is not None:
                    for passed in stops:
                        told(passed)
            # (What a descent saw last is differentiated by moves of where it began.)
            view = self.look(unit, levels[-1], None if looks else end)
            if (self.capacity, self.window) == (capacity, window):
                return Found(unit, view, tuple(taken), tuple(way), taken[-1] < most)
            # The view outgrew its buffers or window on the way: go on from there with larger ones.

    def glance(self, unit: Camera, number: int = -1) -> View:
        """Return the view on a level (the last), whose overlaps are resolved, in buffers as they
        are: NaN where these are too small."""
        self._widen(unit)
        return self._further(unit, self._resolved(number), 0.0, 1, self.capacity)[-1]

    def descended(self, unit: Camera, steps: int, number: int = -1) -> Found:
        """Return what some steps on a level (the last), whose overlaps are resolved, lead to, in
        buffers as they are: NaN where these do not suffice. It has no way, and its view is
        differentiated by moves of the beginning: what is to be reported is to be looked at."""
        self._widen(unit)
        px = FINE_PX[self.dtype] if number in (-1, self.finest) else COARSE_PX
        unit, n, _, view = self._further(unit, self._resolved(number), px, steps, self.capacity)
        return Found(unit, view, (int(n),), ended=int(n) < steps)

    def _resolved(self, number: int) -> Level:
        """Return a level on which pixels show the union's coverage, as on the finest: so it is not
        biased."""
        return self.levels[number]._replace(resolved=np.array(True))

    @collector_at_rest()
    def _further(self, unit: Camera, level: Level, px: float, steps: int, capacity: Capacity):
        """Return `descended`'s from a camera: one program, whether it takes steps or only looks."""
        ends = np.asarray(px, self.dtype), np.asarray(steps, np.int32)
        given = unit, self.problem, level, *ends, self.names, capacity
        return programs.call(DESCENDED, given, lambda: like_descended(unit, level))

    def _each_step(self, unit: Camera, level: int, end: Stop, path: Array) -> list[Stop]:
        """Return where each step of a level ended; those past `RECORDED` together."""
        before = np.asarray(path)[: max(end.steps - 1, 0)]
        each = [Stop(self.step(unit, level, y), end.level, 1) for y in before]
        return [*each, end._replace(steps=end.steps - len(each))]


def on_film_plane(unit: Camera, points: np.ndarray) -> np.ndarray:
    """Return homogeneous film points (n, 3) of a canonical camera, in film heights."""
    seen = (points - np.asarray(unit.e, float)) @ axes_of(unit).T
    focal = 0.5 / np.tan(float(unit.phi) / 2)
    if unit.lens is None:
        aspect, centre = 1.0, np.array([unit.W / 2 / unit.H, 0.5])
    else:
        aspect, centre = float(unit.lens.aspect), np.asarray(unit.lens.principal_point, float)
    scale = np.array([focal * aspect, focal])
    return np.column_stack([seen[:, :2] * scale + centre * seen[:, 2:], seen[:, 2]])


@eqx.filter_jit
def _step(unit: Camera, about: tuple[Any, Any, Bounds | None], scale: Any, y: Any, names) -> Camera:
    """Return the camera moved by y in the solver's units, about a pivot with a radius."""
    return moved(move_about(unit, *about, scale, names), y, names)


def _mesh_of(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return a scene's vertices (V, 3) and faces (F, 3), none where there is no mesh."""
    if scene.mesh is None:
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    return np.asarray(scene.mesh.vertices), np.asarray(scene.mesh.faces)
