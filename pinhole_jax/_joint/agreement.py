"""Agreement of the views of one problem, and the error bars that it leaves.

The mask of a view errs, and so does its gradient g of the sum of squares, with the covariance G
that `outline_errors` reads from its outline. Where all views' squares are least, g' G^-1 g says how
far a view is from what the others say: chi-squared where nothing but the masks errs. Where it is
more, something errs that no outline shows: joint angles, meshes, transforms, the lens. Then the
covariance grows by as much (Birge 1932).

A view whose residuals are larger than most views' counts less (weights of Student's t): its mask is
worse, or its joint angles or transforms are wrong.

Views weighed by their G (Hansen's generalised moments, 1982) were tried in place of squares: on a
robot's ten masks the eye moved by 6 mm with where the descent began, and it was no nearer.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from .._fit.drift import sigma_of
from .._fit.result import gradients
from .._outline.outline_errors import OutlineErrors
from .._outline.statistics import err_alike, mask_errors
from .._outline.stretches import Blocks
from .._rules import RULES
from .._solver.least_squares import LinearSolution
from .._solver.parameters import components
from .._solver.problem import FINE_PX, UNIT_PX
from .._solver.solver import Solver
from .system import LEAST_DAMPING, Descent, JointProblem, Minimum, Part, ViewRows

#: Degrees of freedom of the t distribution of views' residuals: a few bad views count for little.
#: (With 1 a view 3 times as far off as the middle one has a fifth of the weight, one 10 times a
#: fiftieth.)
HEAVY = 1.0
#: Rounds of weights at most; those that change by a smaller share have settled.
ROUNDS, SETTLED = 16, 0.1
#: A view this many times farther off than is usual is named: it has less than 0.28 of the weight.
#: Exact masks are so narrow that this would show: one that the model does not match has none, nor
#: has another kind of mask among them.
OFF, NO_WEIGHT = 2.5, 1e-6
#: Of a normal distribution 95 % lie within this many standard deviations.
NORMAL_95 = 1.959964
#: How many times a residual's variance masks may err by, against priors.
DESIGNS = (1.0, 4.0, 16.0, 64.0, 256.0, 1024.0, 4096.0)
#: Coverage and residuals of pixels that are the same agree to the inverse of this.
LEVELS = 1 << 14
#: What of a covariance of gradients counts as nothing, beside its largest.
NOTHING = 1e-10
#: A parameter moves along a direction if by more than this share of the largest move.
HARDLY = 1e-6


@dataclass(frozen=True, eq=False)
class Agreement(Minimum):
    """Where the weighed views' squares are least (`problem.weights`, at most 1), and how well these
    agree.

    - `gradients`: the covariance of each view's J^T r.
    - `excess`: how many times as far apart the views are as their masks' errors say; at least 1.
    - `freedom`: how many numbers say so.
    - `off` (V,): each view's residuals beside the middle one's.
    - `errors`: how each mask's outline errs, None where it is exact, and explained.
    - `sigma` (V,): how surely each view disagrees with the others, as of one normal number.
    """

    gradients: list[np.ndarray]
    excess: float
    freedom: int
    off: np.ndarray
    errors: list[OutlineErrors | None]
    sigma: np.ndarray

    def without(self, view: int) -> "Agreement":
        """The agreement of the other views, and priors, by themselves."""
        weights = np.where(np.arange(len(self.off)) == view, 0.0, self.problem.weights)
        less = replace(self, problem=replace(self.problem, weights=weights))
        vars(less)["_pixels"] = self._pixels  # (They are the same, and take a while to compare.)
        return less

    def explains(self, k: int) -> bool:
        """True unless the mask of a view is exact, and the model does not match it."""
        solver, view = self.problem.eyes[k].solver, self.descent.seen[k].view
        matches = not solver.kind.exact or solver.kind.explains(view.touched_misfit, False)
        return matches and not err_alike(solver, view)

    @property
    def differs(self) -> bool:
        """Whether views surely differ by more than their masks' errors explain."""
        return sigma_of(self.excess**2 * self.freedom, self.freedom) > RULES.times

    @property
    def wider(self) -> float:
        """The factor by which variances grow: as much as the views are farther apart, and as that
        is read from few of them.

        It jumps where the excess passes 1, since few numbers do not tell 1 from 1.5: of intervals
        97 % hold where nothing but masks errs, 93 to 95 % where more does (86 to 90 % where one
        number alone says so). Of 2 to 6 numbers, widened by what is beyond 1 alone 91 to 94 % would
        hold, by Birge's factor 83 to 92 % (`experiments/intervals.py`).
        """
        if self.excess <= 1:
            return 1.0
        return (self.excess * width_by_few(1.0 * self.freedom)) ** 2

    def covariance_of(self, parts: Sequence[Part], independent: bool = False) -> np.ndarray:
        """The covariance (p, p) of the numbers by which unknowns are reported; infinite, with no
        covariances, where they move along directions that change no mask."""
        by_unknowns, place = self.problem.reports(parts, self.descent)
        errors = self.by_pixels if independent else self.by_masks
        result = by_unknowns @ errors.covariance(place) @ by_unknowns.T
        forget(result, by_unknowns @ self.unseen[place])
        return result

    @cached_property
    def unseen(self) -> np.ndarray:
        """Directions of the unknowns (size, d) that change no mask."""
        return self.solved.unseen()

    @cached_property
    def by_masks(self) -> "Sandwich":
        """What the masks' errors, and priors, leave (the sandwich of Huber 1967, a view at a
        time)."""
        views = zip(self.descent.seen, self.gradients, self.problem.weights, strict=True)
        of_views = [self.wider * w**2 * s.moves.T @ g @ s.moves for s, g, w in views]
        return self._sandwich(of_views, self._seen_again(of_views))

    @cached_property
    def by_pixels(self) -> "Sandwich":
        """The same were the residuals independent and of one variance."""
        total, eyes = self.descent.total, self.problem.eyes
        count = max(total("touched") - self.problem.size, 1)
        least = (eye.solver.kind.least for eye in eyes)
        variance = max(total("touched_squares") / count, *least)
        return self._sandwich([variance * p.rows.T @ p.rows for p in self.parts[: len(eyes)]])

    def _sandwich(self, of_views: list[np.ndarray], more: Sequence[Any] = ()) -> "Sandwich":
        of_all = *of_views, *(self.noise**2 * p.rows.T @ p.rows for p in self.prior_rows)
        errors = [*zip((p.columns for p in self.parts), of_all, strict=True), *more]
        return Sandwich(self.solved, errors)

    def _seen_again(self, of_views: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
        """The shared unknowns, and what the covariance of views' gradients by these lacks: what
        stands still before a camera that does shows the same pixels again, and their errors, too.

        That covariance G becomes W G W', as that of independent pixels becomes what it is where
        those that are the same err together.
        """
        if self._pixels is None:
            return []
        rows, view, same = self._pixels
        known = sum(x.T @ of_view @ x for x, of_view in zip(self._by_shared, of_views, strict=True))
        alone = self.problem.weights[view][:, None] * rows
        together = same.sum(alone)
        root = _root(alone.T @ alone)
        back = np.linalg.pinv(root)
        grown = root @ _root(back @ together.T @ together @ back) @ back
        return [(self.solved.shared, grown @ known @ grown.T - known)]

    @property
    def _by_shared(self) -> list[np.ndarray]:
        """The unknowns of each view (k,) by the shared ones (k, s): those that it has are these."""
        of_views = self.parts[: len(self.off)]
        return [(part.columns[:, None] == self.solved.shared) + 0.0 for part in of_views]

    @cached_property
    def _pixels(self) -> tuple[np.ndarray, np.ndarray, Blocks] | None:
        """The residuals' derivatives (P, s) by shared unknowns at all views' pixels, the view that
        each is of, and which are the same; None where no camera has several views."""
        cameras = [eye.shot.camera for eye in self.problem.eyes]
        if len({*cameras}) == len(cameras) or not len(self.solved.shared):
            return None
        keys, rows, view = [], [], []
        for k, (seen, own) in enumerate(zip(self.descent.seen, self._by_shared, strict=True)):
            pixels, window = seen.view.pixels, seen.view.level.window()
            row, column = np.divmod(pixels.cell, window.W + 2)
            camera = np.full(len(row), cameras.index(cameras[k]))
            # (All that are the same have the same bits: their geometry is.)
            values = np.round(LEVELS * np.array([pixels.coverage, pixels.residual]))
            keys.append(
                np.column_stack([camera, row + window.bottom, column + window.left, *values])
            )
            rows.append(pixels.jacobian @ seen.moves @ own)
            view.append(np.full(len(row), k))
        same = Blocks.alike(np.concatenate(keys))
        return np.concatenate(rows), np.concatenate(view), same


class Sandwich:
    """The unknowns' covariance by errors of the right-hand side: the covariance of each part's, and
    its columns.

    By those of the shared ones it is summed up once: a block's own unknowns follow these, and only
    the errors of its own views come to that. So the covariances of all blocks cost as much as there
    are views.
    """

    def __init__(self, solved: LinearSolution, errors: Iterable[tuple[np.ndarray, np.ndarray]]):
        self._solved, self._of_block = solved, defaultdict[int, Any](float)
        for columns, covariance in errors:
            root = solved.root(columns)
            self._of_block[int(np.max(solved.owner[columns]))] += root.T @ covariance @ root
        s = len(solved.shared)
        self._shared = sum(known[:s, :s] for known in self._of_block.values())

    def covariance(self, place: np.ndarray) -> np.ndarray:
        """The covariance (p, p) of some unknowns."""
        shared = self._solved.root(place, -1)
        result = shared @ self._shared @ shared.T
        owners = np.unique(self._solved.owner[place]).tolist()
        for block in (x for x in owners if x >= 0):
            whole, known = self._solved.root(place, block), self._of_block[block]
            s = shared.shape[1]
            result += whole @ known @ whole.T - shared @ known[:s, :s] @ shared.T
        return result


def _root(matrix: np.ndarray) -> np.ndarray:
    """The root of a symmetric matrix that has no negative values but by rounding."""
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T


def forget(covariance: np.ndarray, unseen: np.ndarray) -> None:
    """Put infinite variances, and no covariances, where numbers move along directions (p, d) that
    change no mask."""
    most = np.max(np.abs(unseen), axis=0, initial=0)
    lost = np.any(np.abs(unseen) > HARDLY * np.maximum(most, 1e-300), axis=1)
    covariance[lost, :] = covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf


def width_by_few(freedom: float) -> float:
    """The width of a 95 % interval where this many numbers show the variance (Student's t), in that
    of a normal distribution."""
    from scipy.stats import t

    return float(t.ppf(0.975, freedom)) / NORMAL_95


def agree(problem: JointProblem, found: Descent, px: float) -> Agreement:
    """The agreement of views where their weighed squares are least, from a descent's end on.

    Steps of `px` are negligible. Views that agree keep the problem's weights.
    """
    counts = problem.weights
    for _ in range(ROUNDS):
        here = _agreement(problem, found, counts)
        further = counts * np.minimum((HEAVY + 1) / (HEAVY + here.off**2), 1.0)
        exact = np.array([eye.solver.kind.exact for eye in problem.eyes])
        for k in np.flatnonzero(here.off > OFF).tolist():
            if not here.explains(k) or (not exact[k] and np.mean(exact) > 0.5):
                further[k] = min(further[k], NO_WEIGHT)
        if len(counts) < 3 or np.max(np.abs(np.log(further / problem.weights))) < SETTLED:
            return here
        problem = replace(problem, weights=further)
        most = problem.max_steps
        found = found.then(problem.descend(found.state, most, px, LEAST_DAMPING))
    return _agreement(problem, found, counts)


def weigh_priors(problem: JointProblem, found: Descent) -> JointProblem:
    """The problem whose priors are weighed against the masks so that they are known best: what errs
    along stretches, or all outwards, says less than its residuals do."""
    if not problem.priors:
        return problem
    spreads = []
    for design in DESIGNS:
        here = _agreement(replace(problem, design=design), found, problem.weights)
        here = replace(here, excess=1.0)  # (A prior that masks contradict drives views apart.)
        spread = sum(
            float(np.trace(p.rows @ here.by_masks.covariance(p.columns) @ p.rows.T))
            for p in here.prior_rows
        )
        spreads.append(spread / here.noise**2)
    return replace(problem, design=DESIGNS[int(np.argmin(spreads))])


def _agreement(problem: JointProblem, found: Descent, counts: np.ndarray) -> Agreement:
    """The agreement of weighed views; those that agree had the weights `counts`."""
    here, rows = Minimum(problem, found), []
    for eye, seen in zip(problem.eyes, found.seen, strict=True):
        errors = mask_errors(eye.solver, seen.view)
        gradient = _gradient(eye.solver, seen, errors)
        misfit = max(seen.view.touched_misfit, eye.solver.kind.least)
        felt = 1.0 if errors is None else errors.felt
        rows.append((errors, gradient, misfit, *_distance(eye.solver, seen, gradient * felt**2)))
    errors, gradients, misfits, squares, ranks = map(list, zip(*rows, strict=True))

    freedom = sum(ranks) + len(here.prior_rows) - problem.size
    of_priors = sum(part.squares for part in here.prior_rows) / here.noise**2
    apart = float(problem.weights @ np.array(squares)) + of_priors
    several = len(rows) > 1  # (One view has none that it could differ from.)
    misfit = np.array(misfits) * counts
    return Agreement(
        problem=problem,
        descent=found,
        gradients=gradients,
        excess=max(apart / max(freedom, 1), 1.0) ** 0.5 if several else 1.0,
        freedom=max(freedom, 1),
        off=(misfit / np.median(misfit)) ** 0.5,
        errors=errors,
        sigma=np.array([*map(sigma_of, squares, ranks)]),
    )


def _gradient(solver: Solver, seen: ViewRows, errors: OutlineErrors | None) -> np.ndarray:
    """The covariance (n, n) of J^T r in a view."""
    sums, triangle = seen.view.sums, seen.view.triangle
    noise = float(sums.touched_squares) / max(float(sums.touched) - len(triangle), 1)
    of_mask = gradients(seen.view, max(noise, solver.kind.least), solver.kind, errors)[1]
    # The last step was off by as much as is negligible.
    normal = FINE_PX[solver.dtype] / UNIT_PX * triangle.T @ triangle
    return of_mask + normal @ normal.T


def _distance(solver: Solver, seen: ViewRows, covariance: np.ndarray) -> tuple[float, int]:
    """A view's g' G^-1 g, its gradient by its own camera's moves, and the number of these.

    (What joints move is a few stretches of the outline, whose errors are not known well enough: a
    round flange that turns made views differ by 32 times what they err.)
    """
    own = len(components(solver.freed))
    covariance = covariance[:own, :own]
    triangle = seen.view.triangle[:, :own]
    size = np.linalg.norm(triangle, axis=0)
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    counted = values > NOTHING * max(values[-1], 1e-300)
    parts = vectors[:, counted].T @ (triangle.T @ seen.view.along / size)
    return float(np.sum(parts**2 / values[counted])), int(np.count_nonzero(counted))
