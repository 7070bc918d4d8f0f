"""The result of a fit as a user reads it: what all have in common, and `Fit`."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from .._camera.axes import axes_of
from .._camera.camera import Camera
from .._mask.kinds import Kind
from .._numerics.arrays import ArrayLike, Input, check_kind, is_concrete
from .._outline.outline_errors import OutlineErrors, is_drawn
from .._outline.stretches import quantised
from .._rules import RULES
from .._solver.looks import Sums, View
from .._solver.moves import Bounds, displaced, on_film
from .._solver.parameters import LABELS, PARAMETERS, components, labels_of
from .._solver.problem import COSINE, FINE_PX, UNIT_PX
from .._solver.solver import Solution, Stop
from .._solver.uncertainty import (
    BLIND,
    covariance,
    in_words,
    moves_in_words,
    weak_directions,
    weak_moves,
)
from .places import Free
from .words import STATUSES, ParameterTable, accuracy, parameter_lines, parameter_table

#: Rounding leaves a root mean square residual of this many machine epsilons in a touched pixel.
FLOOR = 1000
#: A solver's last step is off by this share of the step that it calls negligible.
LAST_STEP = 0.2
WRONG = "there the mask, the mesh or the camera is wrong"
#: A move that hardly shows is no weakness where it is known to this many px (one sigma).
KNOWN_PX = 0.01


AnyRecord = TypeVar("AnyRecord", bound="Record")
AnyFit = TypeVar("AnyFit", bound="Result")


class MaskError(NamedTuple):
    """How a mask's outline errs: its standard deviation (px), and over how many px of the outline
    it is correlated; both 0 where quantisation explains all."""

    px: float
    over_px: float

    @classmethod
    def from_outline(cls, errors: OutlineErrors | None) -> "MaskError | None":
        """The error of a mask's outline; None where it is exact, and explained."""
        return None if errors is None else cls(errors.size, errors.length)

    def __str__(self) -> str:
        """The error as a sentence."""
        if not self.px:
            return "quantisation alone"
        return f"{self.px:.1f} px, over some {self.over_px:.0f} px of the outline"


class Progress(NamedTuple):
    """How far a fit has come: the camera so far, the level in px, the steps since the last word.

    ```python
    says = lambda stop: print(stop)  # "96 x 80 pixels: 3 steps"
    fit = pj.fit_camera(scene, mask, start, progress=says)
    ```
    """

    camera: Camera
    W: int
    H: int
    steps: int

    def __str__(self) -> str:
        """Return it as a line."""
        return f"{self.W} x {self.H} pixels: {self.steps} step{'s' * (self.steps != 1)}"


def check_fit(fit: Any) -> None:
    """Raise ValueError unless this is a fit."""
    check_kind("fit", fit, Fit, "a Fit")


class Record(eqx.Module):
    """A part of a result; `_replace` makes one with other values, as a named tuple's does."""

    def _replace(self: AnyRecord, **changes: Any) -> AnyRecord:
        return replace(self, **changes)


class Measurement(Record):
    """Numbers whose errors are known by their `covariance` (n, n)."""

    covariance: eqx.AbstractVar[Float[np.ndarray, "n n"]]

    @property
    def std(self) -> Float[np.ndarray, "n"]:
        """Standard deviations (n,)."""
        return np.sqrt(np.diag(self.covariance))


class Result(Record):
    """What every fit returns: `status`, `weak` (sentences), and other answers (`modes`)."""

    status: eqx.AbstractVar[str]
    _: KW_ONLY
    weak: tuple[str, ...] = ()
    modes: tuple[Any, ...] = ()

    #: What a fit was made to.
    data: ClassVar[str] = "the mask"

    @property
    def notes(self) -> tuple[str, ...]:
        """What else there is to say, as sentences: `weak`, and how many `modes` there are.

        ```python
        print(*fit.notes, sep="\\n")
        ```
        """
        if not self.modes:
            return self.weak
        several = f"{len(self.modes)} other views fit"
        views = "another view fits" if len(self.modes) == 1 else several
        return (*self.weak, f"{views} {self.data} equally well")


class CameraResult(Result, Measurement):
    """A fitted `camera`, its parameters' `names`, their `covariance`, and the way to it."""

    camera: Camera
    status: str
    names: tuple[str, ...]
    covariance: Float[np.ndarray, "n n"]
    _: KW_ONLY
    history: tuple[Progress, ...] = ()

    #: What each status means.
    meanings: ClassVar[Mapping[str, str]] = {}

    @property
    def parameters(self) -> ParameterTable:
        """The fitted parameters for people: `rows` of `name`, `value`, `std`, `unit` and `words`,
        angles in degrees, the orientation as pitch, yaw and roll; and the rows' `covariance`.

        ```python
        [(row.name, row.value, row.std, row.unit) for row in fit.parameters.rows]
        ```
        """
        return parameter_table(self)

    def displaced(self, step: Input[ArrayLike, "n"]) -> Camera:
        """The camera with `names` changed by a small step, in the units of `std`.

        ```python
        step = np.random.default_rng(0).multivariate_normal(0 * fit.std, fit.covariance)
        fit.displaced(step)  # a camera as likely as this one
        ```
        """
        return displaced(self.camera, self.names, np.asarray(step, float))

    @property
    def _agreement(self) -> tuple[str, str, str]:
        """How well camera and data agree: a name, a value, and what else there is."""
        raise NotImplementedError

    def __str__(self) -> str:
        """The result as a table; in a line where it is traced."""
        if not is_concrete(*jax.tree.leaves(self.camera)):
            return repr(self)
        lines = [
            ("status", self.status, self.meanings.get(self.status, "")),
            ("accuracy", accuracy(self.names, self.covariance), ""),
            self._agreement,
            *(("note", words, "") for words in self.notes),
        ]
        shown = [
            f"{name:<11}{value}" + (f"   ({more})" if more else "")
            for name, value, more in lines
            if value
        ]
        return "\n".join([*parameter_lines(self.parameters), *shown])

    def __repr__(self) -> str:
        """The result in a line, its arrays and history left out."""
        what, (name, value, _) = type(self).__name__, self._agreement
        return f"<{what}: {self.status}, {name} {value}, {', '.join(self.names)}>"


class Fit(CameraResult):
    """The result of `fit_camera`.

    - `camera`: the fitted camera; it has the start's gauge (`|p-e|`, `|u|`, `u.v`).
    - `status`: one of `words.STATUSES`; trust the camera only where it is "converged".
    - `names`: the fitted parameters, in the order of `covariance` (n, n) and `std` (n,):
      small rotations of the camera about its own axes b1, b2, v (rad), the eye (world units), phi
      (rad), d (world units), the principal point (px).
    - `covariance` propagates the mask's errors; the mesh counts as exact. Masks that people or
      networks made err together along stretches of their outline, and all outwards or inwards: the
      outline shows by how much and how far (`mask_error`), and how likely it is that a mask has no
      such errors. Infinite where the mask does not determine a parameter, and an interval's where
      `weak` or a drawn mask's errors leave one. Never below what rounding, the mask's quantisation
      and the solver's last step leave.
    - `independent_covariance` assumes independent pixel noise of one size (of variance 1 / weight
      up to a factor), estimated from the residuals of the pixels that the outline touches. For an
      exact mask that the model matches, both are equal.
    - `rms`: root mean square of coverage minus target over all pixels that count, but for the few
      where contours overlap in an exact mask; `iou` their intersection over union.
    - `steps`: Levenberg-Marquardt steps on each level, coarse to fine; more than one round of
      levels where the view outgrew its buffers on the way.
    - `weak`: directions that the mask determines badly or not at all, as sentences; last, if so,
      how much of the outline is far from the mask's edge.
    - `mask_error`: how the mask's outline errs; None for an exact mask that the model matches.
    - `unbelieved`: points (px, film coordinates) of the mask's edge that the fit ignored, as
      something may be in front of the object; None if there are none. `weak` says which share of
      the edge they are. `rms` and `iou` count the whole mask.
    - `modes`: other cameras that fit the mask equally well, the best first.
    - `history`: the way to `camera`, from the start (0 steps) to the end of each level, or with
      `record` of each step.

    ```python
    dict(zip(fit.names, fit.std))
    ```
    """

    rms: float
    iou: float
    steps: tuple[int, ...]
    _: KW_ONLY
    modes: tuple["Fit", ...] = ()
    independent_covariance: Float[np.ndarray, "n n"] | None = None
    mask_error: MaskError | None = None
    unbelieved: Float[np.ndarray, "m 2"] | None = None

    meanings: ClassVar[Mapping[str, str]] = STATUSES

    @property
    def _agreement(self) -> tuple[str, str, str]:
        return "IoU", f"{self.iou:.4f}", f"rms of coverage {self.rms:.2g}"

    def _repr_html_(self) -> str | None:
        """The fit as notebooks show it: its table, and its camera in space."""
        from ..show.table import fit_card

        return fit_card(self) if is_concrete(*jax.tree.leaves(self.camera)) else None


def progress_at(stop: Stop, camera: Camera) -> Progress:
    """The progress of a fit at a stop, on the user's film."""
    shrunk = float(stop.level.scale) / camera.H
    W, H = (int(np.ceil(shrunk * x)) for x in (camera.W, camera.H))
    return Progress(on_film(stop.camera, camera), W, H, stop.steps)


class Context(NamedTuple):
    """What is known beside a view: the mask's kind, bounds, the directions found to be free, how
    the outline errs; where the likelihood gives it, the `covariance` (n, n) by moves; else the move
    that shows least, and its `shelf`; how the mask contradicts a prior, or what is not free."""

    kind: Kind
    bounds: Bounds | None = None
    free: Sequence[Free] = ()
    errors: OutlineErrors | None = None
    astray: float | None = None
    hidden: bool = False
    covariance: np.ndarray | None = None
    shelf: tuple[np.ndarray, float] | None = None
    contradictions: tuple[str, ...] = ()


def report(
    camera: Camera, found: Solution, over_all: Sums, freed: tuple[str, ...], context: Context
) -> Fit:
    """The fit that a user reads."""
    at, view, steps, way, _ = found
    fitted, dtype = on_film(at, camera), np.dtype(camera.e.dtype)
    triangle, ended = without_ended(view.triangle, at, freed, context.bounds)
    sums: Any = jax.tree.map(float, view.sums)
    whole: Any = jax.tree.map(float, over_all)
    labels, to_reported = labels_of(freed), to_units(view.to_reported, freed, camera)
    n = len(labels)
    if not (np.all(np.isfinite(triangle)) and np.isfinite(sums.squares)):
        known = {"names": labels, "covariance": np.full((n, n), np.nan), "steps": steps}
        return Fit(camera=fitted, status="non_finite", rms=np.nan, iou=np.nan, **known)
    rest = found.ended
    if context.covariance is None:
        rest = at_rest(triangle, view.along, sums.squares, sums.touched, dtype, found.ended)
    triangle = without_free(triangle, context.free)
    noise = max(sums.touched_squares / max(sums.touched - n, 1), context.kind.least)
    both = gradients(view, noise, context.kind, context.errors)
    if context.covariance is not None:
        normal = triangle.T @ triangle
        both = both[0], normal @ context.covariance @ normal
    independent, cov = (covariance(triangle, to_reported, g, BLIND[dtype]) for g in both)
    tolerance = LAST_STEP * FINE_PX[dtype] / UNIT_PX
    drawn = context.covariance is not None or is_drawn(context.errors)
    independent = independent + widened(to_reported, [] if drawn else context.free, tolerance)
    known_by = cov if drawn else np.zeros_like(cov)
    cov = cov + widened(to_reported, context.free, tolerance, known_by)
    cov = cov + _flatter(triangle, to_reported, both[1], context.shelf)
    names_of_moves = components(freed)
    # (How far a drawn mask's errors reach is in the covariance: no direction is free for that.)
    free = [f for f in context.free if not drawn or np.isinf(f.ahead)]
    moves = [f.move for f in free] + well_known(triangle, both[1])
    words = partial(moves_in_words, names_of_moves, axes_of(at))
    blind, weak = weak_directions(triangle, words, BLIND[dtype], moves)
    weak = (*map(str, free), *weak, *ended, *context.contradictions)
    open_turn = uncertain_rotation(cov, labels, at)
    nearly_free = bool(context.free or weak_moves(triangle, names_of_moves))
    astray = share_astray(sums, whole) if context.astray is None else context.astray
    explained = context.kind.explains(view.touched_misfit, nearly_free)
    weak += (*open_turn, *_disagreement(sums, astray, context.kind.exact and not explained))
    explained = astray <= RULES.astray and (explained or not context.kind.exact)
    explained = explained and not context.contradictions
    status = _status(triangle, rest, whole, context.hidden, explained, bool(blind or free))
    status = "uncertain" if status == "converged" and open_turn else status
    iou, rms = iou_and_rms([over_all])
    return Fit(
        camera=fitted,
        status=status,
        names=labels,
        covariance=cov,
        rms=rms,
        iou=iou,
        steps=steps,
        weak=weak,
        history=tuple(progress_at(stop, camera) for stop in way),
        independent_covariance=independent,
        mask_error=MaskError.from_outline(context.errors),
    )


def _flatter(
    triangle: np.ndarray,
    to_reported: np.ndarray,
    gradient: np.ndarray,
    shelf: tuple[np.ndarray, float] | None,
) -> np.ndarray | float:
    """What a covariance lacks along a shelf's move: nothing where most of the squares foretold are
    left."""
    if shelf is None or shelf[1] > RULES.foretold:
        return 0.0
    move, left = shelf
    shown = max(float(np.sum((triangle @ move) ** 2)), 1e-300)
    variance = (1 / left - 1) * float(move @ gradient @ move) / shown**2
    return variance * np.outer(to_reported @ move, to_reported @ move)


def _disagreement(sums: Any, astray: float, unexplained: bool) -> tuple[str, ...]:
    """Return sentences on how much of the outline the mask does not have, or has elsewhere."""
    off, words = sums.off / max(sums.touched, 1), []
    if unexplained:
        words.append(f"{off:.0%} of the outline is too far from the edge of a mask of this kind")
    if astray > (RULES.little if unexplained else RULES.astray):
        words.append(f"{astray:.0%} of the outline is far from the mask's edge: {WRONG}")
    return tuple(words)


def well_known(triangle: np.ndarray, gradient: np.ndarray) -> list[np.ndarray]:
    """Return the moves (n,) along which a camera is known to `KNOWN_PX`, however little they
    show."""
    _, values, directions = np.linalg.svd(triangle)
    spread = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", directions, gradient, directions), 0))
    return [*directions[spread * UNIT_PX < KNOWN_PX * values**2]]


def gradients(
    view: View, variance: float, kind: Kind, errors: OutlineErrors | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the covariance (n, n) of J^T r if residuals are independent, and as a mask of a kind
    errs."""
    triangle = view.triangle
    independent = variance * triangle.T @ triangle
    # What is not of this mask's pixels, as a prior, keeps its variance.
    beside = variance * view.known.T @ view.known
    share, computed = 1.0 if errors is None else errors.computed, independent
    if kind.hard and share:
        computed = variance * quantised(view) + beside
    if errors is None:
        return independent, computed
    return independent, share * computed + (1 - share) * beside + errors.gradient


def uncertain_rotation(
    covariance: np.ndarray,
    labels: tuple[str, ...],
    camera: Camera,
    limit: float | None = None,
    more: str = "",
) -> tuple[str, ...]:
    """A sentence on the turn that is known worst, and `more`, if its standard error is above a
    limit (rad; None: as the rules say); none where it is not, no turn is free, or one is not
    determined."""
    turns = np.flatnonzero([label.startswith("rotation") for label in labels])
    if not (turns.size and np.all(np.isfinite(part := covariance[np.ix_(turns, turns)]))):
        return ()
    values, vectors = np.linalg.eigh(part)
    limit = RULES.uncertain if limit is None else limit
    if not (sigma := float(np.sqrt(max(values[-1], 0.0)))) > limit:
        return ()
    axis, degrees = in_words(vectors[:, -1] @ axes_of(camera)), float(f"{np.rad2deg(sigma):.2g}")
    words = f"rotation about the axis {axis} is uncertain by {degrees:g} degrees (1 sigma)"
    return (words + more,)


def iou_and_rms(masks: Sequence[Sums]) -> tuple[float, float]:
    """Intersection over union, and root mean square of coverage minus target, of masks together."""
    total = lambda name: sum(float(getattr(mask, name)) for mask in masks)
    union, weight = total("union"), total("weight")
    iou = total("overlap") / union if union > 0 else 0.0
    return iou, (total("squares") / weight) ** 0.5 if weight > 0 else float("nan")


def share_astray(near: Sums, whole: Sums) -> float:
    """The share of the outline that is far from the mask's edge, by the sums near it and over the
    whole."""
    return 1 - float(near.touched) / float(whole.touched) if whole.touched else 0.0


def with_modes(fit: AnyFit, modes: Sequence[AnyFit]) -> AnyFit:
    """The fit with the other answers that explain what it was fitted to as well."""
    if modes and fit.status in ("converged", "rank_deficient", "unchecked", "uncertain"):
        fit = fit._replace(status="ambiguous")
    return fit._replace(modes=tuple(modes))


def without_free(triangle: np.ndarray, free: Sequence[Free]) -> np.ndarray:
    """Return R, blind to directions that are free all the way round."""
    for direction in free:
        if np.isinf(direction.ahead):
            unit = direction.move / np.linalg.norm(direction.move)
            triangle = triangle - np.outer(triangle @ unit, unit)
    return triangle


def widened(
    to_reported: np.ndarray,
    free: Sequence[Free],
    tolerance: float,
    already: np.ndarray | None = None,
) -> np.ndarray:
    """The addition to the reported parameters' covariance (n, n): the solver's `tolerance`
    (in its units), and intervals of directions that are free (all places in one as likely), but for
    what of them the covariance `already` has."""
    added = tolerance**2 * to_reported @ to_reported.T
    for direction in free:
        if np.isfinite(direction.ahead):
            along = to_reported @ direction.move
            a, b = direction.behind, direction.ahead
            variance = (a**3 + b**3) / (3 * (a + b))
            if already is not None and np.all(np.isfinite(already)):
                turn = along[:3]  # rotations are reported first
                variance -= turn @ already[:3, :3] @ turn / max(turn @ turn, 1e-150) ** 2
            added += max(variance, 0.0) * np.outer(along, along)
    return added


def without_ended(
    triangle: Any, camera: Camera, freed: tuple[str, ...], bounds: Bounds | None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return R without the columns of parameters that are held at an end of their bounds, and words
    about them."""
    result = np.array(triangle, float)
    ended = {} if bounds is None else bounds.ended(camera)
    moves = [PARAMETERS[label].components[0].name for label in ended]
    result[:, [components(freed).index(move) for move in moves]] = 0
    return result, held_words(ended)


def held_words(labels: Iterable[str]) -> tuple[str, ...]:
    """A sentence on each parameter that is held."""
    return tuple(f"{label} is held at an end of its bounds" for label in labels)


def to_units(derivative: Any, freed: tuple[str, ...], camera: Camera) -> np.ndarray:
    """Return the derivative of the reported parameters by the solver's moves.

    Film coordinates are in film heights inside the fit: the principal point's come back in px.
    """
    to_reported = np.array(derivative, float)
    to_reported[[LABELS[label].unit == "px" for label in labels_of(freed)]] *= camera.H
    return to_reported


def _status(
    triangle: np.ndarray, rest: bool, whole: Any, hidden: bool, explained: bool, blind: bool
) -> str:
    if not np.any(triangle):
        # As much as there is to cover: `union` counts a pixel by the larger of image and target.
        covered = whole.touched == 0 and whole.union >= (1 - 1e-6) * whole.weight
        return "no_overlap" if whole.overlap == 0 else "saturated" if covered else "rank_deficient"
    if whole.overlap < RULES.overlap * whole.union and not hidden:
        return "no_overlap"
    if not rest:
        return "max_steps"
    if not explained:
        return "misfit"
    return "rank_deficient" if blind else "converged"


def at_rest(
    triangle, along, squares: float, count: float, dtype: np.dtype, ended: bool = False
) -> bool:
    """True if `count` residuals, whose squares sum up to `squares`, have come to a minimum.

    MINPACK's test: the residual is orthogonal to every column of the Jacobian. Near the rounding
    floor the residual has no direction; there the Newton step must be negligible, and on it nothing
    is left to ask. Steps that `ended` by themselves stand still at a kink, where a pixel comes or
    goes: there the slope need not be as small.
    """
    columns = np.linalg.norm(triangle, axis=0)
    slope = np.abs(triangle.T @ along)
    cosine = np.max(slope / np.maximum(columns * np.sqrt(squares), 1e-300))
    newton = np.linalg.pinv(triangle, rcond=BLIND[dtype]) @ along
    floor = squares <= (FLOOR * np.finfo(dtype).eps) ** 2 * count
    limit = (1000 if ended else 100) * COSINE[dtype]
    still = cosine <= limit or UNIT_PX * np.max(np.abs(newton)) <= 10 * FINE_PX[dtype]
    return bool(floor or still)
