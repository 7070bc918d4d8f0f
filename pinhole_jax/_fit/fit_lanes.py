"""`fit_lanes`: many masks of one object, or of several, each from a start, side by side."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._camera.camera import Camera, check_camera
from .._mask.mask import Mask
from .._mask.pyramid import PAGE, Level, pyramid
from .._mask.target import check_target, inside_of, levelled, object_window
from .._numerics.arrays import ArrayLike, Input
from .._scene.scene import Scene, astype, ball_about, bounding_box, check_scene, filled_alike
from .._solver.buffers import explained_by
from .._solver.capacity import contours, diagonal_of
from .._solver.kinds import kind_of
from .._solver.lanes import Given, Lane, Rig, descended, looked
from .._solver.moves import canonical
from .._solver.parameters import check_free, in_one, with_lens
from .._solver.priors import no_others
from .._solver.problem import COARSE_PX, View
from .._solver.residuals import Capacity
from .._solver.solver import Found, Stop, last_px
from .fit_camera import Settings, check_border, check_reach, check_steps, fit_camera, fit_descended
from .result import Fit
from .strategy import POOR

#: Lanes of a program: few sizes, since each is compiled.
BUCKETS = (1, 4, 16, 64, 256, 1024, 4096)
#: Lanes at a time at most: on a CPU more wait for one another, and are no faster. (Of 64 lanes,
#: masks of 64 px: 20 ms of the processor each in steps of 16, 35 ms in steps of 64.)
TOGETHER = {"cpu": 16}
#: Buffers of a lane are one of few sizes, from these on, each twice as large, and its pyramid's
#: cells.
LEAST_EDGES, LEAST_PIECES, LEAST_CELLS = 64, 128, 1 << 12


class Lanes(NamedTuple):
    """The result of `fit_lanes`.

    - `fits`: a `Fit` for each mask, as `fit_camera` gives it.
    - `alone`: for each mask why it was fitted alone once more, "" where it was not.

    ```python
    lanes.fits[0].status, lanes.alone
    ```
    """

    fits: tuple[Fit, ...]
    alone: tuple[str, ...]


@dataclass
class _OfMask:
    """A lane on the host: its scene, mask and start; its pyramid, and how its mask is explained;
    where it is, and where each level ended; why it is to go alone."""

    scene: Scene
    mask: Mask
    start: Camera
    weight: Any
    target: Any
    levels: list[Level] = field(default_factory=list)
    pyramid: Any = None
    fine_px: float = 0.0
    camera: Any = None
    before: Any = None
    view: Any = None
    stops: list[Stop] = field(default_factory=list)
    ended: bool = False
    alone: str = ""


def fit_lanes(
    scene: Scene | Sequence[Scene],
    targets: Input[Sequence[ArrayLike] | np.ndarray | Array, "N H W"],
    cameras: Camera | Sequence[Camera],
    free: str | Sequence[str] = ("pose",),
    *,
    weights: Input[Sequence[ArrayLike | None] | np.ndarray | Array | None, "N H W"] = None,
    outlier_px: float | None = 2.0,
    max_steps: int = 64,
) -> Lanes:
    """Return a `Fit` for each mask, those of `fit_camera`, by descents that go side by side.

    - `scene`: one for all masks, or one for each. Several are filled up to the largest one's size:
      all with a mesh or none, and as many spheres.
    - `targets`: masks (N, H, W), or in a list; their sizes may differ.
    - `cameras`: where to start: one for each mask in a list, or a `Camera` whose arrays have a
      leading axis N. What is `free` is each one's own.
    - `weights`: for each mask, or None.
    - `free`, `outlier_px`, `max_steps`: as in `fit_camera`.

    The way from the start down the levels, which is most of a fit, is a program of fixed shapes
    under `vmap`: some steps of a level for all lanes, then those that are done are dropped. What
    ends there is handed to `fit_camera`'s own questions (is the mask explained, what is as good,
    what is not determined; for masks that are not exact its steps near the mask's edge): no camera
    is given that `fit_camera` would not give. A lane whose start hardly overlaps its mask, whose
    view outgrows its buffers or window, or which does not come to rest, goes through `fit_camera`
    alone, from its start: `Lanes.alone` says why.

    Made for accelerators, where a step of a thousand lanes takes little longer than one of a few.
    On a CPU a lane takes as long as a fit alone: there
    `pinhole_jax.fit_many` is faster, which has all cores.

    Raises ValueError for arguments that make no fits; what the solver met is in each `Fit.status`.

    ```python
    lanes = pj.fit_lanes(scene, masks[:1], [start])
    ```
    """
    check_steps(max_steps)
    check_reach(outlier_px)
    starts = _listed(cameras)
    count = len(starts)
    scenes = [scene] * count if isinstance(scene, Scene) else [*scene]
    weights = [None] * count if weights is None else weights
    for name, given in (("targets", targets), ("scene", scenes), ("weights", weights)):
        if not hasattr(given, "__len__") or len(given) != count:
            number = len(given) if hasattr(given, "__len__") else type(given).__name__
            raise ValueError(f"`{name}`: expected one for each of {count} cameras, got {number}")
    for one in {id(s): s for s in scenes}.values():
        check_scene(one)
    freed = in_one(check_free(free, starts[0]))
    settings = Settings(outlier_px, max_steps)

    lanes = []
    inputs = zip(scenes, targets, starts, weights, strict=True)
    for number, (one, target, start, weight) in enumerate(inputs):
        base = with_lens(start, freed)
        with_number = lambda error, k=number: ValueError(f"mask {k}: {error}")
        try:
            image, weighed = check_target(target, weight, base.W, base.H)
            check_border(image, weighed, one, start)
        except ValueError as error:
            raise with_number(error) from None
        mask = Mask(levelled(image, weighed), weighed, base)
        lanes.append(_OfMask(one, mask, start, weight, target))
    rigs, capacity = _rigs(scenes, starts[0].e.dtype), _room(lanes)
    cells = _cells(lanes)
    fits, alone = [], []
    most = TOGETHER.get(jax.default_backend(), BUCKETS[-1])
    while lanes:
        some, lanes = lanes[:most], lanes[most:]  # (what is done with lets its views go)
        room = cells, capacity, isinstance(scene, Scene)
        descend(some, rigs, freed, settings, *room)
        fits += [_finished(lane, freed, settings) for lane in some]
        alone += [lane.alone for lane in some]
    return Lanes(tuple(fits), tuple(alone))


def descend(
    lanes: list[_OfMask],
    rigs: dict[int, Rig],
    freed: tuple[str, ...],
    settings: Settings,
    cells: int,
    capacity: Capacity,
    shared: bool,
) -> None:
    """Bring lanes down their levels, and look at where they end."""
    for lane in lanes:
        _prepare(lane, settings, cells)
    _Descent(lanes, rigs, freed, settings.max_steps, capacity, shared).run()


def _listed(cameras: Any) -> list[Camera]:
    """Return the cameras to start from, in a list."""
    if isinstance(cameras, Camera):
        leaves = jax.tree.leaves(cameras)
        if np.ndim(cameras.e) != 2 or any(len(np.atleast_1d(x)) != len(cameras.e) for x in leaves):
            shape = np.shape(cameras.e)
            raise ValueError(
                "`cameras`: expected a list, or a Camera whose arrays have a leading axis (N, ...),"
                f" got one whose e has shape {shape}"
            )
        host = jax.tree.map(np.asarray, cameras)
        cameras = [jax.tree.map(lambda x, k=k: x[k], host) for k in range(len(host.e))]
    if not isinstance(cameras, Sequence):
        raise ValueError(f"`cameras`: expected cameras in a list, got {type(cameras).__name__}")
    if not cameras:
        raise ValueError("`cameras`: expected at least one, got none")
    for camera in cameras:
        check_camera(camera, "cameras")
    kinds = {(jax.tree.structure(c.replace(W=1, H=1)), c.e.dtype) for c in cameras}
    if len(kinds) > 1:
        raise ValueError("`cameras`: expected lenses and float types that are alike")
    return [*cameras]


def _finished(lane: _OfMask, freed: tuple[str, ...], settings: Settings) -> Fit:
    """Return the fit that a lane's descent leads to; from its start, if it cannot be trusted."""
    if not lane.alone:
        steps = tuple(stop.steps for stop in lane.stops[1:])
        found = Found(lane.camera, lane.view, steps, tuple(lane.stops), lane.ended)
        way = lane.stops[0].camera, lane.before, found
        fit = fit_descended(lane.scene, lane.mask, freed, settings, *way)
        if fit is not None and fit.status not in ("max_steps", "non_finite"):
            return fit
        lane.alone = "the descent did not come to rest, left the window, or led to nothing better"
    return fit_camera(
        lane.scene,
        lane.target,
        lane.start,
        freed,
        weight=lane.weight,
        outlier_px=settings.outlier_px,
        max_steps=settings.max_steps,
    )


def _rigs(scenes: list[Scene], dtype: Any) -> dict[int, Rig]:
    """Return the rigs of scenes (by their identity), all of one size."""
    different = list({id(scene): scene for scene in scenes}.values())
    filled = filled_alike([astype(scene, dtype) for scene in different])
    rigs = {}
    for scene, alike in zip(different, filled, strict=True):
        ball = ball_about(np.asarray(bounding_box(scene), float))
        where: Any = [np.asarray(x, dtype) for x in ball]
        rigs[id(scene)] = Rig(alike, *where)
    return rigs


def _prepare(lane: _OfMask, settings: Settings, cells: int) -> None:
    """Work out a lane's levels, as a fit alone does."""
    target, weights, dtype = lane.mask.target, lane.mask.weight, lane.mask.camera.e.dtype
    window = object_window(target)
    kind = kind_of(window.of(target), window.of(weights), dtype)
    lane.fine_px = last_px(kind, dtype, settings.outlier_px is not None)
    lane.pyramid, levels = pyramid(target, weights, dtype, window=window, least=cells)
    lane.levels = explained_by(kind, levels, dtype)
    lane.camera = jax.tree.map(np.asarray, canonical(lane.mask.camera))


def _cells(lanes: list[_OfMask]) -> int:
    """Return room for any mask's pyramid: it depends on their size alone, so that all lanes share
    programs."""
    H, W = np.max([lane.mask.target.shape for lane in lanes], axis=0).tolist()
    cells = 0
    while H > 1 and W > 1:
        cells += H * (W + 2) + 1 + PAGE
        H, W = -(-H // 2), -(-W // 2)
    return _grown(LEAST_CELLS, cells)


def _grown(least: int, need: int) -> int:
    """Return the first of sizes that double that is no less than needed; 1 for nothing."""
    return least << max(-(-need // least) - 1, 0).bit_length() if need else 1


def _room(lanes: list[_OfMask]) -> Capacity:
    """Return buffers for all lanes' views."""
    edges = pieces = arcs = 0
    spheres = lanes[0].scene.spheres
    for lane in lanes:
        mesh, extent = lane.scene.mesh, diagonal_of(inside_of(lane.mask.target))
        if mesh is not None and mesh.edge_faces.shape[0]:
            number, length = contours(mesh)
            edges = max(edges, int(1.5 * np.max(number)))
            pieces = max(pieces, int(1.25 * np.max(number + length * extent)))
        if spheres is not None:
            arcs = max(arcs, int(4 * extent) + 8 * len(spheres.radii))
    arc = _grown(LEAST_PIECES, arcs)
    return Capacity(_grown(LEAST_EDGES, edges), _grown(LEAST_PIECES, pieces), arc, arc)


class _Descent:
    """Some lanes on their way down."""

    def __init__(self, lanes, rigs, freed, max_steps: int, capacity: Capacity, shared: bool):
        self.lanes, self.freed, self.capacity = lanes, freed, capacity
        self.max_steps: Any = np.int32(max_steps)
        self.dtype = lanes[0].start.e.dtype
        self.shared = shared
        if shared:
            self.rig = rigs[id(lanes[0].scene)]
        else:
            self.rig = jax.device_put(_stacked([rigs[id(lane.scene)] for lane in lanes]))
        # (What a pyramid does not fill is not looked at.)
        self.pyramid = jax.device_put(jax.tree.map(_filled_together, *(x.pyramid for x in lanes)))

    def run(self) -> None:
        """Bring all lanes to the end of their finest level."""
        self._look("before")
        for lane in self.lanes:
            sums = lane.before.sums
            if not _fits(lane.before, self.capacity):
                lane.alone = "the start's view outgrows the buffers"
            elif float(sums.overlap) <= POOR * float(sums.union):
                lane.alone = "the start hardly overlaps the mask"
            lane.stops = [Stop(lane.camera, lane.levels[0], 0)]
        for depth in range(max(len(lane.levels) for lane in self.lanes), 0, -1):
            going = [lane for lane in self._going() if len(lane.levels) >= depth]
            if going:
                self._level(going, depth)
        self._look("view")
        for lane in self._going():
            if not _fits(lane.view, self.capacity):
                lane.alone = "the view outgrows the buffers"

    def _going(self) -> list[_OfMask]:
        return [lane for lane in self.lanes if not lane.alone]

    def _level(self, going: list[_OfMask], depth: int) -> None:
        """Bring lanes to the end of a level: some steps, then those that are done are dropped."""
        zero: Any = self.dtype.type(1), np.int32(0), np.False_, np.False_
        states = {id(lane): Lane(lane.camera, *zero) for lane in going}
        todo = going
        while todo:
            for state, lane in zip(self._steps(todo, states, depth), todo, strict=True):
                states[id(lane)] = state
            todo = [lane for lane in todo if not states[id(lane)].done]
        for lane in going:
            state = states[id(lane)]
            lane.camera, lane.ended = state.camera, bool(state.steps < self.max_steps)
            lane.stops.append(Stop(lane.camera, lane.levels[-depth], int(state.steps)))
            if state.overflow:
                lane.alone = "a view on the way outgrows the buffers"

    def _steps(self, todo: list[_OfMask], states: dict[int, Lane], depth: int) -> Iterator[Lane]:
        """Yield the lanes' states after some steps."""
        some = self._filled_up(todo)
        px: Any = [lane.fine_px if depth == 1 else COARSE_PX for lane in some]
        state = _stacked([states[id(lane)] for lane in some])
        given = self._given(some), _stacked([x.levels[-depth] for x in some])
        px = np.asarray(px, self.dtype)
        found: Any = descended(state, *given, px, self.max_steps, self.freed, self.capacity)
        return _unstacked(found, len(todo))

    def _look(self, name: str) -> None:
        """Look at the finest level from where each lane is."""
        going = self._going()
        if not going:
            return
        some = self._filled_up(going)
        given = self._given(some), _stacked([x.levels[-1] for x in some])
        cameras = _stacked([lane.camera for lane in some])
        views = looked(cameras, *given, self.freed, self.capacity)
        for lane, view in zip(going, _unstacked(views, len(going)), strict=True):
            setattr(lane, name, view)

    def _filled_up(self, lanes: list[_OfMask]) -> list[_OfMask]:
        """Return lanes, the first again and again up to one of few numbers."""
        size = next(size for size in BUCKETS if size >= len(lanes))
        return [*lanes, *lanes[:1] * (size - len(lanes))]

    def _given(self, some: list[_OfMask]) -> Given:
        """Return what some of the lanes fit."""
        number = {id(lane): k for k, lane in enumerate(self.lanes)}
        index = np.array([number[id(lane)] for lane in some])
        of = lambda tree: jax.tree.map(lambda x: jnp.take(x, index, axis=0), tree)
        rig = self.rig if self.shared else of(self.rig)
        others = no_others(self.freed, self.dtype)
        return Given(rig, of(self.pyramid), others, self.shared)


def _fits(view: View, capacity: Capacity) -> bool:
    return all(int(need) <= room for need, room in zip(view.load, capacity, strict=True))


def _filled_together(*rows: np.ndarray) -> np.ndarray:
    """Return rows (n,) as one array (N, most), with 0 after those that are shorter."""
    result = np.zeros((len(rows), max(map(len, rows))), rows[0].dtype)
    for row, values in zip(result, rows, strict=True):
        row[: len(values)] = values
    return result


def _stacked(trees: list[Any]) -> Any:
    """Return trees of arrays as one, along a first axis."""
    return jax.tree.map(lambda *x: np.stack([np.asarray(a) for a in x]), *trees)


def _unstacked(tree: Any, count: int) -> Iterator[Any]:
    """Yield the first of the trees that are along the first axis of one's arrays."""
    host = jax.tree.map(np.asarray, tree)
    leaves, structure = jax.tree.flatten(host)
    for k in range(count):
        yield jax.tree.unflatten(structure, [x[k] for x in leaves])
