"""A fit of one scene to one mask: what is asked, and steps and looks, level by level."""

from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._camera.camera import Camera
from .._mask.edges import Weights
from .._mask.kinds import Kind
from .._mask.mask import Mask
from .._mask.pyramid import LEAST_CELLS, Level
from .._mask.target import Window, object_window
from .._numerics.threads import in_threads, some_at_once
from .._scene.alike import Revolution
from .._scene.scene import Ball
from .looks import Origin, View, size_of_looks
from .moves import Bounds, moved, reported
from .priors import Prior, no_prior
from .problem import COARSE_PX, FINE_PX, SETTLED, Problem, move_about
from .store import Levels, Store
from .subject import Subject

#: A step that is negligible (px) where a fit goes on to fewer pixels: half as many steps as to
#: float32's resolution, and squares within a hundred thousandth.
CONTINUED_PX = 5e-3
#: Where there are finer levels, a fit looks for what is far away on this one, where the object has
#: 128 to 256 px. A residual tells of an outline that is a pixel away at most: of 12 degrees ten
#: steps took 10 to 12 back on this level, 1.5 on one where the object had 1500 px.
FAR_LEVEL = 3
#: What a residual errs by, as a prior is weighed against it, before any was looked at.
UNSEEN_NOISE = 0.1


class Stop(NamedTuple):
    """Where steps on a level ended: the camera (canonical), the level, their number."""

    camera: Camera
    level: Level
    steps: int


class Solution(NamedTuple):
    """A camera (canonical), what is seen there, the steps taken on each level; the way there, from
    the start (0 steps) on, by levels or (a solver that records) by steps; whether the last steps
    ended by themselves, not at a limit."""

    camera: Camera
    view: View
    steps: tuple[int, ...]
    way: tuple[Stop, ...] = ()
    ended: bool = False


def onward(before: Solution, after: Solution) -> Solution:
    """The end of a further descent, with the steps of both."""
    steps, way = before.steps + after.steps, before.way + after.way[1:]
    return after._replace(steps=steps, way=way)


@dataclass(frozen=True, eq=False)
class Solver:
    """One subject, one mask, and what is asked of them.

    A value: with other weights, another scene or other views' knowledge it is another solver. What
    it keeps of its mask is in its `store`, which they share.

    - `target`: the mask (H, W); `weights`: how much its pixels count; `kind`: its kind.
    - `freed`: what is free; `bounds` and `prior`: what is known of it, or what other views know.
    - `max_steps`: the most steps on a level; `fine_px`: what step is negligible on the finest.
    - `record`: whether the way is to hold each step.
    - `only_finest`: whether there is but one level, the finest.
    - `motions`: velocities of vertices, by which looks alone are differentiated, too.
    - `walked`: walks all round a line: from there another need not be taken.
    """

    subject: Subject
    target: np.ndarray
    weights: Weights
    kind: Kind
    freed: tuple[str, ...]
    max_steps: int
    fine_px: float
    store: Store
    bounds: Bounds | None = None
    prior: Prior | None = None
    record: bool = False
    only_finest: bool = False
    motions: tuple[Array, ...] = ()
    walked: list[tuple[Camera, Revolution, list[Solution]]] = field(
        default_factory=list, init=False
    )

    @classmethod
    def on(
        cls,
        subject: Subject,
        mask: Mask,
        freed: tuple[str, ...],
        max_steps: int,
        bounds: Bounds | None = None,
        prior: Prior | None = None,
        record: bool = False,
        continued: bool = False,
        cells: int = LEAST_CELLS,
    ) -> "Solver":
        """The solver of a subject and a mask, whose pyramids hold `cells` at least. A fit that is
        `continued` on fewer pixels moves by more then, unless the mask is exact."""
        rough = continued and not mask.kind.exact
        given = subject, mask.target, mask.weight, mask.kind, freed, max_steps
        px = CONTINUED_PX if rough else FINE_PX[subject.dtype]
        store = Store(object_window(mask.target), cells)
        return cls(*given, px, store, bounds, prior, record=record)

    def weighed(
        self, weights: Weights, target: np.ndarray | None = None, only_finest: bool = False
    ) -> "Solver":
        """Return the solver to which pixels count otherwise, and of another mask if one is given;
        of the finest level alone, if that is all that is asked for."""
        target = self.target if target is None else target
        return replace(self, weights=weights, target=target, only_finest=only_finest)

    def beside_motions(self, velocities: Iterable[np.ndarray]) -> "Solver":
        """Return the solver whose looks are differentiated by vertices' velocities (v, 3), too."""
        mesh = self.subject.scene.mesh
        assert mesh is not None
        room = lambda v: np.pad(v, ((0, len(mesh.vertices) - len(v)), (0, 0)))
        motions = (jnp.asarray(room(v), self.dtype) for v in velocities)
        return replace(self, motions=tuple(motions))

    @property
    def dtype(self) -> np.dtype:
        """Return the float type that a fit works in."""
        return self.subject.dtype

    @property
    def _levels(self) -> Levels:
        asked = self.kind.explained, self.only_finest, self.dtype
        return self.store.levels(self.target, self.weights, *asked)

    @property
    def levels(self) -> list[Level]:
        """Return the mask's levels, from coarse to fine."""
        return self._levels.each

    @property
    def finest(self) -> int:
        """Return the number of the finest level."""
        return len(self.levels) - 1

    @property
    def far(self) -> int:
        """Return the number of the level on which what is far away is looked for: the finest where
        a prior or other views count, whose residuals are weighed against that level's."""
        return min(FAR_LEVEL, self.finest) if self.prior is None else self.finest

    @property
    def problem(self) -> Problem:
        """The problem that the fit's programs solve, beside a camera and a level."""
        return self._problem(self._levels)

    def _problem(self, levels: Levels) -> Problem:
        known = self.prior or no_prior(self.freed, self.dtype)
        if known.in_sigmas:
            noise = UNSEEN_NOISE if self.store.noise is None else self.store.noise
            known = known.times(np.asarray(noise, self.dtype))
        about = self.subject.scene, levels.pyramid, self.subject.pivot
        return Problem(*about, self.bounds, known, self.motions)

    @property
    def counted(self) -> int:
        """The number of the finest level's pixels that have weight."""
        return self._levels.counted

    def look(self, camera: Camera, level: int = -1) -> View:
        """The view at a camera, on a level (the last)."""
        self._widen(camera)
        view = self._further(camera, level, 0.0, 1)[-1]
        share = float(self.levels[level].scale) / len(self.target)
        weight = float(view.sums.weight) + share**2 * self._levels.beside
        return replace(view, sums=view.sums._replace(weight=np.asarray(weight)))

    def outline(self, camera: Camera, level: int = -1) -> Origin:
        """What of a look tells the pixels that the outline touches, on a level (the last)."""
        self._widen(camera)
        levels = self._levels
        size = size_of_looks(levels.each)
        return Origin(camera, self._problem(levels), levels.each[level], self.freed, size)

    def looks(self, cameras: Sequence[Camera], level: int = -1) -> list[View]:
        """The view at each camera, as many at once as there are cores."""
        look = lambda camera: self.look(camera, level)
        return in_threads(look, cameras, lambda camera: self.program(camera, level))

    def known(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """How many standard deviations a prior's parameters are off (k,), and by moves (k, n)."""
        assert self.prior is not None
        off = self.prior.residuals(reported(camera, camera, self.freed))
        to_reported = self.look(camera, self.finest).to_reported
        return np.asarray(off, float), np.asarray(self.prior.rows, float) @ to_reported

    @property
    def weighs_prior(self) -> bool:
        """True if a prior is weighed against the mask."""
        return self.prior is not None and self.prior.in_sigmas

    def _heed(self, misfit: float) -> None:
        """Weigh a prior by the mean square that a touched pixel's residual errs by, from now on."""
        self.store.noise = np.sqrt(max(misfit, np.finfo(self.dtype).eps ** 2))

    def _widen(self, camera: Camera) -> None:
        """Look at the whole film from now on if a camera may show the scene beside the window."""
        if not self.holds(camera):
            H, W = self.target.shape
            self.store.window = Window(0, 0, W, H)

    def holds(self, camera: Camera) -> bool:
        """True if a camera shows nothing of the scene outside the window, as far as a box
        about it tells."""
        H, W = self.target.shape
        return self.subject.within(self.store.window, camera, W, H)

    def step(self, camera: Camera, level: int, y: np.ndarray) -> Camera:
        """Return the camera moved by y (n,) in the solver's units."""
        about = self.subject.pivot, self.bounds, self.levels[level].scale, self.freed
        return _stepped(np.asarray(y, self.dtype), camera, *about)

    def solve(
        self,
        camera: Camera,
        levels: Sequence[int],
        on_stop: Callable[[Stop], None] = lambda stop: None,
        coarse_px: float = COARSE_PX,
        fine_px: float | None = None,
        steps: int | None = None,
    ) -> Solution:
        """Return the camera found from level to level, and its view on the last of them.

        Steps of `coarse_px`, on the finest level of `fine_px` (None: the fit's own limit), are
        negligible; at most this many `steps` are taken on a level.
        """
        most = min(steps or self.max_steps, self.max_steps)
        way, taken = [Stop(camera, self.levels[levels[0]], 0)], []
        self._widen(camera)
        while True:
            window = self.store.window
            for number in levels:
                if self.weighs_prior:
                    self._heed(self.look(camera, number).touched_misfit)
                level = self.levels[number]
                finest = number == self.finest
                tolerance = (fine_px or self.fine_px) if finest else coarse_px
                n, path, end = self._further(camera, number, tolerance, most)
                # (Steps past `RECORDED` are told together.)
                each = path[max(len(path) - n, 0) : -1] if self.record else ()
                stops = [Stop(self.step(camera, number, y), level, 1) for y in each]
                stops.append(Stop(end.camera, level, n - len(each)))
                way += stops
                if self.weighs_prior:
                    self._heed(end.touched_misfit)
                camera = end.camera
                taken.append(n)
                for stop in stops:
                    on_stop(stop)
            # (What a descent saw last is differentiated by moves of where it began.)
            view = self.look(camera, levels[-1])
            if self.store.window == window:
                return Solution(camera, view, tuple(taken), tuple(way), taken[-1] < most)
            # The view outgrew its window on the way: go on from there with a larger one.

    def solve_each(
        self,
        cameras: Iterable[Camera],
        levels: Sequence[int],
        on_stop: Callable[[Stop], None] = lambda stop: None,
        coarse_px: float = COARSE_PX,
        fine_px: float | None = None,
        steps: int | None = None,
    ) -> list[Solution]:
        """The solutions from each camera, as `solve` finds them; as many at once as cores."""
        limits = coarse_px, fine_px, steps
        if self.weighs_prior:  # (What one look leaves weighs it at the next.)
            return [self.solve(camera, levels, on_stop, *limits) for camera in cameras]
        cameras = [*cameras]
        for camera in cameras:
            self._widen(camera)
        # (Programs are of levels, which the copies of the store then have in common.)
        programs = [tuple(self.program(camera, k) for k in levels) for camera in cameras]
        own = [replace(self, store=replace(self.store)) for _ in cameras]
        run = lambda x: x[0].solve(x[1], levels, lambda stop: None, *limits)
        found = in_threads(run, [*zip(own, cameras, programs, strict=True)], lambda x: x[2])
        for solver in own:
            self.store.widen(solver.store)
        for stop in (stop for f in found for stop in f.way[1:]):
            on_stop(stop)
        return found

    def continued(
        self,
        found: Sequence[Solution],
        levels: Sequence[int],
        on_stop: Callable[[Stop], None] = lambda stop: None,
        fine_px: float | None = None,
    ) -> list[Solution]:
        """The solutions after further descents from their ends."""
        ends = self.solve_each((f.camera for f in found), levels, on_stop, fine_px=fine_px)
        return [onward(*pair) for pair in zip(found, ends, strict=True)]

    def descents(
        self, cameras: Iterable[Camera], steps: int, number: int = -1
    ) -> Iterator[Solution]:
        """Yield the solution that `steps` steps on a level (-1: the last) reach from each start.

        Cores work in parallel, ahead of the caller. Solutions have no `way`, and their views are
        differentiated by moves of the start: look again before you report one.
        """
        px = FINE_PX[self.dtype] if number in (-1, self.finest) else COARSE_PX
        for some in some_at_once(cameras):
            for camera in some:
                self._widen(camera)
            further = lambda camera: self._further(camera, number, px, steps)
            ends = in_threads(further, some, lambda camera: self.program(camera, number))
            for n, _, view in ends:
                yield Solution(view.camera, view, (n,), ended=n < steps)

    def program(self, camera: Camera, level: int) -> Hashable:
        """A key of the compiled program that looks at a camera."""
        leaves, tree = jax.tree.flatten(self._given(camera, level, 0.0, 1))
        return tree, *((x.shape, x.dtype) if hasattr(x, "shape") else x for x in leaves)

    def _given(self, camera: Camera, number: int, px: float, steps: int) -> tuple[Any, ...]:
        """What the fit's program is given. (Levels are read once: another thread may widen the
        window.)"""
        levels = self._levels
        settled = 0.0 if self.kind.exact else SETTLED
        ends = *np.asarray([px, settled], self.dtype), np.asarray(steps, np.int32)
        problem, level = self._problem(levels), levels.each[number]
        return camera, problem, level, *ends, self.freed, size_of_looks(levels.each)

    def _further(self, camera: Camera, number: int, px: float, steps: int):
        """Steps taken, path and last view from a camera. (The program is the same for a single
        look.)"""
        # (optimistix takes a third of this package's import.)
        from .levenberg_marquardt import descended

        given = self._given(camera, number, px, steps)
        n, path, look = descended(*given)
        _, problem, level, *_, size = given
        origin = Origin(look.camera, problem, level, self.freed, size)
        return int(n), np.asarray(path), View.from_look(look, origin)


@partial(jax.jit, static_argnames="freed")
def _stepped(
    y: Any, camera: Camera, ball: Ball, bounds: Bounds | None, scale: Any, freed: tuple[str, ...]
) -> Camera:
    return moved(move_about(camera, ball, bounds, scale, freed), y, freed)
